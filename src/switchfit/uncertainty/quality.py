"""How well a fit explains its data: share of the variance of each channel, and whether what is left is noise.

- explained share (R²) of a channel: ``1 - sum r² / sum (y - mean)²`` over its samples that are not missing; for a
  reference signal the sums are integrals over time, and channels of weight zero are left out. If measurements do not
  vary, the sum in the denominator is that of y² itself, so that ``1 - share`` is the square of the relative root mean
  square of the residuals (NRMSE); a constant reference has no variance to explain.
- samples that a robust loss treats as outliers are left out, unless they are more than half of all: the fit is then
  wrong, not the samples.
- noise is white, without outliers, and of the size of sigma. Each is tested, and the test that fails says what is
  suspected: the model, outliers, or sigma.
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
from switchfit.uncertainty.answers import HALF, NO_RESIDUALS, SERIOUS, UNLIKELY, compare_with_sigma
from switchfit.uncertainty.residuals import FEWEST, ChannelResiduals, diagnose


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
    freedom : int
    probability : float
        Of what is left, if it is noise: the smallest of all tests, times the number of channels. NaN if none applies.
    known : bool
        Whether the size of the noise is known: sigma is a number, and chi-square is not far too small.
    """

    channels: tuple[ChannelQuality, ...]
    explained: float
    chi_square: float
    freedom: int
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
    single, is_given = len(fit.comparisons) == 1, fit.sigma_known is True
    channels: list[ChannelQuality] = []
    for e, run in enumerate(fit.comparisons):
        for comparison in run:
            for k, name in enumerate(comparison.names):
                if not np.isfinite(comparison.measured[:, k]).any():
                    continue
                residuals = next(diagnosed) if comparison.kind == "measurements" else None
                squares, spread, _ = _sum_squares(comparison, k)
                if not np.isfinite(squares):
                    continue
                explained = 1 - squares / spread if spread > 0 else np.nan
                tests = {}
                if residuals is not None and not 1 - explained < NO_RESIDUALS:
                    tests = _test_residuals(comparison, k, residuals, is_given)
                channels.append(
                    ChannelQuality(
                        label=name if single else f"{fit.run_names[e]} {name}",
                        experiment=e,
                        kind=comparison.kind,
                        count=int(np.isfinite(comparison.measured[:, k]).sum()),
                        explained=explained,
                        chi_square=_compute_chi_square(comparison, k),
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
    return Quality(
        channels=tuple(channels),
        explained=explain_all(fit.comparisons),
        chi_square=chi_square,
        freedom=fit.freedom,
        probability=min(found, default=np.nan),
        known=known,
    )


def _test_residuals(comparison: Comparison, k: int, residuals: ChannelResiduals, is_given: bool) -> dict[str, float]:
    """Return the tests of a channel, as of `ChannelQuality.tests`.

    The largest residual is compared with the root mean square of all (Grubbs). Beside a robust loss, of which outliers
    are no concern, the median of the residuals takes the place of chi-square, in a sign test.
    """
    z, n, tests = np.abs(residuals.values), len(residuals.values), {}
    if np.isfinite(residuals.whiteness):
        serious = residuals.correlation > 0 and min(residuals.narrowing, residuals.widening) > SERIOUS
        tests["model"] = residuals.whiteness if serious else 1.0
    if comparison.downweighted is not None:
        if is_given:
            above = int(np.sum(z > SERIOUS * special.ndtri(0.75)))
            tests["sigma"] = float(special.bdtrc(above - 1, n, HALF))
        elif _share_outliers(comparison, k) > HALF:
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
    if comparison.downweighted is not None and _share_outliers(comparison, k) <= HALF:
        there &= ~comparison.downweighted[:, k]
    if not there.any() or (comparison.weights is not None and comparison.weights[k] == 0):
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
