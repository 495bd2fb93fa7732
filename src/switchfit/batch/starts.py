"""Multistart: the same problem from many starts, to see which minima it has and which is the lowest."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, overload

import jax
import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.batch.again import find_replaced, redo_doubted, redo_unresolved
from switchfit.batch.chunks import Arrays, compute_fingerprint
from switchfit.batch.evaluations import Evaluations
from switchfit.batch.fits import CHUNK_FORMAT, Fits, check_long_run, repeat
from switchfit.batch.intervals import trace_chunk
from switchfit.batch.layout import Varying, choose_chunk_size, count_chunks_together
from switchfit.batch.program import describe_failure, fit_chunk
from switchfit.batch.quality import count_samples, describe_ends
from switchfit.batch.verdict import judge_starts
from switchfit.discretization.arguments import build_arguments
from switchfit.discretization.mesh import Mesh
from switchfit.estimation.estimator import Estimate
from switchfit.estimation.local_fit import check_settings, fit_locally
from switchfit.fit.evaluator import Evaluator, evaluator_of
from switchfit.fit.random_starts import MOST_DRAWN, draw_starts
from switchfit.fit.solution import constraints_of
from switchfit.fit.variation import measure_variation
from switchfit.optimize import Status
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem, require_unknowns
from switchfit.problem.validation import as_array, as_count, as_instance, as_seed
from switchfit.runtime.errors import NotIntegrableError
from switchfit.runtime.presentation import Axes, Figure, draw_figure
from switchfit.uncertainty.verdict import Verdict

ENDS_TRIED = 10
"""Ends from which a full estimate is tried, the lowest first."""

CLEARLY_LOWER = 1e-4
"""Part of the best cost by which another end is better: on the mesh that all starts share costs are less accurate."""

SAME_COST = 1e-6
"""Two ends are one minimum if their costs differ by less than this part of them, and ..."""

SAME_PLACE = 1e-3
"""... each parameter by less than this part of the spread of the starts, or of its size where they do not differ in it,
each transition time by less than this part of the horizon. Modes that have collapsed (shorter than that) do not count:
where they sit is arbitrary."""


@dataclass(frozen=True, eq=False, repr=False)
class Multistart(Fits):
    """Result of `multistart`: everything in `Fits`, the minima that were found, and the best. Print it for the table.

    Attributes
    ----------
    clusters : (R,) int
        Which minimum each start ended in, 0 being the lowest; -1 where it did not converge.
    best : Estimate or None
        A full estimate, resumed at the lowest end; None where each of the lowest ones raises an error.

    See Also
    --------
    multistart, Fits

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> problem = heater_problem()

    >>> found = sf.multistart(problem, 8)
    >>> found.best.success, int(found.clusters.max())
    (True, 0)
    """

    clusters: NDArray[np.int64]
    best: Estimate | None

    @cached_property
    def verdict(self) -> Verdict:
        """That on the best end, and how many of the other starts ended there: most of them may well be bad."""
        best = self.best
        return judge_starts(self, None if best is None else best.verdict)

    @overload  # type: ignore[override]  # a waterfall is not of one unknown
    def plot(self, *, ax: None = ...) -> Figure: ...
    @overload
    def plot(self, *, ax: Axes) -> Axes: ...
    def plot(self, *, ax: Axes | None = None) -> Axes | Figure:
        """Draw a waterfall: the cost at the end of every start, ascending.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Axes to draw in, which are returned; without them, a Figure is made and returned.

        See Also
        --------
        multistart, Multistart.plot_parameters

        Examples
        --------
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem
        >>> problem = heater_problem()

        >>> figure = sf.multistart(problem, 8).plot()
        >>> figure.axes[0].get_ylabel()
        'cost above the best'
        """
        return draw_figure(self, ax=ax)

    @overload
    def plot_parameters(self, *, ax: None = ...) -> Figure: ...
    @overload
    def plot_parameters(self, *, ax: Axes) -> Axes: ...
    def plot_parameters(self, *, ax: Axes | None = None) -> Axes | Figure:
        """Draw where every start ended: a line over all unknowns for each, starts of one minimum in one colour.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Axes to draw in, which are returned; without them, a Figure is made and returned.

        See Also
        --------
        multistart, Multistart.plot

        Examples
        --------
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem
        >>> problem = heater_problem()

        >>> figure = sf.multistart(problem, 8).plot_parameters()
        >>> [text.get_text() for text in figure.axes[0].get_yticklabels()]
        ['tau_1 (h)', 'k (1/h)']
        """
        return draw_figure(self, what="parameters", ax=ax)


def multistart(
    problem: Problem,
    starts: int | ArrayLike = 64,
    *,
    seed: int = 0,
    tolerance: float = 1e-7,
    max_iterations: int = 200,
    client: Any = None,
    folder: str | Path | None = None,
    callback: Callable[[int, int], object] | None = None,
) -> Multistart:
    """Fit a problem from many starts.

    Parameters
    ----------
    problem : Problem
    starts : int or (S, d) array_like
        How many, drawn from a scrambled Sobol sequence over everything that bounds, order and minimum durations allow;
        or the starts themselves. The first of those that are drawn is the problem's initial guess.
    seed : int
        Of the sequence.
    tolerance, max_iterations : as of `estimate`
    client, folder, callback : as of `monte_carlo`

    Returns
    -------
    Multistart

    Raises
    ------
    ValueError
        If a parameter lacks a bound and starts are to be drawn, or given starts have the wrong shape or are infeasible.
    TypeError
        If an argument is of the wrong type.

    Notes
    -----
    All starts share the mesh that is refined at the initial guess, or at the first start that can be integrated; the
    best end is fitted again on a mesh of its own. With guards or terminal constraints a start that does not converge,
    loses a mode or ends far from the data is fitted again with transitions free of their guards first.

    See Also
    --------
    estimate, estimate_many

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> problem = heater_problem()

    >>> found = sf.multistart(problem, 8, seed=1)
    >>> found.best.theta.round(2)
    array([2.46, 0.39])
    """
    as_instance(problem, "problem", Problem, "an sf.Problem")
    require_unknowns(problem)
    seed = as_seed(seed)
    tolerance, max_iterations = check_settings(tolerance, max_iterations)
    check_long_run(client, folder, callback)
    began = time.perf_counter()
    several = hasattr(type(starts), "__len__")
    if several:
        points = _check_starts(problem, starts)
    else:
        points = draw_starts(problem, as_count(starts, "starts", at_least=1, at_most=MOST_DRAWN), seed)
    work = _Work(problem, _find_meshes(problem, points), points, tolerance, max_iterations)
    found = repeat(problem, work, len(points), "Multistart", began, client=client, folder=folder, callback=callback)
    best, errors = _find_best(problem, Fits(**found), tolerance, max_iterations)
    if errors:
        status, message = found["status"].astype(object), found["message"].astype(object)
        for k, error in errors.items():
            status[k], message[k] = Status.ERROR.name, describe_failure(error)
        found |= {"status": status.astype(str), "message": message.astype(str)}
    clusters = _find_clusters(problem, Fits(**found))
    if best is not None:
        best = replace(best, starts=_count_starts(Fits(**found), clusters, best.cost))
    return Multistart(**found, clusters=clusters, best=best)


def _find_meshes(problem: Problem, points: FloatArray) -> list[Mesh]:
    """Return the meshes of the initial guess, or of the first start (S, d) that can be integrated where that cannot."""
    try:
        return list(evaluator_of(problem).meshes)
    except NotIntegrableError:
        for point in points:
            with suppress(NotIntegrableError):
                return list(Evaluator(problem, point).meshes)
        raise


def _count_starts(fits: Fits, clusters: NDArray[np.int64], best: float) -> tuple[int, int, int]:
    """Return how many starts there were beside the one that ended in the best, how many ended lower, how many there."""
    costs = fits.cost[fits.success]
    better = int(np.sum(costs < best - CLEARLY_LOWER * abs(best)))
    return len(fits) - 1, better, max(int(np.sum(clusters == 0)) - 1, 0)


def _find_best(
    problem: Problem, fits: Fits, tolerance: float, max_iterations: int
) -> tuple[Estimate | None, dict[int, Exception]]:
    """Return a full estimate, resumed at the lowest end that allows one, and the errors of the ends that do not."""
    errors: dict[int, Exception] = {}
    for k in np.lexsort((np.nan_to_num(fits.cost, nan=np.inf), ~fits.success))[:ENDS_TRIED].tolist():
        start = fits.theta[k] if np.isfinite(fits.theta[k]).all() else fits.start[k]
        try:
            return fit_locally(problem, start=start, tolerance=tolerance, max_iterations=max_iterations), errors
        except Exception as error:  # of this end alone: listed
            errors[k] = error
    return None, errors


@dataclass
class _Work:
    """The runs of a multistart, for `run_chunks`."""

    problem: Problem
    meshes: list[Mesh]
    starts: FloatArray
    tolerance: float
    max_iterations: int

    @property
    def size(self) -> int:
        return choose_chunk_size()

    @cached_property
    def most_chunks(self) -> int:
        return count_chunks_together(self.problem, self.meshes, Varying((), ()))

    def __call__(self, runs: range) -> Arrays:
        starts = self.starts[runs.start : runs.stop]
        first = found = fit_chunk(
            self.problem,
            self.meshes,
            Varying((), ()),
            starts,
            tolerance=self.tolerance,
            max_iterations=self.max_iterations,
            room=self.size * self.most_chunks,
            retry=False,
        )
        settings: Any = {"tolerance": self.tolerance, "max_iterations": self.max_iterations}
        variation = float(measure_variation(self.problem).sum())
        found = redo_unresolved(found, lambda k: self.problem, self.meshes, **settings)
        if self.problem.constraint_names:
            found = redo_doubted(found, lambda k: self.problem, starts, variation, **settings)
        evaluations = partial(Evaluations, self.problem, self.meshes, Varying((), ()))  # no data: no room is needed
        own, again = lambda k: self.problem, find_replaced(first, found)
        pieces = trace_chunk(found, again, lambda k: self.problem, evaluations, own)
        return {
            **found._asdict(),
            **describe_ends(self.problem, found.theta, found.cost, variation),
            "pieces": pieces,
            "start": starts,
            "samples": np.full(len(runs), count_samples(self.problem)),
        }

    def fingerprint(self) -> str:
        unknowns = self.problem.unknowns
        bounds = unknowns.lower, unknowns.upper, unknowns.A, unknowns.b, *unknowns.priors
        leaves = jax.tree.leaves([build_arguments(self.problem, e, mesh) for e, mesh in enumerate(self.meshes)])
        settings = self.tolerance, self.max_iterations, unknowns.names, self.problem.digests
        return compute_fingerprint(CHUNK_FORMAT, "multistart", settings, self.starts, *bounds, *map(np.asarray, leaves))


def _check_starts(problem: Problem, starts: Any) -> FloatArray:
    """Return starts of the user's, checked."""
    points = as_array(starts, "starts")
    d = len(problem.theta_names)
    if points.ndim != 2 or points.shape[1] != d or len(points) == 0:
        raise ValueError(f"starts must be a number, or an array of shape (S, {d}); got shape {points.shape}.")
    constraints = constraints_of(problem)
    for k, point in enumerate(points):
        slack = constraints.slack(problem.check_theta(point, f"starts[{k}]"))
        if np.any(slack < -1e-12 * (1 + np.max(np.abs(point)))):
            raise ValueError(f"start {k} violates: {constraints.names[int(np.argmin(slack))]}.")
    return points


def _find_clusters(problem: Problem, fits: Fits) -> NDArray[np.int64]:
    """Return the number of the minimum in which each fit ended, ascending in cost; -1 where it did not converge."""
    labels = np.full(len(fits), -1)
    unknowns = problem.unknowns
    times = np.concatenate(unknowns.times)
    places = np.setdiff1d(np.arange(len(unknowns.names)), times).tolist()
    spread = np.ptp(fits.start, axis=0)
    size = np.max(np.abs(fits.theta[fits.success]), axis=0, initial=1e-9)
    spread = np.where(spread > 1e-12 * (1 + np.max(np.abs(fits.start), axis=0)), spread, size)[places]
    found: list[tuple[float, FloatArray, list[Any]]] = []
    for k in np.argsort(fits.cost, kind="stable"):
        if not fits.success[k]:
            continue
        cost, p, schedule = float(fits.cost[k]), fits.theta[k][places], _build_schedule(problem, fits.theta[k])
        for label, (other_cost, other_p, other_schedule) in enumerate(found):
            level = abs(cost - other_cost) <= SAME_COST * max(abs(cost), 1e-300)
            if (
                level
                and np.all(np.abs(p - other_p) <= SAME_PLACE * spread)
                and _is_same_schedule(schedule, other_schedule)
            ):
                labels[k] = label
                break
        else:
            labels[k] = len(found)
            found.append((cost, p, schedule))
    return labels


def _build_schedule(problem: Problem, theta: FloatArray) -> list[Any]:
    """Return each experiment's modes without the collapsed ones, and when they switch as parts of the horizon."""
    schedules = []
    for experiment, ends in zip(problem.experiments, problem.ends_of_modes(theta), strict=True):
        knots = (ends - experiment.t0) / experiment.initial_length
        modes: list[str] = []
        switches: list[float] = []
        for mode, begin, end in zip(experiment.mode_sequence, knots[:-1], knots[1:], strict=True):
            if end - begin > SAME_PLACE and (not modes or modes[-1] != mode):
                modes.append(mode)
                switches.append(float(begin))
        switches.append(float(knots[-1]))
        schedules.append((modes, np.array(switches)))
    return schedules


def _is_same_schedule(one: list[Any], other: list[Any]) -> bool:
    return all(
        modes == others and np.all(np.abs(times - other_times) <= SAME_PLACE)
        for (modes, times), (others, other_times) in zip(one, other, strict=True)
    )
