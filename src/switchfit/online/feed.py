"""The nodes and samples of a log that grows, in arrays that machine code reads in place."""

from __future__ import annotations

from typing import Any

from switchfit.engine.native.hypotheses import NativeHypotheses
from switchfit.problem.data import FloatArray


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
    """

    def __init__(self, engine: NativeHypotheses, t0: float, capacity: int) -> None:
        self.capacity, self.count = capacity, 1
        self._nodes, self._signals, self._samples = engine.reserve(capacity, capacity)
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

    def signal(self, node: int) -> FloatArray:
        """Return the coefficients of the signals in the cell after a node, (4, S), to be written."""
        return self._signals[node]

    def find(self, time: float) -> int:
        """Return the last node that is not later than a time; -1 if all are."""
        if time >= self._nodes[self.count - 1]:
            return self.count - 1
        return int(self.nodes.searchsorted(time, "right")) - 1

    def append(self, time: float) -> int:
        """Add a node at the end; the signals of the cell before it are the caller's to write."""
        node = self.count
        if node > self.capacity:
            raise ValueError(f"there is no room for more than {self.capacity} times: raise capacity=, or set window=.")
        self._nodes[node] = time
        self.count += 1
        for first, *_ in self._samples:
            first[node + 1] = first[node]
        return node

    def insert(self, node: int, time: float) -> None:
        """Put a node between two others; it becomes `node`, and later ones move on. A cell is cut in two."""
        self.append(self.last)
        end = self.count
        self._nodes[node + 1 : end] = self._nodes[node : end - 1].copy()
        self._signals[node : end - 1] = self._signals[node - 1 : end - 2].copy()
        self._nodes[node] = time
        s, (c0, c1, c2, c3) = time - self._nodes[node - 1], self._signals[node - 1]
        self._signals[node] = c0 + s * (c1 + s * (c2 + s * c3)), c1 + s * (2 * c2 + 3 * s * c3), c2 + 3 * s * c3, c3
        for first, *_ in self._samples:
            first[node + 1 : end + 1] = first[node:end].copy()

    def add(self, k: int, node: int, value: FloatArray, weight: FloatArray) -> None:
        """Add a sample (q,) of sensor k at a node."""
        first, times, values, weights = self._samples[k]
        place, end = first[node + 1], first[self.count]
        if end == self.capacity:
            raise ValueError(f"there is no room for more than {end} samples: raise capacity=, or set window=.")
        if place < end:
            for array in (times, values, weights):
                array[place + 1 : end + 1] = array[place:end].copy()
        times[place], values[place], weights[place] = self._nodes[node], value, weight
        first[node + 1 : self.count + 1] += 1

    def has_sample(self, k: int, node: int) -> bool:
        """Return whether sensor k has a sample at a node."""
        first = self._samples[k][0]
        return bool(first[node + 1] > first[node])

    def drop(self, node: int) -> None:
        """Forget all nodes before one, which becomes the first, and the samples up to and at it."""
        end = self.count
        self._nodes[: end - node] = self._nodes[node:end].copy()
        self._signals[: end - 1 - node] = self._signals[node : end - 1].copy()
        self.count -= node
        for first, *arrays in self._samples:
            gone, last = first[node + 1], first[end]
            for array in arrays:
                array[: last - gone] = array[gone:last].copy()
            first[: self.count + 1] = first[node : end + 1] - gone
            first[0] = 0

    def copy_arrays(self) -> dict[str, Any]:
        """Return what is in the log, by name, for `set_arrays`."""
        found: dict[str, Any] = {"nodes": self.nodes.copy(), "signals": self._signals[: self.count].copy()}
        for k, (first, *_) in enumerate(self._samples):
            arrays = zip(("times", "values", "weights"), self.samples(k), strict=True)
            found |= {f"{name} {k}": array.copy() for name, array in arrays}
            found[f"first {k}"] = first[: self.count + 1].copy()
        return found

    def set_arrays(self, given: dict[str, FloatArray]) -> None:
        """Replace the log by one that was copied."""
        self.count = len(given["nodes"])
        self._nodes[: self.count], self._signals[: self.count] = given["nodes"], given["signals"]
        for k, (first, *arrays) in enumerate(self._samples):
            for name, array in zip(("times", "values", "weights"), arrays, strict=True):
                array[: len(given[f"{name} {k}"])] = given[f"{name} {k}"]
            first[: self.count + 1] = given[f"first {k}"]
