"""The nodes, signals and samples of a log that grows, in arrays that machine code reads in place.

The arrays have room for the whole capacity from the beginning and never move, since compiled programs hold their
addresses; of each only the beginning is in use, and what is put in shifts what is behind it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.engine.native.native_hypotheses import NativeHypotheses


class Feed:
    """Nodes, signals and samples of a growing log, with room for a number of them.

    Nodes are all times of samples, and others between them. Samples that come late are put in where they belong.

    Parameters
    ----------
    engine : NativeHypotheses
        Whose arrays are replaced.
    t0 : float
        First node.
    capacity : int
        Of nodes, and of samples of each sensor.

    Attributes
    ----------
    signals : (capacity, 4, S)
        Coefficients of the signals in the cell after each node.
    """

    def __init__(self, engine: NativeHypotheses, t0: float, capacity: int) -> None:
        self.capacity, self.count = capacity, 1
        self._nodes, self.signals, self._samples = engine.reserve(capacity, capacity)
        self._nodes[0] = t0

    @property
    def nodes(self) -> FloatArray:
        """The nodes so far."""
        return self._nodes[: self.count]

    @property
    def last(self) -> float:
        """The last node."""
        return float(self._nodes[self.count - 1])

    def samples(self, k: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return times (K,), values and weights (K, q) of the samples of sensor k so far."""
        first, times, values, weights = self._samples[k]
        end = first[self.count]
        return times[:end], values[:end], weights[:end]

    def find(self, time: float) -> int:
        """Return the last node that is not later than a time; -1 if all are."""
        # The usual case, a sample that is the newest, needs no search.
        if time >= self._nodes[self.count - 1]:
            return self.count - 1
        return int(self.nodes.searchsorted(time, "right")) - 1

    def insert(self, time: float) -> int:
        """Put a node where it belongs, and return it. A cell between two others is cut in two; the signals of one at
        the end are the caller's to write.
        """
        node, end = self.find(time) + 1, self.count
        if end > self.capacity:
            raise ValueError(f"there is no room for more than {self.capacity} times: raise capacity=, or set window=.")
        if node < end:
            # Copies, since source and target overlap; this is the rare case of a late sample.
            self._nodes[node + 1 : end + 1] = self._nodes[node:end].copy()
            self.signals[node:end] = self.signals[node - 1 : end - 1].copy()
            # A cell that is cut keeps its cubic on the left; on the right it counts from the new node.
            self.signals[node] = shift_cubic(self.signals[node - 1], time - self._nodes[node - 1])
        self._nodes[node] = time
        # `first[j]` is the number of samples before node j: the new node has none, and all behind it move by one.
        for first, *_ in self._samples:
            first[node + 1 : end + 2] = first[node : end + 1].copy()
        self.count += 1
        return node

    def add(self, k: int, node: int, value: FloatArray, weight: FloatArray) -> None:
        """Add a sample (q,) of sensor k at a node."""
        first, times, values, weights = self._samples[k]
        place, end = first[node + 1], first[self.count]
        if end == self.capacity:
            raise ValueError(f"there is no room for more than {end} samples: raise capacity=, or set window=.")
        # Samples stand in the order of their nodes, as machine code walks through them.
        if place < end:
            for array in (times, values, weights):
                array[place + 1 : end + 1] = array[place:end].copy()
        times[place], values[place], weights[place] = self._nodes[node], value, weight
        # A running count: all nodes behind have one sample more before them.
        first[node + 1 : self.count + 1] += 1

    def has_sample(self, k: int, node: int) -> bool:
        """Return whether sensor k has a sample at a node."""
        first = self._samples[k][0]
        return bool(first[node + 1] > first[node])

    def drop(self, node: int) -> None:
        """Forget all nodes before one, which becomes the first, and the samples up to and at it."""
        end = self.count
        self._nodes[: end - node] = self._nodes[node:end].copy()
        self.signals[: end - 1 - node] = self.signals[node : end - 1].copy()
        self.count -= node
        for first, *arrays in self._samples:
            # Samples at the node itself are in the start of the window, which counts them.
            gone, last = first[node + 1], first[end]
            for array in arrays:
                array[: last - gone] = array[gone:last].copy()
            first[: self.count + 1] = first[node : end + 1] - gone
            first[0] = 0

    def copy_arrays(self) -> dict[str, Any]:
        """Return what is in the log, by name, for `set_arrays`."""
        lengths = {"nodes": self.count, "signals": self.count}
        for k, (first, *_) in enumerate(self._samples):
            lengths |= {f"{k} 0": self.count + 1} | {f"{k} {i}": int(first[self.count]) for i in (1, 2, 3)}
        return {name: array[: lengths[name]] for name, array in self._arrays.items()}

    def set_arrays(self, given: dict[str, FloatArray]) -> None:
        """Replace the log by one that was copied."""
        self.count = len(given["nodes"])
        for name, array in self._arrays.items():
            array[: len(given[name])] = given[name]

    @property
    def _arrays(self) -> dict[str, Any]:
        """All arrays by name; only the beginning of each is in use."""
        samples = {f"{k} {i}": array for k, arrays in enumerate(self._samples) for i, array in enumerate(arrays)}
        return {"nodes": self._nodes, "signals": self.signals, **samples}


def shift_cubic(coefficients: FloatArray, s: float) -> FloatArray:
    """Return the coefficients (4, S) of cubics in the time since a moment that is s later."""
    c0, c1, c2, c3 = coefficients
    return np.stack([c0 + s * (c1 + s * (c2 + s * c3)), c1 + s * (2 * c2 + 3 * s * c3), c2 + 3 * s * c3, c3])
