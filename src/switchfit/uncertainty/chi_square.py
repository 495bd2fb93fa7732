"""Chi-square of the residuals, compared with sigma; and the probabilities below which nothing is noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.arrays import FloatArray
from switchfit.runtime import special

UNLIKELY_AS_NOISE = 1e-3
"""Probability below which what is left is not noise: one false alarm in a thousand fits. It is shared among the
channels of a fit, and among the fits of many."""

CLEARLY_OFF = 0.1
"""How far the reduced chi-square must be from 1 as well: with 10,000 samples chi-square rejects a sigma that is 2 %
off, which no instrument is known to."""


def compare_with_sigma(
    chi_square: ArrayLike, freedom: ArrayLike, tests: int = 1
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return the probability of chi-square, or of a larger one, and whether it is not far too small: sigma is then no
    measure of the noise. The probability of one that is not clearly too large is 1; that of each of several tests is
    multiplied by their number.

    Parameters
    ----------
    chi_square, freedom : (R,)
    tests : int
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        above, below = special.chdtrc(freedom, chi_square), special.chdtr(freedom, chi_square)
        ratio = np.asarray(chi_square) / freedom
    # Both are asked for: an unlikely chi-square, and one that is off by what matters (`CLEARLY_OFF`).
    probability = np.where(ratio > 1 + CLEARLY_OFF, np.minimum(1.0, tests * above), 1.0)
    return probability, ~((tests * below < UNLIKELY_AS_NOISE) & (ratio < 1 - CLEARLY_OFF))
