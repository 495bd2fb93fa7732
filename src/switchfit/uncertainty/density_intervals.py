"""Intervals of transition times at which a measured state jumps: quantiles of the density exp(−J_p).

Where a state jumps that is measured, J jumps at samples, as that of a change point: 2 (J_p − J) at the truth is no
chi-square then, but up to twice as large at the same level ([1]_), and it falls below the quantile again behind higher
places. The time is a parameter of location, of which the density exp(−J_p) has intervals that hold the truth as often
as they say; so its quantiles are taken.

References
----------
.. [1] B. E. Hansen, Sample splitting and threshold estimation, Econometrica 68 (2000) 575-603.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.fit.result import Fit
from switchfit.uncertainty.profile_pieces import find_first_root

HIGHEST_RISE = 8.0
"""Rise of J, in variances of the noise, up to which the density of a transition time with a reset map is followed."""

LEAST_JUMP = 0.25
"""Jump of J between two pieces, in variances of the noise, that is no error of parabolas."""

POINTS_OF_DENSITY = 41
"""Points of a piece at which a density is taken."""


def list_resets(fit: Fit) -> list[int]:
    """Return where in theta the transition times stand at which the state jumps."""
    found: list[int] = []
    for path, places in zip(fit.trajectories, fit.transition_places, strict=True):
        # Places in the trajectory at which a segment begins; the node before has the state before the transition.
        after = path.segments[1:-1]
        jumps = (path.states[after] != path.states[after - 1]).any(axis=1)
        found += places[jumps & (places >= 0)].tolist()
    return found


def replace_where_cost_jumps(
    intervals: FloatArray, pieces: FloatArray, places: NDArray[np.intp], fit: Fit, level: float
) -> FloatArray:
    """Return intervals (d, 2) with those of transition times at which J jumps between pieces from its density.

    Parameters
    ----------
    intervals : (d, 2)
    pieces : (T, 2, P, 5)
    places : (T,) int
    fit : Fit
    level : float
    """
    found, scale, resets = intervals.copy(), fit.variance_scale, list_resets(fit)
    for own, place in zip(pieces, places.tolist(), strict=True):
        sides = [side[~np.isnan(side[:, 0])] for side in own]
        # Without a jump of J the state that jumps is not measured near by: the time is like any other.
        if place in resets and any(_find_jumps(side).max() > LEAST_JUMP * scale for side in sides):
            low, high = _find_quantiles(sides, scale, level)
            # J may be lowest at the edge of what is likely, beside a sample: the estimate is never left out.
            found[place] = min(low, fit.theta[place]), max(high, fit.theta[place])
    return found


def _find_jumps(pieces: FloatArray) -> FloatArray:
    """Return by how much each of the pieces to a side (P, 5) begins beside where the one before it ends: (P,)."""
    # J at the beginning of each piece, and its slope and curvature outwards: J at the end of it follows.
    start, stop, rise, slope, curvature = pieces.T
    length = np.abs(stop - start)
    ends = rise + length * (slope + 0.5 * curvature * length)
    # The first piece begins at the estimate, where the rise is 0.
    return np.abs(rise - np.append(0.0, ends[:-1]))


def _find_quantiles(sides: Sequence[FloatArray], scale: float, level: float) -> FloatArray:
    """Return the ends of the interval that has the middle part, its level, of the density of pieces to both sides."""
    values, costs = [], []
    for sign, pieces in zip((-1, 1), sides, strict=True):
        start, stop, rise, slope, curvature = pieces.T[..., None]
        length, left = np.abs(stop - start), HIGHEST_RISE * scale - rise[-1]
        # The last piece as far as it is known.
        reach = find_first_root(left, slope[-1], curvature[-1]) if left > 0.0 else 0.0
        length[-1] = np.minimum(length[-1], reach)
        along = length * np.linspace(0.0, 1.0, POINTS_OF_DENSITY)
        # Left pieces run outwards from the estimate: reversed, so that x ascends over both sides.
        values.append((start + sign * along).ravel()[::sign])
        costs.append((rise + along * (slope + 0.5 * curvature * along)).ravel()[::sign])
    # Trapezoids over x; ends of two pieces at one x have no width between them, so that a jump adds nothing.
    x, density = np.concatenate(values), np.exp(-np.concatenate(costs) / scale)
    below = np.append(0.0, np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(x)))
    return np.interp([0.5 * (1.0 - level), 0.5 * (1.0 + level)], below / below[-1], x)
