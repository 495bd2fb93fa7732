"""Monte Carlo: simulate, perturb, fit again, thousands of times."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from switchfit.batch.fits import Fits, LongRun, repeat
from switchfit.batch.program import Limits, Varying
from switchfit.batch.study import Study
from switchfit.batch.verdict import LEVEL, judge_study
from switchfit.discretization.mesh import Mesh, split_by_cell
from switchfit.estimation.local_fit import LARGEST_INTEGRATION_ERROR, ORDER, REFINEMENTS, fit_locally
from switchfit.fit.accuracy import cost_error
from switchfit.fit.evaluator import Evaluator, place_on_guards
from switchfit.fit.trajectory import compare, replace_values
from switchfit.problem.data import FloatArray, Measurements, ReferenceSignal
from switchfit.problem.experiment import Experiment
from switchfit.problem.problem import Problem, require_estimable
from switchfit.problem.validation import as_array, as_callable, as_count, as_instance, as_seed, shorten
from switchfit.uncertainty.verdict import Verdict

Noise = float | ArrayLike | Callable[[np.random.Generator, FloatArray, Any], ArrayLike] | None


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
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
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
        intervals = self.confidence_intervals(LEVEL)
        return judge_study(self, truth=self.truth, intervals=intervals, error=self.integration_error)

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
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem
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
        of the data from the clean ones. A `ReferenceSignal` is simulated at the samples it was made from, and
        interpolated and filtered anew.
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
        If the noise is not known, there is nothing to simulate, or the folder holds something else.
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
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> problem = heater_problem()

    >>> study = sf.monte_carlo(problem, 20, theta=[2.5, 0.4], seed=1)
    >>> len(study), bool((study.standard_deviation < 0.05).all())
    (20, True)
    """
    as_instance(problem, "problem", Problem, "an sf.Problem")
    require_estimable(problem)
    runs, seed = as_count(runs, "runs", at_least=1), as_seed(seed)
    how = LongRun.check(tolerance, max_iterations, client, folder, callback)
    noise = _check_noise(noise)
    given = None if theta is None else problem.check_theta(theta)
    begin = None if start is None else problem.check_theta(start, "start")
    truth = fit_locally(problem).theta if given is None else _move_onto_guards(problem, given)
    begin = truth if begin is None else begin
    study, error = build_study(problem, runs, truth, begin, noise, seed, how.limits)
    return MonteCarlo(**repeat(problem, study, runs, "Monte Carlo", how), truth=truth, integration_error=error)


def _move_onto_guards(problem: Problem, theta: FloatArray) -> FloatArray:
    """Return `theta` with guarded times on their guards; as it is where there are none, or no such point is near."""
    with suppress(ValueError):
        return place_on_guards(problem, theta)[1]
    return theta


def _check_noise(noise: Noise) -> Noise:
    """Return the noise as an array, a function or None."""
    if noise is None:
        return None
    if callable(noise):
        return as_callable(noise, "noise", "a function noise(rng, clean, item)", arguments=3)
    return as_array(noise, "noise", form="a number, one for each channel, or a function")


def build_study(
    problem: Problem, runs: int, truth: FloatArray, begin: FloatArray, noise: Noise, seed: int, limits: Limits
) -> tuple[SimulatedStudy, float]:
    """Return fits of simulated data, to be done by `repeat`, and the integration error at the truth.

    Parameters
    ----------
    problem, runs, noise, seed : as of `monte_carlo`
    truth, begin : (d,)
        Where the data are simulated, and where every fit begins.
    limits : Limits
    """
    study = SimulatedStudy(problem, [], begin[None], limits, seed, truth, noise, simulate_clean(problem, truth))
    study.meshes, error = _build_meshes(study.problem_of(0), truth, begin)
    return study, error


Values = dict[tuple[int, int], FloatArray]
"""Values of data that are simulated, by the experiment and the place among its data: (K, q), or (R, K, q) of R runs."""


def simulate_clean(problem: Problem, truth: FloatArray) -> Values:
    """Return what data would be without noise."""
    runs, places = [], []
    for e, experiment in enumerate(problem.experiments):
        items = {k: _sample(item, experiment) for k, item in enumerate(experiment.data)}
        items = {k: item for k, item in items.items() if item is not None}
        if not items:
            raise ValueError("monte_carlo needs Measurements or a ReferenceSignal made from samples to simulate.")
        runs.append(replace(experiment, data=list(items.values())))
        places += [(e, k) for k in items]
    sampled = replace(problem, experiments=runs)
    evaluator = Evaluator(sampled, meshes=[mesh.divide() for mesh in Evaluator(sampled, truth).meshes])
    _, comparisons = compare(evaluator, truth)
    return dict(zip(places, (comparison.fitted for run in comparisons for comparison in run), strict=True))


def _sample(item: Any, experiment: Experiment) -> Measurements | None:
    """Return what is simulated of the data of an experiment: Measurements; None for costs without data."""
    if isinstance(item, Measurements):
        return replace(item, values=np.nan_to_num(item.values))
    if not isinstance(item, ReferenceSignal) or item.samples is None:
        return None
    times, values = item.samples
    if np.any(np.diff(times) == 0):
        raise ValueError("A ReferenceSignal that was broken by a time given twice cannot be simulated.")
    if times.min() < experiment.t0 or times.max() > experiment.earliest_end:
        after = ", or after the lower bound of a free tf," if experiment.has_free_tf else ""
        raise ValueError(f"A ReferenceSignal with samples outside the horizon{after} cannot be simulated.")
    return Measurements(times, np.nan_to_num(values), item.observe, sigma=1.0)


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
    truth : (d,)
    noise : as of `monte_carlo`
    clean : Values
        As of `simulate_clean`.
    """

    truth: FloatArray
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
                values = clean + self._spreads[e, k] * rng.standard_normal(clean.shape)
            is_finite = bool(np.isfinite(values).all())
            if values.shape != clean.shape or not is_finite:
                raise ValueError(
                    f"noise must give finite values of shape {clean.shape}; got shape {values.shape}"
                    f"{'' if is_finite else ', not all finite,'} in run {run}."
                )
            drawn[e, k] = values
        return drawn

    @cached_property
    def _spreads(self) -> Values:
        """Standard deviations of the noise."""
        experiments = self.problem.experiments
        return {(e, k): self._find_spread(clean, experiments[e].data[k], e) for (e, k), clean in self.clean.items()}

    def _find_spread(self, clean: FloatArray, item: Any, e: int) -> FloatArray:
        """Return the standard deviation of the noise of each value of an item: (K, q)."""
        sigma = self.noise
        if sigma is None:
            sigma = item.noise(self.problem.name_parameters(self.truth, e)) if isinstance(item, Measurements) else None
            if sigma is None:
                raise ValueError(
                    "noise must be given, since the data have no sigma from which to draw: a standard deviation, one "
                    "for each channel, or a function."
                )
        try:
            spread = np.broadcast_to(sigma, clean.shape)
        except ValueError as error:
            raise ValueError(f"noise of shape {np.shape(sigma)} does not fit data of shape {clean.shape}.") from error
        if not (np.isfinite(spread).all() and (spread >= 0).all()):
            raise ValueError(f"noise must be zero or positive; got {shorten(sigma)}.")
        return spread

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
        (leaves, places), changed = self.leaves, dict[int, Any]()
        for e, experiment in enumerate(self.problem.experiments):
            measured = channel = 0
            for k, item in enumerate(experiment.data):
                if isinstance(item, Measurements):
                    leaf = places[e].samples[measured].value
                    padded = np.zeros((len(values[e, k]), *leaves[leaf].shape))
                    padded[:, : len(item.times)] = np.where(np.isnan(item.values), 0.0, values[e, k])
                    changed[leaf] = padded
                    measured += 1
                elif isinstance(item, ReferenceSignal):
                    q = item.signal.channels
                    if (e, k) in values:
                        leaf = places[e].signals
                        R = len(values[e, k])
                        if leaf not in changed:
                            changed[leaf] = np.repeat(np.asarray(leaves[leaf])[None], R, axis=0)
                        changed[leaf][..., channel : channel + q] = _find_cells(item, values[e, k], self.meshes[e])
                    channel += q
        return changed


def _find_cells(item: ReferenceSignal, values: FloatArray, mesh: Mesh) -> FloatArray:
    """Return reference signals made from values (R, K, q), as cubics in the cells of a mesh: (R, G, 4, q).

    All R at once: interpolation and filter treat channels one by one, so that runs can be channels too.
    """
    R, K, q = values.shape
    times, measured = item.samples  # type: ignore[misc]  # there are some: they have been simulated
    table = np.where(np.isnan(measured), np.nan, values)
    channels = np.moveaxis(table, 0, 1).reshape(K, R * q)
    signal = ReferenceSignal.from_samples(times, channels, lowpass_hz=item.lowpass_hz).signal
    cells = split_by_cell(signal, mesh)
    return np.moveaxis(cells.reshape(*cells.shape[:2], R, q), 2, 0)
