"""Share of the variance of the data that a model explains (R²), by channel and in all.

``1 - sum r² / sum (y - mean)²`` over the samples of a channel that are not missing; for a reference signal the sums are
integrals over time, and channels of weight zero are left out. If measurements do not vary, the sum in the denominator
is that of y² itself, so that ``1 - share`` is the square of the relative root mean square of the residuals (NRMSE); a
constant reference has no variance to explain.

Samples that a robust loss treats as outliers are left out, unless they are more than half of all or the typical
residual is `FAR_FROM_SIGMA` from sigma too: the fit is then wrong, not the samples.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.fit.comparison import Comparison
from switchfit.fit.data_variation import NO_VARIATION
from switchfit.fit.result import Fit
from switchfit.runtime import special

FAR_FROM_SIGMA = 2.0
"""Factor by which the median of the absolute residuals beside a robust loss exceeds that of normal noise if 40 % of the
values are outliers. Real outliers raise it to 1.2; a mode too few, which left 49 % weighed down, to 3.5."""

HALF = 0.5
"""Share of the variance below which a model explains less than it leaves."""

NO_RESIDUALS = 1e-10
"""Unexplained share that is rounding and tolerance: nothing is read from residuals of that size."""


def explain_channel(comparison: Comparison, k: int) -> float:
    """Return the share of the variance of channel k that is explained; NaN if its variance is zero.

    Parameters
    ----------
    comparison : Comparison
    k : int
        Index of the channel, from 0.
    """
    squares, spread, _ = sum_squares(comparison, k)
    return 1 - squares / spread if spread > 0 else np.nan


def explain_worst(fit: Fit, e: int) -> float:
    """Return the smallest share of the variance that is explained of a channel of a run; infinite without channels.

    Parameters
    ----------
    fit : Fit
    e : int
        Index of the run, from 0.
    """
    shares = [explain_channel(comparison, k) for comparison in fit.comparisons[e] for k in range(len(comparison.names))]
    return min((share for share in shares if np.isfinite(share)), default=np.inf)


def rank_runs(fit: Fit) -> list[int]:
    """Return the indices of the runs, the one with the channel that is explained worst first.

    Parameters
    ----------
    fit : Fit
    """
    return np.argsort([explain_worst(fit, e) for e in range(len(fit.trajectories))], kind="stable").tolist()


def explain_all(runs: Sequence[Sequence[Comparison]]) -> float:
    """Return the share of the variance of all channels that is explained, see `Quality.explained`; NaN without data.

    Parameters
    ----------
    runs : sequence of sequences of Comparison, one for each experiment
    """
    left = total = 0.0
    for comparison in (comparison for run in runs for comparison in run):
        for k in range(len(comparison.names)):
            squares, spread, size = sum_squares(comparison, k)
            if np.isfinite(squares) and spread > 0:
                # Each channel in units of its own noise: metres and degrees add up.
                left, total = left + squares / size, total + spread / size
    return 1 - left / total if total > 0 else np.nan


def sum_squares(comparison: Comparison, k: int) -> tuple[float, float, float]:
    """Return the sums of squares of the residuals of a channel and of its values about their mean, and the divisor of
    both when channels are added; NaN if the channel has no values or no weight.
    """
    y, residual = comparison.measured[:, k], comparison.residuals[:, k]
    there = np.isfinite(residual)
    if not there.any() or (comparison.weights is not None and comparison.weights[k] == 0):
        return np.nan, np.nan, 1.0
    # There is no telling outliers from a wrong fit without the size of the noise.
    if comparison.downweighted is not None and comparison.sigma is not None:
        outliers = comparison.downweighted[there, k]
        # Indexed by itself: `outliers` has an entry only for values that are there.
        there[there] = ~outliers | (not are_outliers(outliers, residual[there] / comparison.sigma[there, k]))
    weight = _compute_weights(comparison)[there]
    y, residual = y[there], residual[there]
    size = 1.0
    if comparison.sigma is not None:
        size = float(np.mean(comparison.sigma[there, k] ** 2))
    elif comparison.weights is not None:
        size = 1.0 / float(comparison.weights[k])
    mean = float(weight @ y / weight.sum()) if weight.sum() > 0 else 0.0
    spread, about_zero = float(weight @ (y - mean) ** 2), float(weight @ y**2)
    # Values that do not vary have a spread of rounding, of which any residual is a multiple.
    if spread <= NO_VARIATION**2 * about_zero:
        spread = about_zero if comparison.kind == "measurements" else 0.0
    return float(weight @ residual**2), spread, size if size > 0 else 1.0


def are_outliers(weighed_down: NDArray[np.bool_], z: FloatArray) -> bool:
    """Return whether samples (n,) that a robust loss weighs down are to blame, and not the fit; z in units of sigma."""
    return bool(np.mean(weighed_down) <= HALF and np.median(np.abs(z)) <= FAR_FROM_SIGMA * special.ndtri(0.75))


def _compute_weights(comparison: Comparison) -> FloatArray:
    """Return the weight of each row: 1 for a sample, that of the trapezoidal rule for a node of a reference signal."""
    if comparison.kind == "measurements":
        return np.ones(len(comparison.times))
    steps = np.diff(comparison.times)
    # Half a step from each side, so that a mesh that is fine somewhere does not count more there.
    return 0.5 * (np.append(steps, 0.0) + np.append(0.0, steps))
