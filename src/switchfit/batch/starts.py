"""Multistart: the same problem from many starts, to see which minima it has and which is the lowest."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.arrays import FloatArray
from switchfit.batch.failures import describe_failure
from switchfit.batch.fits import Fits
from switchfit.batch.long_run import LongRun, repeat
from switchfit.batch.programs import Limits
from switchfit.batch.study import Study
from switchfit.batch.study_verdict import judge_starts
from switchfit.discretization.mesh import Mesh
from switchfit.estimation.estimates import Estimate
from switchfit.fit.local_fit import fit_locally
from switchfit.meshes.evaluator import Evaluator, evaluator_of
from switchfit.optimize import Status
from switchfit.problem.problem import Problem, require_estimable
from switchfit.problem.validation.arrays import as_array, as_count, as_seed
from switchfit.problem.validation.objects import as_instance
from switchfit.runtime.errors import NotIntegrableError
from switchfit.runtime.presentation import Drawn, draw_figure
from switchfit.strategy.many_starts import SAME_COST
from switchfit.strategy.random_starts import MOST_DRAWN, draw_starts
from switchfit.uncertainty.verdict import Verdict

ENDS_TRIED = 10
"""Ends from which a full estimate is tried, the lowest first."""

CLEARLY_LOWER = 1e-4
"""Part of the best cost by which another end is better: on the mesh that all starts share costs are less accurate."""


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
    >>> problem = heater_problem()

    >>> found = sf.multistart(problem, 8)
    >>> found.best.success, int(found.clusters.max())
    (True, 0)
    """

    clusters: NDArray[np.int64]
    best: Estimate | None

    @cached_property
    def verdict(self) -> Verdict:
        """That on the best end, doubtful if starts are left; most of the others may well be bad."""
        return judge_starts(self, None if self.best is None else self.best.verdict)

    def plot(self, *, ax: Drawn | None = None) -> Drawn:
        """Draw a waterfall: the cost at the end of every start, ascending.

        Parameters
        ----------
        ax : matplotlib.axes.Axes, optional
            Axes to draw in, which are returned; without them, a Figure is made and returned.

        See Also
        --------
        multistart

        Examples
        --------
        >>> problem = heater_problem()

        >>> figure = sf.multistart(problem, 8).plot()
        >>> figure.axes[0].get_ylabel()
        'cost above the best'
        """
        return draw_figure(self, ax=ax)


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
    >>> problem = heater_problem()

    >>> found = sf.multistart(problem, 8, seed=1)
    >>> found.best.theta.round(2)
    array([2.46, 0.39])
    """
    as_instance(problem, "problem", Problem, "an sf.Problem")
    require_estimable(problem)
    seed = as_seed(seed)
    how = LongRun.check(tolerance, max_iterations, client, folder, callback)
    if hasattr(type(starts), "__len__"):
        points = _check_starts(problem, starts)
    else:
        points = draw_starts(problem, as_count(starts, "starts", at_least=1, at_most=MOST_DRAWN), seed)
    study = Study(problem, _find_meshes(problem, points), points, how.limits, seed)
    found = repeat(problem, study, len(points), "Multistart", how)
    fits, best = _find_best(problem, Fits(**found), how.limits)
    clusters = _find_clusters(fits)
    if best is not None:
        best = replace(best, starts=_count_starts(fits, clusters, best.cost))
    return Multistart(**found | {"status": fits.status, "message": fits.message}, clusters=clusters, best=best)


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


def _find_best(problem: Problem, fits: Fits, limits: Limits) -> tuple[Fits, Estimate | None]:
    """Return a full estimate, resumed at the lowest end that allows one, and the fits with the errors of lower ends."""
    status, message = fits.status.astype(object), fits.message.astype(object)
    best = None
    # Converged ends first, the lowest of them first.
    for k in np.lexsort((np.nan_to_num(fits.cost, nan=np.inf), ~fits.success))[:ENDS_TRIED].tolist():
        start = fits.theta[k] if np.isfinite(fits.theta[k]).all() else fits.start[k]
        try:
            best = Estimate.take_over(fit_locally(problem, start=start, **limits._asdict()))
            break
        except Exception as error:  # of this end alone: listed
            status[k], message[k] = Status.ERROR.name, describe_failure(error)
    return replace(fits, status=status.astype(str), message=message.astype(str)), best


def _check_starts(problem: Problem, starts: object) -> FloatArray:
    """Return starts of the user's, checked."""
    points = as_array(starts, "starts")
    d = len(problem.theta_names)
    if points.ndim != 2 or points.shape[1] != d or len(points) == 0:
        raise ValueError(f"starts must be a number, or an array of shape (S, {d}); got shape {points.shape}.")
    constraints = problem.constraints
    for k, point in enumerate(points):
        # Rounding of a start that was computed, as on a bound, is no violation.
        slack = constraints.slack(problem.check_theta(point, f"starts[{k}]"))
        if np.any(slack < -1e-12 * (1 + np.max(np.abs(point)))):
            raise ValueError(f"start {k} violates: {constraints.names[int(np.argmin(slack))]}.")
    return points


def _find_clusters(fits: Fits) -> NDArray[np.int64]:
    """Return the number of the minimum in which each fit ended, ascending in cost; -1 where it did not converge."""
    labels, ended = np.full(len(fits), -1), np.flatnonzero(fits.success)
    found, lowest = -1, -np.inf
    for k in ended[np.argsort(fits.cost[ended], kind="stable")].tolist():
        cost = float(fits.cost[k])
        # With the lowest of the cluster, not with its neighbour: a chain of small steps would join minima that differ.
        if not cost - lowest <= SAME_COST * max(abs(cost), 1e-300):
            found, lowest = found + 1, cost
        labels[k] = found
    return labels
