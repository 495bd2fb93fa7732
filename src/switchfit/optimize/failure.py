"""Why a line search found no decrease: rounding, a jump, a kink, a wrong slope, infinite values, or a valley.

J is evaluated at some dozens of points along the direction that failed, and its rounding error is measured there
([1]_). Nothing here changes the state of the minimization.

References
----------
.. [1] J. J. More, S. M. Wild, Estimating computational noise, SIAM J. Sci. Comput. 33 (2011) 1292-1314.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from switchfit.arrays import FloatArray, IntArray
from switchfit.optimize import algebra
from switchfit.optimize.feasibility import move
from switchfit.optimize.oracle import Oracle
from switchfit.optimize.result import LineSearchFailure
from switchfit.optimize.search_direction import SearchDirection
from switchfit.optimize.state import State
from switchfit.optimize.threads import one_thread

#: Part of its distance, and of the step, within which a jump or a kink is located.
LOCATED, SHORTEST = 2.0**-40, 2.0**-60

#: Fractions of the step over which differences of J are taken.
DIFFERENCE_LENGTHS = 10.0 ** -np.arange(1, 6)

#: A slope is wrong where differences of J contradict it by more than this part of it, beyond their own error.
DISAGREES = 0.1

#: Number of unknowns that are named at most.
MOST_NAMED_COORDINATES = 4


def is_below_rounding(oracle: Oracle, state: State, direction: SearchDirection) -> bool:
    """Return whether the decrease that a step still promises is below the rounding error of J.

    This error is a part of J or, where J is a small difference of large terms, as at a perfect fit, more. The largest J
    seen is a bound on it, which says little where the start was far away: between the two the error is measured, as
    standard deviation along the step. Differences of the fourth order of a smooth J at equal distances vanish, those of
    its error do not ([1]_). A jump or a kink makes them large too; it is on one side of the point, so that the smaller
    of both sides counts.
    """
    smallest, largest = 10 * algebra.COST_NOISE * abs(state.point.cost), 10 * algebra.COST_NOISE * state.cost_scale
    # Outside of these two bounds no evaluation is needed.
    if not smallest < direction.reduction <= largest:
        return direction.reduction <= smallest
    found, step = [np.inf], direction.step
    for side in (1.0, -1.0):
        trials = [move(oracle.problem, state.point.theta, side * k / 8 * step, state.scale) for k in range(9)]
        samples = [sample for trial in trials if (sample := oracle.first(trial)) is not None]
        if len(samples) == 9:
            values = [sample.lagrangian(state.point.forces)[0] for sample in samples]
            found.append(math.sqrt(float(np.mean(np.diff(values, 4) ** 2)) / 70))  # 70 = 8! / (4!)²
    return direction.reduction <= 10 * min(found)


class _Place(NamedTuple):
    """J, its slope and its gradient (d,) at a fraction of a step; cost and slope are infinite where not finite."""

    fraction: float
    theta: FloatArray
    cost: float
    slope: float
    gradient: FloatArray

    def excess(self, before: _Place) -> float:
        """Return by how much J rises from a place before this one more than its slopes at both say."""
        return self.cost - before.cost - 0.5 * (self.fraction - before.fraction) * (before.slope + self.slope)


class _Line(NamedTuple):
    """J along a step (d,), and its rounding error; with equality constraints, the Lagrangian."""

    oracle: Oracle
    state: State
    step: FloatArray
    noise: float

    def see(self, fraction: float) -> _Place:
        """Evaluate J at a fraction of the step; at its begin J is known, on the sides of kinks to which it leads."""
        point = self.state.point
        theta = point.theta + fraction * self.step
        sample = self.oracle.sample(theta, 1) if fraction else point.plus
        if sample is None:
            return _Place(fraction, theta, np.inf, np.inf, self.step)
        cost, gradient = sample.lagrangian(point.forces)
        if not fraction:
            gradient = algebra.mix_sides(gradient, point.minus.lagrangian(point.forces)[1], self.step)
        return _Place(fraction, theta, cost, float(gradient @ self.step), gradient)

    def jumps(self, low: _Place, high: _Place) -> bool:
        """Return whether J rises between two places by more than its slopes explain."""
        return high.cost < np.inf and abs(high.excess(low)) > 10 * self.noise

    def bends(self, low: _Place, high: _Place) -> bool:
        """Return whether the slope of J rises between two places by more than a part of what it was at the begin."""
        return high.slope - low.slope > DISAGREES * max(abs(self.see(0.0).slope), abs(low.slope))


@one_thread()
def explain_failure(oracle: Oracle, state: State, direction: SearchDirection) -> LineSearchFailure:
    """Find out why no fraction of a step decreases J although its slope is negative."""
    step, noise = direction.step, algebra.COST_NOISE * max(abs(state.point.cost), 0.01 * state.cost_scale)
    line = _Line(oracle, state, step, noise)
    begin = line.see(0.0)
    # The slope is rounding itself: there is nothing to explain.
    if not begin.slope < 0.0:
        return LineSearchFailure("rounding", {"noise": noise})
    low, high = _locate_rise(line)
    if line.jumps(low, high):
        return LineSearchFailure("jump", {"before": low.cost, "after": high.cost}, _who_jumps(line, low, high))
    # After the jump: differences across one contradict a slope that is right between jumps.
    measured = _contradict_slope(line)
    if measured is not None:
        return LineSearchFailure("wrong slope", {"before": begin.slope, "after": measured})
    if high.cost == np.inf:
        return LineSearchFailure("not finite", {}, _list_places(np.flatnonzero(step), high))
    if line.bends(low, high):
        change = np.abs((high.gradient - low.gradient) * step)
        bent = np.flatnonzero(change > 0.1 * change.max())[:MOST_NAMED_COORDINATES]
        return LineSearchFailure("kink", {"before": low.slope, "after": high.slope}, _list_places(bent, high))
    # J falls for a part of the step, but by less than can be seen; else it falls visibly and rises again, as along a
    # bent valley with walls so steep that no straight step stays in it.
    lost = begin.cost - low.cost <= noise and -0.5 * low.fraction * begin.slope <= noise
    return LineSearchFailure("rounding", {"noise": noise}) if lost else LineSearchFailure("valley", {})


def _list_places(coordinates: IntArray, place: _Place) -> tuple[tuple[int, float], ...]:
    return tuple((i, float(place.theta[i])) for i in coordinates.tolist())


def _locate_rise(line: _Line) -> tuple[_Place, _Place]:
    """Return a place at which J falls, and the next one at which it has risen; the begin twice if it nowhere rises.

    They are as near to each other as makes no difference where J jumps or bends between them, or is not finite from
    there on; where it is smooth, their slopes are nearly equal.
    """
    low = high = begin = line.see(0.0)
    # From the shortest length, a power of 1/64, from which on J is larger.
    for k in range(10):
        there = line.see(64.0**-k)
        if there.cost <= low.cost + line.noise:
            break
        high = there
    # Bisection between a place where J falls and one where it has risen, until the two differ by rounding, or J is
    # smooth between them: a smooth rise is at no place in particular.
    while high.fraction - low.fraction > max(LOCATED * high.fraction, SHORTEST):
        if high.cost < np.inf and not line.jumps(low, high) and not line.bends(low, high):
            break
        middle = line.see(0.5 * (low.fraction + high.fraction))
        rises = middle.cost > begin.cost + line.noise or middle.slope >= 0.0
        low, high = (low, middle) if rises else (middle, high)
    return low, high


def _who_jumps(line: _Line, low: _Place, high: _Place) -> tuple[tuple[int, float], ...]:
    """Find the coordinate whose change across a jump of J makes it jump alone, and its value there.

    Up to four coordinates that the step moves, where none of them does so alone.
    """
    moving = np.flatnonzero(line.step)
    for i in moving[low.theta[moving] != high.theta[moving]].tolist():
        moved = np.where(np.arange(line.step.size) == i, high.theta, low.theta)
        sample = line.oracle.sample(moved, 1)
        cost = low.cost if sample is None else sample.lagrangian(line.state.point.forces)[0]
        if abs(cost - low.cost) > 0.5 * abs(high.cost - low.cost):
            return ((i, float(high.theta[i])),)
    return _list_places(moving[:MOST_NAMED_COORDINATES], high)


def _contradict_slope(line: _Line) -> float | None:
    """Return what differences of J say in place of its slope at the begin, if they contradict it; None if not.

    They have to contradict the slopes farther on as well: at a kink within the shortest difference they do not.
    """
    begin, values, errors, farther = line.see(0.0), [], [], []
    # J is smooth, if it is what it is said to be, up to the next breakpoint or bound.
    low, high = line.oracle.problem.breakpoints.piece(begin.theta, line.oracle.problem.constraints)
    moving = np.flatnonzero(line.step)
    parts = (np.where(line.step > 0.0, high, low) - begin.theta)[moving] / line.step[moving]
    smooth = np.min(parts, where=parts > 0.0, initial=1.0)
    for length in DIFFERENCE_LENGTHS * smooth:
        half, full = line.see(0.5 * length), line.see(length)
        if max(half.cost, full.cost) < np.inf:
            values.append((4 * half.cost - 3 * begin.cost - full.cost) / length)
            errors.append(8 * line.noise / length)
            farther.append(abs(full.excess(half)) / (0.5 * length))
    if len(values) < 2:
        return None
    spread = np.abs(np.diff(values)) + np.array(errors[1:])
    best = int(np.argmin(spread)) + 1
    # The length whose difference changes least to the next shorter one: longer ones have the error of the formula,
    # which falls with the square of the length, shorter ones that of rounding, which grows as 1 / length.
    error = 2 * spread[best - 1] + DISAGREES * max(abs(begin.slope), abs(values[best]))
    return values[best] if min(abs(values[best] - begin.slope), farther[best]) > error else None
