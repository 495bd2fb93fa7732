"""Pieces of the profile of a transition time, and the intervals that follow from them at any level.

A piece is an array of five numbers: the transition times where it starts and stops, by how much the profile exceeds J
of the estimate at the start, and its slope and curvature there, in the direction in which the walk goes. The interval
is where 2 (J_p − J) stays below the squared quantile.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray

NUMBERS_OF_PIECE = 5
"""Numbers of a piece."""

JUMP_BETWEEN_PIECES = 0.9
"""Part of the rise of J up to a piece of which the piece before it says nothing where J jumps between them."""

BISECTIONS = 40
"""Halvings of a piece until its crossing of the threshold is known to rounding."""


def find_first_root(height: FloatArray, slope: FloatArray, curvature: FloatArray) -> FloatArray:
    """Return the smallest x > 0 with slope x + ½ curvature x² = height > 0; infinite where there is none: (n,)."""
    with np.errstate(invalid="ignore", divide="ignore"):
        # 2 height / (slope + sqrt(slope^2 + 2 curvature height)) loses no digits where the curvature is small; NaN and
        # a root that is not positive mean that the parabola never gets so high.
        root = slope + np.sqrt(slope * slope + 2.0 * curvature * height)
        return np.where(root > 0.0, 2.0 * height / root, np.inf)


def replace_intervals(
    intervals: FloatArray, pieces: FloatArray, places: NDArray[np.intp], thresholds: FloatArray
) -> FloatArray:
    """Return intervals (..., d, 2) with those of transition times with samples near, or at a kink, from their pieces.

    Parameters
    ----------
    intervals : (..., d, 2)
        From one standard error each.
    pieces : (..., T, 2, P, 5)
        To both sides, NaN after the last.
    places : (T,) int
        Where in theta they stand.
    thresholds : (...)
        By how much J may exceed its minimum.
    """
    found = intervals.copy()
    if not len(places):
        return found
    replaced = ~np.isnan(pieces[..., 0, 0, 0])
    for end, side in enumerate((-1, 1)):
        ends = find_ends(pieces[..., end, :, :], thresholds[..., None], side)
        found[..., places, end] = np.where(replaced, ends, found[..., places, end])
    return found


def find_ends(pieces: FloatArray, thresholds: FloatArray, side: int) -> FloatArray:
    """Return where profiles first reach thresholds above the estimate; where the last piece ends if they do not.

    A piece is the cubic that also has the rise with which the piece after it begins; the last one is a parabola, and so
    is one behind which J jumps, as where a transition with a reset map passes a sample.

    Parameters
    ----------
    pieces : (..., P, 5)
        Outwards; after the last of them NaN.
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
            parabola = find_first_root(height, slope, curvature)
            # The next piece's rise is J itself, where the parabola is a prediction: the cubic meets both ends.
            cubic, risen = np.full_like(found, np.inf), searched & (after >= thresholds)
            if risen.any():
                cubic = np.where(risen, _bisect(after - rise, slope, curvature, length, height), np.inf)
            said = rise + length * (slope + 0.5 * curvature * length)
            jumps = (after >= thresholds) & (after - said > JUMP_BETWEEN_PIECES * after)
            cubic = np.where(jumps, np.minimum(parabola, length), cubic)
            reach = np.where(height <= 0, 0.0, np.where(last, parabola, cubic))
        # Of many profiles at once, some have fewer pieces: theirs end here.
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
