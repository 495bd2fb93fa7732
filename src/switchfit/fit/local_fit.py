"""Fit a problem once, from one start: combines mesh, derivatives and optimizer.

The mesh is frozen while the optimizer works. At the end J is compared with that of halved steps: where they differ, the
mesh is refined and the fit resumed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike

from switchfit.fit.ending import describe_ending, find_undefined_function
from switchfit.fit.insignificance import drop_noise_of_times, is_within_error
from switchfit.fit.minimization import minimize_cost
from switchfit.fit.solved_fit import SolvedFit
from switchfit.meshes.evaluator import Evaluator, evaluator_of
from switchfit.meshes.follower import Follower
from switchfit.meshes.halving import ORDER_OF_METHODS, refine_meshes, stabilize
from switchfit.meshes.integration_error import LARGEST_INTEGRATION_ERROR, judge_meshes
from switchfit.optimize import IterationRecord, Result, Status
from switchfit.optimize.minimization_problem import HessianKind
from switchfit.problem.problem import Problem, keep_with_problem
from switchfit.problem.validation.arrays import as_count, as_positive
from switchfit.problem.validation.messages import join_names, shorten
from switchfit.problem.validation.names import as_choice
from switchfit.runtime.errors import NotIntegrableError

HESSIANS = get_args(HessianKind)

REFINEMENTS = 2
"""Largest number of times that the mesh is refined at the solution, and the fit resumed, for the integration error."""

STOPPED = (Status.INTERRUPTED, Status.NONFINITE_START, Status.MAX_ITERATIONS)
"""Statuses after which a fit is not resumed on a finer mesh."""


def fit_locally(
    problem: Problem,
    *,
    hessian: HessianKind = "auto",
    tolerance: float = 1e-7,
    max_iterations: int = 200,
    callback: Callable[[IterationRecord], object] | None = None,
    start: ArrayLike | None = None,
    first_cost: float = 0.0,
) -> SolvedFit:
    """Fit a problem once from one start, as `estimate` does with ``strategy="local"``, with the same arguments.

    `first_cost` is J at the start of a search that ends with this fit: a large one is the scale of the integration
    error.

    Raises
    ------
    NotIntegrableError
        For a guess at which the model cannot be integrated.
    ValueError
        For a bad setting.
    """
    hessian = as_choice(hessian, "hessian", HESSIANS)
    tolerance, max_iterations = check_settings(tolerance, max_iterations)
    if problem.constraint_names and hessian not in ("auto", "exact"):
        raise ValueError(f"with guards or terminal constraints hessian must be 'auto' or 'exact'; got {hessian!r}.")
    began = time.perf_counter()
    first = theta = problem.check_theta(start, "start")
    unknowns = problem.unknowns
    if names := [unknowns.names[i] for i in np.flatnonzero(unknowns.log & ~unknowns.is_time & (first <= 0))]:
        raise ValueError(f"start must be above 0 for {join_names(names)}, whose scale is 'log'; got {shorten(first)}.")
    evaluator = evaluator_of(problem) if start is None else Evaluator(problem, first)
    history: list[IterationRecord] = []
    evaluations, multipliers, broken = 0, None, None
    finer = evaluator
    for attempt in range(REFINEMENTS + 1):
        last = history[-1] if history else None
        report = None if callback is None else lambda record, last=last: callback(record.continue_from(last))
        follower = Follower(finer)
        following = minimize_cost(follower, theta, hessian, tolerance, max_iterations, report, multipliers=multipliers)
        if attempt and following.status is Status.NONFINITE_START:  # what was found stays
            broken = finer, following
            break
        result, earlier = following, max(len(history) - 1, 0)
        followed, evaluator = finer is not follower.evaluator, follower.evaluator
        history += [record.continue_from(last) for record in result.history[1:]] if history else result.history
        evaluations += result.evaluations
        theta = result.theta
        scale = max(first_cost, history[0].cost if history else 0.0)
        values = [value for _, value, _ in result.equalities]
        multipliers = [multiplier for _, _, multiplier in result.equalities] or None
        first_meshes = not attempt and not followed
        by_cells = first_meshes and start is None
        fine, fine_cost, error, output = judge_meshes(evaluator, theta, result.cost, scale, values, by_cells=by_cells)
        if is_within_error(problem, result, abs(fine_cost - result.cost)):
            result = replace(result, status=Status.CONVERGED_PRECISION)
        excess = error / max(LARGEST_INTEGRATION_ERROR, problem.rtol)
        if attempt == REFINEMENTS or result.status is Status.INTERRUPTED:
            break
        failed = not result.status.successful or excess > 2**ORDER_OF_METHODS
        stable = stabilize(evaluator, first, theta) if failed else None
        if stable is None and (result.status in STOPPED or not excess > 1):
            break
        try:
            finer = stable or refine_meshes(evaluator, first, theta, excess, first=first_meshes)
        except NotIntegrableError:  # what was found stays, with its integration error
            break
    result = drop_noise_of_times(problem, result)
    ended = describe_ending(evaluator, result, earlier, error)
    if undefined := find_undefined_function(*(broken or (evaluator, result))):
        ended = replace(ended, reason=undefined)
    found = SolvedFit(
        **vars(ended),
        **_describe(problem),
        **_describe_solution(evaluator, result, hessian),
        initial_theta=first,
        history=tuple(history),
        evaluations=evaluations,
        trajectories=(),
        comparisons=(),
        hessian_kind="sharp" if follower.has_rough_hessian and hessian in ("auto", "exact") else hessian,
        integration_error=error,
        integration_error_of=output,
        seconds=time.perf_counter() - began,
        initial_cost=history[0].cost if history else np.nan,
    )
    found.simulate_later(fine)
    return found


def check_settings(tolerance: float, max_iterations: int) -> tuple[float, int]:
    """Check and return the two settings that every fit has."""
    return as_positive(tolerance, "tolerance"), as_count(max_iterations, "max_iterations")


def _describe_solution(evaluator: Evaluator, result: Result, hessian: HessianKind) -> dict[str, Any]:
    """Return the fields of a fit at the solution: the exact Hessian even if the optimizer used another one.

    A model may be too sharp for an exact Hessian: see `Follower`.
    """
    times, parameters = evaluator.problem.split(result.theta)
    is_other = hessian in ("gauss-newton", "none") and np.isfinite(result.cost)
    return {
        "theta": result.theta,
        "transition_times": tuple(times),
        "parameters": {name: np.array(value) for name, value in parameters.items()},
        "gradient": result.gradient,
        "hessian": evaluator(result.theta).hessian if is_other else result.hessian,
        "constraints": result.equalities,
        "free_basis": result.free_basis,
        "engine": evaluator.engine,
        "problem": evaluator.problem,
        "evaluator": evaluator,
    }


@keep_with_problem
def _describe(problem: Problem) -> dict[str, Any]:
    """Return the fields of a fit that all fits of a problem share."""
    unknowns, parameters = problem.unknowns, problem.parameters
    counts = [len(run.transition_times) for run in problem.experiments]
    times = list(zip(unknowns.times, counts, strict=True))
    return {
        "theta_names": unknowns.names,
        "theta_units": unknowns.units,
        "lower": unknowns.lower,
        "upper": unknowns.upper,
        "run_names": problem.run_names,
        "transition_places": tuple(where[:count] for where, count in times),
        "final_places": tuple(int(where[count]) if len(where) > count else -1 for where, count in times),
        "parameter_units": {name: parameter.unit for name, parameter in parameters.items()},
        "fixed": tuple(name for name, parameter in parameters.items() if parameter.fixed),
        "sigma_known": problem.is_sigma_known,
        "priors": {name: text for name, text in zip(unknowns.names, unknowns.priors.texts(), strict=True) if text},
        "log_scaled": unknowns.log_names,
        "log_origins": unknowns.origin,
        "least_squares": problem.is_least_squares,
    }
