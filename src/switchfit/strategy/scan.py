"""Scan over sample intervals: for each run, each transition is tried in every interval between two samples.

Between two samples the cost is smooth in a transition time, and at each it has a kink, so that minima lie in several
intervals. Given the unknowns that runs share, the other unknowns of a run are few: Newton's method with the transition
confined to an interval, begun at the end of the interval beside it, gives the least cost of each interval and, by the
Schur complement of its Hessian, how that changes with the shared unknowns, as a parabola. The shared unknowns then
minimize the sum over the runs of the lowest parabolas, a fit of all runs follows, and this is repeated as long as the
cost falls.
"""

from __future__ import annotations

import math
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.fit.evaluator import Evaluator
from switchfit.optimize import lapack
from switchfit.optimize.algebra import is_finite
from switchfit.optimize.qp import is_definite
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem
from switchfit.runtime.progress import show_detail
from switchfit.strategy.horizon import list_sample_times
from switchfit.strategy.quick import End, OutOfTimeError, check_time, fit_briefly, prepare_meshes

ROUNDS = 8

STEPS = 3
"""Newton steps in an interval."""

SETTLED = (1e-2, 1e-8)
"""Part of the cost below which a predicted fall ends the steps in an interval: in the first scan, in later ones."""

MOST_INTERVALS = 60
"""Intervals of a transition in the first scan: where there are more samples, several are joined to one."""

NEAR = 2
"""Intervals on either side that later scans look at."""

RISES = 3
"""Intervals in turn in which the cost is far above the lowest, after which the scan turns round."""

FAR = 3.0
"""Multiple of the lowest cost of a run that counts as far above it."""

LOWER = 1e-6
"""Predicted decrease, as a part of the cost, from which another fit is worth its time."""

WORTHWHILE = 1e-5
"""Decrease, as a part of the cost, after which the intervals near by are scanned once more: after smaller ones no
further minimum has been found."""

SMALLEST_EIGENVALUE = 1e-8
"""Eigenvalues of a matrix, scaled to a diagonal of one, below which they are replaced."""

DEFINITE = 1e-6
"""Pivots, relative to the diagonal, above which a matrix needs no scaling."""

EPS = float(np.finfo(float).eps)

MOST_SHARED = 8
"""Number of shared unknowns up to which the curvature of each run in them is used to predict where they move."""


class Option(NamedTuple):
    """The best of one run in one interval: theta, J, its slope and curvature in the shared unknowns (s,), (s, s), and
    the derivative of the run's own unknowns (o,) in them, (o, s)."""

    theta: FloatArray
    cost: float
    slope: FloatArray
    curvature: FloatArray
    follows: FloatArray


def can_scan(problem: Problem) -> bool:
    """Return whether there are samples with intervals between them, and transitions."""
    return any(run.transition_times and len(list_sample_times(run)) > 1 for run in problem.experiments)


def scan_intervals(problem: Problem, theta: FloatArray) -> End:
    """Return where scans end that begin at the end of a fit, theta (d,)."""
    evaluator = prepare_meshes(problem, theta)
    current = fit_briefly(problem, theta, evaluator=evaluator)
    if evaluator is None or current.failed:
        return current
    evaluations = current.evaluations
    scan = Scan(problem, evaluator, current.theta)
    with suppress(OutOfTimeError):
        for repeated in range(ROUNDS):
            start, fall = scan.choose(everywhere=not repeated)
            if repeated and fall <= LOWER * abs(current.cost):
                break
            evaluator = prepare_meshes(problem, start)
            end = fit_briefly(problem, start, evaluator=evaluator)
            evaluations += end.evaluations
            lower = end.cost < current.cost - WORTHWHILE * abs(current.cost)
            if evaluator is not None and end.cost < current.cost:
                current = end
                scan.move(evaluator, end.theta)
            if repeated and not lower:
                break
    return current._replace(evaluations=evaluations - (-scan.evaluations // len(problem.experiments)))


class Scan:
    """Scans of all runs about theta (d,): of all intervals, or, more accurately, of those near by.

    Parameters
    ----------
    problem : Problem
    evaluator : Evaluator
    theta : (d,)
    far : float
        Multiple of the lowest cost of a run above which intervals are not worth a further look.
    """

    def __init__(self, problem: Problem, evaluator: Evaluator, theta: FloatArray, far: float = FAR) -> None:
        self.problem, self.evaluator, self.theta, self.far = problem, evaluator, theta, far
        self.reach, self.settled = float(NEAR), SETTLED[1]
        self.evaluations = 0
        depends = np.array([self._find_dependencies(e) for e in range(len(problem.experiments))])
        several = len(depends) > 1
        self.shared = np.flatnonzero(depends.sum(0) > 1) if several else np.zeros(0, dtype=np.intp)
        self.own = [np.setdiff1d(np.flatnonzero(which), self.shared) for which in depends]
        self._sums = [self._sum_over(e) for e in range(len(depends))]

    def _sum_over(self, e: int) -> FloatArray:
        """Return the matrix (o + s, k) that adds up a run's own vector for its own unknowns and the shared ones."""
        own, mine = self.problem.own_places[e]
        count = len(self._evaluate_run(self.theta, e, 1)[1])
        sums = np.zeros((len(self.own[e]) + len(self.shared), count))
        for row, place in enumerate([*self.own[e], *self.shared]):
            sums[row, own[mine == place]] = 1.0
        return sums

    def move(self, evaluator: Evaluator, theta: FloatArray) -> None:
        """Set the theta, and the evaluator on its meshes, about which the next scans look."""
        self.evaluator, self.theta = evaluator, theta

    def choose(self, *, everywhere: bool) -> tuple[FloatArray, float]:
        """Return the best theta over all combinations of intervals, and the decrease of J that parabolas predict."""
        self.reach, self.settled = (np.inf, SETTLED[0]) if everywhere else (float(NEAR), SETTLED[1])
        options = []
        for e in range(len(self.problem.experiments)):
            show_detail(f"run {e + 1} of {len(self.problem.experiments)}")
            with np.errstate(invalid="ignore", over="ignore"):  # what is not finite is left out
                options.append(self._scan_run(e))
        move = np.zeros(len(self.shared))
        for _ in range(20):
            best = [min(own, key=lambda option: self._predict_cost(option, move)) for own in options]
            slope = sum((option.slope for option in best), np.zeros(len(move)))
            curvature = sum((option.curvature for option in best), np.zeros((len(move), len(move))))
            before, move = move, -_solve_convex(curvature, slope) if len(move) else move
            if np.array_equal(before, move):
                break
        theta = self.theta.copy()
        theta[self.shared] += move
        for own, option in zip(self.own, best, strict=True):
            theta[own] = option.theta[own] + option.follows @ move
        unknowns = self.problem.unknowns
        theta = np.clip(theta, unknowns.lower, unknowns.upper)
        cost = sum(self._evaluate_run(self.theta, e, 1)[0] for e in range(len(best)))
        return self._put_in_order(theta), cost - sum(self._predict_cost(option, move) for option in best)

    def _put_in_order(self, theta: FloatArray) -> FloatArray:
        """Return theta with the transition times of each run inside its horizon and in order."""
        for run, where in zip(self.problem.experiments, self.problem.unknowns.times, strict=True):
            free = where[where >= 0]
            theta[free] = np.maximum.accumulate(np.clip(theta[free], run.t0, run.end))
        return theta

    @staticmethod
    def _predict_cost(option: Option, move: FloatArray) -> float:
        return float(option.cost + option.slope @ move + 0.5 * move @ option.curvature @ move)

    def _find_dependencies(self, e: int) -> NDArray[np.bool_]:
        """Return which unknowns the cost of a run depends on: (d,)."""
        own, mine = self.problem.own_places[e]
        found = self._evaluate_run(self.theta, e, 1)
        depends = np.zeros(len(self.theta), dtype=bool)
        np.logical_or.at(depends, mine, (found[1][own] != 0) | np.any(found[2][own] != 0, axis=1))
        return depends

    def _evaluate_run(self, theta: FloatArray, e: int, side: int) -> tuple[float, FloatArray, FloatArray]:
        check_time()
        self.evaluations += 1
        found = self.evaluator.engines[e].derivatives(*self.problem.vectors(theta, e), side, "exact")
        return float(found.cost), found.gradient, found.hessian

    def _scan_run(self, e: int) -> list[Option]:
        """Return the best of each interval for each transition of a run, the others left to follow."""
        where, run = self.problem.unknowns.times[e], self.problem.experiments[e]
        samples = list_sample_times(run)
        stay = self._fit_inside(self.theta, e, -1, -np.inf, np.inf)
        options = [] if stay is None else [stay]
        for i, place in enumerate(where.tolist()):
            if place < 0:
                continue
            earliest = self.theta[where[i - 1]] if i and where[i - 1] >= 0 else run.t0
            latest = self.theta[where[i + 1]] if i + 1 < len(where) and where[i + 1] >= 0 else run.end
            earliest = max(earliest, float(self.problem.unknowns.lower[place]))
            latest = min(latest, float(self.problem.unknowns.upper[place]))
            inside = samples[(samples > earliest) & (samples < latest)]
            stride = -(-len(inside) // MOST_INTERVALS) if self.reach == np.inf and len(inside) else 1
            edges = np.concatenate([[earliest], inside[::stride], [latest]])
            here = int(np.clip(np.searchsorted(edges, self.theta[place], "right") - 1, 0, len(edges) - 2))
            first, last = max(here - self.reach, 0), min(here + self.reach, len(edges) - 2)
            for way in (range(here, int(last) + 1), range(here - 1, int(first) - 1, -1)):
                options += self._scan_one_way(e, place, edges, way, stay)
        return options or [Option(self.theta, np.inf, *(np.zeros(0),) * 3)]

    def _scan_one_way(self, e: int, place: int, edges: FloatArray, way: range, stay: Option | None) -> list[Option]:
        """Return the best of each interval, from one to the next, until the cost stays far above the lowest."""
        found, rises = [], 0
        theta, lowest = self.theta, np.inf if stay is None else stay.cost
        for k in way:
            start = theta.copy()
            start[place] = np.clip(start[place], edges[k], edges[k + 1])
            option = self._fit_inside(start, e, place, edges[k], edges[k + 1])
            if option is None:
                break
            found.append(option)
            theta = option.theta
            lowest = min(lowest, option.cost)
            rises = rises + 1 if option.cost > self.far * lowest else 0
            if rises == RISES:
                break
        return found

    def _fit_inside(self, theta: FloatArray, e: int, place: int, low: float, high: float) -> Option | None:
        """Return the run's best with the unknown at `place` between two values; None if J cannot be evaluated."""
        own, sums = self.own[e], self._sums[e]
        lower, upper = self.problem.unknowns.lower[own].copy(), self.problem.unknowns.upper[own].copy()
        lower[own == place], upper[own == place] = low, high
        best: tuple[Any, ...] | None = None
        o = len(own)
        for step in range(STEPS + 1):
            side = -1 if place >= 0 and theta[place] >= high else 1
            J, g, H = self._evaluate_run(theta, e, side)
            g, H = sums @ g, sums @ H @ sums.T
            if not (math.isfinite(J) and is_finite(g) and is_finite(H)):
                break
            if best is not None and best[1] < J:
                break
            move, held = _step_inside_bounds(g[:o], H[:o, :o], lower - theta[own], upper - theta[own])
            best = theta, J, g, H, np.flatnonzero(~held)
            if step == STEPS or -(g[:o] @ move) <= self.settled * abs(J):
                break
            theta = theta.copy()
            theta[own] = np.minimum(np.maximum(theta[own] + move, lower), upper)
        return None if best is None else self._reduce_to_shared(best, o)

    def _reduce_to_shared(self, best: tuple[Any, ...], o: int) -> Option:
        """Return an option with slope and curvature in the shared unknowns, the moving ones eliminated."""
        theta, J, g, H, moving = best
        s = len(self.shared)
        follows = np.zeros((o, s))
        if not 0 < s <= MOST_SHARED:
            return Option(theta, J, np.zeros(s), np.zeros((s, s)), follows)
        across = H[moving, o:]
        if len(moving):
            follows[moving] = -_solve_convex(H[np.ix_(moving, moving)], across)
        return Option(theta, J, g[o:] + follows[moving].T @ g[moving], H[o:, o:] + across.T @ follows[moving], follows)


def _solve_convex(matrix: FloatArray, right: FloatArray) -> FloatArray:
    """Return the solution of a linear system; an indefinite matrix is made positive definite by its eigenvalues."""
    size = np.abs(matrix.diagonal())
    factor, found, failed = lapack.dposv(matrix, right)
    if not failed and bool((factor.diagonal() ** 2 > DEFINITE * size).all()):
        return np.asarray(found)
    scale = np.sqrt(np.where(size > EPS**2 * size.max(initial=0.0), size, 1.0))  # what J does not depend on stays
    scaled, goal = matrix / (scale[:, None] * scale), (right.T / scale).T
    least = SMALLEST_EIGENVALUE * np.eye(len(scaled))
    if is_definite(scaled - least):
        solution = lapack.dposv(scaled, goal)[1]
    else:
        values, vectors = np.linalg.eigh(scaled)
        values = np.maximum(np.abs(values), SMALLEST_EIGENVALUE)
        solution = vectors @ ((vectors.T @ goal).T / values).T
    return np.asarray(solution.T / scale).T


def _step_inside_bounds(
    g: FloatArray, H: FloatArray, lower: FloatArray, upper: FloatArray
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Return Newton's step inside bounds, and which entries are held at a bound."""
    held = np.zeros(len(g), dtype=bool)
    if not len(g):
        return np.zeros(0), held
    step = -_solve_convex(H, g)
    for _ in range(2):
        out = ~held & ((step < lower) | (step > upper))
        if not out.any():
            return step, held
        step[out] = np.clip(step[out], lower[out], upper[out])
        held |= out
        moving = ~held
        if moving.any():
            rest = g[moving] + H[np.ix_(moving, held)] @ step[held]
            step[moving] = -_solve_convex(H[np.ix_(moving, moving)], rest)
    inside = np.minimum(np.maximum(step, lower), upper)
    return inside, held | (step < lower) | (step > upper)
