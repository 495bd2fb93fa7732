"""Intervals of transition times across sample times, where the cost has kinks.

Between two sample times J is smooth in a transition time; at each of them its slope and its curvature jump. With
samples within a few standard errors of the estimate one parabola is no picture of J. Here it is made of one parabola
for each stretch between samples: at every sample time the one-sided derivatives there give the slope and the curvature
of the profile, all other unknowns eliminated by a Newton step (the Schur complement),

    J_p = J − ½ g_o' H_oo⁻¹ g_o,   s = g_k − H_ko H_oo⁻¹ g_o,   c = H_kk − H_ko H_oo⁻¹ H_ok,

and the interval is where 2 (J_p − J) stays below the squared quantile. It costs an evaluation for each sample time on
the way.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from switchfit.fit.evaluator import Evaluator
from switchfit.fit.result import Fit
from switchfit.problem.data import FloatArray, Measurements
from switchfit.problem.problem import Problem

MOST_PIECES = 60
"""Sample times that are passed in one direction; with more of them in an interval the kinks average out."""

MOST_RUNS = 15
"""Problems of more experiments, whose evaluations take long, keep the intervals of one parabola."""

AT_SAMPLE = 1e-9
"""A transition time nearer to a sample time than this part of the horizon is at it."""


def replace_intervals(
    fit: Fit, problem: Problem, evaluator: Evaluator, intervals: FloatArray, level: float
) -> FloatArray:
    """Return intervals (d, 2) with those of transition times with samples inside, or at a kink, from their pieces."""
    found = intervals.copy()
    threshold = _threshold(fit, level)
    if threshold is None or len(problem.experiments) > MOST_RUNS:
        return found
    others = _movable(fit)
    for e, k in _transitions(problem):
        samples = _sample_times(problem, e)
        held = any(kink.unknown == fit.theta_names[k] for kink in fit.kinks)
        low, high = intervals[k]
        inside = samples[(samples >= low) & (samples <= high)]
        if held or (inside.size and others[k]):
            free = others.copy()
            free[k] = False
            ends = (_walk(fit, problem, evaluator, e, k, free, samples, side, threshold) for side in (-1, 1))
            found[k] = next(ends), next(ends)
    return found


def _threshold(fit: Fit, level: float) -> float | None:
    """Return by how much J may exceed its minimum: half the squared quantile, times the residual variance."""
    if fit.sigma_known is None or not fit.status.successful:
        return None
    scale = 1.0 if fit.sigma_known else 2.0 * fit.cost / max(fit.freedom, 1)
    return 0.5 * fit.quantile(level) ** 2 * scale


def _movable(fit: Fit) -> Any:
    """Return which unknowns are free one by one: (d,) of bool."""
    Z = fit.free_basis
    return np.sum(Z * Z, axis=1) > 1 - 1e-9


def _transitions(problem: Problem) -> Iterator[tuple[int, int]]:
    """Yield the experiment and the place in theta of each free transition time that moves alone."""
    places = [place for where in problem.unknowns.times for place in where[where >= 0].tolist()]
    for e, where in enumerate(problem.unknowns.times):
        for place in where[where >= 0].tolist():
            if places.count(place) == 1:
                yield e, place


def _sample_times(problem: Problem, e: int) -> FloatArray:
    """Return the times of all measurements of an experiment, in ascending order."""
    times = [data.times for data in problem.experiments[e].data if isinstance(data, Measurements)]
    return np.unique(np.concatenate(times)) if times else np.zeros(0)


def _walk(
    fit: Fit,
    problem: Problem,
    evaluator: Evaluator,
    e: int,
    k: int,
    free: Any,
    samples: FloatArray,
    side: int,
    threshold: float,
) -> float:
    """Return where the profile reaches the threshold, going to one side of the estimate from sample to sample."""
    theta, here = fit.theta.copy(), float(fit.theta[k])
    limit = _limit(fit, problem, e, k, side)
    span = fit.trajectories[e].times
    near = AT_SAMPLE * (span[-1] - span[0])
    ahead = samples[side * (samples - here) > near]
    for stop in [*ahead[::side][:MOST_PIECES], limit]:
        stop = side * min(side * stop, side * limit)
        at = evaluator(theta, side)
        cost, slope, curvature, follow = _profile_at(at, k, free)
        rise = cost - fit.cost
        if rise >= threshold:
            return float(theta[k])
        reach = _first_root(threshold - rise, side * slope, curvature)
        length = side * (stop - theta[k])
        if reach <= length or stop == limit:
            return float(theta[k] + side * min(reach, length))
        theta[free] -= follow[0] + follow[1] * side * length
        theta = np.clip(theta, fit.lower, fit.upper)
        theta[k] = stop
    return float(theta[k] + side * reach)


def _limit(fit: Fit, problem: Problem, e: int, k: int, side: int) -> float:
    """Return how far a transition time may move alone: to its bound or to its neighbour."""
    times = fit.transition_times[e]
    i = int(np.flatnonzero(problem.unknowns.times[e] == k)[0])
    span = fit.trajectories[e].times
    if side > 0:
        neighbour = times[i + 1] if i + 1 < len(times) else span[-1]
        return float(min(neighbour, fit.upper[k]))
    return float(max(times[i - 1] if i else span[0], fit.lower[k]))


def _profile_at(at: Any, k: int, free: Any) -> tuple[float, float, float, tuple[FloatArray, FloatArray]]:
    """Return cost, slope and curvature of the profile, and how the others follow: at once, and by length."""
    g, H = at.gradient, at.hessian
    rest = np.column_stack([g[free], H[free, k]])
    solved = np.linalg.solve(H[np.ix_(free, free)], rest) if free.any() else rest
    newton, follow = solved.T
    cost = at.cost - 0.5 * g[free] @ newton
    return float(cost), float(g[k] - H[k, free] @ newton), float(H[k, k] - H[k, free] @ follow), (newton, follow)


def _first_root(height: float, slope: float, curvature: float) -> float:
    """Return the smallest x > 0 with slope x + ½ curvature x² = height > 0; infinite where there is none."""
    square = slope * slope + 2.0 * curvature * height
    if square < 0.0:
        return np.inf
    root = slope + np.sqrt(square)
    return 2.0 * height / root if root > 0.0 else np.inf
