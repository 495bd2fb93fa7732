"""Step size control of the adaptive solve that chooses the mesh.

A step of the Dormand-Prince pair from y at t has the error ``e = h sum_j e_j K_j``. It is accepted if
``norm = rms(e / (atol + rtol max(|y|, |y+|))) < 1``. The next step size is ``h min(10, max(0.2, 0.9 norm^(-1/5)))``,
not larger than h after a rejected step. A step after an accepted one is never shorter than a few units in the last
place of t, and the last step ends at the end time exactly. This is the step size control of SciPy's RK45 (Hairer,
Norsett and Wanner I, section II.4). Steps of the implicit method have the error of `row_errors.estimate_error`, whose
order is 4: the exponent is -1/4. A step whose stages are not found has an error that is NaN, and is rejected.

Functions of one step take ``xp``, the module for their arrays: NumPy, or the namespace of a graph of scalars.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from switchfit.arrays import ArrayModule, FloatArray, Traced

SAFETY, SMALLEST_FACTOR, LARGEST_FACTOR = 0.9, 0.2, 10.0
MACHINE_EPSILON, SMALLEST_DOUBLE = float(np.finfo(float).eps), float(np.nextafter(0.0, 1.0))

EXPONENT, STIFF_EXPONENT = -1 / 5, -1 / 4
"""Minus one over the order of the error, one more than that of the estimate, of explicit and of implicit steps."""


class Tolerances(NamedTuple):
    """Relative and absolute tolerance of a step: (), ()."""

    rtol: Traced
    atol: Traced


class Progress(NamedTuple):
    """State of an adaptive solve.

    Attributes
    ----------
    t : (), time reached
    step : (), size of the next step
    refused : whether the last step was rejected
    stuck : whether the next step would not change t, or is NaN: the solve has failed
    """

    t: Traced
    step: Traced
    refused: Traced
    stuck: Traced


def _measure_error(error: Traced, y: Traced, after: Traced, tolerances: Tolerances, xp: ArrayModule = np) -> Traced:
    """Return the root mean square of an error (n,), relative to the tolerances for a step from y to `after`."""
    relative = error / (tolerances.atol + tolerances.rtol * xp.maximum(xp.abs(y), xp.abs(after)))
    return xp.sqrt((relative * relative).sum() / len(y))


def _shortest_step(t: Traced, xp: ArrayModule = np) -> Traced:
    """Return the shortest step to try at t: about ten units in the last place."""
    return xp.maximum(10.0 * MACHINE_EPSILON * xp.abs(t), 10.0 * SMALLEST_DOUBLE)


def limit_step(t: Traced, step: Traced, end: Traced, xp: ArrayModule = np) -> Traced:
    """Return the step, shortened so that it does not pass the end."""
    return xp.where(end <= t + step, end - t, step)


def judge_error(
    at: Progress,
    end: Traced,
    tolerances: Tolerances,
    y: Traced,
    after: Traced,
    error: Traced,
    exponent: float,
    xp: ArrayModule,
) -> tuple[Progress, Traced]:
    """Accept or reject a step from y to `after`, (n,) each, with an error (n,); choose the size of the next one."""
    norm = _measure_error(error, y, after, tolerances, xp)
    accepted = norm < 1.0
    # h+ = h min(largest, max(0.2, 0.9 norm^(-1/q))), q the order of the error; after a rejection it does not grow.
    largest = xp.where(at.refused, 1.0, LARGEST_FACTOR)
    factor = xp.minimum(xp.maximum(SAFETY * xp.float_power(norm, exponent), SMALLEST_FACTOR), largest)
    step = at.step * xp.where(norm >= 0.0, factor, SMALLEST_FACTOR)  # comparisons with a NaN norm are false
    # Comparisons with a NaN step size are false: the solve is stuck, instead of trying for ever.
    # A step of ten units in the last place changes t by its rounding: below it, the solve has failed.
    stuck = ~(accepted | (_shortest_step(at.t, xp) <= step))
    # The end is taken as it is, not as t + step: the next stretch begins on its bits, and a node is found there.
    t = xp.where(accepted, xp.where(end - at.t <= at.step, end, at.t + at.step), at.t)
    step = xp.where(accepted, xp.maximum(step, _shortest_step(t, xp)), step)
    now = Progress(t, limit_step(t, step, end, xp), ~accepted, stuck)
    return now, xp.where(accepted, after, y)


def first_step(
    slope: Callable[..., FloatArray], t: float, y: FloatArray, end: float, tolerances: Tolerances, exponent: float
) -> float:
    """Choose the size of the first step from ``slope(t, y)`` at y (n,), and one more slope (Hairer et al. I, II.4).

    NaN if a slope is not finite.
    """
    K = slope(t, y)
    with np.errstate(all="ignore"):
        if not np.isfinite(K).all():
            return np.nan
        of_state, of_slope = (float(_measure_error(each, y, y, tolerances)) for each in (y, K))
        if not np.isfinite(of_slope):  # its square overflows: the first step will fail, with a message
            return min(1e-6, end - t)
        # An Euler step h_0 that moves y by 1 % of its size, then h_1 from (h_1)^q max(|f|, |df| / h_0) = 0.01: the
        # smaller of h_1 and 100 h_0 (Hairer, Norsett and Wanner I, section II.4).
        guess = min(1e-6 if of_state < 1e-5 or of_slope < 1e-5 else 0.01 * of_state / of_slope, end - t)
        step = 0.0
        if guess > 0.0:
            ahead = min(t + guess, float(np.nextafter(end, t)))
            bend = float(_measure_error(slope(ahead, y + guess * K) - K, y, y, tolerances)) / guess
            flat = of_slope <= 1e-15 and bend <= 1e-15
            step = max(1e-6, guess * 1e-3) if flat else (0.01 / max(of_slope, bend)) ** -exponent
        step = min(100.0 * guess, step)
        return float(limit_step(t, max(step, float(_shortest_step(t))), end))
