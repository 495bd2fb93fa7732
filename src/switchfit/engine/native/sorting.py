"""Sorting and searching, unrolled into comparisons and selections."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np

from switchfit.engine.native.entries import (
    MOST_CHOICES,
    MOST_ROWS_OF_TABLE,
    Integer,
    Unsupported,
    both,
    choose,
    equal,
    is_traced,
    known_number,
    less,
)
from switchfit.engine.native.scalars import Graph, Node, as_objects

MOST_SORTED = 16
"""Largest number of entries to sort. n entries take n (n - 1) / 2 comparisons, each followed by selections."""

Entries = tuple[Any, ...]
"""Entries that move together: one of each array that is sorted."""


def sort(graph: Graph, equation: Any, *arrays: Any) -> list[Any]:
    """Trace `jax.lax.sort`: stable, NaN last, by the first `num_keys` arrays."""
    params = equation.params
    axis, keys = params["dimension"], params["num_keys"]
    kinds = [variable.aval.dtype.kind for variable in equation.invars[:keys]]

    def behind(one: Entries, other: Entries) -> Any:
        return _is_behind(graph, kinds, one[:keys], other[:keys])

    shape = arrays[0].shape
    rows = [np.moveaxis(a, axis, -1).reshape(-1, shape[axis]) for a in arrays]
    found = [np.empty(row.shape, dtype=object) for row in rows]
    for k in range(len(rows[0])):
        entries = _sort_entries(graph, list(zip(*(row[k].tolist() for row in rows), strict=True)), behind)
        for to, column in zip(found, zip(*entries, strict=True), strict=True):
            to[k] = as_objects(column)
    moved = tuple(n for k, n in enumerate(shape) if k != axis)
    return [np.moveaxis(each.reshape(*moved, shape[axis]), -1, axis) for each in found]


def _sort_entries(
    graph: Graph, entries: list[Entries], behind: Callable[[Entries, Entries], Any], first: int | None = None
) -> list[Entries]:
    """Sort entries, or only until the `first` ones are in place, by exchanging neighbors."""
    n = len(entries)
    if n > MOST_SORTED:
        raise Unsupported(f"sorts {n} numbers that depend on the state (limit: {MOST_SORTED})")
    entries = list(entries)
    for front in range(n - 1 if first is None else min(first, n - 1)):
        for k in reversed(range(front, n - 1)):
            one, other = entries[k], entries[k + 1]
            swap = behind(one, other)
            entries[k] = tuple(choose(graph, swap, b, a) for a, b in zip(one, other, strict=True))
            entries[k + 1] = tuple(choose(graph, swap, a, b) for a, b in zip(one, other, strict=True))
    return entries


def _is_behind(graph: Graph, kinds: list[str], one: Entries, other: Entries) -> Any:
    """Return whether an entry comes after another by the first key in which they differ."""
    kind, a, b = kinds[0], one[0], other[0]
    if kind == "f":  # a > b, or a is NaN and b is not
        behind = graph.apply("and", graph.apply("not", graph.apply("le", a, b)), graph.apply("eq", b, b))
    else:
        behind = less(graph, b, a)
    if len(kinds) == 1:
        return behind
    if kind == "f":
        undefined = graph.apply("and", graph.apply("ne", a, a), graph.apply("ne", b, b))
        same: Any = graph.apply("or", graph.apply("eq", a, b), undefined)
    else:
        same = equal(graph, a, b)
    later = both(graph, same, _is_behind(graph, kinds[1:], one[1:], other[1:]))
    return choose(graph, behind, True, later) if isinstance(behind, Node) else behind or later


def top_k(graph: Graph, equation: Any, a: Any) -> list[Any]:
    """Trace `jax.lax.top_k`: the largest entries and their indices; NaN counts as largest, ties keep their order.

    Unlike in a sort, 0.0 is larger than -0.0. The reciprocal of each entry moves with it and tells the two apart.
    """
    k, kind = equation.params["k"], equation.invars[0].aval.dtype.kind

    def behind(one: Entries, other: Entries) -> Any:
        found = _is_behind(graph, [kind], other, one)
        if kind != "f":
            return found
        zeros = graph.apply("and", graph.apply("eq", one[0], other[0]), graph.apply("lt", one[2], other[2]))
        return graph.apply("or", found, zeros)

    shape = (*a.shape[:-1], k)
    values, places = np.empty((2, int(np.prod(shape[:-1])), k), dtype=object)
    for row, to, at in zip(a.reshape(-1, a.shape[-1]), values, places, strict=True):
        reciprocals = [graph.apply("div", 1.0, value) if kind == "f" else 0 for value in row]
        found = _sort_entries(graph, list(zip(row.tolist(), range(len(row)), reciprocals, strict=True)), behind, k)[:k]
        to[:], at[:], _ = (as_objects(column) for column in zip(*found, strict=True))
    return [values.reshape(shape), places.reshape(shape)]


# Searching sorted arrays


def compare_in_order(graph: Graph, op: str, a: Any, b: Any) -> Any:
    """Return whether a < b ("lt") or a <= b ("le") in the order in which NaN comes after all numbers."""
    undefined = graph.apply("ne", b, b)
    if op == "lt":
        undefined = graph.apply("and", undefined, graph.apply("eq", a, a))
    return graph.apply("or", graph.apply(op, a, b), undefined)


def search(graph: Graph, table: Any, query: Any, right: bool) -> Any:
    """Trace `jnp.searchsorted`: the insertion index of each number in a sorted table (K,)."""
    entries = [known_number(e) if is_traced(e) else e for e in table.tolist()]
    numbers = None if None in entries else np.array(entries, dtype=float)
    of_constants = numbers is not None and not any(a > b for a, b in pairwise(numbers)) and not np.isnan(numbers).any()

    def place(x: Any) -> Any:
        if of_constants:
            return _search_constants(graph, numbers, x, right)
        return _search(graph, table.tolist(), x, right)

    return as_objects([place(x) for x in np.ravel(query).tolist()]).reshape(np.shape(query))


def _search(graph: Graph, table: list[Any], x: Any, right: bool) -> Any:
    """Bisect with JAX's comparisons, written out for all branches."""

    if len(table) > MOST_CHOICES:
        raise Unsupported(f"searches {len(table)} numbers that depend on the state (limit: {MOST_CHOICES})")

    def between(low: int, high: int, turns: int) -> Any:
        if turns == 0:
            return high
        middle = low + (high - low) // 2
        entry = table[min(middle, len(table) - 1)]
        # Insert before equal entries, or after them (`right`).
        left = compare_in_order(graph, "lt", x, entry) if right else compare_in_order(graph, "le", x, entry)
        return choose(graph, left, between(low, middle, turns - 1), between(middle, high, turns - 1))

    return between(0, len(table), int(np.ceil(np.log2(len(table) + 1))))


def _search_constants(graph: Graph, table: Any, x: Any, right: bool) -> Any:
    """Bisect a constant table in memory, in a fixed number of log2 K steps."""
    K = len(table)
    if K > MOST_ROWS_OF_TABLE:
        raise Unsupported(f"searches a table of {K} entries (limit: {MOST_ROWS_OF_TABLE})")
    turns = K.bit_length()
    padded = np.concatenate([table, np.full(2**turns - 1 - K, np.inf)])
    found: Any = graph.constant(0.0)
    for step in (2**k for k in reversed(range(turns))):
        last = found + float(step - 1)
        entry = graph.lookup(padded, last)
        beyond = graph.apply("not", graph.apply("lt" if right else "le", x, entry))  # NaN comes after all numbers
        found = graph.apply("select", beyond, found + float(step), found)
    most = float(K)
    if 2**turns - 1 > K:
        found = graph.apply("select", graph.apply("lt", most, found), most, found)
    return Integer(found, 0, K) if found.number is None else int(found.number)
