"""Fits of one model to many data sets or from many starts, in one compiled program.

On a CPU the program takes the fits of a chunk one after the other: each stays in the processor's cache, a fit that has
converged costs nothing more, and chunks run side by side, one a core. On a GPU all fits of a chunk go in lockstep.
Either way each is the same function of its data and start. (Lockstep on a CPU gains little, and two programs at once
can deadlock there: XLA splits large operations among the same threads.)

Fits with features that `minimize_traced` does not support are finished by `minimize`, like a single fit.
"""

from __future__ import annotations

import re
import threading
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from numpy.typing import NDArray

from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import Mesh
from switchfit.engine.choice import derivatives_inside_program, runs_natively
from switchfit.engine.native.experiment import places_in_library
from switchfit.fit.evaluator import Evaluator
from switchfit.fit.result import inverse_on
from switchfit.fit.solution import constraints_of, minimize_cost
from switchfit.fit.termination import Kink, Termination, termination_of
from switchfit.optimize import Status
from switchfit.optimize.qp import nearest_feasible
from switchfit.optimize.traced import Breakpoints, Constraints, Outcome, minimize_traced
from switchfit.problem.data import FloatArray
from switchfit.problem.functions import use_float64
from switchfit.problem.priors import PriorTerms
from switchfit.problem.problem import Problem
from switchfit.problem.structure import Structure
from switchfit.problem.variables import Variables
from switchfit.runtime.cache import use_compilation_cache

CHUNK = 64
"""Fits of a chunk on a CPU."""

CHUNK_IN_LOCKSTEP = 1024
"""The same on a GPU, where they go in lockstep."""

MOST_CHUNKS = 4
"""Chunks that one call takes at most on a CPU ..."""

MOST_BYTES = 2**24
"""... if the data of so many fits, and their Hessians, are not more than this."""

EVALUATIONS = 256
"""Evaluations in one call of the program; shorter calls are padded, which costs nothing."""

LONGEST_ERROR = 500
"""Characters of an error that are listed."""

UNDEFINED = (ValueError, ArithmeticError, np.linalg.LinAlgError)
"""What a model raises where it is undefined."""

RAISED = re.compile(r"\s*[\w.]+(Error|Exception): ")
"""The line of a traceback that names an exception."""


ONE_BY_ONE = (
    {"xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"} if jax.__version_info__ >= (0, 10) else {}
)
"""Options of XLA with which the operations of a program run one after another. They take a microsecond each; to hand
some of them to other threads takes an eighth of the time of all fits."""

compile_for_layout = partial(jax.jit, static_argnames=("layout",), compiler_options=ONE_BY_ONE)


class Varying(NamedTuple):
    """What differs from fit to fit, each with a leading axis: the leaves of all `Arguments`, in JAX's order.

    Attributes
    ----------
    places : tuple of int
        Which leaves.
    values : tuple of arrays, (R, ...) each
    """

    places: tuple[int, ...]
    values: tuple[Any, ...]


@dataclass(frozen=True)
class Layout:
    """What the compiled program depends on: structures, and where in theta each experiment's unknowns stand."""

    structures: tuple[Structure, ...]  # where machine code evaluates J, what their sequences have in common alone
    transitions: tuple[int, ...]
    places: tuple[tuple[int, ...], ...]  # of the N transition times and M parameters, -1 where fixed
    varying: tuple[int, ...]
    lockstep: bool
    natively: bool  # whether machine code evaluates J


class Limits(NamedTuple):
    """When a fit ends: arguments of the program, which serves other limits too."""

    tolerance: float
    max_iterations: int


class Unscaled(NamedTuple):
    """What is known about theta itself, in whose place the optimiser has variables of its own.

    Attributes
    ----------
    variables : Variables
    priors : PriorTerms
    lower, upper : (d,), bounds of theta
    """

    variables: Variables
    priors: PriorTerms
    lower: Any
    upper: Any

    def theta(self, z: Any) -> Any:
        """Return theta at z: (d,)."""
        return jnp.clip(self.variables.outward(z, jnp), self.lower, self.upper)


class Chunk(NamedTuple):
    """What was found, one entry a fit.

    Attributes
    ----------
    theta, cost, gradient, hessian : (R, d), (R,), (R, d), (R, d, d)
    optimality : (R,)
    iterations, evaluations : (R,) int
    status : (R,) str
        Name of the `Status`.
    message : (R,) str
        Empty where the status is CONVERGED without an active constraint; the error of a fit that ended with one.
    free : (R,) int
        Directions that constraints and kinks leave free; the covariance is of these.
    covariance : (R, d, d)
        ``Z (Z' H Z)^-1 Z'`` on the free directions Z, not yet scaled; NaN where it is not positive definite.
    """

    theta: FloatArray
    cost: FloatArray
    gradient: FloatArray
    hessian: FloatArray
    optimality: FloatArray
    iterations: NDArray[np.int64]
    evaluations: NDArray[np.int64]
    status: NDArray[np.str_]
    message: NDArray[np.str_]
    free: NDArray[np.int64]
    covariance: FloatArray


def uses_lockstep() -> bool:
    """Return whether fits go in lockstep: where JAX's default device is not a CPU."""
    return str(jax.default_backend()) != "cpu"


def choose_chunk_size(lockstep: bool | None = None) -> int:
    """Return how many fits are a chunk."""
    return CHUNK_IN_LOCKSTEP if (uses_lockstep() if lockstep is None else lockstep) else CHUNK


def count_chunks_together(problem: Problem, meshes: Sequence[Mesh], varying: Varying) -> int:
    """Return how many chunks one call of the program of a problem may take.

    Only one where machine code does not evaluate J: a function that calls back into Python may raise an error for one
    fit, which ends the program for all of its call.

    Parameters
    ----------
    problem : Problem
    meshes : one an experiment
    varying : Varying
        Of any number of fits.
    """
    own = sum(np.asarray(value)[0].nbytes for value in varying.values) + 8 * len(problem.theta_names) ** 2
    if own * MOST_CHUNKS * CHUNK > MOST_BYTES or uses_lockstep():
        return 1
    return MOST_CHUNKS if choose_layout(problem, Evaluator(problem, meshes=meshes)).natively else 1


def fit_chunk(
    problem: Problem,
    meshes: Sequence[Mesh],
    varying: Varying,
    starts: FloatArray,
    *,
    tolerance: float,
    max_iterations: int,
    room: int = 0,
    retry: bool = True,
    lockstep: bool | None = None,
) -> Chunk:
    """Fit a problem R times.

    The program of all fits has no trust region, and a step too long may lead one astray.

    Parameters
    ----------
    problem : Problem
    meshes : one an experiment, the same for all fits
    varying : Varying
        What replaces the problem's own numbers, R of each.
    starts : (R, d)
        Feasible.
    tolerance, max_iterations : as of `estimate`
    room : int
        Most fits of any call, if that is more than a chunk: one program takes them all.
    retry : bool
        Whether `minimize` begins anew at the start, with the iterations that are left, where a fit ended in no strict
        minimum; the lower cost counts. Of many starts for the same data, another one serves as well.
    lockstep : bool, optional
        Whether to run all fits in lockstep; decided by the device if left out.
    """
    again = starts if retry else None
    if problem.constraint_names or problem.unknowns.log_times.any():  # which the program does not know
        evaluator = Evaluator(problem, meshes=meshes)
        outcome = _leave_all(np.asarray(starts, dtype=float))
        return _finish_rest(problem, evaluator, varying, outcome, again, tolerance, max_iterations)
    unknowns = problem.unknowns
    lockstep = uses_lockstep() if lockstep is None else lockstep
    evaluator = Evaluator(problem, meshes=meshes)
    structures = evaluator.structures
    layout = replace(choose_layout(problem, evaluator, lockstep), varying=varying.places)
    count = len(starts)
    size = max(count, room, choose_chunk_size(lockstep))
    variables = unknowns.variables
    bounds = variables.inward(unknowns.lower), variables.inward(unknowns.upper)
    constraints = (unknowns.A, unknowns.b, *bounds, variables.sizes_inward(problem.sizes))
    with use_float64():
        given = (
            tuple(evaluator.arguments),
            tuple(_pad(value, size) for value in varying.values),
            tuple(experiment.initial_times_with_jumps for experiment in problem.experiments),
            read_sequences(layout, structures),
            Constraints(*map(jnp.asarray, constraints)),
            Unscaled(variables, unknowns.priors, unknowns.lower, unknowns.upper),
            # What it does not settle has as many iterations left for the optimiser that finishes it.
            Limits(float(tolerance), max_iterations // 2),
            _pad(variables.inward(np.asarray(starts)), size),
            count,
        )
        try:
            with _compile_once(layout, given):
                outcome = jax.tree.map(lambda a: np.asarray(a)[:count], _minimize_fits(*given, layout=layout))
        except Exception as error:
            # A function of the model that calls back into Python may raise for one fit and ends the whole program: the
            # fits are then done one by one, and that one is listed. Any other error is a defect of the program.
            if not _is_raised_in_callback(error):
                warnings.warn(_NO_PROGRAM.format(error=describe_error(error)), RuntimeWarning, stacklevel=2)
            outcome = _leave_all(np.asarray(starts, dtype=float))
    return _finish_rest(problem, evaluator, varying, outcome, again, tolerance, max_iterations)


def give_data(evaluator: Evaluator, base: tuple[Arguments, ...], varying: Varying, k: int) -> None:
    """Replace the data of an evaluator by those of the k-th fit; `base` are the arguments of the problem itself."""
    with use_float64():
        values = [jnp.asarray(value[k]) for value in varying.values]
        evaluator.replace_arguments(replace_leaves(base, varying.places, values))


def replace_leaves(
    arguments: Sequence[Arguments], places: tuple[int, ...], values: Sequence[Any]
) -> tuple[Arguments, ...]:
    """Return the arguments of all experiments with some of their leaves replaced."""
    leaves, tree = jax.tree.flatten(tuple(arguments))
    for place, value in zip(places, values, strict=True):
        leaves[place] = value
    return tuple(jax.tree.unflatten(tree, leaves))


class Evaluations:
    """Cost, gradient and Hessian of any fits of a call with their own data, many at a time.

    Parameters
    ----------
    problem : Problem
    meshes : one an experiment
    varying : Varying
    room : int
        As of `fit_chunk`.

    Attributes
    ----------
    quick : bool
        Whether machine code evaluates them, in one program; otherwise they are evaluated one by one.
    """

    def __init__(self, problem: Problem, meshes: Sequence[Mesh], varying: Varying, room: int = 0) -> None:
        self.problem, self.varying, self.room = problem, varying, max(room, CHUNK)
        self.evaluator = Evaluator(problem, meshes=meshes)
        self.base = tuple(self.evaluator.arguments)
        self.layout = replace(choose_layout(problem, self.evaluator), varying=varying.places)
        self.quick = self.layout.natively

    def __call__(
        self, fits: NDArray[np.intp], thetas: FloatArray, sides: NDArray[np.int64]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return costs (n,), gradients (n, d) and Hessians (n, d, d) at thetas (n, d), to one side (n,) of breakpoints.

        `fits` (n,) says whose data are taken. NaN where the model is undefined.
        """
        if not self.quick:
            n, d = thetas.shape
            J, g, H = np.full(n, np.nan), np.full((n, d), np.nan), np.full((n, d, d), np.nan)
            for s, (k, theta, side) in enumerate(zip(fits.tolist(), thetas, sides.tolist(), strict=True)):
                give_data(self.evaluator, self.base, self.varying, k)
                with suppress(*UNDEFINED):
                    found = self.evaluator(theta, side)
                    J[s], g[s], H[s] = found.cost, found.gradient, found.hessian
            return J, g, H
        parts = [
            self._run(
                fits[first : first + EVALUATIONS], thetas[first : first + EVALUATIONS], sides[first:][:EVALUATIONS]
            )
            for first in range(0, len(fits), EVALUATIONS)
        ]
        J, g, H = (np.concatenate(column) for column in zip(*parts, strict=True))
        return J, g, H

    def _run(self, fits: Any, thetas: FloatArray, sides: Any) -> tuple[FloatArray, ...]:
        problem, layout = self.problem, self.layout
        with use_float64():
            given = (
                self.base,
                self._values,
                tuple(experiment.initial_times_with_jumps for experiment in problem.experiments),
                read_sequences(layout, self.evaluator.structures),
                problem.unknowns.priors,
                *(_pad(each, EVALUATIONS) for each in (fits, thetas, np.asarray(sides, dtype=float))),
                len(fits),
            )
            with _compile_once(layout, given):
                found = _evaluate_fits(*given, layout=layout)
        return tuple(np.asarray(each)[: len(fits)] for each in found)

    @cached_property
    def _values(self) -> tuple[jax.Array, ...]:
        """Return the data of all fits as arrays of JAX, which otherwise copies them in each call of the program."""
        return tuple(jnp.asarray(_pad(value, self.room)) for value in self.varying.values)


@compile_for_layout
def _evaluate_fits(
    arguments: tuple[Arguments, ...],
    values: tuple[jax.Array, ...],
    times: tuple[jax.Array, ...],
    sequences: tuple[dict[str, jax.Array], ...],
    priors: PriorTerms,
    fits: jax.Array,
    thetas: jax.Array,
    sides: jax.Array,
    count: jax.Array,
    *,
    layout: Layout,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return cost, gradient and Hessian of the first `count` fits at their thetas."""
    n, d = thetas.shape

    def one(s: jax.Array, found: tuple[jax.Array, jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array, jax.Array]:
        here = replace_leaves(arguments, layout.varying, [value[fits[s]] for value in values])
        J, g, H = evaluate_total(layout, here, times, sequences, thetas[s], sides[s])
        prior, prior_g, prior_h = priors.evaluate(thetas[s], jnp)
        new = J + prior, g + prior_g, H + jnp.diag(prior_h)
        return tuple(all_.at[s].set(each) for all_, each in zip(found, new, strict=True))  # type: ignore[return-value]

    empty = jnp.zeros(n), jnp.zeros((n, d)), jnp.zeros((n, d, d))
    return lax.fori_loop(0, count, one, empty)


_known: set[Any] = set()
_lock = threading.Lock()


@contextmanager
def _compile_once(layout: Layout, given: Any) -> Iterator[None]:
    """Compile the program in the first call that needs it, using the compilation cache; other threads wait."""
    key = (layout, tuple(np.shape(leaf) for leaf in jax.tree.leaves(given)))
    with _lock:
        if key not in _known:
            with use_compilation_cache():
                yield
            _known.add(key)
            return
    yield


def _pad(values: Any, size: int) -> FloatArray:
    """Repeat the last of `values` (R, ...) up to `size`: the number of fits must not shape the program."""
    array = np.asarray(values)
    return np.concatenate([array, np.repeat(array[-1:], size - len(array), axis=0)]) if len(array) < size else array


@compile_for_layout
def _minimize_fits(
    arguments: tuple[Arguments, ...],
    values: tuple[jax.Array, ...],
    times: tuple[jax.Array, ...],
    sequences: tuple[dict[str, jax.Array], ...],
    constraints: Constraints,
    unscaled: Unscaled,
    limits: Limits,
    starts: jax.Array,
    count: jax.Array,
    *,
    layout: Layout,
) -> Outcome:
    """Return the outcomes of the first `count` fits."""

    def build_functions(own: tuple[jax.Array, ...]) -> tuple[Any, Breakpoints]:
        """Return the function `evaluate` and the breakpoints of the fit with these data, for `minimize_traced`."""
        here = replace_leaves(arguments, layout.varying, own)

        def evaluate(z: jax.Array, side: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            theta = unscaled.theta(z)
            J, g, H = evaluate_total(layout, here, times, sequences, theta, side)
            prior, prior_g, prior_h = unscaled.priors.evaluate(theta, jnp)
            given = unscaled.variables.derivatives_inward(theta, g + prior_g, H + jnp.diag(prior_h), jnp)
            return J + prior, *given

        return evaluate, _list_breakpoints(layout, here)

    def convert(found: Outcome) -> Outcome:
        theta = unscaled.theta(found.theta)
        left = unscaled.variables.derivatives_outward(theta, found.left, found.hessian, jnp)[0]
        gradient, hessian = unscaled.variables.derivatives_outward(theta, found.gradient, found.hessian, jnp)
        return found._replace(theta=theta, gradient=gradient, hessian=hessian, left=left)

    def fit(own: tuple[jax.Array, ...], start: jax.Array) -> Outcome:
        evaluate, breakpoints = build_functions(own)
        return convert(minimize_traced(evaluate, start, constraints, breakpoints, **limits._asdict()))

    if layout.lockstep:
        return jax.vmap(fit)(values, starts)
    empty = Outcome.zeros(*starts.shape)

    def one(k: jax.Array, outcomes: Outcome) -> Outcome:
        outcome = fit(tuple(value[k] for value in values), starts[k])
        return jax.tree.map(lambda all_, new: all_.at[k].set(new), outcomes, outcome)

    return lax.fori_loop(0, count, one, empty)


def choose_layout(problem: Problem, evaluator: Evaluator, lockstep: bool | None = None) -> Layout:
    """Return the layout of a program that evaluates a problem on given meshes, with its own numbers.

    Parameters
    ----------
    problem : Problem
    evaluator : Evaluator
        With the meshes.
    lockstep : bool, optional
        Decided by the device if left out.
    """
    structures = evaluator.structures
    lockstep = uses_lockstep() if lockstep is None else lockstep
    natively = not lockstep and problem.engine != "jax" and runs_natively(structures, evaluator.arguments)
    return Layout(
        tuple(structure.library for structure in structures) if natively else structures,
        tuple(structure.N for structure in structures),
        tuple(tuple(int(k) for k in places) for places in problem.places),
        varying=(),
        lockstep=lockstep,
        natively=natively,
    )


def read_sequences(layout: Layout, structures: Sequence[Structure]) -> tuple[dict[str, NDArray[np.int64]], ...]:
    """Return what machine code reads at run time of the sequence of modes of each experiment; JAX is written for it."""
    if not layout.natively:
        return tuple({} for _ in structures)
    return tuple(places_in_library(structure) for structure in structures)


def _list_breakpoints(layout: Layout, arguments: tuple[Arguments, ...]) -> Breakpoints:
    """Return the nodes of each free transition time; these are not scaled."""
    nodes = {
        place: own.nodes
        for own, N, places in zip(arguments, layout.transitions, layout.places, strict=True)
        for place in places[:N]
        if place >= 0
    }
    if not nodes:
        return Breakpoints((), jnp.zeros((0, 1)))
    longest = max(len(a) for a in nodes.values())
    padded = [jnp.pad(a, (0, longest - len(a)), constant_values=jnp.inf) for a in nodes.values()]
    return Breakpoints(tuple(nodes), jnp.stack(padded))


def evaluate_total(
    layout: Layout,
    arguments: tuple[Arguments, ...],
    times: tuple[jax.Array, ...],
    sequences: tuple[dict[str, jax.Array], ...],
    theta: jax.Array,
    side: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the cost, gradient and Hessian of all experiments together.

    Those that share a structure and all lengths are taken in a loop, so that the program does not grow with them.
    """
    d = theta.shape[0]
    J, g, H = jnp.zeros(()), jnp.zeros(d), jnp.zeros((d, d))
    extended = jnp.append(theta, 0.0)
    for group in _group_experiments(layout, arguments, sequences):
        structure, N = layout.structures[group[0]], layout.transitions[group[0]]
        where = np.array([layout.places[e] for e in group])
        where = np.where(where < 0, d, where)  # what is fixed stands one past the last, and is dropped below
        fixed = jnp.stack([times[e] for e in group])
        tau = jnp.where(where[:, :N] < d, extended[where[:, :N]], fixed)
        given = jax.tree.map(lambda *leaves: jnp.stack(leaves), *((arguments[e], sequences[e]) for e in group))

        def one(
            given: tuple[tuple[Arguments, dict[str, jax.Array]], jax.Array, jax.Array],
            structure: Structure = structure,
        ) -> tuple[jax.Array, jax.Array, jax.Array]:
            (own, sequence), tau, p = given
            found: tuple[jax.Array, jax.Array, jax.Array] = derivatives_inside_program(
                structure, own, tau, p, side, natively=layout.natively, places=sequence or None
            )
            return found

        operands = (given, tau, extended[where[:, N:]])
        if len(group) == 1:
            J_e, g_e, H_e = (value[None] for value in one(jax.tree.map(lambda leaf: leaf[0], operands)))
        else:
            J_e, g_e, H_e = jax.vmap(one)(operands) if layout.lockstep else lax.map(one, operands)
        J = J + J_e.sum()
        g = g.at[where].add(g_e, mode="drop")
        H = H.at[where[:, :, None], where[:, None, :]].add(H_e, mode="drop")
    return J, g, H


def _group_experiments(
    layout: Layout, arguments: tuple[Arguments, ...], sequences: Sequence[Mapping[str, Any]]
) -> list[list[int]]:
    """Return groups of experiments with the same structure and array shapes, which one loop can evaluate."""
    groups: dict[Any, list[int]] = {}
    given = zip(layout.structures, layout.transitions, arguments, sequences, strict=True)
    for e, (structure, N, own, sequence) in enumerate(given):
        shapes = tuple(np.shape(leaf) for leaf in jax.tree.leaves(own))
        groups.setdefault((structure, N, shapes, tuple(sorted(sequence))), []).append(e)
    return list(groups.values())


_NO_PROGRAM = (
    "The compiled program of many fits failed ({error}); they are done one by one, which takes much longer. This is an "
    "error in switchfit itself: please report it."
)


def _is_raised_in_callback(error: BaseException) -> bool:
    """Return whether a function that a program calls in Python raised it: JAX raises a ValueError or a JaxRuntimeError
    of its own, with the traceback in its text.
    """
    return "error calling callback" in str(error)


def describe_failure(error: BaseException) -> str:
    """Return the message of a fit that ended with an error, on one line."""
    return str(Termination.of_error(describe_error(error)))


def describe_error(error: BaseException) -> str:
    """Return kind and text of an error on one line; of an error in a callback, those of the original error."""
    text = str(error)
    if "Traceback" in text:  # as JAX hands on what a callback raised: its last line says what it was
        raised = [line.strip() for line in text.splitlines() if RAISED.match(line)]
        text = raised[-1] if raised else text
    else:
        text = f"{type(error).__name__}: {text}"
    return " ".join(text.split())[:LONGEST_ERROR]


def mark_failed(chunk: Chunk, errors: Mapping[int, BaseException]) -> Chunk:
    """Return the chunk with some of its fits marked as failed: those whose data could not be made.

    Parameters
    ----------
    chunk : Chunk
    errors : mapping of int to exception
        By the place of the fit in the chunk.
    """
    found = {name: np.array(value) for name, value in chunk._asdict().items()}
    found["message"] = found["message"].astype(object)
    found["status"] = found["status"].astype(object)
    for k, error in errors.items():
        found["status"][k], found["message"][k] = Status.ERROR.name, describe_failure(error)
        for name in ("theta", "cost", "gradient", "hessian", "optimality", "covariance"):
            found[name][k] = np.nan
        for name in ("iterations", "evaluations", "free"):
            found[name][k] = 0
    return Chunk(**found | {name: found[name].astype(str) for name in ("status", "message")})


def make_failed_chunk(starts: FloatArray, errors: Mapping[int, BaseException]) -> Chunk:
    """Return a chunk in which all fits have failed before they began; starts (R, d) are its theta."""
    R, d = starts.shape
    nothing, none, blank = np.full(R, np.nan), np.zeros(R, dtype=int), np.full(R, "", dtype=object)
    square = np.full((R, d, d), np.nan)
    return mark_failed(
        Chunk(starts.copy(), nothing, np.full((R, d), np.nan), square, nothing, none, none, blank, blank, none, square),
        errors,
    )


def _leave_all(starts: FloatArray) -> Outcome:
    """Return unsettled outcomes at the starts (R, d): `minimize` then does all of these fits."""
    R, d = starts.shape
    nothing, none, no = np.full(R, np.nan), np.zeros(R, dtype=int), np.zeros(R, dtype=bool)
    slopes, square = np.full((R, d), np.nan), np.full((R, d, d), np.nan)
    held = np.zeros((R, d), dtype=bool)
    return Outcome(starts, nothing, slopes, square, nothing, none, none, no, slopes, held)  # type: ignore[arg-type]  # NumPy's


def _describe_kink(problem: Problem, outcome: Outcome, k: int, tolerance: float) -> Termination:
    """Return the termination of fit k, which ended at kinks."""
    names, theta = problem.unknowns.names, outcome.theta[k]
    kinks = tuple(
        Kink(names[i], float(theta[i]), float(outcome.left[k, i]), float(outcome.gradient[k, i]))
        for i in np.flatnonzero(outcome.held[k])
    )
    return Termination(
        Status.CONVERGED_AT_KINK,
        cost=float(outcome.cost[k]),
        optimality=float(outcome.optimality[k]),
        tolerance=tolerance,
        iterations=int(outcome.iterations[k]),
        kinks=kinks,
    )


def _finish_rest(
    problem: Problem,
    evaluator: Evaluator,
    varying: Varying,
    outcome: Outcome,
    starts: FloatArray | None,
    tolerance: float,
    max_iterations: int,
) -> Chunk:
    """Return the outcomes as a chunk; fits that did not settle are finished by `minimize`, one by one.

    What then ends in no strict minimum is fitted from its start as well, unless `starts` is None.
    """
    R, d = outcome.theta.shape
    found = {name: np.array(getattr(outcome, name)) for name in Outcome._fields[:7]}
    status = np.full(R, Status.CONVERGED.name, dtype=object)
    message = np.full(R, "", dtype=object)
    free = np.full(R, d)
    covariance = np.full((R, d, d), np.nan)
    settled = np.asarray(outcome.settled)
    base = tuple(evaluator.arguments)
    if settled.any():
        held = np.asarray(outcome.held)[settled]
        either = held[:, :, None] | held[:, None, :]
        covariance[settled] = np.linalg.inv(np.where(either, np.eye(d), found["hessian"][settled])) * ~either
        free[settled] -= held.sum(axis=1)
    for k in np.flatnonzero(settled & np.asarray(outcome.held).any(axis=1)):
        status[k], message[k] = Status.CONVERGED_AT_KINK.name, str(_describe_kink(problem, outcome, int(k), tolerance))
    constraints = constraints_of(problem)
    for k in np.flatnonzero(~settled):
        try:
            give_data(evaluator, base, varying, int(k))
            left = max_iterations - int(found["iterations"][k])
            start = nearest_feasible(constraints, found["theta"][k])
            results = [minimize_cost(evaluator, start, "exact", tolerance, left, constraints=constraints)]
            left -= results[0].iterations
            strayed = found["iterations"][k] > 0 and not results[0].status.is_strict_minimum
            if starts is not None and strayed and left > 0:
                results.append(minimize_cost(evaluator, starts[k], "exact", tolerance, left, constraints=constraints))
        except Exception as error:  # of any kind: the other fits go on
            status[k], message[k] = Status.ERROR.name, describe_failure(error)
            free[k] = 0
            continue
        result = min(results, key=lambda one: np.nan_to_num(one.cost, nan=np.inf))
        for name in ("theta", "cost", "gradient", "hessian", "optimality"):
            found[name][k] = getattr(result, name)
        for name in ("iterations", "evaluations"):
            found[name][k] += sum(getattr(one, name) for one in results)
        result = replace(result, iterations=int(found["iterations"][k]))
        status[k] = result.status.name
        message[k] = str(termination_of(result, problem))
        free[k] = result.free_basis.shape[1]
        covariance[k] = inverse_on(result.free_basis, result.hessian)
    return Chunk(**found, status=status.astype(str), message=message.astype(str), free=free, covariance=covariance)
