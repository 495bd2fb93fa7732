"""Many hypotheses on the mode sequence of one experiment, propagated over its mesh by machine code."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.discretization.arguments import Arguments, count_samples
from switchfit.engine.hypotheses import Column, Hypotheses, HypothesisLimits, HypothesisTolerances
from switchfit.engine.native import program_cache
from switchfit.engine.native.hypothesis_memory import (
    COLUMN_COUNT,
    HYPOTHESIS_SAMPLE_POINTERS,
    PER_PLACE,
    divide_record,
    measure_record,
    scratch_sizes,
)
from switchfit.engine.native.layout import get_address
from switchfit.engine.native.llvm.compilation import Program
from switchfit.engine.native.sizes import Order, Sizes, constants_of
from switchfit.runtime.work import CALL, count_work

Integers = NDArray[np.int64]

SampleArrays = tuple[Integers, FloatArray, FloatArray, FloatArray]
"""Of one Measurements: the place of the first sample at each node (G + 2,), times (K,), values and weights (K, q)."""


class OrderTables(NamedTuple):
    """A given order of modes, N + 1 places, as machine code takes it.

    Attributes
    ----------
    children : (N + 1, 7), the birth at the end of each place, see `Column`; the last one is not read
    counts : (2, N + 1, 3), the number of births of a hypothesis that stays in a place and of one that leaves it, the
        mode of the place, and 0
    windows : (N + 1, 4), how long the mode of each place lasts at least, the times between which its end is, and how
        long the next mode lasts at least
    stops : (L,), nodes between which births are
    """

    children: Integers
    counts: Integers
    windows: FloatArray
    stops: Integers


class NativeHypotheses:
    """Propagates hypotheses on the mode sequence of one experiment from node to node of a mesh.

    Parameters
    ----------
    code : Program
        Of `hypotheses_program`.
    sizes : Sizes
    arguments : Arguments
    times : (G + 1,) array
        Nodes, the times of jumps among them.
    jumps : sequence of (int, int)
        Node of each jump at a known time, ascending, and the place of its map in the library.

    Attributes
    ----------
    record_size : int
        Length of a record, in doubles.
    """

    def __init__(
        self, code: Program, sizes: Sizes, arguments: Arguments, times: FloatArray, jumps: Sequence[tuple[int, int]]
    ) -> None:
        self._program, self._at = code, divide_record(sizes)
        self._cells, self.record_size = len(times) - 1, measure_record(sizes)
        self._shape = sizes.n, sizes.D, sizes.width
        nodes = np.arange(self._cells + 2)
        # The table of pointers has no names: the order here is that of `HypothesisWriter.names`, that is
        # `HYPOTHESIS_POINTERS`, the scratch space, then the samples of each Measurements.
        self._arrays: dict[str, Any] = {
            "nodes": np.array(times),
            "signals": np.ascontiguousarray(np.asarray(arguments.signals)[: self._cells]),
            "c": np.concatenate([*constants_of(arguments), np.zeros(1)], axis=None),
            "units": np.eye(sizes.D + 1, sizes.width, -1),  # row 0 is zero: the derivative of a time that does not move
            "tolerances": np.zeros(3),
            **{name: np.zeros(sizes.D) for name in ("low", "high", "most")},
            "jump_first": np.searchsorted([node for node, _ in jumps], nodes).astype(np.int64),
            "jump_map": np.array([*(which for _, which in jumps), -1], dtype=np.int64),
            **{name: np.zeros(size) for name, size in scratch_sizes(sizes).items()},
        }
        for k, samples in enumerate(arguments.samples):
            count = count_samples(samples)
            # A sample lies at the end of its cell, which is node cell + 1.
            first = np.searchsorted(np.asarray(samples.cell)[:count] + 1, nodes).astype(np.int64)
            values = (np.array(np.asarray(a)[:count], dtype=np.float64, order="C") for a in samples[1:])
            self._set_samples(k, first, *values)
        self._table = np.array(list(map(get_address, self._arrays.values())), dtype=np.uintp)
        self._table_at = get_address(self._table)
        work = code.modules[Order.GAUSS_NEWTON].work
        self._cell_work = float(sum(work.values()))
        prefix = program_cache.ORDER_PREFIXES[Order.GAUSS_NEWTON]
        self._propagate = code.function(f"{prefix}propagate", 13)
        self._follow_order = code.function(f"{prefix}follow_order", 14)

    def _set_samples(self, k: int, *arrays: NDArray[Any]) -> None:
        self._arrays |= {f"{name} {k}": array for name, array in zip(HYPOTHESIS_SAMPLE_POINTERS, arrays, strict=True)}

    def reserve(self, cells: int, samples: int) -> tuple[FloatArray, FloatArray, list[SampleArrays]]:
        """Replace nodes (G + 1,), signals (G, 4, S) and samples by empty arrays, which are to be filled while a log
        grows; return them.

        Parameters
        ----------
        cells, samples : int
            Capacity: of cells, and of samples of each Measurements.
        """
        self._cells = cells + 1  # no node is the end
        wide = self._arrays["signals"].shape[1:]
        given: dict[str, Any] = {"nodes": np.zeros(cells + 1), "signals": np.zeros((cells, *wide))}
        # Names that are there keep their place in the order, and so in the table.
        self._arrays |= given | {"jump_first": np.zeros(cells + 2, dtype=np.int64)}
        of_sensors = []
        for k in range(sum(name.startswith("first ") for name in self._arrays)):
            channels = self._arrays[f"value {k}"].shape[1]
            first, time = np.zeros(cells + 2, dtype=np.int64), np.zeros(samples)
            of_sensors.append((first, time, np.zeros((samples, channels)), np.zeros((samples, channels))))
            self._set_samples(k, *of_sensors[-1])
        self._table[:] = [get_address(a) for a in self._arrays.values()]
        return given["nodes"], given["signals"], of_sensors

    def begin(
        self, p: FloatArray, start: Hypotheses, tolerances: HypothesisTolerances, limits: HypothesisLimits | None
    ) -> Hypotheses:
        """Return one hypothesis at t0, with the samples there.

        Parameters
        ----------
        p : (M,)
        start : Hypotheses
            One, whose costs, gradients and matrices are those of the priors.
        tolerances : Tolerances
        limits : Limits or None
            Within them the point of linearisation moves towards the minimum of the cost after each `advance` and
            `replay`; None if it stays.
        """
        self._arrays["tolerances"][:] = tolerances
        self._recentres = limits is not None
        if limits is not None:
            for name, values in limits._asdict().items():
                self._arrays[name][:] = values
        counts, children = np.zeros((1, 2), dtype=np.int64), np.zeros((1, 0, COLUMN_COUNT), dtype=np.int64)
        return self.replay(start, p[None], counts, children, np.zeros((1, 0)), 0, recentres=False)

    def advance(self, parents: Hypotheses, children: Integers, first: int, last: int) -> Hypotheses:
        """Return the children at node `last` of parents at node `first`: (C,) from a table (C, 7), see `Column`.

        The samples at the first node are those of the parents; the births come after them.
        """
        parent, before, after, slot = children.T[: Column.SLOT + 1]
        times = np.full((len(children), 1), self._arrays["nodes"][first])
        # One birth, or none: (number, first mode, parent), as `propagate` reads them. A child without a birth begins
        # in its own mode.
        counts = np.stack([slot >= 0, np.where(slot >= 0, before, after), parent], axis=1)
        return self._go_on(parents.records, (children, times, counts), (first, last, False))

    def follow_order(
        self, parents: FloatArray, places: Integers, births: FloatArray, order: OrderTables, first: int, last: int
    ) -> tuple[Integers, FloatArray, Hypotheses]:
        """Take hypotheses from one stop to another in a given order of modes; the lowest scores of each place are kept.

        Parameters
        ----------
        parents : records (B, size) at the first stop
        places : (B,), their places in the order
        births : (B, S + 1), the time of their last birth, or t0, then those of all
        order : OrderTables
        first, last : int
            Among the stops of the order.

        Returns
        -------
        places, births, Hypotheses : at the last stop, the lowest score first
        """
        K, room = len(order.counts[0]), PER_PLACE + 1
        records, wide = np.empty((2, K * room, self.record_size)), np.empty((2, K * room, births.shape[1]))
        numbers, ranks = np.zeros((2, K), dtype=np.int64), np.arange(2 * K * room).reshape(2, K * room)
        # The k-th hypothesis in a place goes to the k-th of its records; the last of each place is spare.
        rank = [places[:k].tolist().count(place) for k, place in enumerate(places.tolist())]
        at = places * room + np.array(rank, dtype=np.int64)
        records[0, at], wide[0, at], numbers[0] = parents, births, np.bincount(places, minlength=K)
        given = records, numbers, ranks, wide, *order
        sizes = K, births.shape[1], first, last, self._cells
        count_work(CALL + (last - first) * K * PER_PLACE * self._cell_work)
        self._follow_order(self._table_at, *map(get_address, given), *sizes)
        # Generations alternate: after an even number of stops the result is in the first.
        end = (last - first) % 2
        kept = np.arange(room) < numbers[end, :, None]
        found = ranks[end].reshape(K, room)[kept] - end * K * room
        found = found[np.argsort(records[end, found, self._at["score"].start], kind="stable")]
        return found // room, wide[end, found], self.view(records[end, found])

    def replay(
        self,
        start: Hypotheses,
        p: FloatArray,
        counts: Integers,
        children: Integers,
        times: FloatArray,
        last: int,
        first: int | None = None,
        *,
        recentres: bool = True,
    ) -> Hypotheses:
        """Return hypotheses propagated anew from t0 to node `last`, with births at any times.

        Parameters
        ----------
        start : Hypotheses
            B, whose costs, gradients and matrices are those of the priors at p, and moved what it shall be.
        p : (B, M), points of linearisation
        counts : (B, 2), number of births, and first mode
        children : (B, S, 7), the births, see `Column`
        times : (B, S), when they are, ascending
        first : int, optional
            Node from which they are propagated instead, from the states and tangents of `start`.
        recentres : bool
            False leaves the point of linearisation where it is at the end.
        """
        at, own = self._at, self.view(np.zeros((len(counts), self.record_size)))
        # One step in the first cell; an error of 1 asks for no longer ones.
        own.costs[:], own.records[:, at["parts"]], own.records[:, at["error"]] = start.costs, 1.0, 1.0
        own.records[:, at["p"]], own.moved[:] = p, start.moved
        own.gradients[:], own.matrices[:] = start.gradients, start.matrices
        if first is not None:
            own.states[:], own.tangents[:] = start.states, start.tangents
        counts = np.column_stack([counts, np.arange(len(counts))])
        return self._go_on(own.records, (children, times, counts), (first or 0, last, first is None), recentres)

    def _go_on(
        self, parents: FloatArray, births: tuple[Any, ...], places: tuple[int, int, bool], recentres: bool = True
    ) -> Hypotheses:
        """Propagate copies of records; `births` are their children, times and counts."""
        children, times, counts = map(np.ascontiguousarray, births)
        records, last = np.empty((len(counts), self.record_size)), places[1]
        addresses = map(get_address, (records, parents, children, times, counts))
        ends = last == self._cells, recentres and self._recentres
        count_work(CALL + len(records) * (last - places[0]) * self._cell_work)
        self._propagate(self._table_at, *addresses, times.shape[1], *places, len(records), *ends)
        return self.view(records)

    def view(self, records: FloatArray) -> Hypotheses:
        """Return what records (B, size) hold, as views."""
        at, B, (n, D, width) = self._at, len(records), self._shape
        H, Z = records[:, at["H"]].reshape(B, D, width)[..., :D], records[:, at["Z"]].reshape(B, n, width)[..., :D]
        g, scores, costs = records[:, at["g"]][:, :D], records[:, at["score"].start], records[:, at["J"].start]
        return Hypotheses(scores, costs, g, H, records[:, at["moved"]], records[:, at["x"]], Z, records)
