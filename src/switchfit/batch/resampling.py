"""Bootstrap: the spread of the estimates over data that are made of the data themselves.

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

A bootstrap in which the model itself makes the noise is `switchfit.monte_carlo`.

References
----------
.. [1] A. C. Davison, D. V. Hinkley, Bootstrap Methods and their Application, Cambridge 1997.
.. [2] R. Y. Liu, Bootstrap procedures under some non-i.i.d. models, Annals of Statistics 16 (1988) 1696-1708.
.. [3] D. N. Politis, J. P. Romano, A circular block-resampling procedure for stationary data, Wiley 1992.
.. [4] E. Carlstein, The use of subseries values for estimating the variance of a general statistic from a stationary
   sequence, Annals of Statistics 14 (1986) 1171-1179.
.. [5] B. Efron, Better bootstrap confidence intervals, J. Am. Stat. Assoc. 82 (1987) 171-185.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from switchfit.batch.fits import Fits, LongRun, repeat
from switchfit.batch.program import Varying
from switchfit.batch.simulated import build_study
from switchfit.batch.study import Study
from switchfit.batch.verdict import judge_study
from switchfit.estimation.estimator import Estimate
from switchfit.fit.evaluator import measure_variation
from switchfit.fit.result import inverse_on
from switchfit.problem.data import FloatArray, Measurements
from switchfit.problem.problem import Problem
from switchfit.problem.validation import as_choice, as_count, as_level, as_seed
from switchfit.runtime import special
from switchfit.uncertainty.prediction import collect_sample_derivatives
from switchfit.uncertainty.residuals import compute_autocorrelation
from switchfit.uncertainty.verdict import Verdict

Resample = Literal["residuals", "wild", "blocks", "runs"]

LEFT_OUT = 1e-8
"""Weight of a run that was not drawn: its own transition times stay determined, and nothing else depends on it."""


@dataclass(frozen=True, eq=False, repr=False)
class Bootstrap(Fits):
    """Result of `bootstrap`: everything in `Fits`, and what it belongs to. Print it for the table.

    Attributes
    ----------
    estimate : (d,)
        Of the data as they are.
    resample : str
    block : int
        Length of the blocks, in samples; 1 if single residuals are drawn.
    acceleration : (d,)
        How the standard error changes with the estimate, for "bca" intervals.
    resampled : (d,) bool
        Of which unknowns something is said: with "runs" only of those that several runs share.
    origin : Verdict
        On the fit that was resampled.

    See Also
    --------
    bootstrap, Fits, MonteCarlo

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> fit = sf.estimate(heater_problem())

    >>> found = sf.bootstrap(fit, 20)
    >>> found.standard_deviation.shape, found.resample
    ((2,), 'residuals')
    """

    estimate: FloatArray
    resample: str
    block: int
    acceleration: FloatArray
    resampled: np.ndarray[Any, np.dtype[np.bool_]]
    origin: Verdict

    @cached_property
    def verdict(self) -> Verdict:
        """Whether to believe the spread: how many fits converged, in the same minimum as the others, without collapsed
        modes, and whether the fit that was resampled is bad. Print it for a line.
        """
        return judge_study(self, origin=self.origin, considered=self.resampled)

    @property
    def standard_deviation(self) -> FloatArray:
        """Of the estimates of the runs that converged, the bootstrap's standard error: (d,)."""
        return np.where(self.resampled, self.theta[self.success].std(0, ddof=1), np.nan)

    @property
    def bias(self) -> FloatArray:
        """Mean of the estimates less the estimate: (d,)."""
        return np.where(self.resampled, self.theta[self.success].mean(0) - self.estimate, np.nan)

    def intervals(self, level: float = 0.95) -> FloatArray:
        """Return confidence intervals: (d, 2); NaN where nothing was resampled.

        They are quantiles of the estimates, shifted for bias and for acceleration (BCa, Efron 1987). The sum of the
        acceleration over the leave-one-out estimates is taken to first order, from exact derivatives, instead of
        fitting again without each sample.

        Parameters
        ----------
        level : float, between 0 and 1

        See Also
        --------
        bootstrap, Estimate.confidence_intervals, profile

        Examples
        --------
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem
        >>> fit = sf.estimate(heater_problem())

        >>> low, high = sf.bootstrap(fit, 20).intervals(0.9).T
        >>> bool((low < high).all())
        True
        """
        level = as_level(level)
        theta = self.theta[self.success]
        found = np.full((len(self.estimate), 2), np.nan)
        if len(theta) < 2:
            return found
        tails = np.array([0.5 - level / 2, 0.5 + level / 2])
        for k in np.flatnonzero(self.resampled):
            below = (np.sum(theta[:, k] < self.estimate[k]) + np.sum(theta[:, k] <= self.estimate[k])) / 2
            # Where all lie on one side, as at a bound, there is no shift to be found.
            inside = float(np.clip(below / len(theta), 0.5 / len(theta), 1 - 0.5 / len(theta)))
            z0 = special.ndtri(inside)
            shifted = z0 + special.ndtri(tails)
            found[k] = np.quantile(theta[:, k], special.ndtr(z0 + shifted / (1 - self.acceleration[k] * shifted)))
        return found


def bootstrap(
    estimate: Estimate,
    runs: int = 1000,
    *,
    resample: Resample = "residuals",
    block: int | None = None,
    seed: int = 0,
    tolerance: float = 1e-7,
    max_iterations: int = 200,
    client: Any = None,
    folder: str | Path | None = None,
    callback: Callable[[int, int], object] | None = None,
) -> Bootstrap:
    """Fit data again that are resampled from the residuals of a fit or from its runs.

    Parameters
    ----------
    estimate : Estimate
        With its problem, whose data are `Measurements`.
    runs : int
    resample : {"residuals", "wild", "blocks", "runs"}
        Residuals independently, with random signs at their places, in blocks of neighbours; or whole experiments.
    block : int, optional
        Samples in a block; from the correlation of neighbouring residuals if left out. Only with "blocks".
    seed : int
        Run k draws from ``numpy.random.default_rng([seed, k])``, wherever and in whatever order it is done.
    tolerance, max_iterations, client, folder, callback : as of `monte_carlo`

    Returns
    -------
    Bootstrap

    Raises
    ------
    TypeError
        If this is no estimate, or an argument is of the wrong type.
    ValueError
        For an estimate that has no problem or did not converge, data that cannot be resampled, fewer than two
        experiments for "runs", or a folder that holds something else.

    See Also
    --------
    monte_carlo, profile, Estimate.confidence_intervals

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> fit = sf.estimate(heater_problem())

    >>> found = sf.bootstrap(fit, 20, resample="blocks", block=4, seed=1)
    >>> len(found), found.intervals(0.9).shape
    (20, (2, 2))
    """
    if not isinstance(estimate, Estimate):
        raise TypeError(f"bootstrap needs the result of sf.estimate; got {type(estimate).__name__}.")
    resample = as_choice(resample, "resample", get_args(Resample))
    if block is not None and resample != "blocks":
        raise ValueError(f"block is the length of blocks: give it with resample='blocks', not with {resample!r}.")
    runs, seed = as_count(runs, "runs", at_least=1), as_seed(seed)
    how = LongRun.check(tolerance, max_iterations, client, folder, callback)
    if not estimate.status.successful:
        raise ValueError(f"a bootstrap begins at a minimum, and this fit has not found one: {estimate.message}")
    problem = estimate.evaluator_at_solution().problem
    _check_data(problem)
    size = 1
    resampled = np.ones(len(estimate.theta), dtype=bool)
    if resample == "runs":
        if len(problem.experiments) < 2:
            raise ValueError("resample='runs' needs two experiments or more; this problem has one. Take 'residuals'.")
        meshes = list(estimate.evaluator_at_solution().meshes)
        study: Study = StudyOfRuns(problem, meshes, estimate.theta[None], how.limits, seed)
        resampled[np.concatenate([where[where >= 0] for where in problem.unknowns.times])] = False
    else:
        draw = _Draw(estimate, problem, resample, block)
        size = draw.block
        study, _ = build_study(problem, runs, estimate.theta, estimate.theta, draw, seed, how.limits)
    acceleration = _compute_acceleration(estimate, by_run=resample == "runs")
    return Bootstrap(
        **repeat(problem, study, runs, "Bootstrap", how),
        estimate=estimate.theta.copy(),
        resample=resample,
        block=size,
        acceleration=acceleration,
        resampled=resampled,
        origin=estimate.verdict,
    )


def _check_data(problem: Problem) -> None:
    for experiment in problem.experiments:
        for item in experiment.data:
            if not isinstance(item, Measurements):
                raise ValueError(
                    f"a bootstrap resamples Measurements; this problem has a {type(item).__name__} as well."
                )
    if not problem.is_least_squares and problem.has_plain_samples:
        raise ValueError(
            "a bootstrap takes least squares alone: no sigma and no delay that is a parameter, no robust loss and no "
            "prior. sf.monte_carlo draws from the noise that was fitted."
        )


def _compute_acceleration(estimate: Estimate, *, by_run: bool) -> FloatArray:
    """Return ``sum l^3 / (6 (sum l^2)^(3/2))`` over the influence l of each sample, or run, on each unknown ([5]_):
    (d,).

    A sample's influence is to first order ``-H^-1 g``, g being the gradient of its part of the cost.
    """
    found = collect_sample_derivatives(estimate.evaluator_at_solution().problem, estimate.sensitivities)
    gradients = (found.weight * found.residual)[:, None] * found.derivative
    if by_run:
        runs = len(estimate.trajectories)
        gradients = np.array([gradients[found.experiment == e].sum(0) for e in range(runs)])
    influence = -gradients @ inverse_on(estimate.free_basis, estimate.hessian)
    spread = np.sum(influence**2, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        acceleration = np.sum(influence**3, axis=0) / (6 * spread**1.5)
    return np.nan_to_num(acceleration)


class _Draw:
    """The noise of one run: as `monte_carlo` takes it."""

    def __init__(self, estimate: Estimate, problem: Problem, resample: str, block: int | None) -> None:
        self.resample = resample
        inflation = np.sqrt(estimate.samples / max(estimate.freedom, 1))
        self.items: list[Measurements] = []
        self.pools: list[FloatArray] = []
        for experiment, comparisons in zip(problem.experiments, estimate.comparisons, strict=True):
            for item, comparison in zip(experiment.data, comparisons, strict=True):
                residuals = inflation * comparison.residuals / _get_sigma(item)
                centred = residuals if resample == "wild" else residuals - np.nanmean(residuals, axis=0)
                self.items.append(item)
                self.pools.append(centred)
        self.block = 1
        if resample == "blocks":
            longest = max(len(item.times) for item in self.items)
            self.block = self._length() if block is None else as_count(block, "block")
            if not 1 <= self.block <= longest:
                raise ValueError(f"block must lie between 1 and the {longest} samples there are; got {block}.")

    def _length(self) -> int:
        """Return the length of a block, by the channel with the largest correlation of neighbours."""
        lengths = [1.0]
        for pool in self.pools:
            for channel in pool.T:
                known = channel[np.isfinite(channel)]
                if len(known) > 2:
                    r = min(float(compute_autocorrelation(known, 1)[0]), 0.99)
                    lengths.append((np.sqrt(6) * r / (1 - r**2)) ** (2 / 3) * len(known) ** (1 / 3) if r > 0 else 1.0)
        return max(1, min(round(max(lengths)), max(len(pool) for pool in self.pools) // 2))

    def __call__(self, rng: np.random.Generator, clean: FloatArray, item: Any) -> FloatArray:
        pool = self.pools[next(k for k, own in enumerate(self.items) if own is item)]
        K = len(pool)
        if self.resample == "wild":
            drawn = np.nan_to_num(pool) * rng.choice([-1.0, 1.0], size=(K, 1))
        else:
            blocks = -(-K // self.block)
            first = rng.integers(K, size=(blocks, 1))
            rows = ((first + np.arange(self.block)) % K).ravel()[:K]
            drawn = pool[rows]
            # Where a moment was drawn at which a channel has no value, that channel draws by itself.
            for k, channel in enumerate(drawn.T):
                missing = np.isnan(channel)
                known = pool[np.isfinite(pool[:, k]), k]
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
