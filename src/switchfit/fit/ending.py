"""How a fit ended, with the reasons that only its model tells: functions without a value, switches, corners."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from switchfit.fit.nonfinite_functions import explain_nonfinite
from switchfit.fit.termination import Termination, termination_of
from switchfit.meshes.evaluator import Evaluator
from switchfit.meshes.integration_error import LARGE_INTEGRATION_ERROR
from switchfit.optimize import Result, Status
from switchfit.problem.comparisons import find_comparisons, find_cost_corner
from switchfit.runtime.issue import Issue

PROBE_IN_STANDARD_ERRORS = 0.3
"""Change of an unknown, in standard errors with all others known, at which J is compared with what its Hessian says."""


def find_undefined_function(evaluator: Evaluator, result: Result) -> Issue | None:
    """Return which function was not finite at the start, or where the line search failed; None if all were."""
    theta = result.theta.copy()
    if result.status is Status.LINE_SEARCH_FAILED and result.reason is not None and result.reason.kind == "not finite":
        for i, value in result.reason.places:
            theta[i] = value
    elif result.status is not Status.NONFINITE_START:
        return None
    return explain_nonfinite(evaluator, theta)


def describe_ending(evaluator: Evaluator, result: Result, earlier: int, error: float) -> Termination:
    """Return how a fit ended, with an integration error; `earlier`: the number of iterations on coarser meshes."""
    problem = evaluator.problem
    ended = termination_of(result, problem, earlier)
    is_stuck = ended.status is Status.MAX_ITERATIONS or (ended.reason is not None and ended.reason.kind == "kink")
    if is_stuck and (corner := find_cost_corner(problem)):
        return replace(ended, reason=Issue("cost corner", (corner,)))
    if ended.reason is None:
        # Steps across a jump of a function are not accurate, however short, or its derivatives lack the jump.
        for i, comparison in find_comparisons(problem).items():
            if error > LARGE_INTEGRATION_ERROR or _lacks_curvature(evaluator, result, i):
                return replace(ended, reason=Issue("switch", (problem.theta_names[i], comparison)))
    return ended


def _lacks_curvature(evaluator: Evaluator, result: Result, i: int) -> bool:
    """Return whether J bends more along an unknown than its Hessian says, on meshes of their own."""
    problem, theta, bend = evaluator.problem, result.theta, float(result.hessian[i, i])
    if not np.isfinite(result.cost) or not bend > 0.0:
        return False
    costs = []
    for sign in (-1.0, 1.0):
        moved = theta + sign * PROBE_IN_STANDARD_ERRORS / np.sqrt(bend) * np.eye(len(theta))[i]
        costs.append(Evaluator(problem, np.clip(moved, problem.unknowns.lower, problem.unknowns.upper)).cost(moved))
    rise = sum(costs) - 2.0 * result.cost
    return bool(np.isfinite(rise) and rise > 2.0 * PROBE_IN_STANDARD_ERRORS**2)
