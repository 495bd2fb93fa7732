"""Step size control of the adaptive solve that chooses the mesh: one description for both engines.

A step of the pair of Dormand and Prince (`tableaus.ADAPTIVE`) from y at t, with the stages of `rows`, has the error
``e = h sum_j e_j K_j``. It is accepted if ``norm = rms(e / (atol + rtol max(|y|, |y+|))) < 1``, and the next length is
``h min(10, max(0.2, 0.9 norm^(-1/5)))``, not longer than h after a step that was refused. A step after an accepted one
is never shorter than a few units in the last place of t, and the last one ends at the end exactly. This is the control
of SciPy's RK45 (Hairer, Norsett and Wanner I, section II.4).

The loop over steps, and the slopes, are each engine's own. Functions of one step take `xp`, the module whose arrays
they are given: NumPy, or the namespace of a graph of scalars.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from switchfit.discretization.rows import combine
from switchfit.discretization.tableaus import ADAPTIVE
from switchfit.problem.data import FloatArray

Array = Any
"""An array of NumPy, whose entries may be the nodes of a graph."""

SAFETY, SMALLEST_FACTOR, LARGEST_FACTOR = 0.9, 0.2, 10.0

EPS, SMALLEST = float(np.finfo(float).eps), float(np.nextafter(0.0, 1.0))

EXPONENT = -1 / 5
"""Minus one over the order of the error, which is one more than that of the estimate."""


class Tolerances(NamedTuple):
    """Relative and absolute tolerance of a step: (), ()."""

    rtol: Array
    atol: Array


class Progress(NamedTuple):
    """Where an adaptive solve stands.

    Attributes
    ----------
    t : (), time reached
    step : (), length of the next step
    refused : whether the last step was refused
    stuck : whether the next step would not change t, or is not a number: the solve has failed
    """

    t: Array
    step: Array
    refused: Array
    stuck: Array


def error_norm(error: Array, y: Array, after: Array, tolerances: Tolerances, xp: Any = np) -> Array:
    """Return the root mean square of an error (n,), relative to what the tolerances allow between y and `after`."""
    relative = error / (tolerances.atol + tolerances.rtol * xp.maximum(xp.abs(y), xp.abs(after)))
    return xp.sqrt((relative * relative).sum() / len(y))


def shortest_step(t: Array, xp: Any = np) -> Array:
    """Return the shortest step that is tried at t: about ten units in the last place."""
    return xp.maximum(10.0 * EPS * xp.abs(t), 10.0 * SMALLEST)


def limit_step(t: Array, step: Array, end: Array, xp: Any = np) -> Array:
    """Return the length of a step that does not pass the end."""
    return xp.where(end <= t + step, end - t, step)


def judge_step(
    at: Progress,
    end: Array,
    tolerances: Tolerances,
    y: Array,
    after: Array,
    slopes: Sequence[Array] | FloatArray,
    xp: Any = np,
) -> tuple[Progress, Array]:
    """Accept or refuse a step, and choose the length of the next one.

    Parameters
    ----------
    y, after : (n,), before and behind the step
    slopes : (s + 1, n), of the stages and behind the step
    """
    norm = error_norm(at.step * combine(ADAPTIVE.error, slopes), y, after, tolerances, xp)
    accepted = norm < 1.0
    largest = xp.where(at.refused, 1.0, LARGEST_FACTOR)
    factor = xp.minimum(xp.maximum(SAFETY * xp.float_power(norm, EXPONENT), SMALLEST_FACTOR), largest)
    step = at.step * xp.where(norm >= 0.0, factor, SMALLEST_FACTOR)  # a norm that is not a number compares as false
    # A length that is not a number compares as false: it is stuck, not tried for ever.
    stuck = ~(accepted | (shortest_step(at.t, xp) <= step))
    t = xp.where(accepted, xp.where(end - at.t <= at.step, end, at.t + at.step), at.t)
    step = xp.where(accepted, xp.maximum(step, shortest_step(t, xp)), step)
    now = Progress(t, limit_step(t, step, end, xp), ~accepted, stuck)
    return now, xp.where(accepted, after, y)


def first_step(
    slope: Callable[[float, FloatArray], FloatArray],
    t: float,
    y: FloatArray,
    K: FloatArray,
    end: float,
    tolerances: Tolerances,
) -> float:
    """Choose the length of the first step from the slope K (n,) at y (n,), and one more (Hairer et al. I, II.4).

    NaN if a slope is not finite.
    """

    def size(error: FloatArray) -> float:
        return float(error_norm(error, y, y, tolerances))

    with np.errstate(all="ignore"):
        if not np.isfinite(K).all():
            return np.nan
        of_state, of_slope = size(y), size(K)
        if not np.isfinite(of_slope):  # too large to be squared: the first step will fail, and say of what
            return min(1e-6, end - t)
        guess = min(1e-6 if of_state < 1e-5 or of_slope < 1e-5 else 0.01 * of_state / of_slope, end - t)
        step = 0.0
        if guess > 0.0:
            ahead = min(t + guess, float(np.nextafter(end, t)))
            bend = size(slope(ahead, y + guess * K) - K) / guess
            flat = of_slope <= 1e-15 and bend <= 1e-15
            step = max(1e-6, guess * 1e-3) if flat else (0.01 / max(of_slope, bend)) ** -EXPONENT
        step = min(100.0 * guess, step)
        return float(limit_step(t, max(step, float(shortest_step(t))), end))
