"""Intervals of transition times across sample times, of many fits: as of `switchfit.uncertainty.piecewise`.

Where a sample lies near a transition time, or a kink holds it, the pieces of its profile are found while the fit's data
are at hand, and kept: from them follows the interval at any level. Most fits have no sample so near, and cost nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy.special
from numpy.typing import NDArray

from switchfit.batch.program import Chunk, Evaluations
from switchfit.batch.quality import count_priors, count_samples
from switchfit.batch.verdict import has_converged
from switchfit.fit.evaluator import Evaluator
from switchfit.fit.solution import is_sigma_known
from switchfit.optimize import Status
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem
from switchfit.uncertainty.piecewise import (
    HIGHEST_LEVEL,
    MOST_HALVINGS,
    MOST_REPEATS,
    MOST_RUNS,
    RIGHT,
    Piece,
    find_ends,
    find_halfway,
    is_any_near,
    is_end_inside,
    list_sample_times,
    list_stops,
    list_transitions,
)

MOST_SAMPLES = 5
"""With more samples than that within an interval one parabola is taken: their kinks begin to average out, and the
pieces of all fits would be most of what is kept."""

MOST_KEPT = MOST_SAMPLES + 1 + MOST_HALVINGS
"""Pieces that are kept for one side."""

AT_KINK = Status.CONVERGED_AT_KINK.name

Derivatives = tuple[FloatArray, FloatArray, FloatArray]
"""Costs (n,), gradients (n, d) and Hessians (n, d, d)."""


def list_places(problem: Problem) -> NDArray[np.intp]:
    """Return the places in theta of the transition times whose profiles are looked at: (T,).

    None where J has no noise model, with guards or terminal constraints, and of more than `MOST_RUNS` experiments.
    """
    judged = is_sigma_known(problem) is not None and not problem.constraint_names
    if not judged or len(problem.experiments) > MOST_RUNS:
        return np.zeros(0, dtype=np.intp)
    return np.array([k for _, k in list_transitions(problem)], dtype=np.intp)


def make_no_pieces(problem: Problem, count: int) -> FloatArray:
    """Return the pieces of fits none of which has a sample near: (R, T, 2, `MOST_KEPT`, 5) of NaN."""
    return np.full((count, len(list_places(problem)), 2, MOST_KEPT, len(Piece._fields)), np.nan)


def trace_chunk(
    chunk: Chunk,
    redone: NDArray[np.bool_],
    problem_at: Callable[[int], Problem],
    prepare: Callable[[], Evaluations],
    problem_of: Callable[[int], Problem],
) -> FloatArray:
    """Return the pieces of the profiles of a chunk's transition times: (R, T, 2, `MOST_KEPT`, 5).

    Parameters
    ----------
    chunk : Chunk
    redone : (R,) bool
        Fits that were done again, on meshes of their own.
    problem_at : callable
        A problem with the bounds and sample times of the k-th fit.
    prepare : callable
        What evaluates the chunk's fits on the meshes that they share; asked for where any fit needs it.
    problem_of : callable
        The problem of the k-th fit with its own data, for one that was done again.
    """
    found = make_no_pieces(problem_at(0), len(chunk.cost))
    if not found.shape[1]:
        return found
    walks: list[_Walk] = []
    for k in np.flatnonzero(has_converged(chunk.status)).tolist():
        walks += _list_walks(problem_at(k), chunk, k)
    if not walks:
        return found
    shared = prepare()
    if not shared.quick:  # an evaluation of its own has to be compiled: for kinks alone, where there is nothing else
        walks = [walk for walk in walks if walk.held]
    own: dict[int, Evaluator] = {}

    def evaluate(fits: NDArray[np.intp], thetas: FloatArray, sides: NDArray[np.int64]) -> Derivatives:
        again = redone[fits]
        n, d = thetas.shape
        J, g, H = np.zeros(n), np.zeros((n, d)), np.zeros((n, d, d))
        if not again.all():
            J[~again], g[~again], H[~again] = shared(fits[~again], thetas[~again], sides[~again])
        for s in np.flatnonzero(again).tolist():
            k = int(fits[s])
            if k not in own:
                own[k] = Evaluator(problem_of(k), chunk.theta[k])
            here = own[k](thetas[s], int(sides[s]))
            J[s], g[s], H[s] = here.cost, here.gradient, here.hessian
        return J, g, H

    try:
        _walk_all(walks, chunk, evaluate, found)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError):  # a model that is undefined near by: one parabola
        return make_no_pieces(problem_at(0), len(chunk.cost))
    incomplete = np.isnan(found[:, :, :, 0, 0]).any(axis=2)
    found[incomplete] = np.nan
    return found


@dataclass
class _Walk:
    """The way from one fit's estimate of a transition time to one side."""

    fit: int
    place: int  # of the transition time in theta
    row: int  # among the chunk's pieces
    side: int
    held: bool
    free: NDArray[np.bool_]  # unknowns that follow
    stops: list[float]
    lower: FloatArray
    upper: FloatArray
    threshold: float
    halvings: int = 0
    repeats: int = 0
    count: int = 0  # of pieces
    before: Piece | None = None

    def must_repeat(self, decrement: float) -> bool:
        """Return whether the other unknowns need a further Newton step at the same place."""
        more = self.repeats < MOST_REPEATS and abs(decrement) > RIGHT * self.threshold
        self.repeats = self.repeats + 1 if more else 0
        return more

    def cut(self, piece: Piece) -> tuple[Piece, bool]:
        """Cut a piece off as `trace_profile` does, or use up its stop; and return whether it is the last."""
        more = self.halvings < MOST_HALVINGS
        halfway = find_halfway(piece, self.before, self.threshold, self.side) if more else None
        if halfway is None:
            self.stops.pop(0)
        else:
            piece, self.halvings = piece._replace(stop=halfway), self.halvings + 1
        self.before, self.count = piece, self.count + 1
        ended = halfway is None and is_end_inside(piece, self.threshold, self.side)
        return piece, ended or not self.stops


def _list_walks(problem: Problem, chunk: Chunk, k: int) -> list[_Walk]:
    """Return the ways to both sides of each transition time at a kink, or with a few samples within its interval."""
    freedom = count_samples(problem) + count_priors(problem) - int(chunk.free[k])
    known = bool(is_sigma_known(problem))
    if not np.isfinite(chunk.cost[k]) or (freedom <= 0 and not known):
        return []
    theta, variance = chunk.theta[k], np.diag(chunk.covariance[k])
    tail = 0.5 + HIGHEST_LEVEL / 2
    quantile = float(scipy.special.ndtri(tail) if known else scipy.special.stdtrit(freedom, tail))
    threshold = 0.5 * quantile**2 * (1.0 if known else 2 * float(chunk.cost[k]) / freedom)
    reach = np.sqrt(2 * threshold * np.maximum(variance, 0.0))
    places, ends = list_places(problem).tolist(), problem.ends_of_modes(theta)
    lower, upper = problem.unknowns.lower, problem.unknowns.upper
    walks = []
    for e, place in list_transitions(problem):
        if np.sum(ends[e] == theta[place]) > 1:  # a collapsed mode ties it to another time
            continue
        samples = list_sample_times(problem, theta, e)
        held = bool(chunk.status[k] == AT_KINK and variance[place] == 0)
        few = np.sum(np.abs(samples - theta[place]) <= reach[place]) <= MOST_SAMPLES
        if not held and not (few and is_any_near(samples, theta[place], reach[place] / quantile)):
            continue
        free = variance > 0
        free[place] = False
        for side in (-1, 1):
            stops = list_stops(problem, theta, e, place, samples, ends[e], lower, upper, side)
            walks.append(_Walk(k, place, places.index(place), side, held, free, stops, lower, upper, threshold))
    return walks


def _walk_all(
    walks: list[_Walk],
    chunk: Chunk,
    evaluate: Callable[[NDArray[np.intp], FloatArray, NDArray[np.int64]], Derivatives],
    found: FloatArray,
) -> None:
    """Go all ways together, sample by sample, and write their pieces into `found`; as of `trace_profile`."""
    theta = {id(walk): chunk.theta[walk.fit].copy() for walk in walks}
    began = False
    while walks:
        fits = np.array([walk.fit for walk in walks])
        at = np.array([theta[id(walk)] for walk in walks])
        sides = np.array([walk.side for walk in walks])
        # J is smooth where the estimate is at no kink, and known there.
        new = np.array([began or chunk.status[walk.fit] == AT_KINK for walk in walks])
        began = True
        J, g, H = chunk.cost[fits], chunk.gradient[fits], chunk.hessian[fits]
        if new.any():
            J[new], g[new], H[new] = evaluate(fits[new], at[new], sides[new])
        n, d = g.shape
        each, places = np.arange(n), np.array([walk.place for walk in walks])
        free = np.array([walk.free for walk in walks])
        both = free[:, :, None] & free[:, None, :]
        column = H[each, :, places]
        rest = np.stack([np.where(free, g, 0.0), np.where(free, column, 0.0)], axis=2)
        solved = np.linalg.solve(np.where(both, H, np.eye(d)), rest)
        newton, follow = solved[:, :, 0], solved[:, :, 1]
        decrement = 0.5 * np.sum(np.where(free, g, 0.0) * newton, axis=1)
        rise = J - decrement - chunk.cost[fits]
        slope = g[each, places] - np.sum(column * newton, axis=1)
        curvature = H[each, places, places] - np.sum(column * follow, axis=1)
        left = []
        for s, walk in enumerate(walks):
            if walk.must_repeat(decrement[s]):
                forward = np.clip(at[s] - newton[s], walk.lower, walk.upper)
            else:
                limit = walk.stops[-1]
                here = Piece(at[s, walk.place], walk.stops[0], rise[s], walk.side * slope[s], curvature[s])
                here, ended = walk.cut(here)
                last = ended or walk.count == MOST_KEPT
                stored = here._replace(stop=limit) if last else here
                found[walk.fit, walk.row, (walk.side + 1) // 2, walk.count - 1] = stored
                if last:
                    continue
                forward = at[s] - newton[s] - follow[s] * (here.stop - here.start)
                forward = np.clip(forward, walk.lower, walk.upper)
                forward[walk.place] = here.stop
            theta[id(walk)] = forward
            left.append(walk)
        walks = left


def replace_intervals(
    intervals: FloatArray, pieces: FloatArray, places: NDArray[np.intp], thresholds: FloatArray
) -> FloatArray:
    """Return intervals (R, d, 2) with those of transition times with samples near, or at a kink, from their pieces.

    Parameters
    ----------
    intervals : (R, d, 2)
        From one parabola each; NaN at a kink.
    pieces : (R, T, 2, P, 5)
        As of `trace_chunk`.
    places : (T,) int
        Where in theta they stand.
    thresholds : (R,)
        By how much J may exceed its minimum.
    """
    found = intervals.copy()
    if not len(places):
        return found
    replaced = ~np.isnan(pieces[:, :, 0, 0, 0])
    for end, side in enumerate((-1, 1)):
        ends = find_ends(pieces[:, :, end], thresholds[:, None], side)
        found[:, places, end] = np.where(replaced, ends, found[:, places, end])
    return found
