"""Simulations: the states, outputs, tangents and costates of one experiment at all rows of its mesh."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from switchfit.arrays import FloatArray, IntArray
from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import find_row_ending_cell
from switchfit.problem.structure import Structure


@dataclass(frozen=True, eq=False)
class Simulation:
    """One experiment row by row, R = cells + N rows in the order of time; up to tf where it is free.

    Attributes
    ----------
    cost : float
        J.
    nodes : (G + 1,)
        Nodes of the mesh.
    first_cell : (N + 1,) int
        The cell in which each segment begins; (N,) where tf is free.
    start, end : (R,)
        Times of each row.
    before, after : (R, n)
        States at the start and at the end of each row.
    y_before, y_after : (R, q)
        Outputs of the reference signals and the Measurements there, in this order.
    seen : tuple of (K, q), one per Measurements
        Its outputs at its samples, late ones included.
    tangents : Tangents or None
        If requested, the derivatives of `before`, `after`, `y_before` and `y_after` in the experiment's unknowns at
        fixed times, along an additional last axis of length D.
    """

    cost: float
    nodes: FloatArray
    first_cell: IntArray
    start: FloatArray
    end: FloatArray
    before: FloatArray
    after: FloatArray
    y_before: FloatArray
    y_after: FloatArray
    seen: tuple[FloatArray, ...] = ()
    tangents: Tangents | None = None

    @property
    def first_row(self) -> IntArray:
        """The row in which each segment begins."""
        return self.first_cell + np.arange(len(self.first_cell))

    @property
    def segments(self) -> list[slice]:
        """Slice of rows of each segment."""
        first = self.first_row.tolist()
        return [slice(a, b) for a, b in zip(first, [*first[1:], len(self.start)], strict=True)]

    def row_ending(self, cells: IntArray) -> IntArray:
        """Return the last row that ends in each of the cells (K,), before any jump at its end; -1 for cell -1."""
        return np.asarray(find_row_ending_cell(self.first_cell, cells, np))


class Tangents(NamedTuple):
    """Derivatives of a `Simulation`: (R, n, D), (R, n, D), (R, q, D), (R, q, D)."""

    before: FloatArray
    after: FloatArray
    y_before: FloatArray
    y_after: FloatArray


class Costates(NamedTuple):
    """Derivatives of the cost to go in the states at the starts of all rows, R = cells + N, up to tf where it is free.

    Samples, jumps and reset maps at the start of a row lie before it: the costate has nothing of them.

    Attributes
    ----------
    times : (R,)
    cells, modes : (R,) int
        Cell of the mesh that holds each row, and the index of its mode in the library.
    states, costates : (R, n)
    """

    times: FloatArray
    cells: IntArray
    modes: IntArray
    states: FloatArray
    costates: FloatArray

    @classmethod
    def of_rows(cls, structure: Structure, first_row: IntArray, *rows: FloatArray) -> Costates:
        """Return the costates of rows, given the times (R,), states and costates at their starts (R, n), without those
        after a free tf; `first_row` is that of each segment.
        """
        times, *states = rows
        segment = np.searchsorted(first_row, np.arange(len(times)), "right") - 1
        # row = cell + segment (`build_rows`).
        cells, modes = np.arange(len(times)) - segment, np.array(structure.mode_of_segment)[segment]
        last = int(first_row[-1]) if structure.has_free_tf else len(times)
        return cls(*(values[:last] for values in (times, cells, modes, *states)))


def finish_simulation(
    simulation: Simulation, structure: Structure, arguments: Arguments, late: Mapping[int, FloatArray]
) -> Simulation:
    """Return the simulation with the outputs of each of the Measurements at its samples, and without the rows after a
    free tf.

    Parameters
    ----------
    simulation : Simulation
    structure : Structure
    arguments : Arguments
    late : mapping
        Outputs of all sensors, (L, q), at the samples of each late Measurements, by its index.
    """
    seen, first = [], sum(q for _, q in structure.references)
    for k, (samples, sensor) in enumerate(zip(arguments.samples, structure.measurements, strict=True)):
        if sensor.delay is None:
            row = simulation.row_ending(np.asarray(samples.cell))
            # Row -1, a sample at t0, sees the state at the start; all others see the end of a row, before a jump there.
            y = np.where((row < 0)[:, None], simulation.y_before[:1], simulation.y_after[row])
        else:
            # Machine code leaves out the padding behind the last sample: its last outputs stand for it, with weight 0.
            y = np.concatenate([late[k], np.repeat(late[k][-1:], len(samples.time) - len(late[k]), axis=0)])
        seen.append(y[:, first : first + sensor.channels])
        first += sensor.channels
    simulation = replace(simulation, seen=tuple(seen))
    if not structure.has_free_tf:
        return simulation
    # The last segment is the rest behind a free tf.
    rows = slice(0, simulation.segments[-1].start)
    by_row = ("start", "end", "before", "after", "y_before", "y_after")
    cut: dict[str, Any] = {name: getattr(simulation, name)[rows] for name in by_row}
    if simulation.tangents is not None:
        cut["tangents"] = Tangents(*(values[rows] for values in simulation.tangents))
    return replace(simulation, first_cell=simulation.first_cell[:-1], **cut)
