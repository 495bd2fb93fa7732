"""Fits of one model to many data sets or from many starts, in one compiled program.

On a CPU the program takes the fits of a chunk one after the other: each stays in the processor's cache, a fit that has
converged costs nothing more, and chunks run side by side, one a core. On a GPU all fits of a chunk go in lockstep.
Either way each is the same function of its data and start. (Lockstep on a CPU gains little, and two programs at once
can deadlock there: XLA splits large operations among the same threads.)

Fits with features that `minimize_traced` does not support are finished by `minimize`, like a single fit.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from numpy.typing import NDArray

from switchfit.batch.layout import (
    Inputs,
    Layout,
    Varying,
    choose_chunk_size,
    choose_layout,
    compile_for_layout,
    compile_once,
    give_data,
    pad_fits,
    replace_leaves,
)
from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import Mesh
from switchfit.engine.branches import has_corners
from switchfit.fit.evaluator import Evaluator
from switchfit.fit.following import Follower
from switchfit.fit.result import Fit, inverse_on
from switchfit.fit.solution import minimize_cost
from switchfit.fit.termination import Kink, Termination, termination_of
from switchfit.optimize import Result, Status
from switchfit.optimize.problem import HessianKind
from switchfit.optimize.qp import nearest_feasible
from switchfit.optimize.traced import Breakpoints, Constraints, Outcome, minimize_traced
from switchfit.problem.data import FloatArray
from switchfit.problem.functions import use_float64
from switchfit.problem.problem import Problem
from switchfit.problem.variables import Variables

LONGEST_ERROR = 500
"""Characters of an error that are listed."""

RAISED = re.compile(r"\s*[\w.]+(Error|Exception): ")
"""The line of a traceback that names an exception."""


class Limits(NamedTuple):
    """When a fit ends: arguments of the program, which serves other limits too."""

    tolerance: float
    max_iterations: int


class Unscaled(NamedTuple):
    """What is known about theta itself, in whose place the optimiser has variables of its own.

    Attributes
    ----------
    variables : Variables
    lower, upper : (d,), bounds of theta
    """

    variables: Variables
    lower: Any
    upper: Any

    def theta(self, z: Any) -> Any:
        """Return theta at z: (d,)."""
        return jnp.clip(self.variables.outward(z, jnp), self.lower, self.upper)


@dataclass
class Chunk:
    """What was found, one entry a fit, to be written to: a fit that is done again replaces what was found before.

    Attributes
    ----------
    theta, cost, gradient, hessian : (R, d), (R,), (R, d), (R, d, d)
    optimality : (R,)
    iterations, evaluations : (R,) int
    status : (R,) object
        Name of the `Status`.
    message : (R,) object
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
    status: NDArray[np.object_]
    message: NDArray[np.object_]
    free: NDArray[np.int64]
    covariance: FloatArray

    @classmethod
    def of(cls, outcome: Outcome) -> Chunk:
        """Return the outcomes of R fits as if all of them had converged, without covariances."""
        found = {name: np.array(getattr(outcome, name)) for name in Outcome._fields[:7]}
        R, d = outcome.theta.shape
        texts = np.full(R, Status.CONVERGED.name, dtype=object), np.full(R, "", dtype=object)
        return cls(
            **found, status=texts[0], message=texts[1], free=np.full(R, d), covariance=np.full((R, d, d), np.nan)
        )

    def replace_fit(self, k: int, found: Result | Fit, message: str) -> None:
        """Replace the k-th fit by another one; iterations and evaluations of both are added."""
        for name in ("theta", "cost", "gradient", "hessian", "optimality"):
            getattr(self, name)[k] = getattr(found, name)
        self.iterations[k] += found.iterations
        self.evaluations[k] += found.evaluations
        self.status[k], self.message[k] = found.status.name, message
        self.free[k] = found.free_basis.shape[1]
        self.covariance[k] = inverse_on(found.free_basis, found.hessian)

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


def fit_chunk(
    problem: Problem,
    meshes: Sequence[Mesh],
    varying: Varying,
    starts: FloatArray,
    limits: Limits,
    *,
    room: int = 0,
    retry: bool = True,
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
    limits : Limits
    room : int
        Most fits of any call, if that is more than a chunk: one program takes them all.
    retry : bool
        Whether `minimize` begins anew at the start, with the iterations that are left, where a fit ended in no strict
        minimum; the lower cost counts. Of many starts for the same data, another one serves as well.
    """
    evaluator = Evaluator(problem, meshes=meshes)
    has_crossings = any(map(has_corners, problem.structures))
    if problem.constraint_names or problem.unknowns.log_times.any() or has_crossings:  # which the program does not know
        outcome = Outcome.at_starts(starts, np)
    else:
        outcome = _run_program(evaluator, varying, starts, limits, room)
    return _finish_rest(evaluator, varying, outcome, starts if retry else None, limits)


def _run_program(evaluator: Evaluator, varying: Varying, starts: FloatArray, limits: Limits, room: int) -> Outcome:
    """Return where the program leaves all fits: at their starts if it fails, or if one mesh does not suit them."""
    layout = choose_layout(evaluator, varying.places)
    count, size = len(starts), max(len(starts), room, choose_chunk_size())
    unknowns = evaluator.problem.unknowns
    variables = unknowns.variables
    bounds = variables.inward(unknowns.lower), variables.inward(unknowns.upper)
    constraints = (unknowns.A, unknowns.b, *bounds, variables.sizes_inward(evaluator.problem.sizes))
    with use_float64():
        given = (
            Inputs.of(evaluator, layout),
            tuple(pad_fits(value, size) for value in varying.values),
            Constraints(*map(jnp.asarray, constraints)),
            Unscaled(variables, unknowns.lower, unknowns.upper),
            # What it does not settle has as many iterations left for the optimiser that finishes it.
            limits._replace(max_iterations=limits.max_iterations // 2),
            pad_fits(variables.inward(np.asarray(starts)), size),
            count,
        )
        try:
            with compile_once(layout, given):
                outcome = jax.tree.map(lambda a: np.asarray(a)[:count], _minimize_fits(*given, layout=layout))
        except Exception as error:
            # A function of the model that calls back into Python may raise for one fit and ends the whole program: the
            # fits are then done one by one, and that one is listed. Any other error is a defect of the program.
            if not _is_raised_in_callback(error):
                warnings.warn(_NO_PROGRAM.format(error=describe_error(error)), RuntimeWarning, stacklevel=3)
            return Outcome.at_starts(starts, np)
    # A program has one mesh for all fits: it is refused where it does not suit the first and the last of them.
    is_sharp = layout.natively and not all(map(Follower(evaluator).suits, outcome.theta[[0, -1]]))
    return Outcome.at_starts(starts, np) if is_sharp else outcome


@compile_for_layout
def _minimize_fits(
    inputs: Inputs,
    values: tuple[jax.Array, ...],
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

        # The optimizer's own variables z (theta on its scales): derivatives follow by the chain rule, and back in
        # `convert`.
        def evaluate(z: jax.Array, side: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
            theta = unscaled.theta(z)
            J, g, H = inputs.evaluate(layout, own, theta, side)
            return J, *unscaled.variables.derivatives_inward(theta, g, H, jnp)

        return evaluate, _list_breakpoints(layout, replace_leaves(inputs.arguments, layout.varying, own))

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
    empty = Outcome.at_starts(starts)

    def one(k: jax.Array, outcomes: Outcome) -> Outcome:
        outcome = fit(tuple(value[k] for value in values), starts[k])
        return jax.tree.map(lambda all_, new: all_.at[k].set(new), outcomes, outcome)

    return lax.fori_loop(0, count, one, empty)


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


def _fit_on_meshes(evaluator: Evaluator, varying: Varying, k: int, start: FloatArray, limits: Limits) -> Result:
    """Fit the data of fit k, which the evaluator has, from a start."""

    def build(meshes: Sequence[Mesh]) -> Evaluator:
        fresh = Evaluator(evaluator.problem, meshes=meshes)
        give_data(fresh, tuple(fresh.arguments), varying, k)
        return fresh

    has_own_times = len(varying.places) == len(jax.tree.leaves(tuple(evaluator.arguments)))
    follower = None if has_own_times else Follower(evaluator, build)
    hessian: HessianKind = "exact" if follower is None else "auto"  # a trust region takes fewer steps
    return minimize_cost(evaluator, start, hessian, *limits, follower=follower)


def _finish_rest(
    evaluator: Evaluator,
    varying: Varying,
    outcome: Outcome,
    starts: FloatArray | None,
    limits: Limits,
) -> Chunk:
    """Return the outcomes as a chunk; fits that did not settle are finished by `minimize`, one by one.

    What then ends in no strict minimum is fitted from its start as well, unless `starts` is None. Meshes follow, unless
    each fit has times of its own, with which no mesh is made.
    """
    problem, chunk = evaluator.problem, Chunk.of(outcome)
    settled, held = np.asarray(outcome.settled), np.asarray(outcome.held)
    # Held coordinates are left out of the covariance: rows of the identity in H, zero in its inverse.
    either = (held[:, :, None] | held[:, None, :])[settled]
    hessians = np.where(either, np.eye(held.shape[1]), chunk.hessian[settled])
    chunk.covariance[settled] = np.linalg.inv(hessians) * ~either
    chunk.free[settled] -= held[settled].sum(axis=1)
    for k in np.flatnonzero(settled & held.any(axis=1)).tolist():
        chunk.status[k] = Status.CONVERGED_AT_KINK.name
        chunk.message[k] = str(_describe_kink(problem, outcome, k, limits.tolerance))
    constraints, base = problem.constraints, tuple(evaluator.arguments)
    for k in np.flatnonzero(~settled).tolist():
        before = int(chunk.iterations[k])
        try:
            give_data(evaluator, base, varying, k)
            left = limits._replace(max_iterations=limits.max_iterations - before)
            fit = partial(_fit_on_meshes, evaluator, varying, k)
            results = [fit(nearest_feasible(constraints, chunk.theta[k]), left)]
            left = left._replace(max_iterations=left.max_iterations - results[0].iterations)
            # The program has no trust region: where it led to no strict minimum, its start is tried once more with one.
            strayed = before > 0 and not results[0].status.is_strict_minimum
            if starts is not None and strayed and left.max_iterations > 0:
                results.append(fit(starts[k], left))
        except Exception as error:  # of any kind: the other fits go on
            chunk.set_error(k, error)
            chunk.free[k] = 0
            continue
        best = min(results, key=lambda one: np.nan_to_num(one.cost, nan=np.inf))
        total, evaluations = (sum(getattr(one, name) for one in results) for name in ("iterations", "evaluations"))
        best = replace(best, iterations=total, evaluations=evaluations)
        chunk.replace_fit(k, best, str(termination_of(replace(best, iterations=before + total), problem)))
    return chunk
