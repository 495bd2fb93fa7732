"""Fit a problem once, from one start: combines mesh, derivatives and optimizer.

The mesh is frozen while the optimizer works. At the end J is compared with that of halved steps: where they differ, the
mesh is refined and the fit resumed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray
from switchfit.estimation.estimator import Estimate
from switchfit.fit.accuracy import Follower, constraint_errors, cost_error
from switchfit.fit.evaluator import Evaluator, evaluator_of
from switchfit.fit.result import Termination, count_priors, count_samples, measure_variance, termination_of
from switchfit.fit.solution import explain_nonfinite, minimize_cost
from switchfit.optimize import IterationRecord, Result, Status
from switchfit.optimize.algebra import EIGENVALUE_FLOOR, EPS
from switchfit.optimize.curvature import null_space
from switchfit.optimize.dense import Dense
from switchfit.optimize.minimization_problem import HessianKind
from switchfit.optimize.stationary_points import NEGATIVE_CURVATURE
from switchfit.problem.comparisons import find_comparisons, find_cost_corner
from switchfit.problem.problem import Problem, keep_with_problem
from switchfit.problem.validation.arrays import as_count, as_positive
from switchfit.problem.validation.messages import join_names, shorten
from switchfit.problem.validation.names import as_choice
from switchfit.runtime.errors import NotIntegrableError
from switchfit.runtime.issue import Issue
from switchfit.uncertainty.certificate import LARGE_INTEGRATION_ERROR

HESSIANS = get_args(HessianKind)

REFINEMENTS = 2
"""Largest number of times that the mesh is refined at the solution, and the fit resumed, for the integration error."""

PROBE = 0.3
"""Change of an unknown, in standard errors with all others known, at which J is compared with what its Hessian says."""

LARGEST_INTEGRATION_ERROR = 1e-8
"""Relative error of J, a guard or a terminal constraint (by halving all steps, see `switchfit.fit.accuracy`) above
which the mesh is refined again, unless rtol allows more."""

STOPPED = (Status.INTERRUPTED, Status.NONFINITE_START, Status.MAX_ITERATIONS)
"""Statuses after which a fit is not resumed on a finer mesh."""

INSIGNIFICANT = 0.25
"""Part of its standard error by which an unknown may be off where a line search has failed, and the fit counts as
converged. Of 20 fits to a mass on a spring with dry friction half ended at jumps of J, up to 0.11 off."""

ORDER = 5
"""Order of both integrators, and of the decrease of their error as steps are divided."""


def fit_locally(
    problem: Problem,
    *,
    hessian: HessianKind = "auto",
    tolerance: float = 1e-7,
    max_iterations: int = 200,
    callback: Callable[[IterationRecord], object] | None = None,
    start: ArrayLike | None = None,
    first_cost: float = 0.0,
) -> Estimate:
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
        if _is_within_error(problem, result, abs(fine_cost - result.cost)):
            result = replace(result, status=Status.CONVERGED_PRECISION)
        excess = error / max(LARGEST_INTEGRATION_ERROR, problem.rtol)
        if attempt == REFINEMENTS or result.status is Status.INTERRUPTED:
            break
        failed = not result.status.successful or excess > 2**ORDER
        stable = evaluator.stabilize(first, theta) if failed else None
        if stable is None and (result.status in STOPPED or not excess > 1):
            break
        try:
            finer = stable or refine_meshes(evaluator, first, theta, excess, first=first_meshes)
        except NotIntegrableError:  # what was found stays, with its integration error
            break
    result = _drop_noise_of_times(problem, result)
    ended = _describe_ending(evaluator, result, earlier, error)
    if undefined := _explain_nonfinite(*(broken or (evaluator, result))):
        ended = replace(ended, reason=undefined)
    found = Estimate(
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


def _is_within_error(problem: Problem, result: Result, error: float) -> bool:
    """Return whether a minimum is found to the accuracy of J, which has an integration error, without convergence.

    J on a mesh has small kinks and jumps where the model has some inside its steps, as where a tank runs dry or a force
    saturates. A minimization may end at one, short of its tolerance: such a jump may be higher than the integration
    error, but nothing is lost that the data could show. Derivatives that are wrong, or no numbers farther on, say
    nothing of what is lost.
    """
    most = error
    if result.status is Status.LINE_SEARCH_FAILED:
        most = max(error, _compute_insignificance(problem, result))
    if not result.predicted <= most or result.violated or not result.smallest_eigenvalue > EIGENVALUE_FLOOR:
        return False
    # Last, since to find it takes evaluations: of a fit that goes on, on a finer mesh, nobody asks for it.
    kind = "" if result.reason is None else result.reason.kind
    return kind != "not finite" and (kind != "wrong slope" or result.predicted <= error)


def _explain_nonfinite(evaluator: Evaluator, result: Result) -> Issue | None:
    """Return which function was not finite at the start, or where the line search failed; None if all were."""
    theta = result.theta.copy()
    if result.status is Status.LINE_SEARCH_FAILED and result.reason is not None and result.reason.kind == "not finite":
        for i, value in result.reason.places:
            theta[i] = value
    elif result.status is not Status.NONFINITE_START:
        return None
    return explain_nonfinite(evaluator, theta)


def _compute_insignificance(problem: Problem, result: Result) -> float:
    """Return the decrease of J over `INSIGNIFICANT` standard errors, along any direction; 0 without a noise model.

    J falls by s²/2 times the residual variance to its minimum from a distance of s standard errors.
    """
    freedom = count_samples(problem) + count_priors(problem) - result.free_basis.shape[1]
    variance = measure_variance(result.cost, freedom, problem.is_sigma_known)  # NaN without a noise model
    return 0.5 * INSIGNIFICANT**2 * float(np.nan_to_num(variance))


def _drop_noise_of_times(problem: Problem, result: Result) -> Result:
    """Return the result with rows of zeros in its Hessian for transition times that the data do not determine.

    J hardly depends on such a time, as between two switchings of a relay whose setpoint changes, where it is constant.
    Its row is integration error then: the minimum would be called a saddle by its sign, or get standard errors of days.
    The time could move over its whole horizon T, and the other unknowns after it, and J would not change by more than
    is insignificant: for ``|H_ii| T^2 / 2``, and ``(H_ij T)^2 / (2 H_jj)`` for what an unknown j gains. A kink whose
    slopes are as small holds no time.
    """
    if not (result.status.is_strict_minimum or result.status is Status.SADDLE):
        return result
    insignificant, hessian = _compute_insignificance(problem, result), result.hessian
    d = len(result.theta)
    lengths = [run.initial_length for run in problem.experiments]
    T = problem.unknowns.put_at_times(np.full(d, np.inf), lengths)  # of times alone
    least = 2.0 * insignificant / T**2
    suspects = problem.unknowns.is_time & (np.abs(np.diag(hessian)) <= least)
    if not hessian[suspects].any():
        return result
    moves = suspects & ((result.free_basis**2).sum(axis=1) > 1.0 - EPS)  # by itself, held by no constraint
    for i, left, right in result.kinks:
        moves[i] = bool(suspects[i]) and max(-left, right) * T[i] <= insignificant
    noise = moves & (hessian**2 <= np.outer(least, np.maximum(np.abs(np.diag(hessian)), least))).all(axis=1)
    cleaned = np.where(noise | noise[:, None], 0.0, hessian)
    held = null_space(np.hstack([result.free_basis, np.eye(d)[:, noise]]).T).T
    curvature = Dense(cleaned).curvature(held, np.zeros(d, dtype=bool), np.zeros(d))
    if not hessian[noise].any() or curvature.spectrum.smallest < NEGATIVE_CURVATURE:
        return result
    kinks = tuple(kink for kink in result.kinks if not noise[kink[0]])
    return replace(result, status=Status.SINGULAR, hessian=cleaned, curvature=curvature, kinks=kinks)


def check_settings(tolerance: float, max_iterations: int) -> tuple[float, int]:
    """Check and return the two settings that every fit has."""
    return as_positive(tolerance, "tolerance"), as_count(max_iterations, "max_iterations")


def judge_meshes(
    evaluator: Evaluator,
    theta: FloatArray,
    cost: float,
    first_cost: float,
    constraints: Sequence[float],
    *,
    by_cells: bool,
) -> tuple[Evaluator, float, float, str]:
    """Return the problem with all steps at theta halved, J there, the largest integration error and its output.

    The first meshes are mostly too coarse. Halved cells show this as well as halved rows do: they are tried first on
    the problem's own meshes, for whose halved cells there is an evaluator that is kept for the next fit.

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
    cost, constraints : float, (m,)
        J, guards and terminal constraints of the evaluator at theta.
    first_cost : float
        J at the start of the fit.
    by_cells : bool
        Whether to halve cells first.
    """
    problem = evaluator.problem
    outputs = ("J", *problem.constraint_names)
    for halve in (lambda: evaluator.halved, lambda: evaluator.halve_rows(theta))[not by_cells :]:
        fine = halve()
        fine_cost = fine.cost(theta)
        errors = [cost_error(problem, fine_cost, cost, first_cost), *constraint_errors(fine, theta, constraints)]
        worst = int(np.argmax(errors))  # NaN counts as the largest
        error, output = float(errors[worst]), outputs[worst]
        if error > max(LARGEST_INTEGRATION_ERROR, problem.rtol):
            break
    return fine, fine_cost, error, output


def refine_meshes(
    evaluator: Evaluator, start: FloatArray, theta: FloatArray, excess: float, *, first: bool
) -> Evaluator:
    """Return the problem on finer meshes: halved, or, if that is not enough, refined at the start and at theta.

    A mode that has become active in another part of the horizon may meet cells there that are far too long for it.
    The first meshes have their cells halved, later ones their rows at theta.
    """
    if excess <= 2**ORDER:
        return evaluator.halved if first else evaluator.halve_rows(theta)
    return Evaluator(evaluator.problem, start, theta)


def _describe_ending(evaluator: Evaluator, result: Result, earlier: int, error: float) -> Termination:
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


def _describe_solution(evaluator: Evaluator, result: Result, hessian: HessianKind) -> dict[str, Any]:
    """Return the fields of an Estimate at the solution: the exact Hessian even if the optimizer used another one.

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


def _lacks_curvature(evaluator: Evaluator, result: Result, i: int) -> bool:
    """Return whether J bends more along an unknown than its Hessian says, on meshes of their own."""
    problem, theta, bend = evaluator.problem, result.theta, float(result.hessian[i, i])
    if not np.isfinite(result.cost) or not bend > 0.0:
        return False
    costs = []
    for sign in (-1.0, 1.0):
        moved = theta + sign * PROBE / np.sqrt(bend) * np.eye(len(theta))[i]
        costs.append(Evaluator(problem, np.clip(moved, problem.unknowns.lower, problem.unknowns.upper)).cost(moved))
    rise = sum(costs) - 2.0 * result.cost
    return bool(np.isfinite(rise) and rise > 2.0 * PROBE**2)


@keep_with_problem
def _describe(problem: Problem) -> dict[str, Any]:
    """Return the fields of an Estimate that all fits of a problem share."""
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
