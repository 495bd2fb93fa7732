"""Times of a beam: the mesh on which it propagates, and the births on a grid among its nodes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.discretization.mesh import Mesh
from switchfit.problem.experiment import Experiment
from switchfit.problem.measurements import Measurements
from switchfit.problem.parameter import Parameter
from switchfit.problem.priors import PriorTerms

MOST_GRID_INTERVALS = 60
"""Births in the horizon where `grid` is left out, if samples are as frequent."""

LIKELY_IN_DEVIATIONS = 5.0
"""Standard deviations of the prior of a time within which a beam looks for it."""


def choose_grid(run: Experiment) -> float:
    """Return the time between births: that between samples, but at most `MOST_GRID_INTERVALS` in the horizon."""
    shortest = (run.end - run.t0) / MOST_GRID_INTERVALS
    gaps = [np.diff(item.times) for item in run.measurements]
    # The median: one gap in a log, or two samples that are close by, is not how often it measures.
    usual = [float(np.median(gap)) for gap in gaps if len(gap)]
    return max([shortest, *([min(usual)] if usual else [])])


def list_sample_times(run: Experiment) -> FloatArray:
    """Return the times at which something is measured: (K,), ascending."""
    times = [item.seen_times[np.any(np.isfinite(item.values), axis=1)] for item in run.measurements]
    return np.unique(np.concatenate([np.zeros(0), *times]))


def keep_apart(times: FloatArray, shortest: FloatArray, t0: float, tf: float) -> FloatArray:
    """Return transition times in order, moved as far as modes with these shortest durations (N + 1,) need."""
    ahead, behind = np.cumsum(shortest[:-1]), np.cumsum(shortest[:0:-1])[::-1]
    low, high = t0 + ahead, tf - behind
    # With the durations taken off, "in order and far enough apart" is "ascending": one pass forward moves times later,
    # one backward from tf moves them earlier. Each moves no time that has room.
    later = np.maximum.accumulate(np.maximum(times, low) - ahead) + ahead
    return np.minimum.accumulate((np.minimum(later, high) + behind)[::-1])[::-1] - behind


def build_mesh(run: Experiment, grid: float, marks: FloatArray | Sequence[float] = ()) -> Mesh:
    """Return the mesh with all required nodes, the times of jumps and `marks`; no cell is longer than the grid."""
    nodes = np.unique(np.concatenate([Mesh.of(run).times, run.jump_times, marks]))
    # A cell that is the grid but for rounding is not cut in two.
    counts = np.maximum(np.ceil(np.diff(nodes) / grid - 1e-9), 1).astype(int)
    ends = zip(nodes[:-1].tolist(), nodes[1:].tolist(), counts.tolist(), strict=True)
    inside = [np.linspace(begin, end, count + 1)[1:-1] for begin, end, count in ends]
    return Mesh.from_times(np.concatenate([nodes, *inside]))


def choose_stops(times: FloatArray, grid: float, marks: FloatArray | Sequence[float] = ()) -> NDArray[np.intp]:
    """Return the nodes of births, `marks` and those nearest to an even grid, between the first and the last node."""
    wanted = np.arange(times[0] + grid, times[-1] - 0.5 * grid, grid)
    # The node nearest to each wanted place, on either side: no node is added for a birth, since each costs a step.
    after = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    nearest = after - (wanted - times[after - 1] < times[after] - wanted)
    return np.unique(np.concatenate([[0], nearest, np.searchsorted(times, marks).astype(np.intp), [len(times) - 1]]))


def count_values(measured: Sequence[Measurements], times: FloatArray) -> FloatArray:
    """Return the number of measured values up to each node: (G + 1,)."""
    found = np.zeros(len(times))
    for item in measured:
        np.add.at(found, np.searchsorted(times, item.seen_times), (~np.isnan(item.values)).sum(1))
    return np.cumsum(found)


def limit_times(times: Sequence[Parameter], births: int) -> FloatArray:
    """Return between which values a beam looks for each time of a transition, by its bounds and its prior: (S, 2).

    Only those of a given order of modes have any; of the fit that follows, a prior is a part of J.
    """
    found = np.array([[-np.inf, np.inf]] * births)
    for own, tau in zip(found, times, strict=False):
        own[:] = (tau.value, tau.value) if tau.fixed else (tau.lower, tau.upper)
        if tau.prior is not None and not tau.fixed:
            (center,), (precision,), (log,) = PriorTerms.of(tau.prior, (1,))
            ends = center + LIKELY_IN_DEVIATIONS * precision**-0.5 * np.array([-1.0, 1.0])
            own[:] = np.clip(np.exp(ends) if log else ends, *own)
    return found
