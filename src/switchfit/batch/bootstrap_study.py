"""Bootstrap: the spread of the estimates over data that are made of the data themselves.

How these are drawn is in `switchfit.batch.resampled_data`. A bootstrap in which the model itself makes the noise is a
Monte Carlo study. Intervals are shifted for bias and acceleration (BCa, [5]_).

References
----------
.. [5] B. Efron, Better bootstrap confidence intervals, J. Am. Stat. Assoc. 82 (1987) 171-185.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.batch.fits import Fits
from switchfit.batch.long_run import LongRun, repeat
from switchfit.batch.resampled_data import ResampledNoise, StudyOfRuns
from switchfit.batch.simulated_study import build_study
from switchfit.batch.study import Study
from switchfit.batch.study_verdict import judge_study
from switchfit.estimation.estimates import Estimate
from switchfit.fit.scaled_hessian import inverse_on
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem
from switchfit.problem.validation import arrays, names
from switchfit.problem.validation.arrays import as_count, as_seed
from switchfit.runtime import special
from switchfit.uncertainty.sample_derivatives import collect_sample_derivatives
from switchfit.uncertainty.verdict import Verdict

Resample = Literal["residuals", "wild", "blocks", "runs"]


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
    >>> fit = sf.estimate(heater_problem())

    >>> found = sf.bootstrap(fit, 20)
    >>> found.standard_deviation.shape, found.resample
    ((2,), 'residuals')
    """

    estimate: FloatArray
    resample: str
    block: int
    acceleration: FloatArray
    resampled: NDArray[np.bool_]
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
        >>> fit = sf.estimate(heater_problem())

        >>> low, high = sf.bootstrap(fit, 20).intervals(0.9).T
        >>> bool((low < high).all())
        True
        """
        level = arrays.as_level(level)
        theta = self.theta[self.success]
        found = np.full((len(self.estimate), 2), np.nan)
        if len(theta) < 2:
            return found
        tails = np.array([0.5 - level / 2, 0.5 + level / 2])
        for k in np.flatnonzero(self.resampled):
            # Ties count half: unknowns at a bound give many estimates of one value.
            below = (np.sum(theta[:, k] < self.estimate[k]) + np.sum(theta[:, k] <= self.estimate[k])) / 2
            # Where all lie on one side, as at a bound, there is no shift to be found.
            inside = float(np.clip(below / len(theta), 0.5 / len(theta), 1 - 0.5 / len(theta)))
            # z0 is the bias of the median in standard deviations; z0 + z / (1 - a z), with z = z0 + the normal
            # quantile, is where the quantile is read ([5]_).
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
        For an estimate that has no problem or did not converge, data that cannot be resampled, a robust loss, a prior,
        a sigma or a delay that is a parameter, fewer than two experiments for "runs", or a folder that holds something
        else.

    See Also
    --------
    monte_carlo, profile, Estimate.confidence_intervals

    Examples
    --------
    >>> fit = sf.estimate(heater_problem())

    >>> found = sf.bootstrap(fit, 20, resample="blocks", block=4, seed=1)
    >>> len(found), found.intervals(0.9).shape
    (20, (2, 2))
    """
    if not isinstance(estimate, Estimate):
        raise TypeError(f"bootstrap needs the result of sf.estimate; got {type(estimate).__name__}.")
    resample = names.as_choice(resample, "resample", get_args(Resample))
    if block is not None and resample != "blocks":
        raise ValueError(f"block is the length of blocks: give it with resample='blocks', not with {resample!r}.")
    runs, seed = as_count(runs, "runs", at_least=1), as_seed(seed)
    how = LongRun.check(tolerance, max_iterations, client, folder, callback)
    # Away from a minimum residuals are no noise, and fits of resampled data would go on downhill as this one would.
    if not estimate.status.successful:
        raise ValueError(f"a bootstrap begins at a minimum, and this fit has not found one: {estimate.message}")
    problem = estimate.evaluator_at_solution().problem
    _check_data(problem)
    size, resampled = 1, np.ones(len(estimate.theta), dtype=bool)
    if resample == "runs":
        if len(problem.experiments) < 2:
            raise ValueError("resample='runs' needs two experiments or more; this problem has one. Take 'residuals'.")
        # The data stay, only weights change: the meshes of the fit serve every run.
        meshes = list(estimate.evaluator_at_solution().meshes)
        study: Study = StudyOfRuns(problem, meshes, estimate.theta[None], how.limits, seed)
        resampled[np.concatenate([where[where >= 0] for where in problem.unknowns.times])] = False
    else:
        draw = ResampledNoise(estimate, problem, resample, block)
        study, _ = build_study(problem, estimate.theta, estimate.theta, draw, seed, how.limits)
        size = draw.block
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
    for item in (item for experiment in problem.experiments for item in experiment.data):
        if not isinstance(item, Measurements):
            raise ValueError(f"a bootstrap resamples Measurements; this problem has a {type(item).__name__} as well.")
    if not (problem.is_least_squares and problem.has_plain_samples):
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
    gradients = found.scores
    if by_run:
        runs = len(estimate.trajectories)
        # A run that is drawn is drawn as a whole: its samples have one influence together.
        gradients = np.array([gradients[found.experiment == e].sum(0) for e in range(runs)])
    # On the free directions: an unknown that is held has no influence and no acceleration, 0 / 0.
    influence = -gradients @ inverse_on(estimate.free_basis, estimate.hessian)
    spread = np.sum(influence**2, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        acceleration = np.sum(influence**3, axis=0) / (6 * spread**1.5)
    return np.nan_to_num(acceleration)
