"""Errors inside one row: the estimate of an implicit method, and the size of a jump of f between stages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from switchfit.arrays import ArrayModule, Traced
from switchfit.discretization.rows import Factorize, combine
from switchfit.discretization.tableaus import STIFF_DAMPING, STIFF_ERROR

LARGEST_BEND = 0.3
"""Difference of the slopes of a row, relative to their range, above which f jumps in it: of a sine it is above where a
row is longer than half a period; of a jump it is 1 to 3 in an explicit row, and 0.4 to 0.6 in an implicit one."""

SMALLEST_BEND = 1e-4
"""Difference of the slopes, relative to the slope at the start of the row, below which it may be rounding."""


def estimate_error(h: Traced, k: Sequence[Traced], slope: Traced, f_x: Traced, factorize: Factorize) -> Traced:
    """Return an estimate of the error of an implicit row, (n,): Hairer and Wanner II, equation (IV.8.19).

    ``(I - h g D_1 f)^-1 g (h f + sum_j e_j k_j)``, of order 4, with f (n,) and D_1 f (n, n) at the start of the row.
    """
    # The factor (I - h g J)^-1 keeps the estimate bounded along stiff components, for which h f alone would be huge.
    right = STIFF_DAMPING * (h * slope + combine(STIFF_ERROR, k))
    (error,) = factorize(np.array([[STIFF_DAMPING]]), h, [f_x]).solve([right])
    return error


def measure_jump(first: Traced, middle: Traced, last: Traced, bend: Traced, smooth: Traced, xp: ArrayModule) -> Traced:
    """Return h times the jump of f inside a row, (n,); 0 where f seems smooth.

    Parameters
    ----------
    first, middle, last : (n,), h times the slopes of three stages
    bend : (n,), a difference of high order of all of them
    smooth : (n,), h times the change of f from the first to the last stage by the mean of its derivatives there

    Where f is smooth, a difference of high order of the slopes is small beside their range, and the derivatives at the
    first and the last stage explain how the slope changes. Where f jumps, neither holds. The state after such a row may
    be accurate, if it is short, but its derivatives have nothing of how the place of the jump moves.
    """
    change, bend = last - first, xp.abs(bend)
    rest = xp.abs(change - smooth)
    # A jump is what neither the smoothness of f nor its derivatives explain: the smaller of bend and rest counts.
    span = xp.maximum(xp.abs(change), xp.abs(middle - first))
    # Beside the range of the slopes, and beside the slope itself: of a constant slope the range is rounding.
    least = LARGEST_BEND * span + SMALLEST_BEND * xp.abs(first)
    return xp.where(xp.less(least, xp.minimum(bend, rest)), bend, 0.0)
