"""The times between which a beam propagates: a mesh, and the births on a grid among its nodes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from switchfit.discretization.mesh import Mesh
from switchfit.problem.data import FloatArray, Measurements
from switchfit.problem.experiment import Experiment
from switchfit.problem.structure import select_kind

INTERVALS = 60
"""Births in the horizon where `grid` is left out, if samples are as frequent."""


def choose_grid(run: Experiment) -> float:
    """Return the time between births: that between samples, but at most `INTERVALS` in the horizon."""
    shortest = (run.end - run.t0) / INTERVALS
    gaps = [np.diff(item.times) for item in select_kind(run.data, Measurements)]
    usual = [float(np.median(gap)) for gap in gaps if len(gap)]
    return max([shortest, *([min(usual)] if usual else [])])


def list_sample_times(run: Experiment) -> FloatArray:
    """Return the times at which something is measured: (K,), ascending."""
    measured = select_kind(run.data, Measurements)
    times = [item.seen_times[np.any(np.isfinite(item.values), axis=1)] for item in measured]
    return np.unique(np.concatenate([np.zeros(0), *times]))


def keep_apart(times: FloatArray, shortest: FloatArray, t0: float, tf: float) -> FloatArray:
    """Return transition times in order, moved as far as modes with these shortest durations (N + 1,) need."""
    ahead, behind = np.cumsum(shortest[:-1]), np.cumsum(shortest[:0:-1])[::-1]
    low, high = t0 + ahead, tf - behind
    later = np.maximum.accumulate(np.maximum(times, low) - ahead) + ahead
    return np.minimum.accumulate((np.minimum(later, high) + behind)[::-1])[::-1] - behind


def build_mesh(run: Experiment, grid: float, marks: FloatArray | Sequence[float] = ()) -> Mesh:
    """Return the mesh with all required nodes, the times of jumps and `marks`; no cell is longer than the grid."""
    nodes = np.unique(np.concatenate([Mesh.of(run).times, run.jump_times, marks]))
    counts = np.maximum(np.ceil(np.diff(nodes) / grid - 1e-9), 1).astype(int)
    ends = zip(nodes[:-1].tolist(), nodes[1:].tolist(), counts.tolist(), strict=True)
    inside = [np.linspace(begin, end, count + 1)[1:-1] for begin, end, count in ends]
    return Mesh.from_times(np.concatenate([nodes, *inside]))


def choose_stops(times: FloatArray, grid: float, marks: FloatArray | Sequence[float] = ()) -> NDArray[np.intp]:
    """Return the nodes of births, `marks` and those nearest to an even grid, between the first and the last node."""
    wanted = np.arange(times[0] + grid, times[-1] - 0.5 * grid, grid)
    after = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    nearest = after - (wanted - times[after - 1] < times[after] - wanted)
    return np.unique(np.concatenate([[0], nearest, np.searchsorted(times, marks).astype(np.intp), [len(times) - 1]]))


def count_values(measured: Sequence[Measurements], times: FloatArray) -> FloatArray:
    """Return the number of measured values up to each node: (G + 1,)."""
    found = np.zeros(len(times))
    for item in measured:
        np.add.at(found, np.searchsorted(times, item.seen_times), (~np.isnan(item.values)).sum(1))
    return np.cumsum(found)
