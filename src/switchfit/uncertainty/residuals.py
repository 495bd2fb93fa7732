"""Test whether residuals are like the assumed noise: white, and of the size of sigma.

Each channel is tested by itself, in the order of its samples that are not missing. At irregular sample times, a lag
counts samples. Standardized residuals are z = (measured - fitted) / sigma; if sigma is unknown, they are divided by
their own root mean square.

- whiteness: Ljung and Box's Q = n (n + 2) sum_k r_k^2 / (n - k) over the first h lags, chi-square with h degrees of
  freedom, h = min(10, n / 5) ([1]_, [2]_);
- effective sample size: n (1 - r) / (1 + r), at most n: the number of independent samples that are worth n samples
  with first-order autoregressive noise, whose correlation r is r_1 without its bias (`correct_correlation`).

How well a fit explains its data: share of the variance of each channel, and whether what is left is noise.

- explained share (R²) of a channel: ``1 - sum r² / sum (y - mean)²`` over its samples that are not missing; for a
  reference signal the sums are integrals over time, and channels of weight zero are left out. If measurements do not
  vary, the sum in the denominator is that of y² itself, so that ``1 - share`` is the square of the relative root mean
  square of the residuals (NRMSE); a constant reference has no variance to explain.
- samples that a robust loss treats as outliers are left out, unless they are more than half of all or the typical
  residual is `FAR` from sigma too: the fit is then wrong, not the samples.
- noise is white, without outliers, and of the size of sigma. Each is tested, and the test that fails says what is
  suspected: the model, outliers, or sigma.

References
----------
.. [1] G. M. Ljung, G. E. P. Box, On a measure of lack of fit in time series models, Biometrika 65 (1978) 297-303.
.. [2] R. J. Hyndman, G. Athanasopoulos, Forecasting: Principles and Practice, 3rd ed., section 5.4 (number of lags).
.. [3] M. G. Kendall, Note on bias in the estimation of autocorrelation, Biometrika 41 (1954) 403-404.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.fit.evaluator import NO_VARIATION
from switchfit.fit.result import Fit
from switchfit.fit.trajectory import Comparison, Trajectory
from switchfit.problem.origin import Origin
from switchfit.runtime import special
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import Printed, format_line, join_first

UNLIKELY = 1e-3
"""Probability below which what is left is not noise: one false alarm in a thousand fits. It is shared among the
channels of a fit, and among the fits of many."""

CLEARLY_OFF = 0.1
"""How far the reduced chi-square must be from 1 as well: with 10,000 samples chi-square rejects a sigma that is 2 %
off, which no instrument is known to."""

SERIOUS = 1.2
"""Factor by which standard errors may be too small, and a typical residual beside a robust loss too large: a 95 %
interval that is too narrow by this factor covers 90 %, and a seventh of all values, if they are outliers, raise the
median of the absolute residuals by it."""

FAR = 2.0
"""Factor by which the median of the absolute residuals beside a robust loss exceeds that of normal noise if 40 % of the
values are outliers. Real outliers raise it to 1.2; a mode too few, which left 49 % weighed down, to 3.5."""

HALF = 0.5
"""Share of the variance below which a model explains less than it leaves."""

NO_RESIDUALS = 1e-10
"""Unexplained share that is rounding and tolerance: nothing is read from residuals of that size."""

FEWEST = 20
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
        return not self.whiteness < UNLIKELY

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
        return self.correlation > 0 and min(self.narrowing, self.widening) > SERIOUS


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
        shared = UNLIKELY / max(len(self.channels), 1)
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


def find_residual_issues(fit: Fit) -> Iterator[Issue]:
    """Find residuals of a fit that are not white noise of the size of sigma.

    Parameters
    ----------
    fit : Fit
    """
    variance = fit.residual_variance
    if fit.sigma_known and np.isfinite(variance):
        probability, is_size = compare_with_sigma(2 * fit.cost, fit.freedom)
        if probability < UNLIKELY or not is_size:
            figures = {"chi-square": variance, "factor": max(variance, 1 / max(variance, 1e-300)) ** 0.5}
            yield Issue("sigma too small" if variance > 1 else "sigma too large", figures=figures)
    if fit.sigma_known is not None:
        yield from diagnose(fit).issues


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
    each *= factors.max(initial=1.0)
    for factor, places in zip(factors, fit.transition_places, strict=True):
        each[places[places >= 0]] = factor
    return each


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
    size = np.sqrt(np.mean(raw[there] ** 2)) if comparison.sigma is None else comparison.sigma[there, k]
    with np.errstate(divide="ignore", invalid="ignore"):
        z = np.nan_to_num(raw[there] / size)
    n = len(z)
    lags = min(10, n // 5)
    r = compute_autocorrelation(z, lags)
    spread = z - z.mean()
    variance = float(np.mean(spread**2))
    whiteness = np.nan
    if n >= FEWEST and variance > 0:  # Ljung and Box
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


def compare_with_sigma(chi_square: Any, freedom: Any, tests: int = 1) -> tuple[FloatArray, NDArray[np.bool_]]:
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
    probability = np.where(ratio > 1 + CLEARLY_OFF, np.minimum(1.0, tests * above), 1.0)
    return probability, ~((tests * below < UNLIKELY) & (ratio < 1 - CLEARLY_OFF))


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
    tests : dict of str to float
        Probability of the residuals, or of ones that are further off, if they are noise: by their correlation
        ("model"), the largest of them ("outliers"), and their size ("sigma"). Those that apply.
    size : float
        Root mean square of the residuals, in units of sigma; 1 if sigma is unknown.
    widening : float
        Factor by which standard errors are too small because the residuals are correlated.
    """

    label: str
    experiment: int
    kind: str
    count: int
    explained: float
    chi_square: float
    tests: dict[str, float]
    size: float
    widening: float

    @property
    def probability(self) -> float:
        """The smallest probability of the tests; NaN where none applies."""
        return min(self.tests.values(), default=np.nan)


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
    probability : float
        Of what is left, if it is noise: the smallest of all tests, times the number of channels. NaN if none applies.
    known : bool
        Whether the size of the noise is known: sigma is a number, and chi-square is not far too small.
    """

    channels: tuple[ChannelQuality, ...]
    explained: float
    chi_square: float
    probability: float
    known: bool

    @property
    def worst(self) -> tuple[ChannelQuality, ...]:
        """Channels whose residuals are no noise, the least likely first; if there is none, that explained worst."""
        ranked = sorted(self.channels, key=lambda c: np.nan_to_num([c.probability, c.explained], nan=1.0).tolist())
        return tuple(c for c in ranked if c.probability * len(ranked) < UNLIKELY) or tuple(ranked[:1])

    @property
    def suspect(self) -> str:
        """What is to blame for residuals that are no noise: the "model", "outliers", or "sigma"."""
        tests = self.worst[0].tests
        failed = [name for name, probability in tests.items() if probability * len(self.channels) < UNLIKELY]
        return failed[0] if failed and "model" in tests else "sigma" if "model" in tests else "model"


def measure_quality(fit: Fit) -> Quality:
    """Return how well a fit explains its data.

    Parameters
    ----------
    fit : Fit
    """
    diagnosed = iter(diagnose(fit).channels)
    is_given = fit.sigma_known is True
    channels: list[ChannelQuality] = []
    for label, e, comparison, k in list_channels(fit.comparisons, fit.run_names):
        residuals = next(diagnosed) if comparison.kind == "measurements" else None
        squares, spread, _ = _sum_squares(comparison, k)
        if not np.isfinite(squares):
            continue
        explained, chi_square, tests = 1 - squares / spread if spread > 0 else np.nan, np.nan, {}
        if residuals is not None and residuals.sigma_known and comparison.downweighted is None:
            chi_square = float(residuals.values @ residuals.values)
        if residuals is not None and not 1 - explained < NO_RESIDUALS:
            tests = _test_residuals(comparison, k, residuals, is_given)
        channels.append(
            ChannelQuality(
                label=label,
                experiment=e,
                kind=comparison.kind,
                count=int(np.isfinite(comparison.measured[:, k]).sum()),
                explained=explained,
                chi_square=chi_square,
                tests=tests,
                size=residuals.rms if is_given and residuals is not None else 1.0,
                widening=1.0 if residuals is None else residuals.widening,
            )
        )
    chi_square, known = np.nan, False
    found = [len(channels) * channel.probability for channel in channels if channel.tests]
    if is_given and np.isfinite(fit.residual_variance):
        chi_square = 2 * fit.cost
        above, is_size = compare_with_sigma(chi_square, fit.freedom)
        known, found = bool(is_size), [*found, float(above)]
    explained, probability = explain_all(fit.comparisons), min(found, default=np.nan)
    return Quality(tuple(channels), explained, chi_square, probability, known)


def _test_residuals(comparison: Comparison, k: int, residuals: ChannelResiduals, is_given: bool) -> dict[str, float]:
    """Return the tests of a channel, as of `ChannelQuality.tests`.

    The largest residual is compared with the root mean square of all (Grubbs). Beside a robust loss, of which outliers
    are no concern, the median of the residuals takes the place of chi-square, in a sign test.
    """
    z, n, tests = np.abs(residuals.values), len(residuals.values), {}
    if np.isfinite(residuals.whiteness):
        tests["model"] = residuals.whiteness if residuals.is_seriously_correlated else 1.0
    if comparison.downweighted is not None:
        if is_given:
            above = int(np.sum(z > SERIOUS * special.ndtri(0.75)))
            tests["sigma"] = float(special.bdtrc(above - 1, n, HALF))
        elif not _are_outliers(comparison.downweighted[np.isfinite(comparison.residuals[:, k]), k], z):
            tests["sigma"] = 0.0
        return tests
    if n >= FEWEST and residuals.rms > 0:
        tests["outliers"] = float(2 * n * special.ndtr(-z.max() / residuals.rms))
    if is_given:
        tests["sigma"] = float(compare_with_sigma(residuals.rms**2 * n, n)[0])
    return tests


def explain_channel(comparison: Comparison, k: int) -> float:
    """Return the share of the variance of channel k that is explained; NaN if its variance is zero.

    Parameters
    ----------
    comparison : Comparison
    k : int
        Index of the channel, from 0.
    """
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
            squares, spread, size = _sum_squares(comparison, k)
            if np.isfinite(squares) and spread > 0:
                left, total = left + squares / size, total + spread / size
    return 1 - left / total if total > 0 else np.nan


def _sum_squares(comparison: Comparison, k: int) -> tuple[float, float, float]:
    """Return the sums of squares of the residuals of a channel and of its values about their mean, and the divisor of
    both when channels are added; NaN if the channel has no values or no weight.
    """
    y, residual = comparison.measured[:, k], comparison.residuals[:, k]
    there = np.isfinite(residual)
    if not there.any() or (comparison.weights is not None and comparison.weights[k] == 0):
        return np.nan, np.nan, 1.0
    if comparison.downweighted is not None and comparison.sigma is not None:
        outliers = comparison.downweighted[there, k]
        there[there] = ~outliers | (not _are_outliers(outliers, residual[there] / comparison.sigma[there, k]))
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


def _are_outliers(weighed_down: NDArray[np.bool_], z: FloatArray) -> bool:
    """Return whether samples (n,) that a robust loss weighs down are to blame, and not the fit; z in units of sigma."""
    return bool(np.mean(weighed_down) <= HALF and np.median(np.abs(z)) <= FAR * special.ndtri(0.75))


def _compute_weights(comparison: Comparison) -> FloatArray:
    """Return the weight of each row: 1 for a sample, that of the trapezoidal rule for a node of a reference signal."""
    if comparison.kind == "measurements":
        return np.ones(len(comparison.times))
    steps = np.diff(comparison.times)
    return 0.5 * (np.append(steps, 0.0) + np.append(0.0, steps))
