"""Entries of traced arrays, and selections among them at run time.

An entry is a Python number, a node (a double, or a truth value in an array of booleans), or an `Integer`: one that
depends on the state, as a double with bounds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from switchfit.engine.native.scalars.graph import Graph, Node
from switchfit.engine.native.tracing.unsupported import check_size

Entry: TypeAlias = Any
"""A known number or truth value; or what depends on the state: an `Integer` in an array of integers, else a node. Which
of these it is follows from the type of the array, which no checker of types knows."""

TracedArray: TypeAlias = NDArray[Any]
"""An array of numbers if all of its entries are known, else an array of objects, its entries."""

Parameters: TypeAlias = Mapping[str, Any]
"""Parameters of an operation of JAX, by their names there."""

MOST_CHOICES = 64
"""Largest number of state-dependent entries from which an index selects: each takes a comparison and a selection."""

MOST_SELECTIONS = 4
"""Largest number of known entries from which an index selects by comparisons; more become a table in memory."""

MOST_ROWS_OF_TABLE = 100_000
"""Largest number of entries of a table in memory. It is part of the module's text: 2 MB at this size."""


@dataclass(frozen=True, slots=True)
class Integer:
    """An integer that depends on the state.

    Attributes
    ----------
    node : Node
        Its value, as a double; it is finite, and never -0.0.
    low, high : int
        Inclusive bounds of its value, far below 2**53, so that arithmetic with doubles is exact.
    """

    node: Node
    low: int
    high: int

    @classmethod
    def of(cls, graph: Graph, value: Entry) -> Integer:
        """Convert a known integer or a truth value to an `Integer`; return an `Integer` as it is."""
        if isinstance(value, Integer):
            return value
        if isinstance(value, Node):
            return cls(graph.apply("select", value, 1.0, 0.0), 0, 1)
        return cls(graph.constant(float(value)), int(value), int(value))


def _is_known_integer(value: object) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def choose(graph: Graph, condition: Entry, yes: Entry, no: Entry) -> Entry:
    """Select one of two entries of the same type; the condition may be known or traced."""
    known = known_number(condition)
    if known is not None:
        return yes if known else no
    # Two known integers become one that is not known, but has bounds: an index by it needs no check of its range.
    if isinstance(yes, Integer) or isinstance(no, Integer) or (_is_known_integer(yes) and _is_known_integer(no)):
        one, other = Integer.of(graph, yes), Integer.of(graph, no)
        node = graph.apply("select", condition, one.node, other.node)
        return Integer(node, min(one.low, other.low), max(one.high, other.high))
    return graph.apply("select", condition, yes, no)


def less(graph: Graph, a: Entry, b: Entry) -> Entry:
    """Return whether a < b for integers: a bool if their bounds decide it."""
    # By the bounds alone where they suffice: the comparison is then a number, and whatever it selects is known.
    one, other = Integer.of(graph, a), Integer.of(graph, b)
    if one.high < other.low:
        return True
    if one.low >= other.high:
        return False
    return graph.apply("lt", one.node, other.node)


def equal(graph: Graph, a: Entry, b: Entry) -> Entry:
    """Return whether a == b for integers: a bool if their bounds decide it."""
    one, other = Integer.of(graph, a), Integer.of(graph, b)
    if one.high < other.low or other.high < one.low:
        return False
    if one.node is other.node or one.low == one.high == other.low == other.high:
        return True
    return graph.apply("eq", one.node, other.node)


def clamp(graph: Graph, index: Entry, low: int, high: int) -> Entry:
    """Clamp an integer to a range; return an int if the result is known."""
    if not isinstance(index, Integer):
        return min(max(int(index), low), high)
    # Bounds inside the range make both selections vanish.
    found = choose_extreme(graph, min, high, choose_extreme(graph, max, low, index))
    return found.low if found.low == found.high else found


def pick(graph: Graph, entries: Sequence[Entry], index: Integer) -> Entry:
    """Select an entry by an index; the first entry belongs to `index.low`, the last one to `index.high`.

    Equal neighbors are merged, so that one number in a row of zeros takes two selections. More than a few known numbers
    become a table in memory, whose lookup takes the same time for any size.
    """
    starts = [k for k in range(len(entries)) if k == 0 or not _is_same(entries[k - 1], entries[k])]
    if len(starts) == 1:
        return entries[0]
    if len(starts) > MOST_SELECTIONS and all(known_number(e) is not None for e in entries):
        return _look_up(graph, list(map(known_number, entries)), index)
    count = len(starts)
    check_size(count, MOST_CHOICES, f"takes one of {count} numbers by an index that depends on the state")

    # A binary tree over the runs of equal entries: each passes log2 of their number in selections.
    def select_run(runs: list[int]) -> Entry:
        if len(runs) == 1:
            return entries[runs[0]]
        middle = len(runs) // 2
        before = less(graph, index, index.low + runs[middle])
        return choose(graph, before, select_run(runs[:middle]), select_run(runs[middle:]))

    return select_run(starts)


def known_number(entry: Entry) -> float | None:
    """Return the value of an entry; None if it depends on the state."""
    if isinstance(entry, Node):
        return entry.number
    return None if isinstance(entry, Integer) else entry


def _is_same(one: Entry, other: Entry) -> bool:
    if isinstance(one, Integer) and isinstance(other, Integer):
        return one.node is other.node
    # 0.0 and -0.0 differ, as 1 / x shows; a NaN is the same as any other.
    a, b = known_number(one), known_number(other)
    if a is None or b is None:
        return one is other
    return bool((a == b and np.signbit(a) == np.signbit(b)) or (a != a and b != b))


def _look_up(graph: Graph, entries: Sequence[Entry], index: Integer) -> Entry:
    check_size(len(entries), MOST_ROWS_OF_TABLE, f"looks up numbers in a table of {len(entries)} entries")
    # The table begins with the entry of `index.low`.
    node = graph.lookup(np.array(entries, dtype=float), index.node - float(index.low))
    if all(isinstance(e, bool | np.bool_) for e in entries):
        return graph.apply("ne", node, 0.0)
    if all(_is_known_integer(e) for e in entries):
        return Integer(node, int(min(entries)), int(max(entries)))
    return node


def choose_extreme(graph: Graph, extreme: Callable[..., int], a: Entry, b: Entry) -> Integer:
    """Return the smaller (larger) of two integers, as Python's `min` (`max`) does for bounds."""
    one, other = Integer.of(graph, a), Integer.of(graph, b)
    is_first = less(graph, one, other) if extreme is min else less(graph, other, one)
    node = choose(graph, is_first, one, other).node
    return Integer(node, extreme(one.low, other.low), extreme(one.high, other.high))
