"""Changes of J that the data cannot show: a fit that stops short by no more than that has converged.

J falls by s²/2 times the residual variance over s standard errors. Falls of J below that of `INSIGNIFICANT` standard
errors, or below the integration error, are no reason to go on; curvature along a transition time that is as small over
the whole horizon is integration error.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from switchfit.fit.statistics import count_priors, count_samples, measure_variance
from switchfit.optimize import Result, Status
from switchfit.optimize.algebra import EIGENVALUE_FLOOR, EPS
from switchfit.optimize.curvature import null_space
from switchfit.optimize.dense import Dense
from switchfit.optimize.stationary_points import NEGATIVE_CURVATURE
from switchfit.problem.problem import Problem

INSIGNIFICANT = 0.25
"""Part of its standard error by which an unknown may be off where a line search has failed, and the fit counts as
converged. Of 20 fits to a mass on a spring with dry friction half ended at jumps of J, up to 0.11 off."""


def is_within_error(problem: Problem, result: Result, error: float) -> bool:
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


def _compute_insignificance(problem: Problem, result: Result) -> float:
    """Return the decrease of J over `INSIGNIFICANT` standard errors, along any direction; 0 without a noise model.

    J falls by s²/2 times the residual variance to its minimum from a distance of s standard errors.
    """
    freedom = count_samples(problem) + count_priors(problem) - result.free_basis.shape[1]
    variance = measure_variance(result.cost, freedom, problem.is_sigma_known)  # NaN without a noise model
    return 0.5 * INSIGNIFICANT**2 * float(np.nan_to_num(variance))


def drop_noise_of_times(problem: Problem, result: Result) -> Result:
    """Return the result with rows of zeros in its Hessian for transition times that the data do not determine.

    J hardly depends on such a time, as between two switchings of a relay whose setpoint changes, where it is constant.
    Its row is integration error then: the minimum would be called a saddle by its sign, or get standard errors of days.
    The time could move over its whole horizon T, and the other unknowns after it, and J would not change by more than
    is insignificant: for ``|H_ii| T^2 / 2``, and ``(H_ij T)^2 / (2 H_jj)`` for what an unknown j gains. A kink whose
    slopes are as small holds no time.
    """
    # Elsewhere the Hessian is not judged, or has been refused already.
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
