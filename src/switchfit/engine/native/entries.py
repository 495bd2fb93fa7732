"""Entries of traced arrays, and selections among them at run time.

An entry is a Python number, a node (a double, or a truth value in an array of booleans), or an `Integer`.

Arithmetic with integers that depend on the state, as doubles.

Each `Integer` has bounds. If they allow a result to overflow its type, or to be too large for doubles to be exact, the
program checks the result at run time (`Graph.require`), and falls back to JAX if it is too large.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from switchfit.engine.native.scalars import Graph, Node


class Unsupported(Exception):  # noqa: N818  # control flow, not an error: the caller falls back to JAX
    """A function that cannot be written as a straight line of scalars.

    Attributes
    ----------
    what : str
        What it does, as the rest of a sentence that begins with the function: "calls jnp.sort".
    where : str or None
        File and line of the user's code, if known.
    """

    def __init__(self, what: str, where: str | None = None) -> None:
        super().__init__(what, where)
        self.what, self.where = what, where

    def __str__(self) -> str:
        return self.what if self.where is None else f"{self.what} ({self.where})"


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
    def of(cls, graph: Graph, value: Any) -> Integer:
        """Convert a known integer or a truth value to an `Integer`; return an `Integer` as it is."""
        if isinstance(value, Integer):
            return value
        if isinstance(value, Node):
            return cls(graph.apply("select", value, 1.0, 0.0), 0, 1)
        return cls(graph.constant(float(value)), int(value), int(value))


def _is_known_integer(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def choose(graph: Graph, condition: Any, yes: Any, no: Any) -> Any:
    """Select one of two entries of the same type; the condition may be known or traced."""
    known = known_number(condition)
    if known is not None:
        return yes if known else no
    if isinstance(yes, Integer) or isinstance(no, Integer) or (_is_known_integer(yes) and _is_known_integer(no)):
        one, other = Integer.of(graph, yes), Integer.of(graph, no)
        node = graph.apply("select", condition, one.node, other.node)
        return Integer(node, min(one.low, other.low), max(one.high, other.high))
    return graph.apply("select", condition, yes, no)


def less(graph: Graph, a: Any, b: Any) -> Any:
    """Return whether a < b for integers: a bool if their bounds decide it."""
    one, other = Integer.of(graph, a), Integer.of(graph, b)
    if one.high < other.low:
        return True
    if one.low >= other.high:
        return False
    return graph.apply("lt", one.node, other.node)


def equal(graph: Graph, a: Any, b: Any) -> Any:
    """Return whether a == b for integers: a bool if their bounds decide it."""
    one, other = Integer.of(graph, a), Integer.of(graph, b)
    if one.high < other.low or other.high < one.low:
        return False
    if one.node is other.node or one.low == one.high == other.low == other.high:
        return True
    return graph.apply("eq", one.node, other.node)


def clamp(graph: Graph, index: Any, low: int, high: int) -> Any:
    """Clamp an integer to a range; return an int if the result is known."""
    if not isinstance(index, Integer):
        return min(max(int(index), low), high)
    found = _choose_extreme(graph, min, high, _choose_extreme(graph, max, low, index))
    return found.low if found.low == found.high else found


def pick(graph: Graph, entries: Sequence[Any], index: Integer) -> Any:
    """Select an entry by an index; the first entry belongs to `index.low`, the last one to `index.high`.

    Equal neighbors are merged, so that one number in a row of zeros takes two selections. More than a few known numbers
    become a table in memory, whose lookup takes the same time for any size.
    """
    starts = [k for k in range(len(entries)) if k == 0 or not _is_same(entries[k - 1], entries[k])]
    if len(starts) == 1:
        return entries[0]
    if len(starts) > MOST_SELECTIONS and all(known_number(e) is not None for e in entries):
        return _look_up(graph, list(map(known_number, entries)), index)
    if len(starts) > MOST_CHOICES:
        raise Unsupported(
            f"takes one of {len(starts)} numbers by an index that depends on the state (limit: {MOST_CHOICES})"
        )

    def select_run(runs: list[int]) -> Any:
        if len(runs) == 1:
            return entries[runs[0]]
        middle = len(runs) // 2
        before = less(graph, index, index.low + runs[middle])
        return choose(graph, before, select_run(runs[:middle]), select_run(runs[middle:]))

    return select_run(starts)


def known_number(entry: Any) -> Any:
    """Return the value of an entry; None if it depends on the state."""
    if isinstance(entry, Node):
        return entry.number
    return None if isinstance(entry, Integer) else entry


def _is_same(one: Any, other: Any) -> bool:
    if isinstance(one, Integer) and isinstance(other, Integer):
        return one.node is other.node
    a, b = known_number(one), known_number(other)
    if a is None or b is None:
        return one is other
    return bool((a == b and np.signbit(a) == np.signbit(b)) or (a != a and b != b))


def _look_up(graph: Graph, entries: Sequence[Any], index: Integer) -> Any:
    if len(entries) > MOST_ROWS_OF_TABLE:
        raise Unsupported(f"looks up numbers in a table of {len(entries)} entries (limit: {MOST_ROWS_OF_TABLE})")
    node = graph.lookup(np.array(entries, dtype=float), index.node - float(index.low))
    if all(isinstance(e, bool | np.bool_) for e in entries):
        return graph.apply("ne", node, 0.0)
    if all(_is_known_integer(e) for e in entries):
        return Integer(node, int(min(entries)), int(max(entries)))
    return node


Meaning = Callable[[Graph, Any, np.dtype[Any]], Callable[..., Any]]
"""Takes a graph, the parameters of a JAX operation and the type of its result; returns the operation on entries."""

LARGEST = 2**51
"""Bound below which sums, products and quotients of doubles are exact for integers."""


def _bounds(dtype: np.dtype[Any]) -> tuple[int, int]:
    info = np.iinfo(dtype)
    return max(info.min, -LARGEST), min(info.max, LARGEST)


def within(graph: Graph, found: Integer, dtype: np.dtype[Any]) -> Any:
    """Return an integer as one of a type, clamped to its range: it may be an index of memory."""
    least, most = _bounds(dtype)
    if found.high < least or found.low > most:
        raise Unsupported(f"does arithmetic with integers beyond {most}")
    inside = clamp(graph, found, least, most)
    if found.low < least or found.high > most:
        graph.require(graph.apply("eq", found.node, Integer.of(graph, inside).node))
    return inside


def _exactly(op: str, value: Callable[..., int]) -> Meaning:
    """Return an operation on doubles; its result is between the extremes at the bounds of the operands and at zero."""

    def get_meaning(graph: Graph, params: Any, dtype: np.dtype[Any]) -> Callable[..., Any]:
        def apply(*given: Any) -> Any:
            args = [Integer.of(graph, a) for a in given]
            corners = [value(*c) for c in product(*((a.low, a.high, min(max(0, a.low), a.high)) for a in args))]
            low, high = min(corners), max(corners)
            node = _drop_sign_of_zero(graph, graph.apply(op, *(a.node for a in args)), low, high, op)
            return within(graph, Integer(node, low, high), dtype)

        return apply

    return get_meaning


def _drop_sign_of_zero(graph: Graph, node: Node, low: int, high: int, op: str) -> Node:
    if op not in ("mul", "neg", "trunc") or low > 0 or high < 0 or node.op == "const":
        return node if node.number != 0.0 else graph.constant(0.0)
    return graph.apply("select", graph.apply("eq", node, 0.0), 0.0, node)


def _quotient(graph: Graph, params: Any, dtype: np.dtype[Any]) -> Callable[..., Any]:
    """Return division rounded towards zero; division by zero yields -1."""

    def divide(one: Any, other: Any) -> Any:
        a, b = Integer.of(graph, one), Integer.of(graph, other)
        largest = max(abs(a.low), abs(a.high), 1)
        low = 0 if a.low >= 0 and b.low >= 0 else -largest
        node = _drop_sign_of_zero(graph, graph.apply("trunc", a.node / b.node), -largest, largest, "trunc")
        return choose(graph, equal(graph, b, 0), -1, within(graph, Integer(node, low, largest), dtype))

    return divide


def _remainder(graph: Graph, params: Any, dtype: np.dtype[Any]) -> Callable[..., Any]:
    """Return the remainder with the sign of the dividend; for a division by zero, it is the dividend itself."""

    def remainder(one: Any, other: Any) -> Any:
        a, b = Integer.of(graph, one), Integer.of(graph, other)
        nonzero = Integer.of(graph, choose(graph, equal(graph, b, 0), 1, b))
        largest = max(abs(b.low), abs(b.high)) - 1
        node = a.node - nonzero.node * graph.apply("trunc", a.node / nonzero.node)
        low, high = (0 if a.low >= 0 else -max(largest, 0)), (0 if a.high <= 0 else max(largest, 0))
        return choose(graph, equal(graph, b, 0), a, Integer(node, low, high))

    return remainder


def _sign(graph: Graph, params: Any, dtype: np.dtype[Any]) -> Callable[[Any], Any]:
    return lambda a: choose(graph, less(graph, a, 0), -1, choose(graph, less(graph, 0, a), 1, 0))


def _choose_extreme(graph: Graph, extreme: Callable[..., int], a: Any, b: Any) -> Integer:
    """Return the smaller (larger) of two integers, as Python's `min` (`max`) does for bounds."""
    one, other = Integer.of(graph, a), Integer.of(graph, b)
    is_first = less(graph, one, other) if extreme is min else less(graph, other, one)
    node = choose(graph, is_first, one, other).node
    return Integer(node, extreme(one.low, other.low), extreme(one.high, other.high))


def from_double(graph: Graph, kind: np.dtype[Any]) -> Callable[[Any], Any]:
    """Return the conversion of doubles to integers of a type: rounded towards zero, NaN to 0, clipped to the bounds."""
    least, most = _bounds(kind)

    def convert(a: Any) -> Any:
        rounded = graph.apply("trunc", a)
        number = graph.apply("select", graph.apply("lt", 0.0, graph.apply("abs", rounded)), rounded, 0.0)
        if kind.itemsize == 8:
            graph.require(graph.apply("le", graph.apply("abs", number), float(most)))
        return clamp(graph, Integer(number, least - 1, most + 1), least, most)

    return convert


OF_INTEGERS: dict[str, Meaning] = {
    "add": _exactly("add", operator.add),
    "sub": _exactly("sub", operator.sub),
    "mul": _exactly("mul", operator.mul),
    "neg": _exactly("neg", operator.neg),
    "abs": _exactly("abs", abs),
    "div": _quotient,
    "rem": _remainder,
    "sign": _sign,
    "max": lambda graph, params, dtype: partial(_choose_extreme, graph, max),
    "min": lambda graph, params, dtype: partial(_choose_extreme, graph, min),
    "lt": lambda graph, params, dtype: partial(less, graph),
    "gt": lambda graph, params, dtype: lambda a, b: less(graph, b, a),
    "le": lambda graph, params, dtype: lambda a, b: graph.apply("not", less(graph, b, a)),
    "ge": lambda graph, params, dtype: lambda a, b: graph.apply("not", less(graph, a, b)),
    "eq": lambda graph, params, dtype: partial(equal, graph),
    "ne": lambda graph, params, dtype: lambda a, b: graph.apply("not", equal(graph, a, b)),
}
"""Operations on each entry of arrays of integers; comparisons too."""
