"""How well a fit explains its data: shares of the variance, and whether what is left is noise.

Noise is white, without outliers, and of the size of sigma. Each is tested, and the test that fails says what is
suspected: the model, outliers, or sigma.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from switchfit.fit.comparison import Comparison
from switchfit.fit.result import Fit
from switchfit.runtime import special
from switchfit.uncertainty.chi_square import UNLIKELY_AS_NOISE, compare_with_sigma
from switchfit.uncertainty.explained_variance import HALF, NO_RESIDUALS, are_outliers, explain_all, sum_squares
from switchfit.uncertainty.residuals import (
    FEWEST_RESIDUALS,
    SERIOUS_WIDENING,
    ChannelResiduals,
    diagnose,
    list_channels,
)


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
        # A channel without a test has probability NaN: it counts as 1, and is ranked by what it explains.
        ranked = sorted(self.channels, key=lambda c: np.nan_to_num([c.probability, c.explained], nan=1.0).tolist())
        return tuple(c for c in ranked if c.probability * len(ranked) < UNLIKELY_AS_NOISE) or tuple(ranked[:1])

    @property
    def suspect(self) -> str:
        """What is to blame for residuals that are no noise: the "model", "outliers", or "sigma"."""
        tests = self.worst[0].tests
        failed = [name for name, probability in tests.items() if probability * len(self.channels) < UNLIKELY_AS_NOISE]
        # In the order of `tests`: a wrong model also makes large residuals and a wrong size, so that it comes first.
        # Too few residuals for a test of whiteness leave the model suspected.
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
        # A channel without values, or whose fit is not finite, cannot be judged.
        squares, spread, _ = sum_squares(comparison, k)
        if not np.isfinite(squares):
            continue
        explained, chi_square, tests = 1 - squares / spread if spread > 0 else np.nan, np.nan, {}
        if residuals is not None and residuals.sigma_known and comparison.downweighted is None:
            chi_square = float(residuals.values @ residuals.values)
        # Data that are met to rounding leave no residuals to test: what is left is arithmetic.
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
    # Bonferroni: of so many channels the least likely one is that unlikely by chance.
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
            above = int(np.sum(z > SERIOUS_WIDENING * special.ndtri(0.75)))
            # Half of normal residuals are beyond 0.6745 sigma. The factor leaves room for outliers, which are no
            # concern beside a robust loss.
            tests["sigma"] = float(special.bdtrc(above - 1, n, HALF))
        elif not are_outliers(comparison.downweighted[np.isfinite(comparison.residuals[:, k]), k], z):
            tests["sigma"] = 0.0
        return tests
    if n >= FEWEST_RESIDUALS and residuals.rms > 0:
        # The largest of n: at most n times the probability of one, on both sides.
        tests["outliers"] = float(2 * n * special.ndtr(-z.max() / residuals.rms))
    if is_given:
        tests["sigma"] = float(compare_with_sigma(residuals.rms**2 * n, n)[0])
    return tests
