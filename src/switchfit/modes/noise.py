"""Tests whether the residuals of an estimate are the noise that the criteria take them for."""

from __future__ import annotations

import numpy as np

from switchfit.estimation.estimates import Estimate
from switchfit.modes.criterion import Score
from switchfit.uncertainty.doubts import NEARLY_ALL
from switchfit.uncertainty.explained_variance import explain_all

UNEXPLAINED = 1e-6
"""Probability of chi-square below which the data are not explained."""

CORRELATED = 1e-9
"""The same of correlated residuals, by Ljung and Box's statistic, whose tail is heavier than chi-square's: of 200,000
series of 150 random numbers 2e-4 had a probability below 1e-6 at 20 lags."""

WITHIN_NOISE = 0.1
"""Root mean square of residuals, in units of sigma, below which it does not matter how they are correlated: data
without noise leave errors of integration."""


def is_far_from_noise(estimate: Estimate, score: Score) -> bool:
    """Return whether residuals are too correlated to be noise.

    Where sigma is unknown, not if nearly all of the variance is explained: real logs often have such residuals with
    the right modes.

    Parameters
    ----------
    estimate : Estimate
    score : Score
    """
    if not is_correlated(estimate, score, CORRELATED):
        return False
    return score.sigma_known is True or explain_all(estimate.comparisons) < NEARLY_ALL


def is_correlated(estimate: Estimate, score: Score, level: float) -> bool:
    """Return whether residuals that matter are too correlated for noise, by a probability below `level`.

    Parameters
    ----------
    estimate : Estimate
    score : Score
    level : float
    """
    if score.has_chi_square and 2 * estimate.cost < WITHIN_NOISE**2 * score.values:
        return False
    return measure_whiteness(estimate) < level


def measure_worth(estimate: Estimate) -> float:
    """Return how many independent residuals each is worth in the most correlated channel; 1 if none is correlated.

    Parameters
    ----------
    estimate : Estimate
    """
    channels = estimate.residuals.channels
    # Only channels whose correlation is beyond doubt: an estimate of r is never exactly 0.
    found = [c.effective / len(c.values) for c in channels if c.whiteness * len(channels) < UNEXPLAINED]
    return min(found, default=1.0)


def measure_whiteness(estimate: Estimate) -> float:
    """Return the probability of residuals so correlated in the worst channel, times the number of channels.

    1 if no channel has enough residuals for the test.

    Parameters
    ----------
    estimate : Estimate
    """
    found = [channel.whiteness for channel in estimate.residuals.channels if np.isfinite(channel.whiteness)]
    return min(1.0, min(found) * len(found)) if found else 1.0
