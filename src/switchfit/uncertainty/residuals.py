"""Tests of the residuals of a fit: are they white, as the assumed noise is?

Each channel is tested by itself, in the order of its samples that are not missing. At irregular sample times, a lag
counts samples. Standardized residuals are z = (measured - fitted) / sigma; if sigma is unknown, they are divided by
their own root mean square.

- whiteness: Ljung and Box's Q = n (n + 2) sum_k r_k^2 / (n - k) over the first h lags, chi-square with h degrees of
  freedom, h = min(10, n / 5) ([1]_, [2]_);
- effective sample size: n (1 - r) / (1 + r), at most n: the number of independent samples that are worth n samples
  with first-order autoregressive noise, whose correlation r is r_1 without its bias (`correct_correlation`).

References
----------
.. [1] G. M. Ljung, G. E. P. Box, On a measure of lack of fit in time series models, Biometrika 65 (1978) 297-303.
.. [2] R. J. Hyndman, G. Athanasopoulos, Forecasting: Principles and Practice, 3rd ed., section 5.4 (number of lags).
.. [3] M. G. Kendall, Note on bias in the estimation of autocorrelation, Biometrika 41 (1954) 403-404.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.fit.comparison import Comparison
from switchfit.fit.result import Fit
from switchfit.fit.trajectory import Trajectory
from switchfit.problem.origin import Origin
from switchfit.runtime import special
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import Printed, format_line, join_first
from switchfit.uncertainty.chi_square import UNLIKELY_AS_NOISE

SERIOUS_WIDENING = 1.2
"""Factor by which standard errors may be too small, and a typical residual beside a robust loss too large: a 95 %
interval that is too narrow by this factor covers 90 %, and a seventh of all values, if they are outliers, raise the
median of the absolute residuals by it."""

FEWEST_RESIDUALS = 20
"""Smallest number of residuals for the tests: with fewer, their statistics are far from chi-square."""


@dataclass(frozen=True, eq=False)
class ChannelResiduals:
    """The residuals of one channel of Measurements.

    Attributes
    ----------
    name : str
    times, values : (n,), (n,)
        Sample times and standardized residuals of the samples that are not missing.
    sigma_known : bool
    mean : float
        Mean of the standardized residuals; 1 / sqrt(n) is its standard deviation if they are white.
    rms : float
        Root mean square of the standardized residuals: near 1 if sigma is right, 1 if it is unknown.
    autocorrelation : (h,)
        At lags 1, 2, ..., h.
    whiteness : float
        Probability of Ljung and Box's statistic, or a larger one, if the residuals are white; NaN for fewer than 20.
    effective : float
        Effective sample size.
    outliers : int
        Number of residuals beyond four standard deviations; 0.001 are expected in 16 samples.
    experiment : int, from 0
    time_unit : str
        Unit of the experiment's times.
    origin : Origin or None
        The date at which times are 0; None where they are no dates.

    See Also
    --------
    ResidualDiagnostics, Estimate.residuals

    Examples
    --------
    >>> fit = sf.estimate(heater_problem())

    >>> channel = fit.residuals.channels[0]
    >>> channel.name, len(channel.values), channel.white
    ('thermometer', 24, True)
    """

    name: str
    times: FloatArray
    values: FloatArray
    sigma_known: bool
    mean: float
    rms: float
    autocorrelation: FloatArray
    whiteness: float
    effective: float
    outliers: int
    experiment: int = 0
    time_unit: str = "s"
    origin: Origin | None = None

    def __repr__(self) -> str:
        return format_line(self, self.name, f"{len(self.values)} values", f"rms = {self.rms:.3g}")

    @property
    def correlation(self) -> float:
        """Correlation of neighboring residuals, at lag 1; 0 if there are too few residuals."""
        return float(self.autocorrelation[0]) if len(self.autocorrelation) else 0.0

    @property
    def white(self) -> bool:
        """Whether the test of whiteness is passed (or there are too few residuals to test)."""
        return not self.whiteness < UNLIKELY_AS_NOISE

    @property
    def narrowing(self) -> float:
        """Factor by which standard errors that assume independent residuals are too small."""
        return float(np.sqrt(len(self.values) / self.effective))

    @property
    def widening(self) -> float:
        """Factor that corrects standard errors for correlated residuals, and for residuals larger than sigma; at least
        1.
        """
        size = self.rms if self.sigma_known else 1.0
        return max(1.0, size * self.narrowing)

    @property
    def is_seriously_correlated(self) -> bool:
        """Whether the correlation of the residuals has an effect on standard errors that matters."""
        return self.correlation > 0 and min(self.narrowing, self.widening) > SERIOUS_WIDENING


@dataclass(frozen=True, eq=False)
class ResidualDiagnostics(Printed):
    """Tests of the residuals of all channels; print it.

    Attributes
    ----------
    channels : tuple of ChannelResiduals
    labels : tuple of str
        Name of each channel, with the experiment's name if there are several.

    See Also
    --------
    ChannelResiduals, Estimate.plot_residuals

    Examples
    --------
    >>> fit = sf.estimate(heater_problem())

    >>> fit.residuals.passed, fit.residuals.labels
    (True, ('thermometer',))
    """

    channels: tuple[ChannelResiduals, ...]
    labels: tuple[str, ...]

    def __repr__(self) -> str:
        return format_line(self, join_first(self.labels) or "no channels")

    @property
    def passed(self) -> bool:
        """Whether all residuals look white."""
        return all(channel.white for channel in self.channels)

    @property
    def correlated(self) -> tuple[bool, ...]:
        """Which channels have correlated residuals: beyond chance, and with an effect on standard errors that matters.

        The probability of a false alarm is divided among the channels.
        """
        shared = UNLIKELY_AS_NOISE / max(len(self.channels), 1)
        return tuple(c.whiteness < shared and c.is_seriously_correlated for c in self.channels)

    @property
    def issues(self) -> list[Issue]:
        """Failed tests: channels whose residuals are correlated."""
        named = zip(self.labels, self.channels, self.correlated, strict=True)
        alike = [(label, channel) for label, channel, correlated in named if correlated]
        if not alike:
            return []
        figures: dict[str, float | tuple[float, ...]] = {
            "correlation": tuple(c.correlation for _, c in alike),
            "values": float(sum(len(c.values) for _, c in alike)),
            "effective": float(sum(c.effective for _, c in alike)),
            "narrowing": max(c.widening for _, c in alike),
        }
        return [Issue("correlated residuals", tuple(label for label, _ in alike), figures)]


def diagnose(fit: Fit) -> ResidualDiagnostics:
    """Test the residuals of a fit, channel by channel.

    Parameters
    ----------
    fit : Fit
    """
    unknowns = fit.free_basis.shape[1] / max(fit.samples, 1)
    return diagnose_runs(fit.comparisons, fit.run_names, fit.trajectories, unknowns=unknowns)


def diagnose_runs(
    runs: Sequence[Sequence[Comparison]],
    names: Sequence[str],
    trajectories: Sequence[Trajectory],
    *,
    unknowns: float = 0.0,
) -> ResidualDiagnostics:
    """Test the residuals of several experiments, channel by channel.

    Parameters
    ----------
    runs : sequence of sequences of Comparison, one for each experiment
    names : sequence of str, one for each experiment
    trajectories : sequence of Trajectory, one for each experiment
        For the unit and the origin of the times.
    unknowns : float
        Number of unknowns that were fitted, for each sample; 0 for residuals of a prediction.
    """
    channels, labels = [], []
    for label, e, comparison, k in list_channels(runs, names):
        if comparison.kind == "measurements":
            found, run = diagnose_channel(comparison, k, unknowns=unknowns), trajectories[e]
            channels.append(replace(found, experiment=e, time_unit=run.time_unit, origin=run.origin))
            labels.append(label)
    return ResidualDiagnostics(tuple(channels), tuple(labels))


def list_channels(
    runs: Sequence[Sequence[Comparison]], names: Sequence[str]
) -> Iterator[tuple[str, int, Comparison, int]]:
    """Yield the label of each channel with values, its experiment, and its comparison with its place there.

    Parameters
    ----------
    runs : sequence of sequences of Comparison, one for each experiment
    names : sequence of str, one for each experiment
        Part of the labels if there are several.
    """
    for e, comparisons in enumerate(runs):
        for comparison in comparisons:
            for k, name in enumerate(comparison.names):
                if np.isfinite(comparison.measured[:, k]).any():
                    yield name if len(runs) == 1 else f"{names[e]} {name}", e, comparison, k


def diagnose_channel(comparison: Comparison, k: int, *, unknowns: float = 0.0) -> ChannelResiduals:
    """Test one channel of a comparison.

    Parameters
    ----------
    comparison : Comparison
    k : int
        Index of the channel, from 0.
    unknowns : float
        As in `diagnose_runs`.
    """
    raw = comparison.residuals[:, k]
    there = np.isfinite(raw)
    # Without a sigma, the residuals' own size: their rms is then 1 by construction.
    size = np.sqrt(np.mean(raw[there] ** 2)) if comparison.sigma is None else comparison.sigma[there, k]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.nan_to_num(raw[there] / size)
    n = len(z)
    # More lags than a fifth of the values would test noise of the correlations themselves.
    lags = min(10, n // 5)
    r = compute_autocorrelation(z, lags)
    spread = z - z.mean()
    variance = float(np.mean(spread**2))
    whiteness = np.nan
    if n >= FEWEST_RESIDUALS and variance > 0:  # Ljung and Box
        Q = n * (n + 2) * float(np.sum(r**2 / (n - np.arange(1, lags + 1))))
        whiteness = float(special.chdtrc(lags, Q))
    # The lags are those of residuals, whose correlation the fit has lowered; the samples are worth n (1 - r) / (1 + r).
    first = correct_correlation(float(r[0]), n, unknowns * n) if lags else 0.0
    return ChannelResiduals(
        name=comparison.names[k],
        times=comparison.times[there],
        values=z,
        sigma_known=comparison.sigma is not None,
        mean=float(z.mean()),
        rms=float(np.sqrt(np.mean(z**2))),
        autocorrelation=r,
        whiteness=whiteness,
        effective=min(n, n * (1 - first) / (1 + first)),
        outliers=int(np.sum(np.abs(spread) > 4 * np.sqrt(variance))) if variance > 0 else 0,
    )


def correct_correlation(first: float, n: int, unknowns: float) -> float:
    """Return the correlation of neighbors in the noise, from that of n residuals of a fit, which is smaller.

    With first-order autoregressive noise of correlation r and unknowns whose effects vary slowly from sample to sample,
    residuals have r_1 with the expectation

        r - (3 r + d (1 + r)) / n + O(1 / n^2)

    for d unknowns. Derivation: sum z_k z_(k-1) has the expectation (n - 1) r - d (1 + r) / (1 - r) in units of the
    variance, sum z_k^2 has n - d (1 + r) / (1 - r), since a slow direction takes the spectrum at frequency 0 out of
    both; the covariance of the two sums adds -2 r / n. With d = 1, and without the -r / n of the n - 1 products, it is
    the ``-(1 + 3 r) / n`` of [3]_ (of the module).

    The result is used to first order in 1 / n, up to that with which the samples are worth d + 1.

    Parameters
    ----------
    first : float
        r_1.
    n : int
    unknowns : float
        d.
    """
    first = float(np.clip(first, -0.999, 0.999))
    most = (n - unknowns - 1) / (n + unknowns + 1)  # n (1 - r) / (1 + r) = d + 1
    corrected = first + (3 * first + unknowns * (1 + first)) / n
    return max(first, min(corrected, most)) if first > 0 else first


def compute_autocorrelation(z: FloatArray, lags: int) -> FloatArray:
    """Return the correlation of z (n,) with itself at lags 1 .. lags, about zero, where residuals should
    be: (lags,).
    """
    square = float(z @ z)
    if square == 0:
        return np.zeros(lags)
    return np.array([float(z[k:] @ z[:-k]) / square for k in range(1, lags + 1)])
