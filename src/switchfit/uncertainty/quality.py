"""How well a fit explains its data: share of the variance of each channel, and chi-square if sigma is known.

- explained share (R²) of a channel: ``1 - sum r² / sum (y - mean)²`` over its samples that are not missing; for a
  reference signal the sums are integrals over time, and channels of weight zero are left out. If measurements do not
  vary, the sum in the denominator is that of y² itself, so that ``1 - share`` is the square of the relative root mean
  square of the residuals (NRMSE); a constant reference has no variance to explain.
- samples that a robust loss treats as outliers are left out, unless they are more than half of all: the fit is then
  wrong, not the samples.
- chi-square: 2 J if all sigmas are known numbers, with `Fit.freedom` degrees of freedom.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from switchfit.fit.result import Fit
from switchfit.fit.trajectory import Comparison
from switchfit.fit.variation import NO_VARIATION
from switchfit.problem.data import FloatArray
from switchfit.runtime import special
from switchfit.uncertainty.residuals import ResidualDiagnostics, diagnose

MOST_OUTLIERS = 0.5
"""Share from which samples beyond the loss scale do not count as outliers: with the usual scales of 1.3 to 3 sigma, up
to a fifth of normal noise is beyond it, and in logs with a tenth of real outliers a third has been observed."""

OUTLYING = 0.2
"""By how much outliers, a seventh of all values, raise the median of the absolute residuals."""

MEDIAN_ERROR = 1.166
"""Standard error of that median of n normal values, relative to it, times sqrt(n): 1 / (2 f(m) m), f their density."""

LARGE_DEVIATION = 2.0
"""Standard errors of that median above which it is not chance. Right fits of 200 values, a twentieth of them outliers,
had medians up to 1.18, wrong ones 1.4 to 5."""


@dataclass(frozen=True)
class ChannelQuality:
    """How well one channel is explained.

    Attributes
    ----------
    label : str
        Its name, with that of the experiment if there are several.
    experiment : int, from 0
    kind : "measurements" or "reference"
    count : int
        Number of values that are not missing.
    explained : float
        Share of the variance that the model explains, at most 1; negative if a constant would fit better. NaN for a
        channel that is 0 throughout, and for a constant reference.
    chi_square : float
        Sum of the squared residuals over sigma; NaN if sigma is unknown.
    whiteness : float
        Probability of the residuals' correlation if they are white; NaN for fewer than 20, and for a reference signal.
    correlated : bool
        Whether the residuals are correlated, see `ResidualDiagnostics.correlated`.
    outliers : float
        Share of the values that a robust loss treats as outliers; 0 without such a loss.
    typical : float
        Median of the absolute residuals over sigma, with a robust loss, relative to that of a standard normal: near 1
        if model and sigma are right, whatever a few outliers are. NaN without such a loss.
    """

    label: str
    experiment: int
    kind: str
    count: int
    explained: float
    chi_square: float
    whiteness: float
    correlated: bool
    outliers: float
    typical: float

    @property
    def are_residuals_large(self) -> bool:
        """Whether the typical residual beside a robust loss is larger than noise and some outliers explain."""
        return _is_large(self.typical, self.count)

    @property
    def probability(self) -> float:
        """Probability of its chi-square, or a larger one, with as many degrees of freedom as values; NaN without."""
        return float(special.chdtrc(self.count, self.chi_square))


@dataclass(frozen=True)
class Quality:
    """How well a fit explains its data.

    Attributes
    ----------
    channels : tuple of ChannelQuality
        Channels with values.
    explained : float
        Share of the variance of all channels: ``1 - sum (r / sigma)² / sum ((y - mean) / sigma)²``, where an unknown
        sigma is 1. NaN without data.
    chi_square : float
        2 J; NaN if sigma is not a known number for all samples, or a loss is robust.
    freedom : int
    residuals : ResidualDiagnostics
    typical : float
        As of a channel, of all channels that have a robust loss.
    are_residuals_large : bool
        Whether that is larger than noise and some outliers explain.
    """

    channels: tuple[ChannelQuality, ...]
    explained: float
    chi_square: float
    freedom: int
    residuals: ResidualDiagnostics
    typical: float
    are_residuals_large: bool

    @property
    def has_chi_square(self) -> bool:
        """Whether chi-square is known and has degrees of freedom."""
        return bool(np.isfinite(self.chi_square))

    @property
    def probability(self) -> float:
        """Probability of chi-square, or of a larger one, if the model and sigma are right; NaN without."""
        return float(special.chdtrc(self.freedom, self.chi_square)) if self.has_chi_square else np.nan

    @property
    def probability_below(self) -> float:
        """Probability of chi-square, or of a smaller one; NaN without."""
        return float(special.chdtr(self.freedom, self.chi_square)) if self.has_chi_square else np.nan

    @property
    def ratio(self) -> float:
        """Reduced chi-square, near 1 if model and sigma are right; NaN without."""
        return self.chi_square / self.freedom if self.has_chi_square else np.nan


def measure_quality(fit: Fit) -> Quality:
    """Return how well a fit explains its data.

    Parameters
    ----------
    fit : Fit
    """
    residuals = diagnose(fit)
    tests = iter(zip(residuals.channels, residuals.correlated, strict=True))
    single = len(fit.comparisons) == 1
    channels: list[ChannelQuality] = []
    ratios = [np.zeros(0)]
    for e, run in enumerate(fit.comparisons):
        for comparison in run:
            for k, name in enumerate(comparison.names):
                if not np.isfinite(comparison.measured[:, k]).any():
                    continue
                if comparison.weights is not None and comparison.weights[k] == 0:
                    continue
                whiteness, correlated = np.nan, False
                if comparison.kind == "measurements":
                    tested, correlated = next(tests)
                    whiteness = tested.whiteness
                squares, spread, _ = _sum_squares(comparison, k)
                if not np.isfinite(squares):
                    continue
                ratios.append(_measure_ratios(comparison, k))
                channels.append(
                    ChannelQuality(
                        label=name if single else f"{fit.run_names[e]} {name}",
                        experiment=e,
                        kind=comparison.kind,
                        count=int(np.isfinite(comparison.measured[:, k]).sum()),
                        explained=1 - squares / spread if spread > 0 else np.nan,
                        chi_square=_compute_chi_square(comparison, k),
                        whiteness=whiteness,
                        correlated=correlated,
                        outliers=_share_outliers(comparison, k),
                        typical=_measure_typical(ratios[-1]),
                    )
                )
    pooled = np.concatenate(ratios)
    judged = fit.sigma_known is True and np.isfinite(fit.residual_variance)
    return Quality(
        channels=tuple(channels),
        explained=explain_all(fit.comparisons),
        chi_square=2 * fit.cost if judged else np.nan,
        freedom=fit.freedom,
        residuals=residuals,
        typical=_measure_typical(pooled),
        are_residuals_large=_is_large(_measure_typical(pooled), len(pooled)),
    )


def explain_channel(comparison: Comparison, k: int) -> float:
    """Return the share of the variance of channel k that is explained; NaN if its variance is zero.

    Parameters
    ----------
    comparison : Comparison
    k : int
        Index of the channel, from 0.
    """
    if comparison.weights is not None and comparison.weights[k] == 0:
        return np.nan
    squares, spread, _ = _sum_squares(comparison, k)
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
            if comparison.weights is not None and comparison.weights[k] == 0:
                continue
            squares, spread, size = _sum_squares(comparison, k)
            if np.isfinite(squares) and spread > 0:
                left, total = left + squares / size, total + spread / size
    return 1 - left / total if total > 0 else np.nan


def _sum_squares(comparison: Comparison, k: int) -> tuple[float, float, float]:
    """Return the sums of squares of the residuals of a channel and of its values about their mean, and the divisor of
    both when channels are added; NaN if the channel has no values.
    """
    y, residual = comparison.measured[:, k], comparison.residuals[:, k]
    there = np.isfinite(residual)
    if comparison.downweighted is not None and _share_outliers(comparison, k) <= MOST_OUTLIERS:
        there &= ~comparison.downweighted[:, k]
    if not there.any():
        return np.nan, np.nan, 1.0
    weight = _compute_weights(comparison)[there]
    y, residual = y[there], residual[there]
    size = 1.0
    if comparison.sigma is not None:
        size = float(np.mean(comparison.sigma[there, k] ** 2))
    elif comparison.weights is not None:
        size = 1.0 / float(comparison.weights[k])
    mean = float(weight @ y / weight.sum()) if weight.sum() > 0 else 0.0
    spread, about_zero = float(weight @ (y - mean) ** 2), float(weight @ y**2)
    if spread <= NO_VARIATION**2 * about_zero:
        spread = about_zero if comparison.kind == "measurements" else 0.0
    return float(weight @ residual**2), spread, size if size > 0 else 1.0


def _share_outliers(comparison: Comparison, k: int) -> float:
    """Return the share of a channel's values that a robust loss treats as outliers."""
    there = np.isfinite(comparison.residuals[:, k])
    if comparison.downweighted is None or not there.any():
        return 0.0
    return float(comparison.downweighted[there, k].mean())


def _measure_ratios(comparison: Comparison, k: int) -> FloatArray:
    """Return a channel's absolute residuals over sigma, without missing ones; none without a robust loss."""
    residual = np.abs(comparison.residuals[:, k])
    if comparison.downweighted is None or comparison.sigma is None:
        return np.zeros(0)
    there = np.isfinite(residual)
    return np.asarray(residual[there] / comparison.sigma[there, k])


def _measure_typical(ratios: FloatArray) -> float:
    """Return the median of absolute residuals over sigma relative to that of a standard normal; NaN of none."""
    return float(np.median(ratios) / special.ndtri(0.75)) if len(ratios) else np.nan


def _is_large(typical: float, count: int) -> bool:
    """Return whether a typical residual of so many values is more than noise and some outliers explain."""
    return bool(typical > 1 + OUTLYING + LARGE_DEVIATION * MEDIAN_ERROR / np.sqrt(max(count, 1)))


def _compute_weights(comparison: Comparison) -> FloatArray:
    """Return the weight of each row: 1 for a sample, that of the trapezoidal rule for a node of a reference signal."""
    if comparison.kind == "measurements":
        return np.ones(len(comparison.times))
    steps = np.diff(comparison.times)
    return 0.5 * (np.append(steps, 0.0) + np.append(0.0, steps))


def _compute_chi_square(comparison: Comparison, k: int) -> float:
    """Return the sum of the squared residuals over sigma; NaN if sigma is unknown or a loss is robust."""
    if comparison.sigma is None or comparison.downweighted is not None:
        return np.nan
    residual = comparison.residuals[:, k]
    there = np.isfinite(residual)
    return float(np.sum((residual[there] / comparison.sigma[there, k]) ** 2))
