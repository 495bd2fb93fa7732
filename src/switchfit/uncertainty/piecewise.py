"""Intervals of transition times across sample times, where the cost has kinks.

Between two sample times J is smooth in a transition time; at each of them its slope and its curvature jump. With
samples within a few standard errors of the estimate one parabola is no picture of J. Here it is made of one parabola
for each stretch between samples: at every sample time the one-sided derivatives there give the slope and the curvature
of the profile, all other unknowns eliminated by a Newton step (the Schur complement),

    J_p = J − ½ g_o' H_oo⁻¹ g_o,   s = g_k − H_ko H_oo⁻¹ g_o,   c = H_kk − H_ko H_oo⁻¹ H_ok,

and the interval is where 2 (J_p − J) stays below the squared quantile. It costs an evaluation for each sample time on
the way. The other unknowns follow a curve, so that a parabola that is trusted as far as the end of the interval misses
that end by a tenth of the interval: 95 % intervals then hold 92 to 93 % of the truths (`benchmarks/coverage.py`).
Therefore the last stretch is covered in up to `MOST_HALVINGS` + 1 pieces, each of which begins halfway to where the one
before it would end; the other unknowns are fitted by Newton's method where each begins, and each piece meets the next.
Of many fits the pieces are kept (`switchfit.batch.intervals`), so that intervals can be had at any level.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from switchfit.fit.evaluator import Evaluator
from switchfit.fit.result import Fit, TimeProfile
from switchfit.problem.data import FloatArray, Measurements
from switchfit.problem.problem import Problem

MOST_PIECES = 60
"""Sample times that are passed in one direction; with more of them in an interval the kinks average out."""

MOST_RUNS = 15
"""Problems of more experiments, whose evaluations take long, keep the intervals of one parabola."""

NEAR = 5.0
"""Pieces are traced if a sample lies within this many standard errors, twice as far as a 99 % interval reaches. Where
most of what is known about a transition time comes from the samples next to it, its profile is far from a parabola
before it reaches them."""

MOST_HALVINGS = 3
"""Times on one side that a piece is cut off halfway to the end of the interval that it predicts ..."""

NEAR_END = 0.75
"""... which is done until the root of the likelihood ratio has reached this part of the quantile, or ..."""

RIGHT = 0.01
"""... parabolas are right up to this part of the threshold."""

MOST_REPEATS = 2
"""Further Newton steps of the other unknowns at one place, while one lowers J by more than `RIGHT` thresholds."""

BISECTIONS = 40
"""Halvings of a piece until its crossing of the threshold is known to rounding."""

HIGHEST_LEVEL = 0.99
"""Pieces are traced up to the end of an interval of this level, whatever lower level is asked for."""

AT_SAMPLE = 1e-9
"""A transition time nearer to a sample time than this part of the horizon is at it."""

SMALLEST = 1e-3
"""Part of its estimate to which an unknown on a logarithmic scale may fall while it follows a transition time."""

LARGEST = 1e100
"""Derivative of J beyond which a profile is not followed: the mesh of the fit is too coarse for a lag that has become
so short, and the integration unstable."""


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


def replace_intervals(fit: Fit, intervals: FloatArray, level: float, profiles: Sequence[TimeProfile]) -> FloatArray:
    """Return intervals (d, 2) with those of transition times that have pieces from these.

    Parameters
    ----------
    fit : Fit
    intervals : (d, 2)
    level : float
    profiles : sequence of TimeProfile
    """
    found, threshold = intervals.copy(), _compute_threshold(fit, level)
    if threshold is not None:
        for profile in profiles:
            k = fit.theta_names.index(profile.unknown)
            found[k, 0] = find_ends(profile.below, np.array(threshold), -1)
            found[k, 1] = find_ends(profile.above, np.array(threshold), 1)
    return found


def trace_profiles(
    fit: Fit, problem: Problem, evaluator: Evaluator, level: float = HIGHEST_LEVEL
) -> tuple[TimeProfile, ...]:
    """Return the profiles of transition times with samples near, or at a kink, up to the ends of intervals of a level.

    Parameters
    ----------
    fit : Fit
    problem : Problem
    evaluator : Evaluator
    level : float
    """
    highest = _compute_threshold(fit, max(level, HIGHEST_LEVEL))
    if highest is None or fit.constraints or len(problem.experiments) > MOST_RUNS:
        return ()
    found = []
    others = _find_movable(fit)
    lower = _keep_logarithms(fit)
    span = [trajectory.times[[0, -1]] for trajectory in fit.trajectories]
    for e, k in list_transitions(problem):
        samples = list_sample_times(problem, fit.theta, e)
        held = any(kink.unknown == fit.theta_names[k] for kink in fit.kinks)
        if held or (others[k] and is_any_near(samples, fit.theta[k], fit.standard_errors[k])):
            free = others.copy()
            free[k] = False
            knots = np.concatenate([span[e][:1], fit.transition_times[e], span[e][1:]])
            sides = []
            for side in (-1, 1):
                stops = list_stops(problem, fit.theta, e, k, samples, knots, fit.lower, fit.upper, side)
                pieces = trace_profile(evaluator, fit.theta, fit.cost, k, free, stops, lower, fit.upper, highest, side)
                sides.append(np.array(list(pieces)))
            found.append(TimeProfile(fit.theta_names[k], *sides))
    return tuple(found)


def _keep_logarithms(fit: Fit) -> FloatArray:
    """Return the lower bounds of a fit, those on a logarithmic scale raised to where a logarithm is finite: (d,).

    The others follow along a straight line, which may lead to a lag or a sigma of 0.
    """
    log = np.isin(fit.theta_names, fit.log_scaled)
    smallest = fit.log_origins + SMALLEST * (fit.theta - fit.log_origins)
    return np.where(log, np.maximum(fit.lower, smallest), fit.lower)


def _compute_threshold(fit: Fit, level: float) -> float | None:
    """Return by how much J may exceed its minimum: half the squared quantile, times the residual variance.

    None for a fit without a noise model, or one that did not converge.
    """
    if fit.sigma_known is None or not fit.status.successful:
        return None
    scale = 1.0 if fit.sigma_known else 2.0 * fit.cost / max(fit.freedom, 1)
    return 0.5 * fit.quantile(level) ** 2 * scale


def is_any_near(samples: FloatArray, value: float, error: float) -> bool:
    """Return whether a sample is so near to a transition time that one parabola does not give its interval."""
    return bool(error > 0 and np.any(np.abs(samples - value) <= NEAR * error))


def _find_movable(fit: Fit) -> Any:
    """Return which unknowns are free one by one, and have an effect on J: (d,) of bool."""
    Z = fit.free_basis
    return (np.sum(Z * Z, axis=1) > 1 - 1e-9) & fit.hessian.any(axis=1)


def list_transitions(problem: Problem) -> Iterator[tuple[int, int]]:
    """Yield the experiment and the place in theta of each free transition time, and of a free tf."""
    for e, where in enumerate(problem.unknowns.times):
        for place in where[where >= 0].tolist():
            yield e, place


def list_sample_times(problem: Problem, theta: FloatArray, e: int) -> FloatArray:
    """Return the times of the states that were measured in an experiment, delays subtracted, in ascending order.

    There the slope of J in a transition time jumps.

    Parameters
    ----------
    problem : Problem
    theta : (d,)
        With delays that are parameters.
    e : int, from 0
    """
    items = [item for item in problem.experiments[e].data if isinstance(item, Measurements)]
    known = [item.seen_times for item in items if not isinstance(item.delay, str)]
    return np.unique(np.concatenate([problem.late_times(theta, e), *known]))


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
    # Where a delay is a parameter, the engines do not tell one side of a sample from the other: stop just behind it.
    ahead = np.where(np.isin(ahead, problem.late_times(theta, e)), ahead + side * near, ahead)
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
    threshold: float,
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
        Where J or its slope jumps, and the limit: a piece ends there at the latest.
    threshold : float
        Rise of J up to which the pieces are to be exact.
    side : -1 or 1
    """
    theta, remaining, before = theta.copy(), list(stops), None
    halvings = repeats = 0
    while remaining:
        at = evaluate(theta, side)
        if not np.all(np.abs(at.gradient) < LARGEST):
            return
        here, slope, curvature, (newton, follow) = _eliminate_others(at, k, free)
        value = float(theta[k])
        if repeats < MOST_REPEATS and abs(here.decrement) > RIGHT * threshold:
            repeats += 1
            theta[free] -= newton
            theta = np.clip(theta, lower, upper)
            continue
        repeats = 0
        piece = Piece(value, remaining[0], here.cost - cost, side * slope, curvature)
        halfway = find_halfway(piece, before, threshold, side) if halvings < MOST_HALVINGS else None
        if halfway is None:
            remaining.pop(0)
        else:
            piece, halvings = piece._replace(stop=halfway), halvings + 1
        yield piece
        if halfway is None and is_end_inside(piece, threshold, side):
            return
        before = piece
        theta[free] -= newton + follow * (piece.stop - value)
        theta = np.clip(theta, lower, upper)
        theta[k] = piece.stop


def find_halfway(piece: Piece, before: Piece | None, threshold: float, side: int) -> float | None:
    """Return where a piece is cut off, halfway to where it reaches the threshold; None if it holds as far as it goes.

    It holds if it begins near the threshold, if it ends before it is halfway there, or if the piece before it was right
    about the rise here: errors of parabolas grow with the third power of their length.
    """
    if piece.rise >= NEAR_END**2 * threshold:
        return None
    reach = _find_first_root(threshold - piece.rise, piece.slope, piece.curvature)
    if 0.5 * reach >= side * (piece.stop - piece.start):
        return None
    if before is not None:
        length = side * (before.stop - before.start)
        error = piece.rise - (before.rise + before.slope * length + 0.5 * before.curvature * length**2)
        if abs(error) * reach**3 <= RIGHT * threshold * length**3:
            return None
    return piece.start + 0.5 * side * reach


def is_end_inside(piece: Piece, threshold: float, side: int) -> bool:
    """Return whether a piece begins above the threshold, or reaches it before it ends."""
    reach = 0.0 if piece.rise >= threshold else _find_first_root(threshold - piece.rise, piece.slope, piece.curvature)
    return bool(reach <= side * (piece.stop - piece.start))


def find_ends(pieces: FloatArray, thresholds: FloatArray, side: int) -> FloatArray:
    """Return where profiles first reach thresholds above the estimate; where the last piece ends if they do not.

    A piece is the cubic that also has the rise with which the piece after it begins; the last one is a parabola.

    Parameters
    ----------
    pieces : (..., P, 5)
        `Piece`s, outwards; after the last of them NaN.
    thresholds : (...)
    side : -1 or 1
    """
    found = np.full(pieces.shape[:-2], np.nan)
    searched = np.ones(found.shape, dtype=bool)
    for p in range(pieces.shape[-2]):
        start, stop, rise, slope, curvature = np.moveaxis(pieces[..., p, :], -1, 0)
        after = pieces[..., p + 1, 2] if p + 1 < pieces.shape[-2] else np.full_like(found, np.nan)
        length, height, last = side * (stop - start), thresholds - rise, np.isnan(after)
        with np.errstate(invalid="ignore", divide="ignore"):
            root = slope + np.sqrt(slope**2 + 2 * curvature * height)
            parabola = np.where(root > 0, 2 * height / root, np.inf)
            cubic = np.where(after >= thresholds, _bisect(after - rise, slope, curvature, length, height), np.inf)
            reach = np.where(height <= 0, 0.0, np.where(last, parabola, cubic))
        searched &= ~np.isnan(start)
        found = np.where(searched, start + side * np.minimum(reach, length), found)
        searched &= ~(reach <= length)
    return found


def _bisect(
    gain: FloatArray, slope: FloatArray, curvature: FloatArray, length: FloatArray, height: FloatArray
) -> FloatArray:
    """Return where cubics from 0, with slope and curvature there and a gain after a length, reach a height."""
    third = (gain - slope * length - 0.5 * curvature * length**2) / length**3
    low, high = np.zeros_like(length), length
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        below = middle * (slope + middle * (0.5 * curvature + middle * third)) < height
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return high


class _Cost(NamedTuple):
    """Cost of the profile, and how much lower it is than J before the Newton step of the other unknowns."""

    cost: float
    decrement: float


def _eliminate_others(at: Any, k: int, free: Any) -> tuple[_Cost, float, float, tuple[FloatArray, FloatArray]]:
    """Return cost, slope and curvature of the profile, and how the others follow: at once, and by length."""
    g, H = at.gradient, at.hessian
    rest = np.column_stack([g[free], H[free, k]])
    solved = np.linalg.solve(H[np.ix_(free, free)], rest) if free.any() else rest
    newton, follow = solved.T
    decrement = 0.5 * float(g[free] @ newton)
    cost = _Cost(float(at.cost) - decrement, decrement)
    return cost, float(g[k] - H[k, free] @ newton), float(H[k, k] - H[k, free] @ follow), (newton, follow)


def _find_first_root(height: float, slope: float, curvature: float) -> float:
    """Return the smallest x > 0 with slope x + ½ curvature x² = height > 0; infinite where there is none."""
    square = slope * slope + 2.0 * curvature * height
    if square < 0.0:
        return np.inf
    root = slope + np.sqrt(square)
    return 2.0 * height / root if root > 0.0 else np.inf
