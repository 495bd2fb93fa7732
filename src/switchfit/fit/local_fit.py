"""Fit a problem once, from one start: combines mesh, derivatives and optimizer.

The mesh is frozen while the optimizer works. At the end J is compared with that of halved steps: where they differ, the
mesh is refined and the fit resumed.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import get_args

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray
from switchfit.fit.ending import describe_ending, find_undefined_function
from switchfit.fit.insignificance import drop_noise_of_times, is_within_error
from switchfit.fit.layout import layout_of
from switchfit.fit.minimization import minimize_cost
from switchfit.fit.result import build_fit
from switchfit.fit.search_record import SearchRecord
from switchfit.fit.solved_fit import SolvedFit, describe_solution
from switchfit.meshes.evaluator import Evaluator, evaluator_of
from switchfit.meshes.follower import Follower
from switchfit.meshes.halving import choose_next_meshes
from switchfit.meshes.integration_error import LARGEST_INTEGRATION_ERROR, judge_meshes
from switchfit.optimize import IterationRecord, Status
from switchfit.optimize.minimization_problem import HessianKind
from switchfit.problem.problem import Problem, check_start
from switchfit.problem.validation.arrays import as_count, as_positive
from switchfit.problem.validation.names import as_choice

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
) -> SolvedFit:
    """Fit a problem once from one start, as `estimate` does with ``strategy="local"``, with the same arguments.

    Raises
    ------
    NotIntegrableError
        For a guess at which the model cannot be integrated.
    ValueError
        For a bad setting.
    """
    began = time.perf_counter()
    first = check_start(problem, start)
    evaluator = evaluator_of(problem) if start is None else Evaluator(problem, first)
    return fit_on_meshes(evaluator, first, hessian, tolerance, max_iterations, callback, began=began)


def fit_on_meshes(
    evaluator: Evaluator,
    start: FloatArray,
    hessian: HessianKind,
    tolerance: float,
    max_iterations: int,
    callback: Callable[[IterationRecord], object] | None = None,
    first_cost: float = 0.0,
    began: float | None = None,
) -> SolvedFit:
    """Fit the problem of an evaluator once, from a start (d,) that has been checked and for which its meshes are.

    `first_cost` is J at the start of a search that ends with this fit: a large one is the scale of the integration
    error. Its seconds count from `began`, by default from here. Raises ValueError for a bad setting.
    """
    problem, theta = evaluator.problem, start
    hessian = as_choice(hessian, "hessian", HESSIANS)
    tolerance, max_iterations = check_settings(tolerance, max_iterations)
    if problem.constraint_names and hessian not in ("auto", "exact"):
        raise ValueError(f"with guards or terminal constraints hessian must be 'auto' or 'exact'; got {hessian!r}.")
    began = time.perf_counter() if began is None else began
    history: list[IterationRecord] = []
    evaluations, multipliers, broken = 0, None, None
    meshes = evaluator
    # A mesh is frozen while the optimizer works, so that J is one function: finer ones come between its runs, each of
    # which goes on from where the last has ended.
    for attempt in range(REFINEMENTS + 1):
        last = history[-1] if history else None
        report = None if callback is None else lambda record, last=last: callback(record.continue_from(last))
        follower = Follower(meshes)
        following = minimize_cost(follower, theta, hessian, tolerance, max_iterations, report, multipliers=multipliers)
        if attempt and following.status is Status.NONFINITE_START:  # what was found stays
            broken = meshes, following
            break
        result, earlier = following, max(len(history) - 1, 0)
        followed, evaluator = meshes is not follower.evaluator, follower.evaluator
        history += [record.continue_from(last) for record in result.history[1:]] if history else result.history
        evaluations += result.evaluations
        theta = result.theta
        # An error that is nothing beside J at the start is no error of a perfect fit, whose J is rounding.
        scale = max(first_cost, history[0].cost if history else 0.0)
        values = [value for _, value, _ in result.equalities]
        # The Lagrangian on the next mesh begins with the multipliers of this one: at zero it would leave the
        # constraints first.
        multipliers = [multiplier for _, _, multiplier in result.equalities] or None
        fine, fine_cost, error, output = judge_meshes(evaluator, theta, result.cost, scale, values)
        # What the optimizer still misses is less than J is accurate to: that is convergence, as far as this mesh can
        # tell.
        if is_within_error(problem, result, abs(fine_cost - result.cost)):
            result = replace(result, status=Status.CONVERGED_PRECISION)
        excess = error / max(LARGEST_INTEGRATION_ERROR, problem.rtol)
        if attempt == REFINEMENTS or result.status is Status.INTERRUPTED:
            break
        failed, stopped = not result.status.successful, result.status in STOPPED
        is_first = not attempt and not followed
        finer = choose_next_meshes(evaluator, start, theta, excess, failed=failed, stopped=stopped, first=is_first)
        if finer is None:
            break
        meshes = finer
    result = drop_noise_of_times(problem, result)
    ended = describe_ending(evaluator, result, earlier, error)
    if undefined := find_undefined_function(*(broken or (evaluator, result))):
        ended = replace(ended, reason=undefined)
    kind = "sharp" if follower.has_rough_hessian and hessian in ("auto", "exact") else hessian
    solution = describe_solution(evaluator, result, kind, error, output)
    search = SearchRecord(
        initial_theta=start,
        initial_cost=history[0].cost if history else np.nan,
        history=tuple(history),
        evaluations=evaluations,
        seconds=time.perf_counter() - began,
    )
    model = {"problem": evaluator.problem, "evaluator": evaluator}
    found = build_fit(SolvedFit, ended, layout_of(problem), solution, search, trajectories=(), comparisons=(), **model)
    # On the halved rows, which have been evaluated for the integration error: curves are those of the better mesh.
    found.simulate_later(fine)
    return found


def check_settings(tolerance: float, max_iterations: int) -> tuple[float, int]:
    """Check and return the two settings that every fit has."""
    return as_positive(tolerance, "tolerance"), as_count(max_iterations, "max_iterations")
