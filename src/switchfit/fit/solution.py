"""One run of the optimizer on a problem with given meshes, for fits, profiles and many fits."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.fit.collapsed import idle_unknowns
from switchfit.fit.evaluator import ArrowEvaluation, Evaluation, Evaluator
from switchfit.fit.hidden import refuse_hidden_switches, refuse_jumps
from switchfit.fit.termination import linear_constraints_of
from switchfit.optimize import IterationRecord, LinearConstraints, Result, Status, minimize, minimize_constrained
from switchfit.optimize.arrow import Arrow
from switchfit.optimize.diagnosis import Finding
from switchfit.optimize.problem import REACH, HessianKind
from switchfit.problem.data import FloatArray, Measurements, TerminalConstraint
from switchfit.problem.problem import Problem
from switchfit.problem.variables import Variables

MANY_RUNS = 16
"""Number of experiments from which the arrow shape of the Hessian is used; with fewer, the algebra of full matrices
takes no longer (the runs part of the benchmarks)."""

PERFECT_RESIDUAL = 1e-8
"""Residual of a perfect fit, as a part of the sample."""

TIME_REACH = 0.01
"""Largest change of a transition time in the first trust-region step, as a part of the horizon."""


@dataclass(frozen=True, eq=False)
class CostAndGradient:
    """Evaluation without Hessian, for steepest descent."""

    cost: float
    gradient: FloatArray
    hessian: None = None


def constraints_of(problem: Problem) -> LinearConstraints:
    """Return the ordering, minimum durations and bounds of a problem in the optimizer's form."""
    unknowns = problem.unknowns
    return LinearConstraints(unknowns.A, unknowns.b, unknowns.lower, unknowns.upper, linear_constraints_of(problem))


def minimize_cost(
    evaluator: Evaluator,
    theta: Any,
    hessian: HessianKind,
    tolerance: float,
    max_iterations: int,
    callback: Callable[[IterationRecord], object] | None = None,
    constraints: LinearConstraints | None = None,
    by_blocks: bool | None = None,
) -> Result:
    """Run the optimizer once on the evaluator's meshes; arguments as in `estimate`.

    `constraints` are by default those of the problem. `by_blocks` is whether to use the arrow shape of the Hessian of
    several runs; by default, it is used where that is faster.
    """
    problem = evaluator.problem

    unknowns = problem.unknowns
    matrix = hessian if hessian in ("gauss-newton", "none") else "exact"
    if by_blocks is None:
        by_blocks = len(problem.experiments) >= MANY_RUNS and 2 * len(evaluator.layout.shared) < len(theta)
    variables = unknowns.variables
    constraints = constraints_of(problem) if constraints is None else constraints
    identity = variables.identity
    seen: list[bool] = []

    def evaluate_theta(theta: Any, side: int) -> Evaluation | ArrowEvaluation | CostAndGradient:
        if hessian not in ("none", "descent-first") and by_blocks:
            return evaluator.arrow(theta, side, matrix)
        here = evaluator(theta, side, matrix=matrix)
        return CostAndGradient(here.cost, here.gradient) if hessian == "none" else here

    def evaluate(z: Any, side: int) -> Any:
        theta = z if identity else _to_theta(variables, constraints, z)
        here = evaluate_theta(theta, side)
        if not seen:
            seen.append(True)
            refuse_hidden_switches(evaluator, theta, here.gradient)
        return here if identity else _to_variables(variables, theta, here)

    def idle(z: FloatArray, everything: bool) -> NDArray[np.bool_]:
        return idle_unknowns(evaluator, z if identity else _to_theta(variables, constraints, z), everything)

    report = callback
    if callback is not None and not identity:
        report = lambda record: callback(_convert_record(variables, constraints, record))  # noqa: E731
    result = minimize(
        evaluate,
        theta if identity else variables.inward(np.asarray(theta)),
        constraints=constraints if identity else _convert_constraints(variables, constraints),
        breakpoints=evaluator.breakpoints(),
        hessian="exact" if by_blocks and hessian == "auto" else hessian,  # a trust region's one radius suits no run
        blocks=unknowns.is_time.astype(int),
        tolerance=tolerance,
        max_iterations=max_iterations,
        callback=report,
        size=problem.sizes if identity else variables.sizes_inward(problem.sizes),
        idle=idle,
        reach=_reach_of(problem),
    )
    if result.status is Status.LINE_SEARCH_FAILED:
        refuse_jumps(evaluator, result.theta if identity else _to_theta(variables, constraints, result.theta))
    return result if identity else _convert_result(variables, constraints, result)


def minimize_with_constraints(
    evaluator: Evaluator,
    theta: FloatArray,
    tolerance: float,
    max_iterations: int,
    callback: Callable[[IterationRecord], object] | None = None,
) -> tuple[Result, tuple[tuple[str, float, float], ...]]:
    """Run the optimizer once with guards and terminal constraints; arguments as in `estimate`.

    Returns its result, and the name, value and multiplier of each constraint.
    """
    problem = evaluator.problem
    names = problem.constraint_names
    found = minimize_constrained(
        evaluator.constrained,
        theta,
        names,
        tolerance=tolerance,
        max_iterations=max_iterations,
        callback=callback,
        constraints=constraints_of(problem),
        breakpoints=evaluator.breakpoints(),
        size=problem.sizes,
        scale=problem.measure_from_start(theta),
    )
    values, multipliers = found.constraints.tolist(), found.multipliers.tolist()
    return found.result, tuple(zip(names, values, multipliers, strict=True))


def _reach_of(problem: Problem) -> FloatArray:
    """Return how far each variable may move in the optimizer's first trust-region step: (d,).

    This is a part of the horizon for a transition time, and a part of the first guess for any other unknown; if the
    guess is zero, of the range between its bounds.
    """
    unknowns = problem.unknowns
    width = unknowns.upper - unknowns.lower
    guess = np.abs(unknowns.initial)
    reach = REACH * np.where(guess > 0, guess, np.where(np.isfinite(width) & (width > 0), width, 1.0))
    for experiment, where in zip(problem.experiments, unknowns.times, strict=True):
        reach[where[where >= 0]] = TIME_REACH * experiment.initial_length
    return np.where(unknowns.variables.log, REACH, reach / unknowns.variables.size)


def _to_theta(variables: Variables, constraints: LinearConstraints, z: FloatArray) -> FloatArray:
    """Return theta at z, kept inside its bounds against rounding."""
    return np.asarray(np.clip(variables.outward(z), constraints.lower, constraints.upper))


def _to_variables(variables: Variables, theta: FloatArray, here: Any) -> Any:
    """Convert an evaluation at theta to the optimizer's variables."""
    if here.hessian is None:
        return CostAndGradient(here.cost, variables.slopes(theta)[0] * here.gradient)
    if isinstance(here.hessian, Arrow):
        D, E = variables.slopes(theta)
        hessian = here.hessian.scale(1.0 / D).plus_diagonal(E * here.gradient)
        return ArrowEvaluation(here.cost, D * here.gradient, hessian)
    return Evaluation(here.cost, *variables.derivatives_inward(theta, here.gradient, here.hessian))


def _convert_constraints(variables: Variables, constraints: LinearConstraints) -> LinearConstraints:
    """Convert constraints to the optimizer's variables. Only bounds change: rows involve transition times alone."""
    lower, upper = variables.inward(constraints.lower), variables.inward(constraints.upper)
    return replace(constraints, lower=lower, upper=upper)


def _convert_record(variables: Variables, constraints: LinearConstraints, record: IterationRecord) -> IterationRecord:
    """Convert a record of the optimizer from its variables to theta."""
    return replace(record, theta=_to_theta(variables, constraints, record.theta))


def _convert_result(variables: Variables, constraints: LinearConstraints, result: Result) -> Result:
    """Convert the optimizer's result to theta; optimality and eigenvalues remain those of its variables."""
    theta = _to_theta(variables, constraints, result.theta)
    slopes = variables.slopes(theta)[0]
    rows = np.ones(len(constraints.b))  # rows involve transition times alone, whose scale is 1
    gradient, hessian = variables.derivatives_outward(theta, result.gradient, result.hessian)
    history = tuple(_convert_record(variables, constraints, record) for record in result.history)
    return replace(
        result,
        theta=theta,
        gradient=gradient,
        hessian=hessian,
        history=history,
        multipliers=result.multipliers / np.concatenate([rows, slopes, slopes]),
        reason=None if result.reason is None else _convert_reason(variables, result.theta, slopes, result.reason),
    )


def _convert_reason(variables: Variables, z: FloatArray, slopes: FloatArray, found: Finding) -> Finding:
    """Convert why the line search failed from the variables z (d,) to theta; `slopes`: dtheta/dz (d,)."""
    places = []
    for i, value in found.places:
        there = z.copy()
        there[i] = value
        places.append((i, float(variables.outward(there)[i])))
    entries = [(i, stated / float(slopes[i]), measured / float(slopes[i])) for i, stated, measured in found.entries]
    return replace(found, places=tuple(places), entries=tuple(entries))


def smallest_cost(problem: Problem) -> float:
    """Return the cost below which errors are not measured relative to the cost itself.

    For half a sum of squares it is the cost of a perfect fit, with residuals of 1e-8 of the samples. A negative log
    likelihood may have any value, 0 too; its terms are of the size of half the number of samples.
    """
    items = [item for e in problem.experiments for item in e.data if isinstance(item, Measurements)]
    if not is_least_squares(problem):
        return 0.5 * sum(item.count for item in items)
    return max(
        0.5 * PERFECT_RESIDUAL**2 * sum(float(np.nansum(item.weights * item.values**2)) for item in items), 1e-300
    )


def is_least_squares(problem: Problem) -> bool:
    """Return whether J is half a sum of squares: no loss is robust, no sigma a parameter."""
    items = [item for e in problem.experiments for item in e.data if isinstance(item, Measurements)]
    return not any(item.sigma_names or item.loss != "linear" for item in items)


def is_plain_least_squares(problem: Problem) -> bool:
    """Return whether J is half a sum of squares of samples alone, without priors and delays that are parameters."""
    items = [item for e in problem.experiments for item in e.data if isinstance(item, Measurements)]
    delayed = any(isinstance(item.delay, str) for item in items)
    return is_least_squares(problem) and not problem.unknowns.priors.any and not delayed


def is_sigma_known(problem: Problem) -> bool | None:
    """Return whether sigma is given for all measurements, as a number or as a parameter.

    None if the cost has other terms than measurements and terminal constraints.
    """
    items = [item for run in problem.experiments for item in run.data if not isinstance(item, TerminalConstraint)]
    if not items or not all(isinstance(item, Measurements) for item in items):
        return None
    return all(item.sigma is not None for item in items)
