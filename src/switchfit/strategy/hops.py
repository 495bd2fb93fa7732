"""Hops of transition times over samples: each sample is a kink of J, and there is a minimum in many of the intervals.

Between two samples J is smooth in a transition time. The quadratic model about the middle of each interval near by says
how low J may be there, with all other unknowns following. Of the best intervals a second model is made about that
minimum.

Farther away J may have another minimum, too: where the difference of two vector fields changes its sign, as it does of
a mass on a spring, a switch on the other side of that has nearly the same effect. What is left may be noise by its size
at both. So it may where the state meets corners: J has a kink where a trajectory takes another path through them, as
where a pendulum with dry friction turns once more before it rests, and may have a minimum on either side.

Removal and re-insertion of modes: what local minima in switching times are made of is undone.

A mode that is not where it should be often cannot get there: on its way it would have to pass other modes, or to
vanish and to appear elsewhere. So the mode whose removal costs least is taken out, and put in where the cost falls
fastest with the length of a mode of no length, which is its derivative in the later of two equal transition times
([1]_). A fit follows, and all this is repeated as long as the cost falls.

References
----------
.. [1] M. Egerstedt, Y. Wardi, H. Axelsson, Transition-time optimization for switched-mode dynamical systems, IEEE
   Trans. Automat. Contr. 51 (2006) 110-115 (the derivative in a transition time).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.engine.corners.branches import has_corners
from switchfit.engine.evaluation import Evaluation, Matrix
from switchfit.fit.evaluator import Evaluator
from switchfit.optimize import lapack
from switchfit.problem.experiment import Experiment
from switchfit.problem.problem import Problem
from switchfit.runtime.progress import show_detail
from switchfit.strategy.beam import list_sample_times
from switchfit.strategy.starts import End, OutOfTimeError, check_time, fit_briefly, make_feasible, prepare_meshes

FURTHEST = 2
"""Sample intervals on either side that are looked at."""

LOWER = 1e-6
"""Part of J by which the model has to be lower for a fit."""

MOST = 4
"""Intervals, those with the lowest models, of which a second model is made, about the minimum of the first. That about
the middle of an interval errs by 1e-4 of J: of five fits that began there with ten joint tosses, one lowered J."""

INSIDE = 1e-3
"""Least distance of a start from the ends of its interval, as a part of the interval."""

DOUBTED = 0.03
"""Part of J by which the first model may be above it for a second one. With 1e-3 one of 100 searches for the order of
three linear modes ended above the truth, with 1e-2 none."""

ROUNDS = 12

SCAN_FIRST, SCAN_RATIO = 3.0, 1.6
"""Distance of the first place of a scan of J over a time, in standard errors, and of each place to that before it.
Between two equal minima J is like (s (s - D))² at the distance s from one: at this ratio the places show the other."""

DIPS, MODELS, RIGHT = 8, 4, 0.2
"""Dips of J that are looked into, the lowest; models of each, one about the minimum of the last; and the part of what a
minimum is above the cost below which the error of J there makes no difference."""

CLOSE = 12.0
"""By how much, in variances of the noise, a point beside another minimum may be above the cost for a fit from there."""

SCAN_STEP = 1 / 40
"""Largest distance of two places, as a part of the horizon: others may be narrow. A scan from a kink begins with it."""

NEAR = 3.0
"""Standard errors of a time within which another sample interval has to begin, if a minimum in it may be lower."""

BEYOND = (2.0, 4.0, 6.0)
"""Standard errors from a minimum, along each unknown with the others following, at which other paths are looked for. Of
78 fits of a pendulum with dry friction 11 ended 0.6 to 2.8 above another minimum, which these found in all cases: one
of them began at 6."""

WORTH = 0.1
"""By how much J has to be lower on another path for a fit: the data cannot tell less, and the model errs as much."""

MATRICES: tuple[Matrix, ...] = ("exact", "gauss-newton")
"""Of models far from a minimum: the second where the first leads to none, since residuals are large at first, and so is
their part of the exact Hessian."""

FindLowest = Callable[[FloatArray], tuple[float, FloatArray]]

PLACES = 60
"""Places along the horizon at which an insertion is tried."""

LENGTHS = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8)
"""Lengths that are tried, as parts of what the mode has room for."""

REMOVALS = 3
"""Number of modes whose removal is tried, those with the smallest increase of J first."""

REINSERTIONS = 20


def hop_over_samples(problem: Problem, best: End, known: Evaluator | None = None) -> End:
    """Return where fits end that begin in other sample intervals than the end of a fit, on known meshes where these
    suit it.
    """
    evaluations, evaluator = 0, prepare_meshes(problem, best.theta, known)
    if evaluator is None:
        return best._replace(evaluations=0)
    for _ in range(ROUNDS):
        for start in choose_hops(evaluator, best.theta, best.cost):
            end = fit_briefly(problem, make_feasible(problem, start), evaluator=evaluator)
            evaluations += end.evaluations
            if is_lower(end.cost, best.cost):
                best = end
                break
        else:
            break
    return best._replace(evaluations=evaluations)


def is_lower(cost: float, than: float) -> bool:
    """Return whether a hop has led to a lower minimum."""
    return cost < than - LOWER * abs(than)


def choose_hops(
    evaluator: Evaluator,
    theta: FloatArray,
    cost: float,
    free: NDArray[np.bool_] | None = None,
    reach: FloatArray | None = None,
    matrices: Sequence[Matrix] = MATRICES[:1],
) -> list[FloatArray]:
    """Return starts in sample intervals near by where J may be lower than the cost at theta, the best first.

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
    cost : float
    free : (d,) bool, optional
        Unknowns that may move; those at a bound do not.
    reach : (d,), optional
        Largest distance of an interval from a time; any if left out.
    matrices : sequence of str, optional
        The first that leads to a minimum is that of a model. Of all hops of a beam the exact one alone leads lower.
    """
    unknowns = evaluator.problem.unknowns
    far = np.full(len(theta), np.inf) if reach is None else reach
    intervals = [
        [
            (place, low, high)
            for place, low, high in _list_intervals(run, unknowns.times[e], list_sample_times(run), theta)
            if max(low - theta[place], theta[place] - high) <= far[place]
        ]
        for e, run in enumerate(evaluator.problem.experiments)
    ]
    movable = np.ones(len(theta), bool) if free is None else free
    hops = _list_hops(evaluator, theta, intervals, movable, matrices)
    near = sorted(hops, key=lambda hop: hop[0])[:MOST]
    again = [find_lowest(start) for lowest, start, find_lowest in near if lowest < cost + DOUBTED * abs(cost)]
    return [start for lowest, start in sorted(again, key=lambda hop: hop[0]) if is_lower(lowest, cost)]


def look_near(evaluator: Evaluator, theta: FloatArray, cost: float, errors: FloatArray) -> list[FloatArray]:
    """Return starts in sample intervals beside a minimum where J may be lower than a cost, the best first.

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
        A minimum.
    cost : float
    errors : (d,)
        Standard errors; 0 of unknowns that are held, as by a kink.
    """
    reach = np.where(errors > 0.0, NEAR * errors, np.inf)
    return choose_hops(evaluator, theta, cost, errors > 0.0, reach, MATRICES)


def find_far_minima(
    evaluator: Evaluator, theta: FloatArray, cost: float, errors: FloatArray, scale: float
) -> tuple[list[FloatArray], list[tuple[int, FloatArray]]]:
    """Return points beside other minima in a transition time at which J is lower than the cost at theta, the best
    first; and those at which it is not much higher, with the place of the time.

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
        A minimum.
    cost : float
    errors : (d,)
        Standard errors.
    scale : float
        Variance of the noise, 1 if sigma is known.
    """
    problem, found, close = evaluator.problem, [], []
    runs = range(len(problem.experiments))
    dips = sorted((cost, e, interval) for e in runs for cost, interval in _scan(evaluator, e, theta, errors))[:DIPS]
    intervals = [[interval for _, run, interval in dips if run == e] for e in runs]
    places = [place for each in intervals for place, _, _ in each]
    hops = _list_hops(evaluator, theta, intervals, errors > 0.0, MATRICES)
    for place, (lowest, start, find_lowest) in zip(places, hops, strict=True):
        least = np.inf
        for _ in range(MODELS):
            point = make_feasible(problem, start)
            there = evaluator.cost(point)
            if is_lower(there, cost):
                found.append((there, point))
            if there < least:
                least, best = there, point
            # A model that is right and not lower than the cost has nothing to tell.
            if not there > cost or abs(there - lowest) < RIGHT * (lowest - cost):
                break
            lowest, start = find_lowest(point)
        if cost < least < cost + CLOSE * scale:
            close.append((place, best))
    return [point for _, point in sorted(found, key=lambda each: each[0])], close


def _list_hops(
    evaluator: Evaluator,
    theta: FloatArray,
    intervals: Sequence[list[tuple[int, float, float]]],
    free: NDArray[np.bool_],
    matrices: Sequence[Matrix],
) -> Iterator[tuple[float, FloatArray, FindLowest]]:
    """Yield for each of some intervals of each run the lowest J of the quadratic model about its middle, theta there,
    and a function that returns both of the model about another point.

    The model of the whole J is that about theta, of which a run has the part `here`, and of that run the one about a
    point, with the first of some matrices that leads to a minimum. A sigma stays what it is: far from a minimum it
    would make up for residuals that the other unknowns are to fit.
    """
    if not any(intervals):
        return
    unknowns, whole = evaluator.problem.unknowns, evaluator(theta)
    free = free & (unknowns.lower < theta) & (theta < unknowns.upper) & ~evaluator.problem.is_sigma
    for e, listed in enumerate(intervals):
        here = _evaluate_run(evaluator, e, theta) if listed else whole
        for place, low, high in listed:
            model = partial(_find_lowest, evaluator, e, whole, here, theta, free, matrices, place, low, high)
            middle = theta.copy()
            middle[place] = 0.5 * (low + high)
            yield *model(middle), model


@np.errstate(over="ignore", invalid="ignore")  # a model whose numbers are not finite has no minimum
def _find_lowest(
    evaluator: Evaluator,
    e: int,
    whole: Evaluation[FloatArray],
    here: Evaluation[FloatArray],
    theta: FloatArray,
    free: NDArray[np.bool_],
    matrices: Sequence[Matrix],
    place: int,
    low: float,
    high: float,
    point: FloatArray,
) -> tuple[float, FloatArray]:
    """Return the lowest J with the unknown at `place` between two values, and theta there (d,); infinite where the
    model about the point has no minimum.
    """
    check_time()
    own, mine = evaluator.problem.own_places[e]
    side, away = 1 if point[place] < high else -1, (theta - point)[mine]
    for matrix in matrices:
        there = _evaluate_run(evaluator, e, point, side, matrix)
        if not np.isfinite(there.hessian).all():
            break
        curvature = there.hessian[own[:, None], own]
        cost = whole.cost - here.cost + there.cost + (there.gradient[own] + 0.5 * curvature @ away) @ away
        gradient, hessian = whole.gradient.copy(), whole.hessian.copy()
        np.add.at(gradient, mine, (there.gradient - here.gradient)[own] + curvature @ away)
        np.add.at(hessian, (mine[:, None], mine), curvature - here.hessian[own[:, None], own])
        inside = INSIDE * (high - low)  # where a reset map acts, J at the end is that of the next interval
        found = _minimize(gradient, hessian, free, place, low + inside - theta[place], high - inside - theta[place])
        if found is not None:
            return float(cost + found[0]), theta + found[1]
    return np.inf, theta


def _evaluate_run(
    evaluator: Evaluator, e: int, theta: FloatArray, side: int = 1, matrix: Matrix = "exact"
) -> Evaluation[FloatArray]:
    return evaluator.engines[e].derivatives(*evaluator.problem.vectors(theta, e), side, matrix)


def _minimize(
    gradient: FloatArray, hessian: FloatArray, free: NDArray[np.bool_], place: int, low: float, high: float
) -> tuple[float, FloatArray] | None:
    """Return the lowest value of a quadratic model with the unknown at `place` between two values, and the step (d,);
    None if it has no minimum.
    """
    step, places = np.zeros(len(gradient)), np.flatnonzero(free | (np.arange(len(free)) == place))
    factor, step[places], failed = lapack.dposv(hessian[places[:, None], places], -gradient[places])
    if failed:
        return None
    if not low <= step[place] <= high:
        # Along the way on which the others follow the unknown to its limit.
        away, is_it = np.clip(step[place], low, high) - step[place], places == place
        along = lapack.dpotrs(factor, is_it.astype(float))[0]
        step[places] += along * (away / along[is_it])
    return float((gradient + 0.5 * hessian @ step) @ step), step


def _list_intervals(
    run: Experiment, where: NDArray[np.intp], nodes: FloatArray, theta: FloatArray
) -> Iterator[tuple[int, float, float]]:
    """Yield the place of a time in theta, and the ends of an interval near by in which it may be."""
    ends = run.ends_of_modes(np.where(where >= 0, theta[where], run.initial_times))
    for i, place in enumerate(where.tolist()[: len(ends) - 2]):  # without a free tf
        k = int(np.searchsorted(nodes, theta[place], "right")) - 1
        for j in range(max(k - FURTHEST, 0), min(k + FURTHEST, len(nodes) - 2) + 1):
            low, high = nodes[j], nodes[j + 1]
            if place >= 0 and j != k and ends[i] < 0.5 * (low + high) < ends[i + 2]:
                yield place, float(low), float(high)


def _scan(
    evaluator: Evaluator, e: int, theta: FloatArray, errors: FloatArray
) -> Iterator[tuple[float, tuple[int, float, float]]]:
    """Yield by how much J of a run is above that at theta in another minimum, with all else as it is; and the place of
    the time in theta, and the ends of the interval in which that is.
    """
    problem = evaluator.problem
    where, run = problem.unknowns.times[e], problem.experiments[e]
    ends = run.ends_of_modes(np.where(where >= 0, theta[where], run.initial_times))
    step, here = SCAN_STEP * (ends[-1] - ends[0]), evaluator.engines[e].cost(*problem.vectors(theta, e))
    for i, place in enumerate(where.tolist()[: len(ends) - 2]):  # without a free tf
        nearest = SCAN_FIRST * errors[place] or step
        for end in (ends[i], ends[i + 2]):
            room, far = abs(end - theta[place]), [nearest]
            if place < 0 or not nearest < room:
                continue
            while far[-1] < room:
                far.append(far[-1] + min((SCAN_RATIO - 1.0) * far[-1], step))
            times, count = theta[place] + np.copysign(far[:-1], end - theta[place]), len(far) - 1
            costs = np.empty(count)
            for j, t in enumerate(times.tolist()):
                moved = theta.copy()
                moved[place] = t
                check_time()
                costs[j] = evaluator.engines[e].cost(*problem.vectors(moved, e))
            falls = np.append(costs[1:] < costs[:-1], False)
            for j in np.flatnonzero(falls[:-1] & ~falls[1:]).tolist():
                low, high = sorted((times[j], times[j + 2] if j + 2 < count else end))
                yield float(costs[j + 1] - here), (place, float(low), float(high))


def look_beyond_corners(
    evaluator: Evaluator, theta: FloatArray, cost: float, covariance: FloatArray
) -> list[FloatArray]:
    """Return where quadratic models of J about points near by are lowest, the best first, if that is below a cost and
    the trajectory of the point takes another path through the corners of its modes than that of theta.

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
        A minimum.
    cost : float
    covariance : (d, d)
    """
    errors, models = np.sqrt(covariance.diagonal()), []
    if not any(map(has_corners, evaluator.structures)):
        return []
    evaluator.cost(theta)
    path = evaluator.paths
    for place in np.flatnonzero(errors > 0.0):
        for side in (-1.0, 1.0):
            for distance in BEYOND:
                point = theta + side * distance / errors[place] * covariance[:, place]
                point = make_feasible(evaluator.problem, point)
                check_time()
                if not np.isfinite(evaluator.cost(point)):
                    break
                if evaluator.paths == path:
                    continue
                for matrix in MATRICES:
                    there = evaluator(point, matrix=matrix)
                    found = _minimize(there.gradient, there.hessian, errors > 0.0, int(place), -np.inf, np.inf)
                    if found is not None:
                        break
                if found is not None and there.cost + found[0] < cost:
                    models.append((there.cost + found[0], point + found[1]))
                break
    return [start for _, start in sorted(models, key=lambda model: model[0])[:MOST]]


def can_reinsert(problem: Problem) -> bool:
    """Return whether a mode can be removed and inserted elsewhere without a change of the sequence: it stands between
    two equal modes, and there are more such places. Not if tf is free, which is the last of the times, nor where
    something has to be met."""
    if problem.constraint_names:
        return False
    known = [run.mode_sequence for run in problem.experiments if not run.has_free_tf]
    return any(next(_list_moves(sequence), None) is not None for sequence in known)


def reinsert_modes(problem: Problem, theta: FloatArray) -> End:
    """Return where removals and insertions end that begin at the end of a fit, theta (d,)."""
    best = fit_briefly(problem, theta)
    evaluations = best.evaluations
    with suppress(OutOfTimeError):
        for repeated in range(REINSERTIONS):
            show_detail(f"round {repeated + 1}", best.cost)
            for start, tried in _list_starts(problem, best.theta):
                end = fit_briefly(problem, start)
                evaluations += tried + end.evaluations
                if is_lower(end.cost, best.cost):
                    best = end
                    break
            else:
                break
    return best._replace(evaluations=evaluations)


def _list_moves(sequence: tuple[str, ...]) -> Iterator[tuple[int, int]]:
    """Yield a segment that may be removed, and one behind which it may be inserted without changing the sequence."""
    for i in range(len(sequence) - 2):
        if sequence[i] == sequence[i + 2]:
            rest = sequence[: i + 1] + sequence[i + 3 :]
            for j in range(len(rest)):
                whole = (*rest[: j + 1], sequence[j + 1] if j + 1 < len(sequence) else "", rest[j], *rest[j + 1 :])
                if whole == sequence and len(rest) > 1:
                    yield i, j


def _list_starts(problem: Problem, theta: FloatArray) -> Iterator[tuple[FloatArray, int]]:
    """Yield theta with a mode moved to where J falls fastest, those modes first whose removal costs least, and the
    number of evaluations.
    """
    evaluator = Evaluator(problem, theta)

    def evaluate(at: FloatArray) -> float:
        return float(np.nan_to_num(evaluator.cost(at), nan=np.inf))

    for run, where in zip(problem.experiments, problem.unknowns.times, strict=True):
        if run.has_free_tf or np.any(where < 0):  # a fixed transition stays where it is, and with it the others' order
            continue
        moves = set(_list_moves(run.mode_sequence))
        closed = {i: evaluate(_move_pair(theta, where, i, i, *[theta[where[i : i + 2]].mean()] * 2)) for i, _ in moves}
        for i in sorted(closed, key=closed.__getitem__)[:REMOVALS]:
            others = np.delete(theta[where], [i, i + 1])
            rates = []
            for begin in np.linspace(run.t0, run.end, PLACES + 2)[1:-1].tolist():
                j = int(np.searchsorted(others, begin, "right"))
                if (i, j) in moves:
                    check_time()
                    pair = _move_pair(theta, where, i, j, begin, begin)
                    rates.append((evaluator(pair).gradient[where[j + 1]], begin, j))
            rate, begin, j = min(rates, default=(0.0, 0.0, 0))
            if rate < 0:
                room = np.append(others, run.end)[j] - begin
                starts = [_move_pair(theta, where, i, j, begin, begin + part * room) for part in LENGTHS]
                yield min(starts, key=evaluate), len(closed) + len(rates) + len(starts)


def _move_pair(theta: FloatArray, where: NDArray[np.intp], i: int, j: int, begin: float, end: float) -> FloatArray:
    """Return theta with the transitions i and i + 1 of a run at two times behind j of the others."""
    moved = theta.copy()
    moved[where] = np.insert(np.delete(theta[where], [i, i + 1]), [j, j], [begin, end])
    return moved
