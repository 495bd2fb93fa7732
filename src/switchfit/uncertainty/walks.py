"""Walks from estimates of transition times to both sides: where they begin, where they stop, what follows.

Between two sample times J is smooth in a transition time; at each of them its slope and its curvature jump. A walk
goes from the estimate outwards, to one side; its stops are the sample times on its way. All walks of many fits are
arrays, so that they go on together, a piece at a time, in few calls (`switchfit.uncertainty.walk_tracing`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.problem.problem import Problem

AT_SAMPLE = 1e-9
"""A transition time nearer to a sample time than this part of the horizon is at it."""

SMALLEST_PART_OF_ESTIMATE = 1e-3
"""Part of its estimate to which an unknown on a logarithmic scale may fall while it follows a transition time."""


class Derivatives(NamedTuple):
    """Costs (n,), gradients (n, d) and Hessians (n, d, d) of n evaluations."""

    cost: FloatArray
    gradient: FloatArray
    hessian: FloatArray


class Walks(NamedTuple):
    """W ways from estimates of transition times, each to one side.

    Attributes
    ----------
    theta : (W, d)
        Where they begin.
    place : (W,) int
        Of the transition time in theta.
    side : (W,) int
        -1 or 1.
    free : (W, d) bool
        Unknowns that follow.
    stops : (W, S)
        Where J or its slope jumps, outwards, and then how far the transition time may move alone; NaN behind that.
    limit : (W,)
        The last of these.
    lower, upper : (W, d)
    threshold : (W,)
        Rise of J up to which the pieces are to be exact.
    """

    theta: FloatArray
    place: NDArray[np.intp]
    side: NDArray[np.intp]
    free: NDArray[np.bool_]
    stops: FloatArray
    limit: FloatArray
    lower: FloatArray
    upper: FloatArray
    threshold: FloatArray


def list_transitions(problem: Problem) -> Iterator[tuple[int, int]]:
    """Yield the experiment and the place in theta of each free transition time, and of a free tf."""
    for e, where in enumerate(problem.unknowns.times):
        for place in where[where >= 0].tolist():
            yield e, place


def list_sample_times(problem: Problem, theta: FloatArray, e: int) -> FloatArray:
    """Return the times of the states that were measured in an experiment, delays subtracted, in ascending order.

    Parameters
    ----------
    problem : Problem
    theta : (d,)
        With delays that are parameters.
    e : int, from 0
    """
    known = [item.seen_times for item in problem.experiments[e].measurements if not isinstance(item.delay, str)]
    return np.unique(np.concatenate([problem.late_times(theta, e), *known]))


def stack_sample_times(problem: Problem, thetas: FloatArray, e: int) -> FloatArray:
    """Return the times of the states that were measured in an experiment, of F fits, where the slope of J in a
    transition time jumps: (F, S), NaN where a fit has fewer than others.

    Parameters
    ----------
    problem : Problem
    thetas : (F, d)
    e : int, from 0
    """
    if not problem.late_times(thetas[0], e).size:
        return np.tile(list_sample_times(problem, thetas[0], e), (len(thetas), 1))
    each = [list_sample_times(problem, theta, e) for theta in thetas]
    times = np.full((len(thetas), max(map(len, each))), np.nan)
    for f, own in enumerate(each):
        times[f, : own.size] = own
    return times


def list_walks(
    problem: Problem,
    e: int,
    place: int,
    thetas: FloatArray,
    free: NDArray[np.bool_],
    thresholds: FloatArray,
    samples: FloatArray,
    most: int,
) -> Walks:
    """Return the ways from the estimates of one transition time of F fits: 2 F, first all to the left.

    Parameters
    ----------
    problem : Problem
    e, place : int
        The experiment, and the place in theta of the transition time.
    thetas : (F, d)
    free : (F, d) bool
        Unknowns that are not held.
    thresholds : (F,)
    samples : (F, S)
        Sample times of experiment e.
    most : int
        Sample times that are passed on one way; with more of them in an interval the kinks average out.
    """
    unknowns = problem.unknowns
    # Unknowns follow along a straight line, which may lead a lag or a sigma on a logarithmic scale to 0.
    smallest = unknowns.origin + SMALLEST_PART_OF_ESTIMATE * (thetas - unknowns.origin)
    lower = np.where(unknowns.log, np.maximum(unknowns.lower, smallest), unknowns.lower)
    upper = np.tile(unknowns.upper, (len(thetas), 1))
    for run, where in zip(problem.experiments, unknowns.times, strict=True):
        times = where[where >= 0]
        lower[:, times] = np.maximum(lower[:, times], run.t0)
        upper[:, times] = np.minimum(upper[:, times], run.end)
    # Bounds hold unknowns for a part of a way.
    at_bound = np.isclose(thetas, unknowns.lowest, rtol=AT_SAMPLE, atol=0.0) | (thetas >= unknowns.upper)
    others = free | (at_bound & ~unknowns.is_time)
    others[:, place] = False
    knots, tau = problem.ends_of_modes(thetas)[e], thetas[:, place]
    beyond = np.full((len(thetas), 1), np.inf)  # a free tf has no neighbour behind it
    i = int(np.flatnonzero(unknowns.times[e] == place)[0]) + 1
    near = AT_SAMPLE * (knots[:, -1] - knots[:, 0])[:, None]
    ways = []
    for side in (-1, 1):
        neighbour = np.concatenate([knots, beyond], axis=1)[:, i + side]
        limit = np.clip(neighbour, lower[:, place], upper[:, place])
        with np.errstate(invalid="ignore"):
            ahead = (side * (samples - tau[:, None]) > near) & (side * (samples - limit[:, None]) < 0)
        # Stop just behind: where a delay is a parameter, engines do not tell one side of a sample from the other.
        marks = samples + side * near
        # Samples ahead in the order in which the way meets them, then the limit, then NaN.
        outwards = np.sort(np.where(ahead, side * marks, np.inf), axis=1)[:, :most]
        stops = np.full((len(thetas), most + 2), np.nan)
        stops[:, : outwards.shape[1]] = np.where(np.isfinite(outwards), side * outwards, np.nan)
        stops[np.arange(len(thetas)), np.sum(np.isfinite(outwards), axis=1)] = limit
        each = np.full(len(thetas), place, dtype=np.intp), np.full(len(thetas), side, dtype=np.intp)
        ways.append(Walks(thetas, *each, others, stops, limit, lower, upper, thresholds))
    return join_walks(ways)


def join_walks(ways: Sequence[Walks]) -> Walks:
    """Return several lots of ways, with as many stops each, as one."""
    return Walks(*map(np.concatenate, zip(*ways, strict=True)))
