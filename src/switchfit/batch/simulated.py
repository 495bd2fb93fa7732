"""Monte Carlo: simulate, perturb, fit again, thousands of times."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import ArrayLike

from switchfit.batch.again import find_replaced, redo_doubted, redo_unresolved
from switchfit.batch.chunks import Arrays, compute_fingerprint
from switchfit.batch.evaluations import Evaluations
from switchfit.batch.fits import CHUNK_FORMAT, Fits, check_long_run, repeat
from switchfit.batch.intervals import trace_chunk
from switchfit.batch.layout import Varying, choose_chunk_size, count_chunks_together
from switchfit.batch.program import fit_chunk, mark_failed
from switchfit.batch.quality import count_samples, describe_ends
from switchfit.batch.verdict import LEVEL, judge_study
from switchfit.discretization.arguments import build_arguments, split_by_cell
from switchfit.discretization.mesh import Mesh
from switchfit.engine.adaptive import refine_mesh
from switchfit.estimation.local_fit import LARGEST_INTEGRATION_ERROR, ORDER, REFINEMENTS, check_settings, fit_locally
from switchfit.fit.accuracy import cost_error
from switchfit.fit.evaluator import Evaluator
from switchfit.fit.guards import place_on_near_guards
from switchfit.fit.trajectory import compare
from switchfit.fit.variation import measure_variation
from switchfit.problem.data import FloatArray, Measurements, ReferenceSignal
from switchfit.problem.problem import Problem, require_unknowns
from switchfit.problem.validation import as_array, as_callable, as_count, as_instance, as_seed, shorten
from switchfit.uncertainty.verdict import Verdict

SOUND_AMONG = 3
"""First runs among which one must be such that its noise can be drawn; what is wrong with a single one is listed."""

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

    def to_arviz(self) -> Any:
        """Return the estimates of the fits that converged as draws of one chain, in the group that ArviZ plots.

        They are draws of the estimate over repetitions of the experiment, and not of a posterior. It is InferenceData
        for ArviZ up to 0.23, and a DataTree for later versions.

        Raises
        ------
        ImportError
            If ArviZ or xarray is not installed.

        See Also
        --------
        MonteCarlo.to_pandas, MonteCarlo.to_xarray

        Examples
        --------
        >>> import warnings
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem

        >>> study = sf.monte_carlo(heater_problem(), 20, theta=[2.5, 0.4])
        >>> with warnings.catch_warnings():
        ...     warnings.simplefilter("ignore")  # ArviZ 0.23 warns of its next version
        ...     draws = study.to_arviz()
        >>> draws.posterior["k"].dims
        ('chain', 'draw')
        """
        return self._collect_draws("Monte Carlo", "truth", self.truth)


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
    require_unknowns(problem)
    runs, seed = as_count(runs, "runs", at_least=1), as_seed(seed)
    tolerance, max_iterations = check_settings(tolerance, max_iterations)
    check_long_run(client, folder, callback)
    noise = _check_noise(noise)
    began = time.perf_counter()
    given = None if theta is None else problem.check_theta(theta)
    begin = None if start is None else problem.check_theta(start, "start")
    truth = fit_locally(problem).theta if given is None else _move_onto_guards(problem, given)
    begin = truth if begin is None else begin
    found, error = fit_simulated(
        problem,
        runs,
        truth,
        begin,
        noise,
        seed=seed,
        tolerance=tolerance,
        max_iterations=max_iterations,
        title="Monte Carlo",
        began=began,
        client=client,
        folder=folder,
        callback=callback,
    )
    return MonteCarlo(**found, truth=truth, integration_error=error)


def _move_onto_guards(problem: Problem, theta: FloatArray) -> FloatArray:
    """Return `theta` with guarded times on their guards, found on meshes that resolve the trajectory there.

    On the mesh of the first guess, the times of a stiff model miss their guards by more than their standard errors.
    """
    if not any(structure.guarded for structure in problem.structures):
        return theta
    near = place_on_near_guards(Evaluator(problem, theta), theta)
    return place_on_near_guards(Evaluator(problem, near), near)


def _check_noise(noise: Noise) -> Noise:
    """Return the noise as an array, a function or None."""
    if noise is None:
        return None
    if callable(noise):
        return as_callable(noise, "noise", "a function noise(rng, clean, item)", arguments=3)
    return as_array(noise, "noise", form="a number, one for each channel, or a function")


def fit_simulated(
    problem: Problem,
    runs: int,
    truth: FloatArray,
    begin: FloatArray,
    noise: Noise,
    *,
    seed: int,
    tolerance: float,
    max_iterations: int,
    title: str,
    began: float,
    client: Any,
    folder: str | Path | None,
    callback: Callable[[int, int], object] | None,
) -> tuple[dict[str, Any], float]:
    """Return fits of simulated data: the fields of `Fits`, and the integration error at the truth.

    Parameters
    ----------
    problem, runs, noise, seed, tolerance, max_iterations, client, folder, callback : as of `monte_carlo`
    truth, begin : (d,)
        Where the data are simulated, and where every fit begins.
    title : str
        Of the bar on the terminal.
    began : float
        ``time.perf_counter()`` when the call began.
    """
    work = _Work(problem, [], truth, begin, noise, seed, tolerance, max_iterations, _simulate_clean(problem, truth))
    work.check_noise(runs)
    work.meshes, error = _build_meshes(work.problem_of(work.sound), truth, begin)
    found = repeat(problem, work, runs, title, began, client=client, folder=folder, callback=callback)
    return found, error


def _simulate_clean(problem: Problem, truth: FloatArray) -> list[list[FloatArray | None]]:
    """Return what each of the data of each experiment would be without noise: (K, q) arrays; None for costs without
    data.
    """
    sampled, which = [], []
    for experiment in problem.experiments:
        items, kept = [], []
        for k, item in enumerate(experiment.data):
            if isinstance(item, Measurements):
                items.append(replace(item, values=np.nan_to_num(item.values)))
            elif isinstance(item, ReferenceSignal) and item.samples is not None:
                times, values = item.samples
                if np.any(np.diff(times) == 0):
                    raise ValueError("A ReferenceSignal that was broken by a time given twice cannot be simulated.")
                inside = (times >= experiment.t0) & (times <= experiment.earliest_end)
                if not inside.all():
                    after = ", or after the lower bound of a free tf," if experiment.has_free_tf else ""
                    raise ValueError(f"A ReferenceSignal with samples outside the horizon{after} cannot be simulated.")
                items.append(Measurements(times, np.nan_to_num(values), item.observe, sigma=1.0))
            else:
                continue
            kept.append(k)
        if not items:
            raise ValueError("monte_carlo needs Measurements or a ReferenceSignal made from samples to simulate.")
        sampled.append(replace(experiment, data=items))
        which.append(kept)
    without_noise = replace(problem, experiments=sampled)
    meshes = Evaluator(without_noise, truth).meshes
    _, comparisons = compare(
        without_noise, truth, Evaluator(without_noise, meshes=[mesh.divide() for mesh in meshes]).simulate(truth)
    )
    clean: list[list[FloatArray | None]] = [[None] * len(experiment.data) for experiment in problem.experiments]
    for e, (kept, found) in enumerate(zip(which, comparisons, strict=True)):
        for k, comparison in zip(kept, found, strict=True):
            clean[e][k] = comparison.fitted
    return clean


def _build_meshes(problem: Problem, truth: FloatArray, start: FloatArray) -> tuple[list[Mesh], float]:
    """Return meshes that resolve the trajectories at the start and at the truth, and the integration error at the
    truth.

    A mode that is active in another part of the horizon at the start would run over cells that are far too long for it,
    and lead somewhere else altogether.
    """
    finer = 1.0
    thetas = (truth,) if np.array_equal(start, truth) else (start, truth)
    for attempt in range(REFINEMENTS + 1):
        indices = range(len(problem.experiments))
        evaluator = Evaluator(problem, meshes=[refine_mesh(problem, e, *thetas, finer=finer) for e in indices])
        fine = evaluator.halve_rows(truth).cost(truth)
        # Without noise J vanishes at the truth; then the error is measured against J where the fits begin.
        error = cost_error(problem, fine, evaluator(truth).cost, evaluator(start).cost)
        excess = error / max(LARGEST_INTEGRATION_ERROR, problem.rtol)
        if not excess > 1 or attempt == REFINEMENTS:
            break
        finer *= 1.1 * excess ** (1 / ORDER)
    return evaluator.meshes, float(error)


@dataclass
class _Work:
    """The runs of a Monte Carlo study, for `run_chunks`."""

    problem: Problem
    meshes: list[Mesh]
    truth: FloatArray
    start: FloatArray
    noise: Any
    seed: int
    tolerance: float
    max_iterations: int
    clean: list[list[FloatArray | None]]
    sound: int = 0  # a run whose noise can be drawn

    @property
    def size(self) -> int:
        return choose_chunk_size()

    @cached_property
    def most_chunks(self) -> int:
        one = {key: values[None] for key, values in self._draw_run(self.sound).items()}
        return count_chunks_together(self.problem, self.meshes, self._stack_values(one))

    def check_noise(self, count: int) -> None:
        """Find a run whose noise can be drawn; raise the error of the first run if none of the first few can."""
        errors = []
        for run in range(min(count, SOUND_AMONG)):
            try:
                self._draw_run(run)
            except Exception as error:  # of this run alone, perhaps
                errors.append(error)
            else:
                self.sound = run
                return
        raise errors[0]

    def _draw_run(self, run: int) -> dict[tuple[int, int], FloatArray]:
        """Return values of the k-th data of experiment e, in one run."""
        rng = np.random.default_rng([self.seed, run])
        drawn = {}
        for e, items in enumerate(self.clean):
            for k, clean in enumerate(items):
                if clean is None:
                    continue
                values = self._draw_values(rng, clean, self.problem.experiments[e].data[k], e, k)
                if values.shape != clean.shape or not np.isfinite(values).all():
                    raise ValueError(
                        f"noise must give finite values of shape {clean.shape}; got shape {values.shape}"
                        + (f" in run {run}." if np.isfinite(values).all() else f", not all finite, in run {run}.")
                    )
                drawn[e, k] = values
        return drawn

    def _draw_values(self, rng: np.random.Generator, clean: FloatArray, item: Any, e: int, k: int) -> FloatArray:
        if callable(self.noise):
            return as_array(self.noise(rng, clean.copy(), item), "what noise(rng, clean, item) returns")
        if (e, k) not in self._spreads:
            self._spreads[e, k] = self._find_spread(clean, item, e)
        return clean + self._spreads[e, k] * rng.standard_normal(clean.shape)

    @cached_property
    def _spreads(self) -> dict[tuple[int, int], FloatArray]:
        """Standard deviations of the noise of the data that were drawn so far."""
        return {}

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
        noisy = self._draw_run(run)
        experiments = []
        for e, experiment in enumerate(self.problem.experiments):
            data = [
                _replace_values(item, noisy[e, k]) if (e, k) in noisy else item
                for k, item in enumerate(experiment.data)
            ]
            experiments.append(replace(experiment, data=data))
        return replace(self.problem, experiments=experiments)

    def __call__(self, runs: range) -> Arrays:
        noisy, errors = [], {}
        for place, run in enumerate(runs):
            try:
                noisy.append(self._draw_run(run))
            except Exception as error:  # listed: it must not end the other runs
                noisy.append(self._fill_undrawn())
                errors[place] = error
        varying = self._stack_values({key: np.stack([values[key] for values in noisy]) for key in noisy[0]})
        starts = np.repeat(self.start[None], len(runs), axis=0)
        first = found = fit_chunk(
            self.problem,
            self.meshes,
            varying,
            starts,
            tolerance=self.tolerance,
            max_iterations=self.max_iterations,
            room=self.size * self.most_chunks,
        )
        found = mark_failed(found, errors) if errors else found
        settings: Any = {"tolerance": self.tolerance, "max_iterations": self.max_iterations}
        found = redo_unresolved(found, lambda k: self.problem_of(runs[k]), self.meshes, **settings)
        if self.problem.constraint_names:
            found = redo_doubted(found, lambda k: self.problem_of(runs[k]), starts, self._variation, **settings)
        evaluations = partial(Evaluations, self.problem, self.meshes, varying, self.size * self.most_chunks)
        own, again = lambda k: self.problem_of(runs[k]), find_replaced(first, found)
        pieces = trace_chunk(found, again, lambda k: self.problem, evaluations, own)
        return {
            **found._asdict(),
            **describe_ends(self.problem, found.theta, found.cost, self._variation),
            "pieces": pieces,
            "start": starts,
            "samples": np.full(len(runs), count_samples(self.problem)),
        }

    @cached_property
    def _variation(self) -> float:
        """J of the data of one run that are met by their means; in the others it differs by noise alone."""
        return float(measure_variation(self.problem_of(self.sound)).sum())

    def _fill_undrawn(self) -> dict[tuple[int, int], FloatArray]:
        """Return placeholder values for a run whose noise could not be drawn."""
        return {(e, k): v for e, items in enumerate(self.clean) for k, v in enumerate(items) if v is not None}

    def _stack_values(self, values: dict[tuple[int, int], FloatArray]) -> Varying:
        """Return noisy values (R, K, q) of all data as leaves of the arguments."""
        arguments = tuple(build_arguments(self.problem, e, mesh) for e, mesh in enumerate(self.meshes))
        leaves, tree = jax.tree.flatten(arguments)
        places = jax.tree.unflatten(tree, range(len(leaves)))
        changed: dict[int, Any] = {}
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
        return Varying(tuple(changed), tuple(changed.values()))

    def fingerprint(self) -> str:
        unknowns = self.problem.unknowns
        data = [np.asarray(values) for items in self.clean for values in items if values is not None]
        drawn = list(self._draw_run(self.sound).values())  # stands for the noise, which may be a function
        settings = self.seed, self.tolerance, self.max_iterations, unknowns.names, self.problem.solver
        model = self.problem.digests
        bounds = unknowns.lower, unknowns.upper, unknowns.A, unknowns.b, *unknowns.priors
        nodes = [mesh.nodes for mesh in self.meshes]
        return compute_fingerprint(
            CHUNK_FORMAT, "monte carlo", settings, model, self.truth, self.start, *bounds, *nodes, *data, *drawn
        )


def _replace_values(item: Any, values: FloatArray) -> Any:
    """Return the same kind of data with other values; missing ones stay missing."""
    if isinstance(item, Measurements):
        return replace(item, values=np.where(np.isnan(item.values), np.nan, values))
    measured = item.samples[1]
    return ReferenceSignal.from_samples(
        item.samples[0],
        np.where(np.isnan(measured), np.nan, values),
        observe=item.observe,
        lowpass_hz=item.lowpass_hz,
        weights=item.weights,
        names=item.names,
    )


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
