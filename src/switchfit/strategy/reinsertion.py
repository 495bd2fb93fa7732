"""Removal and re-insertion of modes: what local minima in switching times are made of is undone.

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

from collections.abc import Iterator
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from switchfit.fit.evaluator import Evaluator
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem
from switchfit.runtime.progress import show_detail
from switchfit.strategy.quick import End, OutOfTimeError, check_time, fit_briefly

PLACES = 60
"""Places along the horizon at which an insertion is tried."""

LENGTHS = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8)
"""Lengths that are tried, as parts of what the mode has room for."""

REMOVALS = 3
"""Number of modes whose removal is tried, those with the smallest increase of J first."""

LOWER = 1e-6
"""A cost has to fall by this part of itself for the search to go on."""

ROUNDS = 20


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
    current = fit_briefly(problem, theta)
    evaluations = current.evaluations
    with suppress(OutOfTimeError):
        for repeated in range(ROUNDS):
            show_detail(f"round {repeated + 1}", current.cost)
            better = None
            for candidate, tried in _list_candidates(problem, current.theta):
                end = fit_briefly(problem, candidate)
                evaluations += tried + end.evaluations
                if end.cost < current.cost - LOWER * abs(current.cost):
                    better = end
                    break
            if better is None:
                break
            current = better
    return current._replace(evaluations=evaluations)


def _list_moves(sequence: tuple[str, ...]) -> Iterator[tuple[int, int]]:
    """Yield a segment that may be removed, and one behind which it may be inserted without changing the sequence."""
    for i in range(len(sequence) - 2):
        if sequence[i] == sequence[i + 2]:
            rest = sequence[: i + 1] + sequence[i + 3 :]
            for j in range(len(rest)):
                whole = (*rest[: j + 1], sequence[j + 1] if j + 1 < len(sequence) else "", rest[j], *rest[j + 1 :])
                if whole == sequence and len(rest) > 1:
                    yield i, j


def _list_candidates(problem: Problem, theta: FloatArray) -> Iterator[tuple[FloatArray, int]]:
    """Yield thetas from which a fit may end at a lower cost, and the evaluations that each took."""
    evaluator = Evaluator(problem, theta)
    for run, where in zip(problem.experiments, problem.unknowns.times, strict=True):
        if run.has_free_tf:
            continue
        moves: dict[int, list[int]] = {}
        if np.any(where < 0):  # a fixed transition stays where it is, and with it the others' order
            continue
        for i, j in _list_moves(run.mode_sequence):
            moves.setdefault(i, []).append(j)
        closed = {}
        for i in moves:
            without = theta.copy()
            without[where[i : i + 2]] = theta[where[i : i + 2]].mean()
            closed[i] = _evaluate_cost(evaluator, without)
        for i in sorted(closed, key=closed.__getitem__)[:REMOVALS]:
            found = _insert(evaluator, theta, where, i, moves[i], run.t0, run.end)
            if found is not None:
                yield found[0], found[1] + len(closed)


def _insert(
    evaluator: Evaluator, theta: FloatArray, where: NDArray[np.intp], i: int, behind: list[int], t0: float, tf: float
) -> tuple[FloatArray, int] | None:
    """Return theta with the transitions i and i + 1 moved to where the cost decreases fastest; None if nowhere."""
    times = theta[where]
    others = np.delete(times, [i, i + 1])
    knots = np.concatenate([[t0], others, [tf]])
    best, tried = (0.0, np.nan, 0), 0
    for place in np.linspace(t0, tf, PLACES + 2)[1:-1]:
        j = int(np.searchsorted(others, place, "right"))
        if j not in behind:
            continue
        check_time()
        there = _insert_pair(theta, where, others, j, place, place)
        slope = evaluator(there).gradient[where[j + 1]]
        tried += 1
        if slope < best[0]:
            best = (float(slope), float(place), j)
    slope, place, j = best
    if slope == 0.0:
        return None
    room = knots[j + 1] - place
    candidates = [_insert_pair(theta, where, others, j, place, place + part * room) for part in LENGTHS]
    costs = [_evaluate_cost(evaluator, candidate) for candidate in candidates]
    return candidates[int(np.argmin(costs))], tried + len(costs)


def _insert_pair(
    theta: FloatArray, where: NDArray[np.intp], others: FloatArray, j: int, begin: float, end: float
) -> FloatArray:
    """Return theta with the transition times `others`, and a pair of times behind the j-th of them."""
    moved = theta.copy()
    moved[where] = np.insert(others, [j, j], [begin, end])
    return moved


def _evaluate_cost(evaluator: Evaluator, theta: FloatArray) -> float:
    cost = evaluator.cost(theta)
    return cost if np.isfinite(cost) else np.inf
