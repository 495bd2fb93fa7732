"""Sort traced arrays, and search in sorted ones, unrolled into comparisons and selections."""

from __future__ import annotations

import numpy as np

from switchfit.engine.native.scalars.graph import Graph, Node, Objects, Scalar, as_objects
from switchfit.engine.native.tracing.entries import (
    MOST_ROWS_OF_TABLE,
    Entry,
    Integer,
    TracedArray,
    choose,
    clamp,
    known_number,
    less,
)
from switchfit.engine.native.tracing.unsupported import Unsupported, check_size
from switchfit.runtime.jax_internals import Equation, array_type

MOST_SORTED = 16
"""Largest number of entries to sort. n entries take n (n - 1) / 2 comparisons, each followed by selections."""

Row = tuple[Entry, ...]
"""Entries that move together: one of each array that is sorted."""


def sort(graph: Graph, equation: Equation, *arrays: TracedArray) -> list[TracedArray]:
    """Trace `jax.lax.sort`: stable, NaN last, by the first array."""
    axis, shape = equation.params["dimension"], arrays[0].shape
    if equation.params["num_keys"] > 1:
        raise Unsupported("sorts by several keys what depends on the state")
    is_double = array_type(equation.invars[0]).dtype.kind == "f"
    rows = [np.moveaxis(a, axis, -1).reshape(-1, shape[axis]) for a in arrays]
    found = [np.empty(row.shape, dtype=object) for row in rows]
    for k in range(len(rows[0])):
        entries = _sort_entries(graph, list(zip(*(row[k].tolist() for row in rows), strict=True)), is_double)
        for to, column in zip(found, zip(*entries, strict=True), strict=True):
            to[k] = as_objects(column)
    moved = tuple(n for k, n in enumerate(shape) if k != axis)
    return [np.moveaxis(each.reshape(*moved, shape[axis]), -1, axis) for each in found]


def _sort_entries(graph: Graph, entries: list[Row], is_double: bool) -> list[Row]:
    """Sort entries by exchanging neighbors."""
    n = len(entries)
    check_size(n, MOST_SORTED, f"sorts {n} numbers that depend on the state")
    for front in range(n - 1):
        for k in reversed(range(front, n - 1)):
            one, other = entries[k], entries[k + 1]
            a, b = one[0], other[0]
            # of doubles, a > b, or a is NaN and b is not
            swap = (
                less(graph, b, a)
                if not is_double
                else graph.apply("and", graph.apply("not", graph.apply("le", a, b)), graph.apply("eq", b, b))
            )
            entries[k] = tuple(choose(graph, swap, b, a) for a, b in zip(one, other, strict=True))
            entries[k + 1] = tuple(choose(graph, swap, a, b) for a, b in zip(one, other, strict=True))
    return entries


# Searching sorted arrays


def compare_in_order(graph: Graph, op: str, a: Entry, b: Entry) -> Node:
    """Return whether a < b ("lt") or a <= b ("le") in the order in which NaN comes after all numbers."""
    undefined = graph.apply("ne", b, b)
    if op == "lt":
        undefined = graph.apply("and", undefined, graph.apply("eq", a, a))
    return graph.apply("or", graph.apply(op, a, b), undefined)


def search(graph: Graph, table: TracedArray, query: TracedArray, right: bool) -> Objects | None:
    """Trace `jnp.searchsorted`: the insertion index of each number in a sorted table of known ones, (K,).

    It is a bisection in memory, in a fixed number of log2 K steps. None for any other table.
    """
    numbers = np.array([known_number(e) for e in table.tolist()], dtype=float)  # NaN for what is not known
    if np.isnan(numbers).any() or (np.diff(numbers) < 0.0).any():
        return None
    K = len(numbers)
    check_size(K, MOST_ROWS_OF_TABLE, f"searches a table of {K} entries")
    turns = K.bit_length()
    padded = np.concatenate([numbers, np.full(2**turns - 1 - K, np.inf)])

    def place(x: Scalar) -> Entry:
        found = graph.constant(0.0)
        for step in (2**k for k in reversed(range(turns))):
            entry = graph.lookup(padded, found + float(step - 1))
            beyond = graph.apply("not", graph.apply("lt" if right else "le", x, entry))  # NaN comes after all numbers
            found = graph.apply("select", beyond, found + float(step), found)
        return clamp(graph, Integer(found, 0, 2**turns - 1), 0, K)

    return as_objects([place(x) for x in np.ravel(query).tolist()]).reshape(np.shape(query))
