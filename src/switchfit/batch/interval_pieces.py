"""Pieces of the profiles of transition times with samples near or a kink, for the intervals of many fits.

Intervals across sample times are those of `switchfit.uncertainty.walks`. Where a sample lies near a transition time, or
a kink holds it, the pieces of its profile are found while the fit's data are at hand, and kept: from them follows the
interval at any level. Most fits have no sample so near, and cost nothing.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.batch.batch import Batch
from switchfit.batch.doubts import has_converged
from switchfit.batch.ends import Chunk
from switchfit.engine.corners.branches import has_corners
from switchfit.fit.statistics import count_priors, count_samples, measure_quantile, measure_variance
from switchfit.optimize import Status
from switchfit.problem.problem import Problem
from switchfit.uncertainty import profile_pieces, transition_profiles, walk_tracing
from switchfit.uncertainty import walks as ways
from switchfit.uncertainty.transition_profiles import HIGHEST_LEVEL
from switchfit.uncertainty.walks import Derivatives, Walks

MOST_SAMPLES_WITHIN_INTERVAL = 5
"""With more samples than that within an interval one parabola is taken: their kinks begin to average out, and the
pieces of all fits would be most of what is kept."""

MOST_PIECES_OF_SIDE = MOST_SAMPLES_WITHIN_INTERVAL + 1 + walk_tracing.MOST_HALVINGS
"""Pieces that are kept for one side."""

AT_KINK = Status.CONVERGED_AT_KINK.name


def list_places(problem: Problem) -> NDArray[np.intp]:
    """Return the places in theta of the transition times whose profiles are looked at: (T,).

    None where J has no noise model, with guards, terminal constraints or corners of the state, of which compiled
    programs know nothing, and of more than `MOST_TRACED_RUNS` experiments.
    """
    alone = problem.is_sigma_known is None or problem.constraint_names or any(map(has_corners, problem.structures))
    if alone or len(problem.experiments) > transition_profiles.MOST_TRACED_RUNS:
        return np.zeros(0, dtype=np.intp)
    return np.array([k for _, k in ways.list_transitions(problem)], dtype=np.intp)


def make_no_pieces(problem: Problem, count: int) -> FloatArray:
    """Return the pieces of fits none of which has a sample near: (R, T, 2, `MOST_PIECES_OF_SIDE`, 5) of NaN."""
    return np.full((count, len(list_places(problem)), 2, MOST_PIECES_OF_SIDE, profile_pieces.NUMBERS_OF_PIECE), np.nan)


def trace_chunk(chunk: Chunk, groups: list[tuple[Problem, NDArray[np.intp]]], batch: Batch) -> FloatArray:
    """Return the pieces of the profiles of a chunk's transition times: (R, T, 2, `MOST_PIECES_OF_SIDE`, 5).

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

    pieces = walk_tracing.trace_walks(
        walks, chunk.cost[fits], evaluate, MOST_PIECES_OF_SIDE, groups[0][0].unknowns.times
    )
    found[fits, rows, (walks.side + 1) // 2] = pieces
    # An interval from one traced side and one parabola would mix two kinds of ends.
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
        # Ends of modes contain the time itself; a second equal one is a mode of no length.
        collapsed = np.sum(ends[e] == tau[:, None], axis=1) > 1  # ties it to another time
        held = (chunk.status[fits] == AT_KINK) & chunk.at_kink[fits, place]
        with np.errstate(invalid="ignore"):
            within = np.abs(samples - tau[:, None]) <= (quantile * errors[:, place])[:, None]
        # Within the interval that one parabola gives; what the profile says is not known yet.
        few = np.sum(within, axis=1) <= MOST_SAMPLES_WITHIN_INTERVAL
        taken = ~collapsed & (held | (few & transition_profiles.is_any_near(samples, tau, errors[:, place])))
        if taken.any():
            own = theta[taken], free[taken], thresholds[taken], samples[taken]
            walks = ways.list_walks(problem, e, place, *own, MOST_PIECES_OF_SIDE)
            yield np.tile(fits[taken], 2), np.full(len(walks.place), row), walks
