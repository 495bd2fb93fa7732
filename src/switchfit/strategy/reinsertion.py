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

from switchfit.arrays import FloatArray
from switchfit.meshes.evaluator import Evaluator
from switchfit.problem.problem import Problem
from switchfit.runtime.progress import show_detail
from switchfit.strategy.short_fit import End, fit_briefly, is_lower
from switchfit.strategy.time_limit import OutOfTimeError, check_time

INSERTION_PLACES = 60
"""Places along the horizon at which an insertion is tried."""

INSERTION_LENGTHS = (0.02, 0.05, 0.1, 0.2, 0.4, 0.8)
"""Lengths that are tried, as parts of what the mode has room for."""

REMOVALS = 3
"""Number of modes whose removal is tried, those with the smallest increase of J first."""

REINSERTIONS = 20


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
            # Greedy: the first move whose fit ends lower is taken. All others would have to be rated anew after it.
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
        # Between two equal modes: without it these are one stretch, and two transitions are free for another place.
        if sequence[i] == sequence[i + 2]:
            rest = sequence[: i + 1] + sequence[i + 3 :]
            for j in range(len(rest)):
                # Put inside stretch j. Only where this gives the sequence again are theta and its unknowns the same.
                whole = (*rest[: j + 1], sequence[j + 1] if j + 1 < len(sequence) else "", rest[j], *rest[j + 1 :])
                if whole == sequence and len(rest) > 1:
                    yield i, j


def _list_starts(problem: Problem, theta: FloatArray) -> Iterator[tuple[FloatArray, int]]:
    """Yield theta with a mode moved to where J falls fastest, those modes first whose removal costs least, and the
    number of evaluations.
    """
    evaluator = Evaluator(problem, theta)

    # Where the model cannot be integrated J is no number, which would compare with nothing.
    def evaluate(at: FloatArray) -> float:
        return float(np.nan_to_num(evaluator.cost(at), nan=np.inf))

    for run, where in zip(problem.experiments, problem.unknowns.times, strict=True):
        if run.has_free_tf or np.any(where < 0):  # a fixed transition stays where it is, and with it the others' order
            continue
        moves = set(_list_moves(run.mode_sequence))
        # The mode closed to no length in the middle of its place: what its removal costs, before anything follows.
        closed = {i: evaluate(_move_pair(theta, where, i, i, *[theta[where[i : i + 2]].mean()] * 2)) for i, _ in moves}
        for i in sorted(closed, key=closed.__getitem__)[:REMOVALS]:
            others = np.delete(theta[where], [i, i + 1])
            rates = []
            for begin in np.linspace(run.t0, run.end, INSERTION_PLACES + 2)[1:-1].tolist():
                j = int(np.searchsorted(others, begin, "right"))
                if (i, j) in moves:
                    check_time()
                    pair = _move_pair(theta, where, i, j, begin, begin)
                    # dJ/d(end) of a mode of no length that begins here: the insertion rate. It costs one gradient a
                    # place, and no fit.
                    rates.append((evaluator(pair).gradient[where[j + 1]], begin, j))
            rate, begin, j = min(rates, default=(0.0, 0.0, 0))
            if rate < 0:
                # The rate says in which direction, not how far: J at a few lengths does.
                room = np.append(others, run.end)[j] - begin
                starts = [_move_pair(theta, where, i, j, begin, begin + part * room) for part in INSERTION_LENGTHS]
                yield min(starts, key=evaluate), len(closed) + len(rates) + len(starts)


def _move_pair(theta: FloatArray, where: NDArray[np.intp], i: int, j: int, begin: float, end: float) -> FloatArray:
    """Return theta with the transitions i and i + 1 of a run at two times behind j of the others."""
    moved = theta.copy()
    moved[where] = np.insert(np.delete(theta[where], [i, i + 1]), [j, j], [begin, end])
    return moved
