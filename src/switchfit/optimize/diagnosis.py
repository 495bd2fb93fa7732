"""Why a line search found no decrease: what J is really like along the direction that failed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

Line = Callable[[float], tuple[float, float] | None]
"""``line(a)``: J and its slope at the fraction a of the step; None where they are not finite."""

LENGTHS = 10.0 ** -np.arange(1, 6)
"""Fractions of the step over which differences of J are taken."""

DISAGREES = 0.1
"""A slope is wrong where differences of J contradict it by more than this part of it, beyond their own error."""

BISECTIONS = 60


@dataclass(frozen=True)
class Finding:
    """What J is like along a line.

    Attributes
    ----------
    kind : {"wrong slope", "jump", "kink", "not finite", "rounding", "valley"}
    at : float
        Fraction of the step where that is.
    before, after : float
        J on both sides of a jump; the slope on both sides of a kink; the slope and the difference quotient where the
        slope is wrong.
    places : tuple of (int, float)
        Coordinates of the jump or the kink, or of the point from which on J is not finite, and where each of them is
        there.
    entries : tuple of (int, float, float)
        Coordinates whose derivative is wrong: the derivative, and the difference quotient.
    noise : float
        Rounding error of J, where that is the reason.
    condition : float
        Condition number of the scaled Hessian, where a valley is the reason.
    """

    kind: Literal["wrong slope", "jump", "kink", "not finite", "rounding", "valley"]
    at: float = 0.0
    before: float = np.nan
    after: float = np.nan
    places: tuple[tuple[int, float], ...] = ()
    entries: tuple[tuple[int, float, float], ...] = ()
    noise: float = np.nan
    condition: float = np.nan


def find_reason(line: Line, noise: float, smooth: float) -> Finding:
    """Find out why no fraction of a step decreases J although its slope is negative.

    Parameters
    ----------
    line : callable
    noise : float
        Rounding error of J.
    smooth : float
        Fraction up to which J is smooth if it is what it is said to be: up to the next breakpoint.
    """
    here = line(0.0)
    if here is None or not here[1] < 0.0:
        return Finding("rounding")
    risen = _find_shortest_rise(line, here[0] + noise)
    jump = None if risen is None else find_jump(line, 0.0, risen, noise)
    if jump is not None:  # before the slope: differences across jumps contradict a slope that is right between them
        return jump
    measured = wrong_slope(line, noise, smooth)
    if measured is not None:
        return Finding("wrong slope", 0.0, here[1], measured)
    if risen is None:
        return Finding("rounding")
    low, high, left, right = 0.0, risen, here[1], _get_slope(line(risen))
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        slope = _get_slope(line(middle))
        if slope >= 0.0:
            high, right = middle, slope
        else:
            low, left = middle, slope
    if right == np.inf:
        return Finding("not finite", high)
    if right - left > DISAGREES * max(abs(here[1]), abs(left)):
        return Finding("kink", high, left, right)
    bottom = line(low)
    lost = bottom is not None and here[0] - bottom[0] <= noise and -0.5 * low * here[1] <= noise
    return Finding("rounding" if lost else "valley")


def _get_slope(there: tuple[float, float] | None) -> float:
    """Return the slope of J at a point of a line; infinite where J is not finite."""
    return np.inf if there is None else there[1]


def _find_shortest_rise(line: Line, cost: float) -> float | None:
    """Return the shortest fraction, a power of 1/64, from which on J is larger than a cost; None if there is none."""
    risen = None
    for fraction in (2.0 ** -np.arange(0, BISECTIONS, 6)).tolist():
        there = line(fraction)
        if there is not None and there[0] <= cost:
            break
        risen = fraction
    return risen


def measure_noise(line: Callable[[float], float | None]) -> float:
    """Return the standard deviation of the error of J, a function of the fraction of a step; infinite if unknown.

    Differences of the fourth order of a smooth J at equal distances vanish, those of its error do not ([1]_). A jump or
    a kink makes them large too; it is on one side of the point, so that the smaller of both sides counts.

    References
    ----------
    .. [1] J. J. More, S. M. Wild, Estimating computational noise, SIAM J. Sci. Comput. 33 (2011) 1292-1314.
    """
    found = []
    for side in (1.0, -1.0):
        values = [value for k in range(9) if (value := line(side * k / 8)) is not None]
        if len(values) == 9:
            found.append(math.sqrt(float(np.mean(np.diff(values, 4) ** 2)) / 70))  # 70 = 8! / (4!)²
    return min(found, default=math.inf)


def find_jump(line: Line, low: float, high: float, noise: float) -> Finding | None:
    """Find where J jumps between two fractions of a step, unexplained by its slopes on both sides; None: nowhere.

    Bisection keeps the half in which J and the mean of its slopes at the ends disagree more; a jump stays where the
    disagreement of a smooth function, or of one with a kink, vanishes with the length.
    """
    left, right = line(low), line(high)
    if left is None or right is None:
        return None
    first = abs(_excess(low, left, high, right))
    if not first > 10 * noise:
        return None
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        there = line(middle)
        if there is None:
            return None
        if not low < middle < high:
            break
        if abs(_excess(low, left, middle, there)) >= abs(_excess(middle, there, high, right)):
            high, right = middle, there
        else:
            low, left = middle, there
        if not abs(_excess(low, left, high, right)) > 10 * noise:
            return None
    return Finding("jump", high, left[0], right[0])


def _excess(low: float, left: tuple[float, float], high: float, right: tuple[float, float]) -> float:
    """Return by how much J rises more than its slopes at the ends say."""
    return right[0] - left[0] - 0.5 * (high - low) * (left[1] + right[1])


def wrong_slope(line: Line, noise: float, smooth: float) -> float | None:
    """Return what differences of J say in place of its slope at 0, if they contradict it; None if they do not.

    They have to contradict the slopes farther on as well: at a kink within the shortest difference they do not.
    """
    here = line(0.0)
    if here is None:
        return None
    values, errors, farther = [], [], []
    for length in LENGTHS * min(smooth, 1.0):
        half, full = line(0.5 * length), line(length)
        if half is None or full is None:
            continue
        values.append((4 * half[0] - 3 * here[0] - full[0]) / length)
        errors.append(8 * noise / length)
        farther.append(abs(_excess(0.5 * length, half, length, full)) / (0.5 * length))
    if len(values) < 2:
        return None
    spread = np.abs(np.diff(values)) + np.array(errors[1:])
    best = int(np.argmin(spread)) + 1
    error = 2 * spread[best - 1] + DISAGREES * max(abs(here[1]), abs(values[best]))
    return values[best] if min(abs(values[best] - here[1]), farther[best]) > error else None
