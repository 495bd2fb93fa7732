"""Sorting, as functions of JAX without loops, which `trace` traces in place of its operations; searching."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

import jax.numpy as jnp
import numpy as np

from switchfit.engine.native.entries import (
    MOST_CHOICES,
    MOST_ROWS_OF_TABLE,
    Integer,
    Unsupported,
    choose,
    is_traced,
    known_number,
)
from switchfit.engine.native.scalars import Graph, as_objects

MOST_SORTED = 16
"""Largest number of entries to sort. n entries take n (n - 1) / 2 comparisons, each followed by selections."""

Entries = tuple[Any, ...]
"""Entries that move together: one of each array that is sorted."""


def sort(*arrays: Any, dimension: int, num_keys: int, **_: Any) -> list[Any]:
    """Return what `jax.lax.sort` does: stable, NaN last, by the first `num_keys` arrays."""
    entries = list(zip(*(jnp.moveaxis(a, dimension, 0) for a in arrays), strict=True))
    found = _sort_entries(entries, lambda one, other: _is_behind(one[:num_keys], other[:num_keys]))
    return [jnp.stack(column, axis=dimension) for column in zip(*found, strict=True)]


def _sort_entries(entries: list[Entries], behind: Callable[[Entries, Entries], Any], first: int = MOST_SORTED) -> Any:
    """Sort entries, or only until the `first` ones are in place, by exchanging neighbors."""
    n = len(entries)
    if n > MOST_SORTED:
        raise Unsupported(f"sorts {n} numbers that depend on the state (limit: {MOST_SORTED})")
    for front in range(min(first, n - 1)):
        for k in reversed(range(front, n - 1)):
            one, other = entries[k], entries[k + 1]
            swap = behind(one, other)
            entries[k] = tuple(jnp.where(swap, b, a) for a, b in zip(one, other, strict=True))
            entries[k + 1] = tuple(jnp.where(swap, a, b) for a, b in zip(one, other, strict=True))
    return entries


def _is_behind(one: Sequence[Any], other: Sequence[Any]) -> Any:
    """Return whether an entry comes after another by the first key in which they differ."""
    (a, *rest), (b, *others) = one, other
    behind = ~(a <= b) & (b == b)  # a > b, or a is NaN and b is not
    if not rest:
        return behind
    same = (a == b) | ((a != a) & (b != b))
    return behind | (same & _is_behind(rest, others))


def top_k(a: Any, *, k: int, **_: Any) -> list[Any]:
    """Return what `jax.lax.top_k` does: the largest entries and their indices; NaN counts as largest.

    Ties keep their order. Unlike in a sort, 0.0 is larger than -0.0: their reciprocals tell the two apart.
    """
    values = list(jnp.moveaxis(a, -1, 0))

    def behind(one: Entries, other: Entries) -> Any:
        found = _is_behind(other[:1], one[:1])
        if a.dtype.kind != "f":
            return found
        return found | ((one[0] == other[0]) & (1.0 / one[0] < 1.0 / other[0]))

    entries = [(value, jnp.full(value.shape, place, np.int32)) for place, value in enumerate(values)]
    return [jnp.stack(column, axis=-1) for column in zip(*_sort_entries(entries, behind, k)[:k], strict=True)]


def find_extreme(a: Any, *, axes: Sequence[int], index_dtype: Any, beyond: Callable[[Any, Any], Any]) -> list[Any]:
    """Return the index of the largest (smallest) entry along an axis, the first of several; NaN counts as extreme."""
    beyond_or_nan = lambda one, other: beyond(one, other) | ((one != one) & (other == other))  # noqa: E731
    return [find_first(beyond_or_nan, jnp.moveaxis(a, axes[0], 0), index_dtype)]


def find_first(beyond: Callable[[Any, Any], Any], values: Any, dtype: Any) -> Any:
    """Return the index of the first value beyond which there is none, along the first axis."""
    best, *others = values
    found = jnp.zeros(best.shape, dtype)
    for k, value in enumerate(others, start=1):
        better = beyond(value, best)
        best, found = jnp.where(better, value, best), jnp.where(better, np.asarray(k, dtype), found)
    return found


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
