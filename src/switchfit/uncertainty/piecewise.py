"""Intervals of transition times across sample times, where the cost has kinks.

Between two sample times J is smooth in a transition time; at each of them its slope and its curvature jump. With
samples within a few standard errors of the estimate one parabola is no picture of J. Here it is made of one parabola
for each stretch between samples: at every sample time the one-sided derivatives there give the slope and the curvature
of the profile, all other unknowns eliminated by a Newton step (the Schur complement),

    J_p = J − ½ g_o' H_oo⁻¹ g_o,   s = g_k − H_ko H_oo⁻¹ g_o,   c = H_kk − H_ko H_oo⁻¹ H_ok,

and the interval is where 2 (J_p − J) stays below the squared quantile. It costs an evaluation for each sample time on
the way. Of many fits the pieces are kept (`switchfit.batch.intervals`), so that intervals can be had at any level.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

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


class Piece(NamedTuple):
    """The profile of J between two sample times, going to one side from the estimate.

    Attributes
    ----------
    start, stop : float
        Transition times between which it holds.
    rise : float
        By how much the profile exceeds J of the estimate at the start.
    slope, curvature : float
        There, in the direction in which the side goes.
    """

    start: float
    stop: float
    rise: float
    slope: float
    curvature: float


def replace_intervals(
    fit: Fit, problem: Problem, evaluator: Evaluator, intervals: FloatArray, level: float
) -> FloatArray:
    """Return intervals (d, 2) with those of transition times with samples inside, or at a kink, from their pieces."""
    found = intervals.copy()
    threshold = _threshold(fit, level)
    if threshold is None or len(problem.experiments) > MOST_RUNS:
        return found
    others = _movable(fit)
    span = [trajectory.times[[0, -1]] for trajectory in fit.trajectories]
    for e, k in list_transitions(problem):
        samples = list_sample_times(problem, e)
        held = any(kink.unknown == fit.theta_names[k] for kink in fit.kinks)
        low, high = intervals[k]
        inside = samples[(samples >= low) & (samples <= high)]
        if held or (inside.size and others[k]):
            free = others.copy()
            free[k] = False
            knots = np.concatenate([span[e][:1], fit.transition_times[e], span[e][1:]])
            for end, side in enumerate((-1, 1)):
                stops = list_stops(problem, fit.theta, e, k, samples, knots, fit.lower, fit.upper, side)
                pieces = trace_profile(evaluator, fit.theta, fit.cost, k, free, stops, fit.lower, fit.upper, side)
                found[k, end] = find_end(pieces, threshold, side)
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


def list_transitions(problem: Problem) -> Iterator[tuple[int, int]]:
    """Yield the experiment and the place in theta of each free transition time that moves alone."""
    places = [place for where in problem.unknowns.times for place in where[where >= 0].tolist()]
    for e, where in enumerate(problem.unknowns.times):
        for place in where[where >= 0].tolist():
            if places.count(place) == 1:
                yield e, place


def list_sample_times(problem: Problem, e: int) -> FloatArray:
    """Return the times of all measurements of an experiment, in ascending order."""
    times = [data.times for data in problem.experiments[e].data if isinstance(data, Measurements)]
    return np.unique(np.concatenate(times)) if times else np.zeros(0)


def list_stops(
    problem: Problem,
    theta: FloatArray,
    e: int,
    k: int,
    samples: FloatArray,
    knots: FloatArray,
    lower: FloatArray,
    upper: FloatArray,
    side: int,
) -> list[float]:
    """Return the sample times on the way to one side, and how far a transition time may move alone: to its bound or to
    its neighbour.

    Parameters
    ----------
    problem : Problem
    theta, lower, upper : (d,)
    e, k : int
        The experiment, and the place in theta of the transition time.
    samples : (n,)
    knots : (N + 2,)
        Where the modes of the experiment begin and end.
    side : -1 or 1
    """
    i = int(np.flatnonzero(problem.unknowns.times[e] == k)[0]) + 1
    neighbour = knots[min(i + 1, len(knots) - 1)] if side > 0 else knots[i - 1]
    limit = min(neighbour, upper[k]) if side > 0 else max(neighbour, lower[k])
    near = AT_SAMPLE * (knots[-1] - knots[0])
    ahead = samples[(side * (samples - theta[k]) > near) & (side * (samples - limit) < 0)]
    return [*ahead[::side][:MOST_PIECES].tolist(), float(limit)]


def trace_profile(
    evaluate: Callable[[FloatArray, int], Any],
    theta: FloatArray,
    cost: float,
    k: int,
    free: Any,
    stops: Sequence[float],
    lower: FloatArray,
    upper: FloatArray,
    side: int,
) -> Iterator[Piece]:
    """Yield the pieces of the profile of theta[k] from the estimate to one side, with an evaluation each.

    Parameters
    ----------
    evaluate : callable
        ``evaluate(theta, side)`` returns cost, gradient and hessian, to that side of breakpoints.
    theta, lower, upper : (d,)
    cost : float
        J at theta.
    k : int
    free : (d,) bool
        Unknowns that follow.
    stops : sequence of float
        Where one piece ends and the next begins.
    side : -1 or 1
    """
    theta = theta.copy()
    for stop in stops:
        here, slope, curvature, (newton, follow) = _profile_at(evaluate(theta, side), k, free)
        yield Piece(float(theta[k]), stop, here - cost, side * slope, curvature)
        theta[free] -= newton + follow * (stop - theta[k])
        theta = np.clip(theta, lower, upper)
        theta[k] = stop


def find_end(pieces: Iterable[Piece], threshold: float, side: int) -> float:
    """Return where a profile reaches a threshold above the estimate; where the last piece ends if it does not."""
    end = np.nan
    for piece in pieces:
        if piece.rise >= threshold:
            return piece.start
        reach = _first_root(threshold - piece.rise, piece.slope, piece.curvature)
        length = side * (piece.stop - piece.start)
        if reach <= length:
            return piece.start + side * reach
        end = piece.stop
    return end


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
