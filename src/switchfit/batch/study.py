"""Studies of one problem, whose data differ from run to run, or where its fits begin; and of one model, of many logs.

What is said of a fit beyond its end is the same in every study, and in a batch of logs: fits are done again that need
it, and pieces of profiles are added, and how well each fit explains its data.

Intervals of transition times across sample times, of many fits: as of `switchfit.uncertainty.walks`.

Where a sample lies near a transition time, or a kink holds it, the pieces of its profile are found while the fit's data
are at hand, and kept: from them follows the interval at any level. Most fits have no sample so near, and cost nothing.

Repeat single fits of a batch: those that failed on the shared mesh, and doubtful ones with guards or constraints.

From a far guess guards pull transitions together, and the modes between them collapse. Each such fit of a batch is then
made alone, with the constraints inside the quadratic programme, and where that does not help with transitions that may
happen anywhere, and from there on their guards.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.batch import fits as judged
from switchfit.batch.chunks import Arrays, compute_fingerprint, run_chunks
from switchfit.batch.fits import Fits, has_converged
from switchfit.batch.program import Batch, Chunk, Limits, Varying, choose_chunk_size, describe_failure
from switchfit.discretization.arguments import build_arguments
from switchfit.discretization.mesh import Mesh
from switchfit.engine.corners.branches import has_corners
from switchfit.estimation.local_fit import LARGEST_INTEGRATION_ERROR, check_settings, fit_locally
from switchfit.fit.accuracy import cost_error
from switchfit.fit.evaluator import Evaluator, evaluator_of, measure_variation
from switchfit.fit.result import count_priors, count_samples, measure_quantile, measure_variance
from switchfit.fit.solution import refuse_hidden_switches
from switchfit.optimize import Status
from switchfit.optimize.traced_state import Outcome
from switchfit.problem.origin import Origin
from switchfit.problem.problem import Problem, require_estimable
from switchfit.problem.validation.messages import join_names
from switchfit.problem.validation.names import as_sequence
from switchfit.problem.validation.objects import as_callable, as_instance, as_path
from switchfit.runtime.progress import show_progress
from switchfit.strategy.starts import End, fit_briefly
from switchfit.uncertainty import walks as ways
from switchfit.uncertainty.walks import HIGHEST_LEVEL, Derivatives, Walks

MOST_SAMPLES = 5
"""With more samples than that within an interval one parabola is taken: their kinks begin to average out, and the
pieces of all fits would be most of what is kept."""

MOST_KEPT = MOST_SAMPLES + 1 + ways.MOST_HALVINGS
"""Pieces that are kept for one side."""

AT_KINK = Status.CONVERGED_AT_KINK.name

CHUNK_FORMAT = "fits 4"
"""Part of every fingerprint: it changes where the arrays of a chunk do, so that folders of before are not used."""


def list_places(problem: Problem) -> NDArray[np.intp]:
    """Return the places in theta of the transition times whose profiles are looked at: (T,).

    None where J has no noise model, with guards, terminal constraints or corners of the state, of which compiled
    programs know nothing, and of more than `MOST_RUNS` experiments.
    """
    alone = problem.is_sigma_known is None or problem.constraint_names or any(map(has_corners, problem.structures))
    if alone or len(problem.experiments) > ways.MOST_RUNS:
        return np.zeros(0, dtype=np.intp)
    return np.array([k for _, k in ways.list_transitions(problem)], dtype=np.intp)


def make_no_pieces(problem: Problem, count: int) -> FloatArray:
    """Return the pieces of fits none of which has a sample near: (R, T, 2, `MOST_KEPT`, 5) of NaN."""
    return np.full((count, len(list_places(problem)), 2, MOST_KEPT, ways.PIECE), np.nan)


def trace_chunk(chunk: Chunk, groups: list[tuple[Problem, NDArray[np.intp]]], batch: Batch) -> FloatArray:
    """Return the pieces of the profiles of a chunk's transition times: (R, T, 2, `MOST_KEPT`, 5).

    Parameters
    ----------
    chunk : Chunk
    groups : list of (Problem, (n,) int)
        Problems with the bounds and sample times of some fits.
    batch : Batch
        Which evaluates the chunk's fits.
    """
    found, at_kink = make_no_pieces(groups[0][0], len(chunk.cost)), chunk.status == AT_KINK
    # With JAX other evaluations have to be compiled for this: it is done for kinks alone, where there is nothing else.
    followed = has_converged(chunk.status) & (at_kink | batch.layout.natively)
    looked_at = groups if found.shape[1] else []
    lots = [lot for problem, fits in looked_at for lot in _list_walks(problem, chunk, fits[followed[fits]])]
    if not lots:
        return found
    fits, rows = (np.concatenate([lot[i] for lot in lots]) for i in (0, 1))
    walks = ways.join_walks([lot[2] for lot in lots])

    def evaluate(which: NDArray[np.intp], thetas: FloatArray) -> Derivatives:
        return batch.evaluate(fits[which], thetas, walks.side[which])

    pieces = ways.trace_walks(walks, chunk.cost[fits], evaluate, MOST_KEPT, groups[0][0].unknowns.times)
    found[fits, rows, (walks.side + 1) // 2] = pieces
    incomplete = np.isnan(found[:, :, :, 0, 0]).any(axis=2)
    found[incomplete] = np.nan
    return found


def _list_walks(
    problem: Problem, chunk: Chunk, fits: NDArray[np.intp]
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp], Walks]]:
    """Yield the ways to both sides of each transition time at a kink, or with a few samples within its interval: which
    fits, which rows among the chunk's pieces, and the ways.

    The fits must share bounds and sample times.
    """
    freedom, known = count_samples(problem) + count_priors(problem) - chunk.free[fits], problem.is_sigma_known
    fits, freedom = (each[np.isfinite(chunk.cost[fits]) & ((freedom > 0) | bool(known))] for each in (fits, freedom))
    if not fits.size:
        return
    theta, variances = chunk.theta[fits], np.diagonal(chunk.covariance[fits], axis1=1, axis2=2)
    quantile = measure_quantile(HIGHEST_LEVEL, freedom, known)
    scale = measure_variance(chunk.cost[fits], freedom, known)
    thresholds = 0.5 * quantile**2 * scale
    with np.errstate(invalid="ignore"):
        errors = np.sqrt(np.maximum(variances, 0.0) * scale[:, None])
        free = (variances > 0) & ~chunk.at_kink[fits]
    ends = problem.ends_of_modes(theta)
    for row, (e, place) in enumerate(ways.list_transitions(problem)):
        tau, samples = theta[:, place], ways.stack_sample_times(problem, theta, e)
        collapsed = np.sum(ends[e] == tau[:, None], axis=1) > 1  # ties it to another time
        held = (chunk.status[fits] == AT_KINK) & chunk.at_kink[fits, place]
        with np.errstate(invalid="ignore"):
            within = np.abs(samples - tau[:, None]) <= (quantile * errors[:, place])[:, None]
        few = np.sum(within, axis=1) <= MOST_SAMPLES
        taken = ~collapsed & (held | (few & ways.is_any_near(samples, tau, errors[:, place])))
        if taken.any():
            own = theta[taken], free[taken], thresholds[taken], samples[taken]
            walks = ways.list_walks(problem, e, place, *own, MOST_KEPT)
            yield np.tile(fits[taken], 2), np.full(len(walks.place), row), walks


def _fit_free_of_guards(problem: Problem, start: FloatArray) -> End:
    """Return where a fit ends whose transitions may happen anywhere, and one on the guards from there."""
    free = fit_briefly(replace(problem, system=replace(problem.system, guards={})), start)
    return free if free.failed else fit_briefly(problem, free.theta)


def _is_resolved(problem: Problem, meshes: Sequence[Mesh] | None, theta: FloatArray, cost: float) -> bool:
    """Return whether cutting all steps in two changes J at theta by no more than the integration error that is allowed.

    `cost` is J where it ended on meshes of its own; on shared ones, it is found anew, as what failed may have none.
    """
    evaluator = evaluator_of(problem) if meshes is None else Evaluator(problem, meshes=meshes)
    fine = evaluator.halve_rows(theta).cost(theta)
    error = cost_error(problem, fine, cost if meshes is None else evaluator.cost(theta), 0.0)
    return error <= max(LARGEST_INTEGRATION_ERROR, problem.rtol)


@dataclass
class Study:
    """Fits of one problem on meshes that they share, for `run_chunks`.

    Derived classes say what differs between the runs: `stack_data`, `problem_of` and `measure_variation`.

    Attributes
    ----------
    problem : Problem
    meshes : list of Mesh
    starts : (runs, d), or (1, d)
        Where the fits begin; one row for all of them.
    limits : Limits
    seed : int
    """

    problem: Problem
    meshes: list[Mesh]
    starts: FloatArray
    limits: Limits
    seed: int

    shares_problem = True  # whether bounds, sample times and meshes are those of `problem`
    is_finished = True  # whether fits are done again that need it, and get pieces

    @property
    def size(self) -> int:
        """Runs in a chunk."""
        return choose_chunk_size(self.problem)

    @cached_property
    def leaves(self) -> tuple[list[Any], Any]:
        """The leaves of the problem's own arguments, and arguments that have the place of each leaf instead."""
        arguments = tuple(build_arguments(self.problem, e, mesh) for e, mesh in enumerate(self.meshes))
        leaves, tree = jax.tree.flatten(arguments)
        return leaves, jax.tree.unflatten(tree, range(len(leaves)))

    def stack_data(self, runs: Iterable[int]) -> tuple[Varying, dict[int, Exception]]:
        """Return the data of some runs, and the errors of those that have none, by their places."""
        return {}, {}

    def problem_of(self, run: int) -> Problem:
        """Return the problem with the data of one run."""
        return self.problem

    def measure_variation(self, runs: range) -> FloatArray | float:
        """Return J of data that are met by their means: (R,), or that of one run, from which others differ by noise."""
        return self._variation

    @cached_property
    def _variation(self) -> float:
        return float(measure_variation(self.problem_of(0)).sum())

    def group_fits(self, runs: range) -> list[tuple[Problem, NDArray[np.intp]]]:
        """Return each problem whose bounds and sample times fits share, with these fits."""
        every = np.arange(len(runs))
        if self.shares_problem:
            return [(self.problem, every)]
        return [(self.problem_of(run), every[k : k + 1]) for k, run in enumerate(runs)]

    def __call__(self, runs: range) -> Arrays:
        """Return the fits of some of the runs."""
        data, errors = self.stack_data(runs)
        batch = Batch(self.problem, self.meshes, data, self.limits)
        chunk = batch.fit(self.list_starts(runs))
        for k, error in errors.items():
            chunk.clear_fit(k, error)
        pieces = make_no_pieces(self.problem, len(runs))
        if self.is_finished:
            self._redo_unresolved(chunk, runs, batch)
            if self.problem.constraint_names:
                self._redo_doubted(chunk, runs, batch)
        self._free_kinks(chunk, runs)
        if self.is_finished and not any(mesh.has_layers for mesh in self.meshes):  # J is rough on one mesh
            pieces = trace_chunk(chunk, self.group_fits(runs), batch)
        return self.describe_fits(chunk, runs) | {"pieces": pieces}

    def _free_kinks(self, chunk: Chunk, runs: range) -> None:
        """Let unknowns at kinks have variances, unless guards, terminal constraints or short modes may tie them."""
        if self.problem.constraint_names or not chunk.at_kink.any():
            return
        found, known = self.describe_fits(chunk, runs), self.problem.is_sigma_known
        freedom = found["samples"] + count_priors(self.problem) - chunk.free
        scale = measure_variance(chunk.cost, freedom, known)
        for k in np.flatnonzero(chunk.at_kink.any(axis=1) & (found["collapsed"] == 0)).tolist():
            chunk.free_kinks(k, float(scale[k]))

    def list_starts(self, runs: range) -> FloatArray:
        """Return where some of the runs begin: (R, d)."""
        return self.starts[runs.start : runs.stop] if len(self.starts) > 1 else self.starts.repeat(len(runs), axis=0)

    def _redo_unresolved(self, chunk: Chunk, runs: range, batch: Batch) -> None:
        """Replace fits whose integration error is too large by those that `estimate` finds.

        Of fits that share meshes, those that failed are looked at. A mode that is active elsewhere than where the
        meshes were refined may find cells there that are far too long for it: what stops the optimiser is then the mesh
        and not the model. A fit that fails again is left as it was.
        """
        failed = ~has_converged(chunk.status)
        looked_at = (chunk.status != Status.ERROR.name) & (failed | (not self.shares_problem))
        for k in np.flatnonzero(looked_at).tolist():
            theta = chunk.theta[k]
            try:
                problem = self.problem_of(runs[k])
                if _is_resolved(problem, self.meshes if self.shares_problem else None, theta, chunk.cost[k]):
                    continue
                again = fit_locally(problem, start=theta, **self.limits._asdict())
            except Exception as error:
                if not failed[k]:
                    chunk.set_error(k, error)
                continue  # a fit from this end fails too: the first one stays, and is listed as failed
            if again.status.successful or not failed[k]:
                batch.replace_fit(chunk, k, again)

    def _redo_doubted(self, chunk: Chunk, runs: range, batch: Batch) -> None:
        """Replace fits that did not converge, lost modes or are far from their data by better ones, if there are any.

        Only of problems with guards or terminal constraints, which the compiled program does not take.
        """
        starts, guarded = self.list_starts(runs), any(structure.guarded for structure in self.problem.structures)
        for find in (fit_briefly, _fit_free_of_guards) if guarded else (fit_briefly,):
            for k in np.flatnonzero(self._find_doubted(chunk, runs)).tolist():
                try:
                    problem = self.problem_of(runs[k])
                    end = find(problem, starts[k])
                    if end.failed:
                        continue
                    again = fit_locally(problem, start=end.theta, **self.limits._asdict())
                except Exception:  # nothing better from this start, or a problem that cannot be built: it is listed
                    continue
                before = chunk.cost[k] if has_converged(chunk.status)[k] else np.inf
                if again.status.successful and again.cost < before:
                    batch.replace_fit(chunk, k, again)

    def _find_doubted(self, chunk: Chunk, runs: range) -> NDArray[np.bool_]:
        """Return of which fits a better end may be elsewhere: not converged, a mode collapsed, or far from the data."""
        kinds = "not converged", "a mode collapsed", "little explained", *judged.EXPLAINED_BADLY
        arrays, known = self.describe_fits(chunk, runs), self.problem.is_sigma_known
        doubts = [d for d in judged.find_doubts(arrays, known, count_priors(self.problem)) if d.kind in kinds]
        return np.any([np.zeros(len(runs), dtype=bool), *(doubt.which for doubt in doubts)], axis=0)

    def describe_fits(self, chunk: Chunk, runs: range) -> Arrays:
        """Return the arrays of fits as they are."""
        variation = np.broadcast_to(self.measure_variation(runs), len(runs))
        described = [
            judged.describe_ends(problem, chunk.theta[fits], chunk.cost[fits], variation[fits])
            for problem, fits in self.group_fits(runs)
        ]
        ends = {name: np.concatenate([one[name] for one in described]) for name in described[0]}
        return {**chunk.to_arrays(), **ends, "start": self.list_starts(runs)}

    def fingerprint(self) -> str:
        """Return a digest of everything that a result depends on."""
        unknowns, data = self.problem.unknowns, self.stack_data([0])[0]  # run 0 stands for all
        bounds = unknowns.lower, unknowns.upper, unknowns.A, unknowns.b, *unknowns.priors
        shared = [np.asarray(leaf) for place, leaf in enumerate(self.leaves[0]) if place not in data]
        settings = type(self).__name__, self.limits, self.seed, unknowns.names, self.problem.solver
        return compute_fingerprint(
            CHUNK_FORMAT, settings, self.problem.digests, self.starts, *bounds, *data.values(), *shared
        )


class LongRun(NamedTuple):
    """When fits end, where a long run is done and kept, who is told how far it is, and when it began.

    Attributes
    ----------
    limits : Limits
    client, folder : as of `run_chunks`
    callback : callable ``(done, total)``, a true value stops; or None
    began : float
        As of ``time.perf_counter()``.
    """

    limits: Limits
    client: Any
    folder: Path | None
    callback: Callable[[int, int], object] | None
    began: float

    @classmethod
    def check(cls, tolerance: Any, max_iterations: Any, client: Any, folder: Any, callback: Any) -> LongRun:
        """Return these settings; raise for those of the wrong type, before anything long is done."""
        limits = Limits(*check_settings(tolerance, max_iterations))
        if client is not None and not hasattr(client, "submit"):
            raise TypeError(f"client must be a dask.distributed.Client; got {type(client).__name__}.")
        folder = None if folder is None else as_path(folder, "folder")
        if callback is not None:
            as_callable(callback, "callback", "a function callback(done, total)", arguments=2)
        return cls(limits, client, folder, callback, time.perf_counter())


def repeat(problem: Problem, work: Any, count: int, title: str, how: LongRun) -> dict[str, Any]:
    """Do `count` runs with a bar on the terminal: the fields of `Fits`.

    Parameters
    ----------
    problem : Problem
        One of those that are fitted: its names, and whether its noise is known.
    work, count : as of `run_chunks`
    title : str
        Of the bar.
    how : LongRun

    Raises
    ------
    ValueError
        For a problem with a switch that is hidden in a function, with which no fit could be right.
    """
    _refuse_hidden_switches(problem)
    with show_progress(how.callback, title) as progress:
        runs, arrays = run_chunks(work, count, client=how.client, folder=how.folder, progress=progress)
    known, priors, unknowns = problem.is_sigma_known, count_priors(problem), problem.unknowns
    variance = measure_variance(arrays["cost"], arrays["samples"] + priors - arrays["free"], known)
    return arrays | {
        "covariance": variance[:, None, None] * arrays["covariance"],
        "theta_names": problem.theta_names,
        "theta_units": unknowns.units,
        "requested": count,
        "runs": runs,
        "sigma_known": known,
        "priors": priors,
        "piece_places": list_places(problem),
        "log_scaled": unknowns.log_names,
        "log_origins": unknowns.origin,
        "seconds": time.perf_counter() - how.began,
        "date_origins": list_origins(problem),
    }


def _refuse_hidden_switches(problem: Problem) -> None:
    """Raise what `estimate` would raise about the model, before thousands of fits list it one by one."""
    try:
        evaluator, theta = evaluator_of(problem), problem.initial_theta
        gradient = evaluator(theta).gradient
    except Exception:  # a guess at which the model cannot be evaluated: the fits that begin there will say so
        return
    if np.isfinite(gradient).all():
        refuse_hidden_switches(evaluator, theta, gradient)


def list_origins(problem: Problem) -> tuple[Origin | None, ...]:
    """Return the date at which each unknown that is a date is 0; None for every other."""
    found: list[Origin | None] = [None] * len(problem.theta_names)
    for experiment, places in zip(problem.experiments, problem.unknowns.times, strict=True):
        for place in places[places >= 0].tolist():
            found[place] = experiment.origin
    return tuple(found)


@dataclass
class StudyOfLogs(Study):
    """Problems of one model, each with data, guess and meshes of its own."""

    problems: list[Problem]

    shares_problem = False

    def __call__(self, runs: range) -> Arrays:
        """Fits of some of the problems: those whose programs agree go together, and then back into their order."""
        groups: dict[Any, list[int]] = {}
        parts, order = [], []
        for k in runs:
            try:
                groups.setdefault(_get_kind(self.problems[k]), []).append(k)
            except Exception as error:  # as where its guess cannot be integrated: listed, it must not end the others
                parts.append(self._select([k], []).describe_failed(error))
                order.append(k)
        for members in groups.values():
            meshes = evaluator_of(self.problems[members[0]]).meshes
            parts.append(super(StudyOfLogs, self._select(members, meshes)).__call__(range(len(members))))
            order += members
        place = np.argsort(order)
        return {name: np.concatenate([part[name] for part in parts])[place] for name in parts[0]}

    def _select(self, members: list[int], meshes: list[Mesh]) -> StudyOfLogs:
        """Return some of the problems, on meshes that they share."""
        problems = [self.problems[k] for k in members]
        return replace(self, problem=problems[0], meshes=meshes, starts=self.starts[members], problems=problems)

    def fingerprint(self) -> str:
        """Return a digest of everything that a result depends on."""
        parts: list[Any] = [CHUNK_FORMAT, "logs", len(self.problems), self.limits]
        for problem in self.problems:
            parts += [problem.theta_names, problem.initial_theta, *problem.unknowns.priors, problem.digests]
            try:
                evaluator = evaluator_of(problem)
            except Exception as error:  # this one will be listed as failed
                parts.append(describe_failure(error))
            else:
                parts += map(np.asarray, jax.tree.leaves(tuple(evaluator.arguments)))
        return compute_fingerprint(*parts)

    def stack_data(self, runs: Iterable[int]) -> tuple[Varying, dict[int, Exception]]:
        """Return all arguments of some problems."""
        leaves = [jax.tree.leaves(tuple(evaluator_of(self.problems[k]).arguments)) for k in runs]
        stacked = (np.stack([np.asarray(leaf) for leaf in column]) for column in zip(*leaves, strict=True))
        return dict(enumerate(stacked)), {}

    def problem_of(self, run: int) -> Problem:
        """Return one of the problems."""
        return self.problems[run]

    def measure_variation(self, runs: range) -> FloatArray:
        """Return J of the data of each problem that are met by their means: (R,)."""
        return np.array([measure_variation(self.problems[k]).sum() for k in runs])

    def describe_failed(self, error: Exception) -> Arrays:
        """Return the arrays of the only problem, whose fit failed before it began."""
        chunk, runs = Chunk.of(Outcome.at_starts(self.starts, np)), range(1)
        chunk.clear_fit(0, error)
        return self.describe_fits(chunk, runs) | {"pieces": make_no_pieces(self.problem, 1)}


def _get_kind(problem: Problem) -> Any:
    """Return a key that is equal for problems that one program can fit with one set of constraints."""
    evaluator = evaluator_of(problem)
    shapes = tuple(np.shape(leaf) for leaf in jax.tree.leaves(tuple(evaluator.arguments)))
    unknowns = problem.unknowns
    numbers = [unknowns.A, unknowns.b, unknowns.lower, unknowns.upper, *problem.places]
    numbers += [*unknowns.priors, *unknowns.variables]
    times = [experiment.initial_times_with_jumps for experiment in problem.experiments]
    fixed = [np.where(where[: len(t)] < 0, t, 0.0) for where, t in zip(problem.places, times, strict=True)]
    return evaluator.structures, shapes, tuple(np.asarray(a).tobytes() for a in (*numbers, *fixed))


def estimate_many(
    problems: Sequence[Problem],
    *,
    tolerance: float = 1e-7,
    max_iterations: int = 200,
    client: Any = None,
    folder: str | Path | None = None,
    callback: Callable[[int, int], object] | None = None,
) -> Fits:
    """Fit many problems of one model, each with its own data, guess and mesh.

    Parameters
    ----------
    problems : sequence of Problem
        With the same modes, mode sequences, kinds of data and unknowns. Numbers of samples may differ; problems whose
        padded lengths agree share one compiled program.
    tolerance, max_iterations : as of `estimate`
    client, folder, callback : as of `monte_carlo`

    Returns
    -------
    Fits
        In the order of the problems. Fits whose integration error turns out too large are done again by `estimate`.

    Raises
    ------
    ValueError
        If the problems differ in more than their numbers, or the folder holds something else.
    TypeError
        If an argument is of the wrong type.

    See Also
    --------
    estimate, monte_carlo, multistart

    Examples
    --------
    >>> fits = sf.estimate_many([heater_problem() for _ in range(3)])
    >>> fits.theta.shape, bool(fits.success.all())
    ((3, 2), True)
    """
    problems = list(as_sequence(problems, "problems", "a sequence of sf.Problem"))
    how = LongRun.check(tolerance, max_iterations, client, folder, callback)
    if not problems:
        raise ValueError("estimate_many needs one problem or more; got none.")
    first = problems[0]
    for k, problem in enumerate(problems):
        as_instance(problem, f"problems[{k}]", Problem, "an sf.Problem")
        require_estimable(problem)
        if problem.theta_names != first.theta_names or problem.is_sigma_known is not first.is_sigma_known:
            raise ValueError(
                f"problem {k} differs from the first one in more than its numbers: it has the unknowns "
                f"{join_names(problem.theta_names)}, the first one {join_names(first.theta_names)}. Fit it by itself."
            )
        units = [[run.time_unit for run in of.experiments] for of in (problem, first)]
        if units[0] != units[1]:
            raise ValueError(
                f"problem {k} has its times in {', '.join(units[0])}, the first one in {', '.join(units[1])}: their "
                "estimates would stand in one array. Give all logs the same time_unit, with their times in it."
            )
    starts = np.array([problem.initial_theta for problem in problems])
    study = StudyOfLogs(first, [], starts, how.limits, 0, problems)
    found = repeat(first, study, len(problems), "Logs", how)
    every = zip(*map(list_origins, problems), strict=True)
    return Fits(**found | {"date_origins": tuple(own[0] if len(set(own)) == 1 else None for own in every)})
