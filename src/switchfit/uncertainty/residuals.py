"""Test whether residuals are like the assumed noise: white, normal, and of the size of sigma.

Each channel is tested by itself, in the order of its samples that are not missing. At irregular sample times, a lag
counts samples. Standardized residuals are z = (measured - fitted) / sigma; if sigma is unknown, they are divided by
their own root mean square.

- whiteness: Ljung and Box's Q = n (n + 2) sum_k r_k^2 / (n - k) over the first h lags, chi-square with h degrees of
  freedom, h = min(10, n / 5) ([1]_, [2]_);
- normality: Jarque and Bera's n / 6 (S^2 + (K - 3)^2 / 4), chi-square with 2 degrees of freedom ([3]_);
- effective sample size: n (1 - r) / (1 + r), at most n: the number of independent samples that are worth n samples
  with first-order autoregressive noise, whose correlation r is r_1 without its bias (`correct_correlation`).

References
----------
.. [1] G. M. Ljung, G. E. P. Box, On a measure of lack of fit in time series models, Biometrika 65 (1978) 297-303.
.. [2] R. J. Hyndman, G. Athanasopoulos, Forecasting: Principles and Practice, 3rd ed., section 5.4 (number of lags).
.. [3] C. M. Jarque, A. K. Bera, A test for normality of observations and regression residuals, Int. Stat. Rev. 55
   (1987) 163-172.
.. [4] M. G. Kendall, Note on bias in the estimation of autocorrelation, Biometrika 41 (1954) 403-404.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from switchfit.fit.result import Fit
from switchfit.fit.trajectory import Comparison, Trajectory
from switchfit.problem.data import FloatArray
from switchfit.problem.dates import Origin
from switchfit.runtime import special
from switchfit.runtime.frames import Tabular
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import Printed, format_line, join_first
from switchfit.uncertainty.answers import SERIOUS, UNLIKELY

FEWEST = 20
"""Smallest number of residuals for the tests: with fewer, their statistics are far from chi-square."""


@dataclass(frozen=True, eq=False)
class ChannelResiduals:
    """The residuals of one channel of Measurements.

    Attributes
    ----------
    experiment : int, from 0
    name : str
    times, values : (n,), (n,)
        Sample times and standardized residuals of the samples that are not missing.
    time_unit : str
        Unit of the experiment's times.
    sigma_known : bool
    mean : float
        Mean of the standardized residuals; 1 / sqrt(n) is its standard deviation if they are white.
    rms : float
        Root mean square of the standardized residuals: near 1 if sigma is right, 1 if it is unknown.
    lags : int
    autocorrelation : (lags,)
        At lags 1, 2, ...
    whiteness, normality : float
        Probabilities of Ljung and Box's and of Jarque and Bera's statistic, or a larger one, if the residuals are
        white and normal; NaN for fewer than 20.
    skewness, kurtosis : float
        0 and 3 for a normal distribution.
    effective : float
        Effective sample size.
    outliers : int
        Number of residuals beyond four standard deviations; 0.001 are expected in 16 samples.
    origin : Origin or None
        The date at which times are 0; None where they are no dates.
    fitted_unknowns : float
        Number of unknowns that were fitted to the channel, shared among channels by their numbers of samples.

    See Also
    --------
    ResidualDiagnostics, Estimate.residuals

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> fit = sf.estimate(heater_problem())

    >>> channel = fit.residuals.channels[0]
    >>> channel.name, len(channel.values), channel.white
    ('thermometer', 24, True)
    """

    experiment: int
    name: str
    times: FloatArray
    values: FloatArray
    time_unit: str
    sigma_known: bool
    mean: float
    rms: float
    lags: int
    autocorrelation: FloatArray
    whiteness: float
    normality: float
    skewness: float
    kurtosis: float
    effective: float
    outliers: int
    origin: Origin | None = None
    fitted_unknowns: float = 0.0

    def __repr__(self) -> str:
        return format_line(self, self.name, f"{len(self.values)} values", f"rms = {self.rms:.3g}")

    @property
    def correlation(self) -> float:
        """Correlation of neighboring residuals, at lag 1; 0 if there are too few residuals."""
        return float(self.autocorrelation[0]) if self.lags else 0.0

    @property
    def white(self) -> bool:
        """Whether the test of whiteness is passed (or there are too few residuals to test)."""
        return not self.whiteness < UNLIKELY

    @property
    def normal(self) -> bool:
        """Whether the test of normality is passed (or there are too few residuals to test)."""
        return not self.normality < UNLIKELY

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


@dataclass(frozen=True, eq=False)
class ResidualDiagnostics(Tabular, Printed):
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
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
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
        """Whether all residuals look white and normal."""
        return all(channel.white and channel.normal for channel in self.channels)

    @property
    def correlated(self) -> tuple[bool, ...]:
        """Which channels have correlated residuals: beyond chance, and with an effect on standard errors that matters.

        The probability of a false alarm is divided among the channels.
        """
        shared = UNLIKELY / max(len(self.channels), 1)
        return tuple(c.whiteness < shared and c.correlation > 0 and c.narrowing > SERIOUS for c in self.channels)

    @property
    def issues(self) -> list[Issue]:
        """Failed tests: channels whose residuals are correlated, and channels whose residuals are not normal."""
        found = []
        named = list(zip(self.labels, self.channels, strict=True))
        tested = zip(named, self.correlated, strict=True)
        alike = [(label, c) for (label, c), correlated in tested if correlated and c.widening > SERIOUS]
        if alike:
            figures: dict[str, float | tuple[float, ...]] = {
                "correlation": tuple(c.correlation for _, c in alike),
                "values": float(sum(len(c.values) for _, c in alike)),
                "effective": float(sum(c.effective for _, c in alike)),
                "narrowing": max(c.widening for _, c in alike),
            }
            found.append(Issue("correlated residuals", tuple(label for label, _ in alike), figures))
        shared = UNLIKELY / max(len(named), 1)
        heavy = [(label, c) for label, c in named if c.normality < shared and c.white]
        if heavy:
            figures = {
                "kurtosis": tuple(c.kurtosis for _, c in heavy),
                "outliers": tuple(float(c.outliers) for _, c in heavy),
            }
            found.append(Issue("residuals not normal", tuple(label for label, _ in heavy), figures))
        return found


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
    for e, comparisons in enumerate(runs):
        for comparison in comparisons:
            if comparison.kind != "measurements":
                continue
            run = trajectories[e]
            for k, name in enumerate(comparison.names):
                if np.isfinite(comparison.measured[:, k]).sum() > 0:
                    channels.append(diagnose_channel(comparison, k, e, run.time_unit, run.origin, unknowns=unknowns))
                    labels.append(name if len(runs) == 1 else f"{names[e]} {name}")
    return ResidualDiagnostics(tuple(channels), tuple(labels))


def correct_errors(fit: Fit) -> FloatArray:
    """Return the standard errors of a fit, widened where residuals are correlated: (d,).

    Parameters
    ----------
    fit : Fit
    """
    return np.asarray(measure_widening(fit) * fit.standard_errors)


def correct_covariance(fit: Fit) -> FloatArray:
    """Return the covariance of a fit with its standard errors widened as by `correct_errors`: (d, d).

    Parameters
    ----------
    fit : Fit
    """
    factors = measure_widening(fit)
    return np.asarray(factors[:, None] * fit.covariance * factors)


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
        if correlated and channel.widening > SERIOUS:
            factors[channel.experiment] = max(factors[channel.experiment], channel.widening)
    each *= factors.max(initial=1.0)
    for factor, places in zip(factors, fit.transition_places, strict=True):
        each[places[places >= 0]] = factor
    return each


def diagnose_channel(
    comparison: Comparison,
    k: int,
    experiment: int = 0,
    time_unit: str = "s",
    origin: Origin | None = None,
    *,
    unknowns: float = 0.0,
) -> ChannelResiduals:
    """Test one channel of a comparison.

    Parameters
    ----------
    comparison : Comparison
    k : int
        Index of the channel, from 0.
    experiment : int, optional
    time_unit : str, optional
    origin : Origin, optional
        They are stored in the result.
    unknowns : float
        As in `diagnose_runs`.
    """
    raw = comparison.residuals[:, k]
    there = np.isfinite(raw)
    known = comparison.sigma is not None
    size = comparison.sigma[there, k] if comparison.sigma is not None else np.sqrt(np.mean(raw[there] ** 2))
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.nan_to_num(raw[there] / size)
    n = len(z)
    lags = min(10, n // 5)
    r = compute_autocorrelation(z, lags)
    spread = z - z.mean()
    variance = float(np.mean(spread**2))
    skewness, kurtosis = 0.0, 3.0
    if variance > 0:
        skewness = float(np.mean(spread**3)) / variance**1.5
        kurtosis = float(np.mean(spread**4)) / variance**2
    whiteness = normality = np.nan
    if n >= FEWEST and variance > 0:
        # Ljung and Box, then Jarque and Bera.
        Q = n * (n + 2) * float(np.sum(r**2 / (n - np.arange(1, lags + 1))))
        whiteness = float(special.chdtrc(lags, Q))
        normality = float(special.chdtrc(2, n / 6 * (skewness**2 + (kurtosis - 3) ** 2 / 4)))
    # The lags are those of residuals, whose correlation the fit has lowered; the samples are worth n (1 - r) / (1 + r).
    first = correct_correlation(float(r[0]), n, unknowns * n) if lags else 0.0
    root = np.sqrt(np.mean(z**2))
    return ChannelResiduals(
        experiment=experiment,
        name=comparison.names[k],
        times=comparison.times[there],
        values=z,
        time_unit=time_unit,
        origin=origin,
        sigma_known=known,
        mean=float(z.mean()),
        rms=float(root),
        lags=lags,
        autocorrelation=r,
        whiteness=whiteness,
        normality=normality,
        skewness=skewness,
        kurtosis=kurtosis,
        effective=min(n, n * (1 - first) / (1 + first)),
        fitted_unknowns=unknowns * n,
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
    the ``-(1 + 3 r) / n`` of [4]_ (of the module).

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
