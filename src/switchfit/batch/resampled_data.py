"""Data of a bootstrap: drawn from the residuals of a fit, or from its runs.

*Residuals*: the fitted values stay, and residuals are added to them that were drawn from the fit's own. They are
centred and multiplied by sqrt(n / (n - d)), as fitting takes that much of the noise away ([1]_, section 6.2.3), and
drawn

- "residuals": by moments: independently with replacement, all channels of a moment together, in units of sigma; for
  noise that is white, of any distribution;
- "wild": each at its own place with a random sign ([2]_); where the size of the noise varies in an unknown way;
- "blocks": as blocks of neighbours from random places, round the end ([3]_); for noise that is correlated in time. The
  length of a block is, with r the correlation of neighbours, (sqrt(6) r / (1 - r^2))^(2/3) n^(1/3) ([4]_), or is given.

*Runs*: whole experiments are drawn with replacement, an experiment that was drawn k times weighs k times. It takes what
varies from run to run into account, the model's errors among it, but says nothing of a run's own transition times.

References
----------
.. [1] A. C. Davison, D. V. Hinkley, Bootstrap Methods and their Application, Cambridge 1997.
.. [2] R. Y. Liu, Bootstrap procedures under some non-i.i.d. models, Annals of Statistics 16 (1988) 1696-1708.
.. [3] D. N. Politis, J. P. Romano, A circular block-resampling procedure for stationary data, Wiley 1992.
.. [4] E. Carlstein, The use of subseries values for estimating the variance of a general statistic from a stationary
   sequence, Annals of Statistics 14 (1986) 1171-1179.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.batch.layout import Varying
from switchfit.batch.study import Study
from switchfit.estimation.estimates import Estimate
from switchfit.fit.data_variation import measure_variation
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem
from switchfit.problem.validation.arrays import as_count

LEFT_OUT = 1e-8
"""Weight of a run that was not drawn: its own transition times stay determined, and nothing else depends on it."""


def _choose_block(estimate: Estimate, longest: int) -> int:
    """Return the length of a block, by the channel with the largest correlation of neighbours."""
    lengths = [1.0]
    for channel in estimate.residuals.channels:
        if channel.correlation > 0:
            # The length grows without bound at 1, which neighbours of a log with a trend may have by rounding.
            r = min(channel.correlation, 0.99)
            lengths.append((np.sqrt(6) * r / (1 - r**2)) ** (2 / 3) * len(channel.values) ** (1 / 3))
    # Two blocks at least: of one there is nothing to draw.
    return max(1, min(round(max(lengths)), longest // 2))


class ResampledNoise:
    """The noise of one run: as `monte_carlo` takes it."""

    def __init__(self, estimate: Estimate, problem: Problem, resample: str, block: int | None) -> None:
        self.resample, self.block = resample, 1
        # Residuals of a fit are smaller than the noise, by the share of the unknowns.
        inflation = np.sqrt(estimate.samples / max(estimate.freedom, 1))
        self.items = [item for experiment in problem.experiments for item in experiment.data]
        self.pools: list[FloatArray] = []
        for item, comparison in zip(self.items, chain.from_iterable(estimate.comparisons), strict=True):
            residuals = inflation * comparison.residuals / _get_sigma(item)
            # A random sign makes the mean 0 by itself, and centring would change values that stay at their places.
            self.pools.append(residuals if resample == "wild" else residuals - np.nanmean(residuals, axis=0))
        if resample == "blocks":
            longest = max(map(len, self.pools))
            self.block = _choose_block(estimate, longest) if block is None else as_count(block, "block")
            if not 1 <= self.block <= longest:
                raise ValueError(f"block must lie between 1 and the {longest} samples there are; got {block}.")

    def __call__(self, rng: np.random.Generator, clean: FloatArray, item: Measurements) -> FloatArray:
        """Return drawn residuals for the values of a data item, around the clean ones: (K, q)."""
        # By identity: two `Measurements` with equal arrays are two sensors, and equality of arrays is no bool.
        pool = next(pool for own, pool in zip(self.items, self.pools, strict=True) if own is item)
        K = len(pool)
        if self.resample == "wild":
            # One sign a moment for all channels: what they have in common at that moment stays.
            drawn = np.nan_to_num(pool) * rng.choice([-1.0, 1.0], size=(K, 1))
        else:
            # Blocks begin anywhere and go round the end, so that every residual is drawn as often as any other ([3]_).
            first = rng.integers(K, size=(-(-K // self.block), 1))
            drawn = pool[((first + np.arange(self.block)) % K).ravel()[:K]]
            # Where a moment was drawn at which a channel has no value, that channel draws by itself.
            for k, channel in enumerate(drawn.T):
                missing, known = np.isnan(channel), pool[np.isfinite(pool[:, k]), k]
                if missing.any():
                    drawn[missing, k] = rng.choice(known, size=int(missing.sum())) if len(known) else 0.0
        return clean + drawn * _get_sigma(item)


def _get_sigma(item: Measurements) -> FloatArray:
    """Return the standard deviation of each sample, 1 where it is unknown: (K, q)."""
    return np.broadcast_to(1.0 if item.sigma is None else item.sigma, item.values.shape)


@dataclass
class StudyOfRuns(Study):
    """Fits with the experiments weighted by how often they were drawn."""

    is_finished = False  # of the times of single runs it says nothing

    def weigh(self, runs: Iterable[int]) -> FloatArray:
        """Return how often each experiment was drawn: (R, E)."""
        count = len(self.problem.experiments)
        drawn = [np.random.default_rng([self.seed, run]).integers(count, size=count) for run in runs]
        return np.array([np.maximum(np.bincount(each, minlength=count), LEFT_OUT) for each in drawn])

    def stack_data(self, runs: Iterable[int]) -> tuple[Varying, dict[int, Exception]]:
        """Return the weights of all samples (R, K, q), times those of their experiments."""
        weights, (leaves, places), changed = self.weigh(runs), self.leaves, {}
        for e, own in enumerate(places):
            for samples in own.samples:
                changed[samples.weight] = weights[:, e, None, None] * np.asarray(leaves[samples.weight])[None]
        return changed, {}

    def measure_variation(self, runs: range) -> FloatArray:
        """Return J of data that are met by their means: (R,)."""
        return self.weigh(runs) @ measure_variation(self.problem)
