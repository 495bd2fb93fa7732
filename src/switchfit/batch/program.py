"""Fits of one model to many data sets or from many starts, in one compiled program.

On a CPU the program takes the fits of a chunk one after the other: each stays in the processor's cache, a fit that has
converged costs nothing more, and chunks run side by side, one a core: with a GPU too, which is no faster than 16 cores
with machine code. What only JAX evaluates goes there, all fits of a chunk in lockstep.
Either way each is the same function of its data and start. (Lockstep on a CPU gains little, and two programs at once
can deadlock there: XLA splits large operations among the same threads.)

What it does not settle, and fits with features that `minimize_traced` does not support, are done by `minimize`, like a
single fit.

What the compiled programs of many fits are written for, and the cost of a problem inside them.

A program serves all problems with the same `Layout`: their numbers are its arguments, those that differ from fit to fit
(`Varying`) with a leading axis.
"""

from __future__ import annotations

import re
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import Mesh
from switchfit.engine.choice import derivatives_inside_program, runs_natively
from switchfit.engine.corners.branches import has_corners
from switchfit.engine.native.library_places import places_in_library
from switchfit.estimation.estimator import Estimate
from switchfit.fit.accuracy import Follower
from switchfit.fit.evaluator import Evaluator, evaluator_of
from switchfit.fit.result import Fit, Kink, Termination, free_kinks, inverse_on, list_kinks, termination_of
from switchfit.fit.solution import minimize_cost
from switchfit.optimize import Result, Status
from switchfit.optimize.traced_constraints import TracedBreakpoints, TracedConstraints
from switchfit.optimize.traced_sqp import minimize_traced
from switchfit.optimize.traced_state import Outcome, TracedProblem
from switchfit.problem.functions import use_float64
from switchfit.problem.priors import PriorTerms
from switchfit.problem.problem import Problem
from switchfit.problem.structure import Structure
from switchfit.problem.variables import Variables
from switchfit.runtime.cache import use_compilation_cache
from switchfit.runtime.issue import Issue
from switchfit.uncertainty.walks import Derivatives

CHUNK = 128
"""Fits of a chunk on a CPU: 20,000 fits of a short log took 6.9 s of the processor, with 64 in a chunk 8.6 s."""

CHUNK_IN_LOCKSTEP = 4096
"""The same in lockstep on a GPU: 8192 fits of the vehicle take 1.3 times as long as 1024, and 13 GB."""

ONE_BY_ONE = (
    {"xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"} if jax.__version_info__ >= (0, 10) else {}
)
"""Options of XLA with which the operations of a program run one after another. They take a microsecond each; to hand
some of them to other threads takes an eighth of the time of all fits."""

compile_for_layout = partial(jax.jit, static_argnames=("layout",), compiler_options=ONE_BY_ONE)

Varying = Mapping[int, Any]
"""What differs from fit to fit: values (R, ...) of leaves of all `Arguments`, by their places in JAX's order."""

_known: set[Any] = set()
_lock, _gpu = threading.Lock(), threading.Lock()

EVALUATIONS = 256
"""Evaluations in one call of the program; shorter calls are padded, which costs nothing."""

UNDEFINED = (ValueError, ArithmeticError, np.linalg.LinAlgError)
"""What a model raises where it is undefined."""

LONGEST_ERROR = 500
"""Characters of an error that are listed."""

RAISED = re.compile(r"\s*[\w.]+(Error|Exception): ")
"""The line of a traceback that names an exception."""

_NO_PROGRAM = (
    "The compiled program of many fits failed ({error}); they are done one by one, which takes much longer. This is an "
    "error in switchfit itself: please report it."
)


@dataclass(frozen=True)
class Layout:
    """What the compiled program depends on: structures, and where in theta each experiment's unknowns stand."""

    structures: tuple[Structure, ...]  # where machine code evaluates J, what their sequences have in common alone
    places: tuple[tuple[int, ...], ...]  # of the N transition times and M parameters, -1 where fixed
    varying: tuple[int, ...]
    lockstep: bool
    natively: bool  # whether machine code evaluates J

    @property
    def size(self) -> int:
        """Fits in a call of the program."""
        return CHUNK_IN_LOCKSTEP if self.lockstep else CHUNK


def has_gpu() -> bool:
    """Return whether JAX's default device is not a CPU."""
    return str(jax.default_backend()) != "cpu"


def choose_chunk_size(problem: Problem) -> int:
    """Return how many fits of a problem are a chunk."""
    return choose_layout(evaluator_of(problem)).size if has_gpu() else CHUNK


def choose_layout(evaluator: Evaluator, varying: tuple[int, ...] = ()) -> Layout:
    """Return the layout of a program that evaluates a problem on given meshes, with its own numbers.

    Parameters
    ----------
    evaluator : Evaluator
        With the problem and the meshes.
    varying : tuple of int
        Leaves of the arguments that differ from fit to fit.
    """
    problem, structures = evaluator.problem, evaluator.structures
    natively = problem.engine != "jax" and runs_natively(structures, evaluator.arguments)
    return Layout(
        tuple(structure.library for structure in structures) if natively else structures,
        tuple(tuple(int(k) for k in places) for places in problem.places),
        varying=varying,
        lockstep=not natively and has_gpu(),
        natively=natively,
    )


class Inputs(NamedTuple):
    """What a program is given beside its fits.

    Attributes
    ----------
    arguments : tuple of Arguments
        Of the problem itself, one an experiment.
    times : tuple of arrays
        First guesses of all transition times of each experiment, in whose place those in theta stand.
    sequences : tuple of dict
        What machine code reads at run time of the sequence of modes of each experiment; JAX is written for it.
    priors : PriorTerms
    variables : Variables
        Those that the optimiser has in place of theta.
    lower, upper : (d,), bounds of theta
    constraints : Constraints
        On the variables.
    """

    arguments: tuple[Arguments, ...]
    times: tuple[Any, ...]
    sequences: tuple[dict[str, Any], ...]
    priors: PriorTerms
    variables: Variables
    lower: Any
    upper: Any
    constraints: TracedConstraints

    @classmethod
    def of(cls, evaluator: Evaluator, layout: Layout) -> Inputs:
        """Return those of a problem on the meshes of an evaluator."""
        problem, unknowns = evaluator.problem, evaluator.problem.unknowns
        variables = unknowns.variables
        times = tuple(experiment.initial_times_with_jumps for experiment in problem.experiments)
        sequences = tuple(places_in_library(each) if layout.natively else {} for each in evaluator.structures)
        limits: list[Any] = [variables.inward(unknowns.lower), variables.inward(unknowns.upper)]
        rows: list[Any] = [unknowns.A, unknowns.b, *limits, variables.sizes_inward(problem.sizes)]
        of_theta = unknowns.priors, variables, unknowns.lower, unknowns.upper
        return cls(tuple(evaluator.arguments), times, sequences, *of_theta, TracedConstraints(*rows))

    def find_theta(self, z: Any) -> Any:
        """Return theta (d,) at z, the variables of the optimiser."""
        return jnp.clip(self.variables.outward(z, jnp), self.lower, self.upper)

    def evaluate(self, layout: Layout, own: Sequence[Any], theta: Any, side: Any) -> tuple[Any, Any, Any]:
        """Return cost, gradient and Hessian of a fit with its own data, inside a program.

        Experiments that share a structure and all lengths are taken in a loop, so that the program does not grow with
        them.
        """
        arguments, d = replace_leaves(self.arguments, layout.varying, own), theta.shape[0]
        J, g, curvature = self.priors.evaluate(theta, jnp)
        H, extended = jnp.diag(curvature), jnp.append(theta, 0.0)
        for group in _group_experiments(layout, arguments, self):
            structure, N = layout.structures[group[0]], len(self.times[group[0]])
            where = np.array([layout.places[e] for e in group])
            where = np.where(where < 0, d, where)  # what is fixed stands one past the last, and is dropped below
            fixed = jnp.stack([self.times[e] for e in group])
            tau = jnp.where(where[:, :N] < d, extended[where[:, :N]], fixed)
            given = jax.tree.map(lambda *leaves: jnp.stack(leaves), *((arguments[e], self.sequences[e]) for e in group))

            def one(given: Any, structure: Structure = structure) -> tuple[jax.Array, jax.Array, jax.Array]:
                (own, sequence), tau, p = given
                return derivatives_inside_program(structure, own, tau, p, side, sequence)

            operands = (given, tau, extended[where[:, N:]])
            if len(group) == 1:
                J_e, g_e, H_e = (value[None] for value in one(jax.tree.map(lambda leaf: leaf[0], operands)))
            else:
                J_e, g_e, H_e = jax.vmap(one)(operands) if layout.lockstep else lax.map(one, operands)
            J = J + J_e.sum()
            g = g.at[where].add(g_e, mode="drop")
            H = H.at[where[:, :, None], where[:, None, :]].add(H_e, mode="drop")
        return J, g, H


def replace_leaves(
    arguments: Sequence[Arguments], places: Iterable[int], values: Sequence[Any]
) -> tuple[Arguments, ...]:
    """Return the arguments of all experiments with some of their leaves replaced."""
    leaves, tree = jax.tree.flatten(tuple(arguments))
    for place, value in zip(places, values, strict=True):
        leaves[place] = value
    return tuple(jax.tree.unflatten(tree, leaves))


def _group_experiments(layout: Layout, arguments: tuple[Arguments, ...], inputs: Inputs) -> list[list[int]]:
    """Return groups of experiments with the same structure and array shapes, which one loop can evaluate."""
    groups: dict[Any, list[int]] = {}
    for e, (structure, *own) in enumerate(
        zip(layout.structures, arguments, inputs.times, inputs.sequences, strict=True)
    ):
        leaves, tree = jax.tree.flatten(own)
        groups.setdefault((structure, tree, tuple(map(np.shape, leaves))), []).append(e)
    return list(groups.values())


@contextmanager
def compile_once(layout: Layout, given: Any) -> Iterator[None]:
    """Compile the program in the first call that needs it, using the compilation cache; other threads wait."""
    key = (layout, tuple(np.shape(leaf) for leaf in jax.tree.leaves(given)))
    with _lock:
        if key not in _known:
            with use_compilation_cache():
                yield
            _known.add(key)
            return
    yield


def pad_fits(values: Any, size: int) -> FloatArray:
    """Repeat the last of `values` (R, ...) up to `size`: the number of fits must not shape the program."""
    array = np.asarray(values)
    return np.concatenate([array, np.repeat(array[-1:], size - len(array), axis=0)]) if len(array) < size else array


class Limits(NamedTuple):
    """When a fit ends: arguments of the program, which serves other limits too."""

    tolerance: float
    max_iterations: int


@dataclass(frozen=True, eq=False)
class Ends:
    """Where R fits ended, one entry a fit.

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
        Directions that constraints and kinks leave free.
    kinks : (R, d, 2)
        Derivatives of J to the left and right of an unknown that ended at a kink; 0 for others.
    covariance : (R, d, d)
        ``Z (Z' H Z)^-1 Z'`` on the free directions Z, later with those at kinks, not yet scaled; NaN where it is not
        positive definite.
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
    kinks: FloatArray
    covariance: FloatArray

    @property
    def at_kink(self) -> NDArray[np.bool_]:
        """Which unknowns ended at a kink: (R, d)."""
        return self.kinks[:, :, 0] < self.kinks[:, :, 1]


class Chunk(Ends):
    """Ends to be written to: a fit that is done again replaces what was found before. Text is in arrays of objects."""

    @classmethod
    def of(cls, outcome: Outcome) -> Chunk:
        """Return the outcomes of R fits as if all of them had converged, without covariances."""
        found = {name: np.array(getattr(outcome, name)) for name in Outcome._fields[:7]}
        R, d = outcome.theta.shape
        texts: list[NDArray[Any]] = [np.full(R, text, dtype=object) for text in (Status.CONVERGED.name, "")]
        unknown, kinks = np.full((R, d, d), np.nan), np.zeros((R, d, 2))
        return cls(**found, status=texts[0], message=texts[1], free=np.full(R, d), kinks=kinks, covariance=unknown)

    def replace_fit(self, k: int, found: Result | Fit, kinks: Sequence[tuple[int, float, float]], message: str) -> None:
        """Replace the k-th fit by another one, with its kinks; iterations and evaluations of both are added."""
        for name in ("theta", "cost", "gradient", "hessian", "optimality"):
            getattr(self, name)[k] = getattr(found, name)
        self.iterations[k] += found.iterations
        self.evaluations[k] += found.evaluations
        self.status[k], self.message[k] = found.status.name, message
        self.free[k] = found.free_basis.shape[1]
        self.covariance[k] = inverse_on(found.free_basis, found.hessian)
        self.kinks[k] = 0.0
        for place, left, right in kinks:
            self.kinks[k, place] = left, right

    def free_kinks(self, k: int, scale: float) -> None:
        """Let the unknowns at kinks of the k-th fit have variances; `scale`: that of its covariance."""
        kinks = [(place, *self.kinks[k, place].tolist()) for place in np.flatnonzero(self.at_kink[k]).tolist()]
        self.covariance[k] = free_kinks(self.covariance[k], self.hessian[k], kinks, scale)

    def set_error(self, k: int, error: BaseException) -> None:
        """Say that the k-th fit ended with an error."""
        self.status[k], self.message[k] = Status.ERROR.name, describe_failure(error)

    def clear_fit(self, k: int, error: BaseException) -> None:
        """Leave nothing of the k-th fit but the error with which it failed before it began."""
        for array in vars(self).values():
            array[k] = np.nan if array.dtype.kind == "f" else 0
        self.set_error(k, error)

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return all arrays by their names, text as such."""
        return {name: a.astype(str) if a.dtype == object else a for name, a in vars(self).items()}


class Batch:
    """Fits of one problem on meshes that they share, each with data of its own, in compiled programs.

    Parameters
    ----------
    problem : Problem
    meshes : one an experiment, the same for all fits
    varying : Varying
        What replaces the problem's own numbers.
    limits : Limits

    Attributes
    ----------
    own : dict of int to callable
        What returns the evaluators of fits that were done again, on meshes of their own.
    """

    def __init__(self, problem: Problem, meshes: Sequence[Mesh], varying: Varying, limits: Limits) -> None:
        self.evaluator = Evaluator(problem, meshes=meshes)
        self.varying, self.limits = varying, limits
        self.own: dict[int, Callable[[], Evaluator]] = {}
        self._base = tuple(self.evaluator.arguments)

    @cached_property
    def layout(self) -> Layout:
        """Layout of the programs."""
        return choose_layout(self.evaluator, tuple(self.varying))

    def _use_device(self) -> AbstractContextManager[Any]:
        """Return a context in which programs with machine code run on the CPU, whatever JAX's default device is, and
        those in lockstep one after another: each takes gigabytes.
        """
        if self.layout.lockstep:
            return _gpu
        return jax.default_device(jax.devices("cpu")[0]) if has_gpu() else nullcontext()

    @cached_property
    def _inputs(self) -> Inputs:
        return Inputs.of(self.evaluator, self.layout)

    @cached_property
    def _values(self) -> tuple[jax.Array, ...]:
        """Return the data of all fits as arrays of JAX, which otherwise copies them in each call of a program."""
        return tuple(jnp.asarray(pad_fits(value, self.layout.size)) for value in self.varying.values())

    def fit(self, starts: FloatArray) -> Chunk:
        """Fit all of them.

        The program of all fits has no trust region, and a step too long may lead one astray: `minimize` begins anew at
        the start of what it does not settle, with the iterations that are left.

        Parameters
        ----------
        starts : (R, d)
            Feasible.
        """
        problem = self.evaluator.problem
        has_crossings = any(map(has_corners, problem.structures))
        if problem.constraint_names or problem.unknowns.log_times.any() or has_crossings:  # unknown to the program
            outcome = Outcome.at_starts(starts, np)
        else:
            outcome = self._run_program(starts)
        return self._finish_rest(outcome, starts)

    def replace_fit(self, chunk: Chunk, k: int, again: Estimate) -> None:
        """Replace the k-th fit by an estimate, on meshes of its own."""
        ordinary = again.status is Status.CONVERGED and not again.active
        chunk.replace_fit(k, again, list_kinks(again), "" if ordinary else again.message)
        self.own[k] = again.evaluator_at_solution

    def evaluate(self, fits: NDArray[np.intp], thetas: FloatArray, sides: NDArray[np.int64]) -> Derivatives:
        """Return costs, gradients and Hessians at thetas (n, d), to one side (n,) of breakpoints.

        `fits` (n,) says whose data are taken. NaN where the model is undefined.
        """
        n, d = thetas.shape
        at = Derivatives(np.full(n, np.nan), np.full((n, d), np.nan), np.full((n, d, d), np.nan))
        alone = np.isin(fits, list(self.own)) | (not self.layout.natively)
        together = np.flatnonzero(~alone)
        for first in range(0, len(together), EVALUATIONS):
            call = together[first : first + EVALUATIONS]
            padded = [pad_fits(each[call], EVALUATIONS) for each in (fits, thetas, sides.astype(float))]
            found = self._run(_evaluate_fits, *padded, len(call))
            for all_, each in zip(at, found, strict=True):
                all_[call] = each[: len(call)]
        for s in np.flatnonzero(alone).tolist():
            k = int(fits[s])
            with suppress(*UNDEFINED):
                evaluator = self.own[k]() if k in self.own else self._give_data(k)
                here = evaluator(thetas[s], int(sides[s]))
                at.cost[s], at.gradient[s], at.hessian[s] = here.cost, here.gradient, here.hessian
        return at

    def _run(self, program: Callable[..., Any], *own: Any) -> Any:
        """Return the results of a program as arrays of NumPy; `own` is what it is given beside inputs and data."""
        with use_float64(), self._use_device():
            given = (self._inputs, self._values, *own)
            with compile_once(self.layout, given):
                return jax.tree.map(np.asarray, program(*given, layout=self.layout))

    def _give_data(self, k: int) -> Evaluator:
        """Return the evaluator with the data of the k-th fit."""
        with use_float64():
            values = [jnp.asarray(value[k]) for value in self.varying.values()]
            arguments = replace_leaves(self._base, self.varying, values)
        given = zip(self.evaluator.meshes, arguments, strict=True)
        meshes = [Mesh.from_times(np.asarray(own.nodes), mesh.stiffness) for mesh, own in given]
        return Evaluator(self.evaluator.problem, meshes=meshes, arguments=arguments)

    def _run_program(self, starts: FloatArray) -> Outcome:
        """Return where the program leaves all fits: at their starts if it fails, or if one mesh does not suit them."""
        # What it does not settle has as many iterations left for the optimiser that finishes it.
        limits = self.limits._replace(max_iterations=self.limits.max_iterations // 2)
        inward = self.evaluator.problem.unknowns.variables.inward(starts)
        try:
            found = self._run(_minimize_fits, limits, pad_fits(inward, self.layout.size), len(starts))
        except Exception as error:
            # A function of the model that calls back into Python may raise for one fit and ends the whole program: the
            # fits are then done one by one, and that one is listed. Any other error is a defect of the program.
            if not _is_raised_in_callback(error):
                warnings.warn(_NO_PROGRAM.format(error=describe_error(error)), RuntimeWarning, stacklevel=3)
            return Outcome.at_starts(starts, np)
        outcome: Outcome = jax.tree.map(lambda a: a[: len(starts)], found)
        # A program has one mesh for all fits: it is refused where it does not suit the first and the last of them.
        is_sharp = self.layout.natively and not all(map(Follower(self.evaluator).suits, outcome.theta[[0, -1]]))
        return Outcome.at_starts(starts, np) if is_sharp else outcome

    def _fit_one(self, k: int, start: FloatArray, limits: Limits) -> Result:
        """Fit the data of fit k from a start. Meshes follow, unless each fit has times of its own, with which no mesh
        is made.
        """
        problem, varying, evaluator = self.evaluator.problem, self.varying, self._give_data(k)

        def build(meshes: Sequence[Mesh]) -> Evaluator:
            return Batch(problem, meshes, varying, limits)._give_data(k)

        if len(varying) == len(jax.tree.leaves(self._base)):
            return minimize_cost(evaluator, start, "exact", *limits)
        # A trust region takes fewer steps.
        return minimize_cost(Follower(evaluator, build), start, "auto", *limits)

    def _finish_rest(self, outcome: Outcome, starts: FloatArray) -> Chunk:
        """Return the outcomes as a chunk; fits that did not settle are done by `minimize`, one by one."""
        problem, limits, chunk = self.evaluator.problem, self.limits, Chunk.of(outcome)
        settled, held = np.asarray(outcome.settled), np.asarray(outcome.held)
        # Held coordinates are left out of the covariance: rows of the identity in H, zero in its inverse.
        either = (held[:, :, None] | held[:, None, :])[settled]
        hessians = np.where(either, np.eye(held.shape[1]), chunk.hessian[settled])
        chunk.covariance[settled] = np.linalg.inv(hessians) * ~either
        chunk.free[settled] -= held[settled].sum(axis=1)
        sides = np.stack([outcome.left, outcome.gradient], axis=2)
        chunk.kinks[:] = np.where((held & settled[:, None])[:, :, None], sides, 0.0)
        for k in np.flatnonzero(settled & held.any(axis=1)).tolist():
            chunk.status[k] = Status.CONVERGED_AT_KINK.name
            chunk.message[k] = str(_describe_kink(problem, outcome, k, limits.tolerance))
        for k in np.flatnonzero(~settled).tolist():
            before = int(chunk.iterations[k])
            try:
                found = self._fit_one(k, starts[k], limits._replace(max_iterations=limits.max_iterations - before))
            except Exception as error:  # of any kind: the other fits go on
                chunk.set_error(k, error)
                chunk.free[k] = 0
                continue
            termination = termination_of(replace(found, iterations=before + found.iterations), problem)
            chunk.replace_fit(k, found, found.kinks, str(termination))
        return chunk


@compile_for_layout
def _minimize_fits(
    inputs: Inputs,
    values: tuple[jax.Array, ...],
    limits: Limits,
    starts: jax.Array,
    count: jax.Array,
    *,
    layout: Layout,
) -> Outcome:
    """Return the outcomes of the first `count` fits."""
    variables = inputs.variables

    def fit(own: tuple[jax.Array, ...], start: jax.Array) -> Outcome:
        # In the optimiser's own variables z (theta on its scales): derivatives follow by the chain rule.
        def evaluate(z: jax.Array, side: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            theta = inputs.find_theta(z)
            J, g, H = inputs.evaluate(layout, own, theta, side)
            return J, *variables.derivatives_inward(theta, g, H, jnp)

        breakpoints = _list_breakpoints(layout, inputs.times, replace_leaves(inputs.arguments, layout.varying, own))
        found = minimize_traced(TracedProblem(evaluate, inputs.constraints, breakpoints, *limits), start)
        theta = inputs.find_theta(found.theta)
        left = variables.derivatives_outward(theta, found.left, found.hessian, jnp)[0]
        gradient, hessian = variables.derivatives_outward(theta, found.gradient, found.hessian, jnp)
        return found._replace(theta=theta, gradient=gradient, hessian=hessian, left=left)

    if layout.lockstep:
        return jax.vmap(fit)(values, starts)
    empty = Outcome.at_starts(starts)

    def one(k: jax.Array, outcomes: Outcome) -> Outcome:
        outcome = fit(tuple(value[k] for value in values), starts[k])
        return jax.tree.map(lambda all_, new: all_.at[k].set(new), outcomes, outcome)

    return lax.fori_loop(0, count, one, empty)


@compile_for_layout
def _evaluate_fits(
    inputs: Inputs,
    values: tuple[jax.Array, ...],
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
        new = inputs.evaluate(layout, [value[fits[s]] for value in values], thetas[s], sides[s])
        return tuple(all_.at[s].set(each) for all_, each in zip(found, new, strict=True))  # type: ignore[return-value]

    empty = jnp.zeros(n), jnp.zeros((n, d)), jnp.zeros((n, d, d))
    return lax.fori_loop(0, count, one, empty)


def _list_breakpoints(layout: Layout, times: tuple[Any, ...], arguments: tuple[Arguments, ...]) -> TracedBreakpoints:
    """Return the nodes of each free transition time; these are not scaled."""
    nodes = {
        place: own.nodes
        for own, tau, places in zip(arguments, times, layout.places, strict=True)
        for place in places[: len(tau)]
        if place >= 0
    }
    if not nodes:
        return TracedBreakpoints(np.zeros(0, np.intp), jnp.zeros((0, 1)))
    longest = max(len(a) for a in nodes.values())
    padded = [jnp.pad(a, (0, longest - len(a)), constant_values=jnp.inf) for a in nodes.values()]
    return TracedBreakpoints(np.array(list(nodes)), jnp.stack(padded))


def _is_raised_in_callback(error: BaseException) -> bool:
    """Return whether a function that a program calls in Python raised it: JAX raises a ValueError or a JaxRuntimeError
    of its own, with the traceback in its text.
    """
    return "error calling callback" in str(error)


def describe_failure(error: BaseException) -> str:
    """Return the message of a fit that ended with an error, on one line."""
    return str(Termination(Status.ERROR, reason=Issue("error", (describe_error(error),))))


def describe_error(error: BaseException) -> str:
    """Return kind and text of an error on one line; of an error in a callback, those of the original error."""
    # JAX hands on what a callback raised as text, whose last such line says what it was.
    raised = [line for line in str(error).splitlines() if RAISED.match(line)]
    text = raised[-1] if raised else f"{type(error).__name__}: {error}"
    return " ".join(text.split())[:LONGEST_ERROR]


def _describe_kink(problem: Problem, outcome: Outcome, k: int, tolerance: float) -> Termination:
    """Return the termination of fit k, which ended at kinks."""
    names, columns = problem.unknowns.names, (outcome.theta[k], outcome.left[k], outcome.gradient[k])
    kinks = tuple(Kink(names[i], *(float(column[i]) for column in columns)) for i in np.flatnonzero(outcome.held[k]))
    figures = {name: getattr(outcome, name)[k].item() for name in ("cost", "optimality", "iterations")}
    return Termination(Status.CONVERGED_AT_KINK, tolerance=tolerance, kinks=kinks, **figures)
