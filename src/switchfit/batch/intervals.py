"""Intervals of transition times across sample times, of many fits: as of `switchfit.uncertainty.piecewise`.

Where a sample lies near a transition time, or a kink holds it, the pieces of its profile are found while the fit's data
are at hand, and kept: from them follows the interval at any level. Most fits have no sample so near, and cost nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from switchfit.batch.evaluations import Evaluations
from switchfit.batch.program import Chunk
from switchfit.batch.quality import count_priors, count_samples, measure_quantile, measure_variance
from switchfit.batch.verdict import has_converged
from switchfit.engine.branches import has_corners
from switchfit.optimize import Status
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem
from switchfit.uncertainty.piecewise import HIGHEST_LEVEL, MOST_RUNS, find_ends, is_any_near
from switchfit.uncertainty.walks import (
    MOST_HALVINGS,
    PIECE,
    Derivatives,
    Samples,
    Walks,
    join_walks,
    list_transitions,
    list_walks,
    trace_walks,
)

MOST_SAMPLES = 5
"""With more samples than that within an interval one parabola is taken: their kinks begin to average out, and the
pieces of all fits would be most of what is kept."""

MOST_KEPT = MOST_SAMPLES + 1 + MOST_HALVINGS
"""Pieces that are kept for one side."""

AT_KINK = Status.CONVERGED_AT_KINK.name


def list_places(problem: Problem) -> NDArray[np.intp]:
    """Return the places in theta of the transition times whose profiles are looked at: (T,).

    None where J has no noise model, with guards, terminal constraints or corners of the state, of which compiled
    programs know nothing, and of more than `MOST_RUNS` experiments.
    """
    judged = problem.is_sigma_known is not None and not problem.constraint_names
    judged = judged and not any(map(has_corners, problem.structures))
    if not judged or len(problem.experiments) > MOST_RUNS:
        return np.zeros(0, dtype=np.intp)
    return np.array([k for _, k in list_transitions(problem)], dtype=np.intp)


def make_no_pieces(problem: Problem, count: int) -> FloatArray:
    """Return the pieces of fits none of which has a sample near: (R, T, 2, `MOST_KEPT`, 5) of NaN."""
    return np.full((count, len(list_places(problem)), 2, MOST_KEPT, PIECE), np.nan)


def trace_chunk(
    chunk: Chunk, groups: list[tuple[Problem, NDArray[np.intp]]], prepare: Callable[[], Evaluations]
) -> FloatArray:
    """Return the pieces of the profiles of a chunk's transition times: (R, T, 2, `MOST_KEPT`, 5).

    Parameters
    ----------
    chunk : Chunk
    groups : list of (Problem, (n,) int)
        Problems with the bounds and sample times of some fits.
    prepare : callable
        What evaluates the chunk's fits; asked for where any fit needs it.
    """
    found, converged = make_no_pieces(groups[0][0], len(chunk.cost)), has_converged(chunk.status)
    if not found.shape[1]:
        return found
    lots = [lot for problem, fits in groups for lot in _list_walks(problem, chunk, fits[converged[fits]])]
    if not lots:
        return found
    fits, rows, walks = (*(np.concatenate([lot[i] for lot in lots]) for i in (0, 1)), join_walks([w for *_, w in lots]))
    smooth = chunk.status[fits] != AT_KINK
    shared = prepare()
    if not shared.quick:  # an evaluation of its own has to be compiled: for kinks alone, where there is nothing else
        kept = ~smooth
        fits, rows, walks, smooth = fits[kept], rows[kept], Walks(*(each[kept] for each in walks)), smooth[kept]

    def evaluate(which: NDArray[np.intp], thetas: FloatArray) -> Derivatives:
        return shared(fits[which], thetas, walks.side[which])

    start = Derivatives(chunk.cost[fits], chunk.gradient[fits], chunk.hessian[fits])
    pieces = trace_walks(walks, start, smooth, evaluate, MOST_KEPT)
    found[fits, rows, (walks.side + 1) // 2] = pieces
    incomplete = np.isnan(found[:, :, :, 0, 0]).any(axis=2)
    found[incomplete] = np.nan
    return found


Lot = tuple[NDArray[np.intp], NDArray[np.intp], Walks]
"""Ways of several fits: which fits, which rows among the chunk's pieces, and the ways."""


def _list_walks(problem: Problem, chunk: Chunk, fits: NDArray[np.intp]) -> Iterator[Lot]:
    """Yield the ways to both sides of each transition time at a kink, or with a few samples within its interval.

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
        free = variances > 0
    ends = problem.ends_of_modes(theta)
    for row, (e, place) in enumerate(list_transitions(problem)):
        tau, samples = theta[:, place], Samples.of(problem, theta, e)
        collapsed = np.sum(ends[e] == tau[:, None], axis=1) > 1  # ties it to another time
        held = (chunk.status[fits] == AT_KINK) & (variances[:, place] == 0)
        with np.errstate(invalid="ignore"):
            within = np.abs(samples.times - tau[:, None]) <= (quantile * errors[:, place])[:, None]
        few = np.sum(within, axis=1) <= MOST_SAMPLES
        taken = ~collapsed & (held | (few & is_any_near(samples, tau, errors[:, place])))
        if taken.any():
            own = Samples(*(each[taken] for each in samples))
            walks = list_walks(problem, e, place, theta[taken], free[taken], thresholds[taken], own, MOST_KEPT)
            yield np.tile(fits[taken], 2), np.full(len(walks.place), row), walks


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
