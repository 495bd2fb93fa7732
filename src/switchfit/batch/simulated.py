"""Studies of data that are drawn anew thousands of times: simulated and perturbed, or resampled.

Bootstrap: the spread of the estimates over data that are made of the data themselves.

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

A bootstrap in which the model itself makes the noise is a Monte Carlo study.

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
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.arrays import FloatArray
from switchfit.batch.fits import Fits, judge_study
from switchfit.batch.program import Limits, Varying
from switchfit.batch.study import LongRun, Study, repeat
from switchfit.discretization.mesh import Mesh
from switchfit.estimation.estimator import Estimate
from switchfit.estimation.local_fit import LARGEST_INTEGRATION_ERROR, ORDER, REFINEMENTS, fit_locally
from switchfit.fit.accuracy import cost_error
from switchfit.fit.evaluator import Evaluator, measure_variation, place_on_guards
from switchfit.fit.result import inverse_on
from switchfit.fit.trajectory import compare, replace_values
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem, require_estimable
from switchfit.problem.validation import arrays, names, objects
from switchfit.problem.validation.arrays import as_array, as_count, as_seed
from switchfit.problem.validation.messages import shorten
from switchfit.runtime import special
from switchfit.uncertainty.prediction import collect_sample_derivatives
from switchfit.uncertainty.verdict import Verdict

Noise = float | ArrayLike | Callable[[np.random.Generator, FloatArray, Any], ArrayLike] | None

Values = dict[tuple[int, int], FloatArray]
"""Values of data that are simulated, by the experiment and the place among its data: (K, q), or (R, K, q) of R runs."""

Resample = Literal["residuals", "wild", "blocks", "runs"]

LEFT_OUT = 1e-8
"""Weight of a run that was not drawn: its own transition times stay determined, and nothing else depends on it."""


@dataclass(frozen=True, eq=False, repr=False)
class MonteCarlo(Fits):
    """Result of `monte_carlo`: everything in `Fits`, and the truth. Print it for the table.

    Attributes
    ----------
    truth : (d,)
        At which the data were simulated.
    integration_error : float
        Error of J at the truth by halving all steps, relative to J, or to 1e-3 of J at the start where that is more.

    See Also
    --------
    monte_carlo, Fits, bootstrap

    Examples
    --------
    >>> problem = heater_problem()

    >>> study = sf.monte_carlo(problem, 20, theta=[2.5, 0.4])
    >>> study.bias.shape, study.coverage().shape
    ((2,), (2,))
    """

    truth: FloatArray
    integration_error: float

    @cached_property
    def verdict(self) -> Verdict:
        """Whether to believe the study: how many fits converged, in the same minimum as the others, whether chi-square
        confirms them, and whether their 95 % intervals hold the truth. Print it for a line.
        """
        return judge_study(self, truth=self.truth, error=self.integration_error)

    @property
    def errors(self) -> FloatArray:
        """Estimate less truth of the fits that converged: (S, d)."""
        return self.theta[self.success] - self.truth

    @property
    def bias(self) -> FloatArray:
        """Mean error: (d,)."""
        return self.errors.mean(0)

    @property
    def standard_deviation(self) -> FloatArray:
        """Of the estimates round their mean: (d,)."""
        return self.errors.std(0, ddof=1)

    def coverage(self, level: float = 0.95) -> FloatArray:
        """Return the part of the fits that converged whose interval contains the truth: (d,); NaN without a noise
        model, and for an unknown that is held in all of them.

        See Also
        --------
        monte_carlo, Fits.confidence_intervals

        Examples
        --------
        >>> problem = heater_problem()

        >>> study = sf.monte_carlo(problem, 20, theta=[2.5, 0.4])
        >>> bool((study.coverage(0.95) > 0.7).all())
        True
        """
        low, high = np.moveaxis(self.confidence_intervals(level)[self.success], 2, 0)
        inside = (low <= self.truth) & (self.truth <= high)
        return np.where(np.isnan(low).all(0), np.nan, inside.mean(0))


def monte_carlo(
    problem: Problem,
    runs: int = 1000,
    *,
    theta: ArrayLike | None = None,
    start: ArrayLike | None = None,
    noise: Noise = None,
    seed: int = 0,
    tolerance: float = 1e-7,
    max_iterations: int = 200,
    client: Any = None,
    folder: str | Path | None = None,
    callback: Callable[[int, int], object] | None = None,
) -> MonteCarlo:
    """Simulate the data of a problem, add noise, and fit them, many times.

    Parameters
    ----------
    problem : Problem
        Its data say what is measured when; their values are replaced, missing ones stay missing.
    runs : int
    theta : (d,) array_like, optional
        The truth; the problem's estimate if left out (a parametric bootstrap).
    start : (d,) array_like, optional
        Where every fit begins; the truth if left out. Give the problem's ``initial_theta`` to study convergence too.
    noise : optional
        Standard deviation of Gaussian noise: a number, one for each channel (q,), or by default the sigma of each of
        the `Measurements`. Or a function ``noise(rng, clean, item) -> (K, q)`` that returns the noisy values of one
        of the data from the clean ones.
    seed : int
        Run k draws from ``numpy.random.default_rng([seed, k])``, wherever and in whatever order it is done.
    tolerance, max_iterations : as of `estimate`
    client : dask.distributed.Client, optional
        A cluster to run on (extra ``cluster``); the cores of this machine if left out.
    folder : path, optional
        Where what is done is kept, so that a broken run goes on.
    callback : callable, optional
        ``callback(done, total)`` after each chunk; a true return value stops. Ctrl-C does as well; what is done is
        returned.

    Returns
    -------
    MonteCarlo

    Raises
    ------
    ValueError
        If the noise is not known, there are no Measurements or other signals to simulate, or the folder holds something
        else.
    TypeError
        If an argument is of the wrong type.

    Notes
    -----
    All fits share one mesh, which resolves the trajectories at the start and at the truth. Transition times that have
    guards are moved onto them in the truth.

    See Also
    --------
    bootstrap, estimate_many

    Examples
    --------
    >>> problem = heater_problem()

    >>> study = sf.monte_carlo(problem, 20, theta=[2.5, 0.4], seed=1)
    >>> len(study), bool((study.standard_deviation < 0.05).all())
    (20, True)
    """
    objects.as_instance(problem, "problem", Problem, "an sf.Problem")
    require_estimable(problem)
    runs, seed = as_count(runs, "runs", at_least=1), as_seed(seed)
    how = LongRun.check(tolerance, max_iterations, client, folder, callback)
    noise = _check_noise(noise)
    given = None if theta is None else problem.check_theta(theta)
    begin = None if start is None else problem.check_theta(start, "start")
    truth = fit_locally(problem).theta if given is None else given
    if given is not None and problem.constraint_names:
        with suppress(ValueError):  # it is not near the guards
            truth = place_on_guards(problem, given)[1]
    begin = truth if begin is None else begin
    study, error = build_study(problem, truth, begin, noise, seed, how.limits)
    return MonteCarlo(**repeat(problem, study, runs, "Monte Carlo", how), truth=truth, integration_error=error)


def _check_noise(noise: Noise) -> Noise:
    """Return the noise as an array, a function or None."""
    if noise is None:
        return None
    if callable(noise):
        return objects.as_callable(noise, "noise", "a function noise(rng, clean, item)", arguments=3)
    return as_array(noise, "noise", form="a number, one for each channel, or a function")


def build_study(
    problem: Problem, truth: FloatArray, begin: FloatArray, noise: Noise, seed: int, limits: Limits
) -> tuple[SimulatedStudy, float]:
    """Return fits of simulated data, to be done by `repeat`, and the integration error at the truth.

    Parameters
    ----------
    problem, noise, seed : as of `monte_carlo`
    truth, begin : (d,)
        Where the data are simulated, and where every fit begins.
    limits : Limits
    """
    clean = simulate_clean(problem, truth)
    drawn = noise if callable(noise) else _find_spreads(problem, truth, noise, clean)
    study = SimulatedStudy(problem, [], begin[None], limits, seed, drawn, clean)
    study.meshes, error = _build_meshes(study.problem_of(0), truth, begin)
    return study, error


def simulate_clean(problem: Problem, truth: FloatArray) -> Values:
    """Return what data would be without noise."""
    found: Values = {}
    comparisons = compare(Evaluator(problem, truth).halved, truth)[1]
    for e, (experiment, run) in enumerate(zip(problem.experiments, comparisons, strict=True)):
        places = [k for k, item in enumerate(experiment.data) if isinstance(item, Measurements)]
        if not places or any(comparison.kind != "measurements" for comparison in run):
            raise ValueError("monte_carlo simulates Measurements: every run needs some, and none a ReferenceSignal.")
        found |= {(e, k): comparison.fitted for k, comparison in zip(places, run, strict=True)}
    return found


def _find_spreads(problem: Problem, truth: FloatArray, noise: Any, clean: Values) -> Values:
    """Return the standard deviations of the noise of all data, (K, q) each."""
    found = {}
    for (e, k), values in clean.items():
        item, sigma = problem.experiments[e].data[k], noise
        if sigma is None:
            sigma = item.noise(problem.name_parameters(truth, e))
        if sigma is None:
            raise ValueError(
                "noise must be given, since the data have no sigma from which to draw: a standard deviation, one for "
                "each channel, or a function."
            )
        try:
            found[e, k] = np.broadcast_to(np.asarray(sigma, dtype=float), values.shape)
        except ValueError as error:
            raise ValueError(f"noise of shape {np.shape(sigma)} does not fit data of shape {values.shape}.") from error
        if not np.all(np.isfinite(found[e, k]) & (found[e, k] >= 0)):
            raise ValueError(f"noise must be zero or positive; got {shorten(sigma)}.")
    return found


def _build_meshes(problem: Problem, truth: FloatArray, start: FloatArray) -> tuple[list[Mesh], float]:
    """Return meshes that resolve the trajectories at the start and at the truth, and the integration error at the
    truth.

    A mode that is active in another part of the horizon at the start would run over cells that are far too long for it,
    and lead somewhere else altogether.
    """
    finer = 1.0
    thetas = (truth,) if np.array_equal(start, truth) else (start, truth)
    for attempt in range(REFINEMENTS + 1):
        evaluator = Evaluator(problem, *thetas, finer=finer)
        fine = evaluator.halve_rows(truth).cost(truth)
        # Without noise J vanishes at the truth; then the error is measured against J where the fits begin.
        error = cost_error(problem, fine, evaluator(truth).cost, evaluator(start).cost)
        excess = error / max(LARGEST_INTEGRATION_ERROR, problem.rtol)
        if not excess > 1 or attempt == REFINEMENTS:
            break
        finer *= 1.1 * excess ** (1 / ORDER)
    return evaluator.meshes, float(error)


@dataclass
class SimulatedStudy(Study):
    """The runs of a Monte Carlo study.

    Attributes
    ----------
    noise : callable, or Values
        The function of the user, or standard deviations.
    clean : Values
        As of `simulate_clean`.
    """

    noise: Any
    clean: Values

    def draw_run(self, run: int) -> Values:
        """Return the values of one run."""
        rng, drawn = np.random.default_rng([self.seed, run]), {}
        for (e, k), clean in self.clean.items():
            if callable(self.noise):
                noisy = self.noise(rng, clean.copy(), self.problem.experiments[e].data[k])
                values = as_array(noisy, "what noise(rng, clean, item) returns")
            else:
                values = clean + self.noise[e, k] * rng.standard_normal(clean.shape)
            is_finite = bool(np.isfinite(values).all())
            if values.shape != clean.shape or not is_finite:
                raise ValueError(
                    f"noise must give finite values of shape {clean.shape}; got shape {values.shape}"
                    f"{'' if is_finite else ', not all finite,'} in run {run}."
                )
            drawn[e, k] = values
        return drawn

    def problem_of(self, run: int) -> Problem:
        """Return the problem with the data of one run."""
        return replace_values(self.problem, self.draw_run(run))

    def stack_data(self, runs: Iterable[int]) -> tuple[Varying, dict[int, Exception]]:
        """Return the data of some runs, and the errors of those whose noise cannot be drawn, by their places."""
        drawn, errors = [], {}
        for place, run in enumerate(runs):
            try:
                drawn.append(self.draw_run(run))
            except Exception as error:  # listed: it must not end the other runs
                drawn.append(self.clean)
                errors[place] = error
        return self.stack_values({key: np.stack([values[key] for values in drawn]) for key in self.clean}), errors

    def stack_values(self, values: Values) -> Varying:
        """Return noisy values (R, K, q) of all data as leaves of the arguments."""
        (leaves, places), changed = self.leaves, {}
        for e, experiment in enumerate(self.problem.experiments):
            measured = [(k, item) for k, item in enumerate(experiment.data) if isinstance(item, Measurements)]
            for samples, (k, item) in zip(places[e].samples, measured, strict=True):
                own, leaf = values[e, k], samples.value
                changed[leaf] = np.zeros((len(own), *leaves[leaf].shape))
                changed[leaf][:, : len(item.times)] = np.where(np.isnan(item.values), 0.0, own)
        return changed


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
    if not estimate.status.successful:
        raise ValueError(f"a bootstrap begins at a minimum, and this fit has not found one: {estimate.message}")
    problem = estimate.evaluator_at_solution().problem
    _check_data(problem)
    size, resampled = 1, np.ones(len(estimate.theta), dtype=bool)
    if resample == "runs":
        if len(problem.experiments) < 2:
            raise ValueError("resample='runs' needs two experiments or more; this problem has one. Take 'residuals'.")
        meshes = list(estimate.evaluator_at_solution().meshes)
        study: Study = StudyOfRuns(problem, meshes, estimate.theta[None], how.limits, seed)
        resampled[np.concatenate([where[where >= 0] for where in problem.unknowns.times])] = False
    else:
        draw = _Draw(estimate, problem, resample, block)
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
        gradients = np.array([gradients[found.experiment == e].sum(0) for e in range(runs)])
    influence = -gradients @ inverse_on(estimate.free_basis, estimate.hessian)
    spread = np.sum(influence**2, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        acceleration = np.sum(influence**3, axis=0) / (6 * spread**1.5)
    return np.nan_to_num(acceleration)


def _choose_block(estimate: Estimate, longest: int) -> int:
    """Return the length of a block, by the channel with the largest correlation of neighbours."""
    lengths = [1.0]
    for channel in estimate.residuals.channels:
        if channel.correlation > 0:
            r = min(channel.correlation, 0.99)
            lengths.append((np.sqrt(6) * r / (1 - r**2)) ** (2 / 3) * len(channel.values) ** (1 / 3))
    return max(1, min(round(max(lengths)), longest // 2))


class _Draw:
    """The noise of one run: as `monte_carlo` takes it."""

    def __init__(self, estimate: Estimate, problem: Problem, resample: str, block: int | None) -> None:
        self.resample, self.block = resample, 1
        inflation = np.sqrt(estimate.samples / max(estimate.freedom, 1))
        self.items = [item for experiment in problem.experiments for item in experiment.data]
        self.pools: list[FloatArray] = []
        for item, comparison in zip(self.items, chain.from_iterable(estimate.comparisons), strict=True):
            residuals = inflation * comparison.residuals / _get_sigma(item)
            self.pools.append(residuals if resample == "wild" else residuals - np.nanmean(residuals, axis=0))
        if resample == "blocks":
            longest = max(map(len, self.pools))
            self.block = _choose_block(estimate, longest) if block is None else as_count(block, "block")
            if not 1 <= self.block <= longest:
                raise ValueError(f"block must lie between 1 and the {longest} samples there are; got {block}.")

    def __call__(self, rng: np.random.Generator, clean: FloatArray, item: Any) -> FloatArray:
        pool = next(pool for own, pool in zip(self.items, self.pools, strict=True) if own is item)
        K = len(pool)
        if self.resample == "wild":
            drawn = np.nan_to_num(pool) * rng.choice([-1.0, 1.0], size=(K, 1))
        else:
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
