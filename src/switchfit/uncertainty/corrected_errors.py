"""Standard errors and intervals of a fit, widened where its residuals are correlated."""

from __future__ import annotations

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.fit.result import Fit
from switchfit.uncertainty.residuals import diagnose


def correct_errors(fit: Fit) -> FloatArray:
    """Return the standard errors of a fit, widened where residuals are correlated: (d,).

    Parameters
    ----------
    fit : Fit
    """
    return np.asarray(measure_widening(fit) * fit.standard_errors)


def correct_intervals(fit: Fit, level: float = 0.95) -> FloatArray:
    """Return the confidence intervals of a fit, widened as `correct_errors` widens standard errors: (d, 2).

    Each side of an interval by itself, on a logarithmic scale its logarithm; cut off at the bounds.

    Parameters
    ----------
    fit : Fit
    level : float, between 0 and 1
    """
    factors, found = measure_widening(fit)[:, None], fit.confidence_intervals(level)
    theta, log = fit.theta[:, None], np.isin(fit.theta_names, fit.log_scaled)[:, None]
    origin = fit.log_origins[:, None]
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):
        size = theta - origin
        # A factor of the logarithm is a power of the ratio.
        wide = np.where(log, origin + size * ((found - origin) / size) ** factors, theta + factors * (found - theta))
    # To the bit as they were where nothing is widened.
    wide = np.where(factors > 1.0, wide, found)
    return np.stack([np.maximum(wide[:, 0], fit.lower), np.minimum(wide[:, 1], fit.upper)], axis=1)


def find_transition_intervals(fit: Fit, e: int, level: float = 0.95) -> FloatArray:
    """Return the interval of each transition time of one experiment, as figures and tables show it: (N, 2).

    As `correct_intervals` has them; NaN for a time that is fixed.

    Parameters
    ----------
    fit : Fit
    e : int, from 0
        Which experiment.
    level : float, between 0 and 1
    """
    every = np.vstack([correct_intervals(fit, level), [np.nan, np.nan]])
    return np.asarray(every[fit.transition_places[e]])  # -1, the last row, for one that is fixed


def measure_widening(fit: Fit) -> FloatArray:
    """Return by how much the standard errors of a fit are too small because residuals are correlated: (d,), at least 1.

    The largest factor of all channels counts; for a transition time, that of the channels of its own run.

    Parameters
    ----------
    fit : Fit
    """
    each = np.ones(len(fit.theta))
    if fit.sigma_known is None or not fit.status.successful:
        return each
    found = diagnose(fit)
    factors = np.ones(len(fit.comparisons))
    for channel, correlated in zip(found.channels, found.correlated, strict=True):
        if correlated:
            factors[channel.experiment] = max(factors[channel.experiment], channel.widening)
    # A parameter acts in all runs, so that the worst of them counts; a transition time is known by its own run alone.
    each *= factors.max(initial=1.0)
    for factor, places in zip(factors, fit.transition_places, strict=True):
        each[places[places >= 0]] = factor
    return each
