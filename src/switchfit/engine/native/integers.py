"""Arithmetic with integers that depend on the state, as doubles.

Each `Integer` has bounds. If they allow a result to overflow its type, or to be too large for doubles to be exact, the
program checks the result at run time (`Graph.require`), and falls back to JAX if it is too large.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np

from switchfit.engine.native.entries import Integer, Unsupported, choose, clamp, equal, less
from switchfit.engine.native.scalars import Graph, Node

Meaning = Callable[[Graph, Any, np.dtype[Any]], Callable[..., Any]]
"""Takes a graph, the parameters of a JAX operation and the type of its result; returns the operation on entries."""

LARGEST = 2**51
"""Bound below which sums, products and quotients of doubles are exact for integers."""


def _bounds(dtype: np.dtype[Any]) -> tuple[int, int]:
    info = np.iinfo(dtype)
    return max(info.min, -LARGEST), min(info.max, LARGEST)


def within(graph: Graph, node: Node, low: int, high: int, dtype: np.dtype[Any]) -> Any:
    """Return a node between two bounds as an integer of a type, clamped to its range: it may be an index of memory."""
    least, most = _bounds(dtype)
    if high < least or low > most:
        raise Unsupported(f"does arithmetic with integers beyond {most}")
    found = Integer(node, low, high)
    inside = clamp(graph, found, least, most)
    if low < least or high > most:
        graph.require(graph.apply("eq", node, Integer.of(graph, inside).node))
    return inside


def _from_bounds(op: str, bounds: Callable[..., tuple[int, int]]) -> Meaning:
    def get_meaning(graph: Graph, params: Any, dtype: np.dtype[Any]) -> Callable[..., Any]:
        def apply(*given: Any) -> Any:
            args = [Integer.of(graph, a) for a in given]
            low, high = bounds(*((a.low, a.high) for a in args))
            node = _drop_sign_of_zero(graph, graph.apply(op, *(a.node for a in args)), low, high, op)
            return within(graph, node, low, high, dtype)

        return apply

    return get_meaning


def _drop_sign_of_zero(graph: Graph, node: Node, low: int, high: int, op: str) -> Node:
    if op not in ("mul", "neg", "trunc") or low > 0 or high < 0 or node.op == "const":
        return node if node.number != 0.0 else graph.constant(0.0)
    return graph.apply("select", graph.apply("eq", node, 0.0), 0.0, node)


def _product(a: tuple[int, int], b: tuple[int, int]) -> tuple[int, int]:
    corners = [x * y for x, y in product(a, b)]
    return min(corners), max(corners)


def _absolute(a: tuple[int, int]) -> tuple[int, int]:
    return (0 if a[0] <= 0 <= a[1] else min(map(abs, a))), max(map(abs, a))


def _quotient(graph: Graph, params: Any, dtype: np.dtype[Any]) -> Callable[..., Any]:
    """Return division rounded towards zero; division by zero yields -1."""

    def divide(one: Any, other: Any) -> Any:
        a, b = Integer.of(graph, one), Integer.of(graph, other)
        largest = max(abs(a.low), abs(a.high), 1)
        low = 0 if a.low >= 0 and b.low >= 0 else -largest
        node = _drop_sign_of_zero(graph, graph.apply("trunc", a.node / b.node), -largest, largest, "trunc")
        return choose(graph, equal(graph, b, 0), -1, within(graph, node, low, largest, dtype))

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


def _extreme(choose_bound: Callable[..., int]) -> Meaning:
    """Return the smaller (larger) of two integers, as Python's `min` (`max`) does for bounds."""

    def get_meaning(graph: Graph, params: Any, dtype: np.dtype[Any]) -> Callable[..., Any]:
        def extreme(a: Any, b: Any) -> Any:
            one, other = Integer.of(graph, a), Integer.of(graph, b)
            first = less(graph, one, other) if choose_bound is min else less(graph, other, one)
            bounds = choose_bound(one.low, other.low), choose_bound(one.high, other.high)
            return Integer(choose(graph, first, one, other).node, *bounds)

        return extreme

    return get_meaning


def of_type(graph: Graph, a: Integer, kind: np.dtype[Any]) -> Any:
    """Convert an integer to a type."""
    return within(graph, a.node, a.low, a.high, kind)


def invert(graph: Graph, condition: Any) -> Any:
    """Negate a condition, known or traced."""
    return graph.apply("not", condition) if isinstance(condition, Node) else not condition


def from_double(graph: Graph, kind: np.dtype[Any]) -> Callable[[Any], Any]:
    """Return the conversion of doubles to integers of a type: rounded towards zero, NaN to 0, clipped to the bounds."""
    least, most = _bounds(kind)

    def convert(a: Any) -> Integer:
        rounded = graph.apply("trunc", a)
        number = graph.apply("select", graph.apply("lt", 0.0, graph.apply("abs", rounded)), rounded, 0.0)
        if kind.itemsize == 8:
            graph.require(graph.apply("le", graph.apply("abs", number), float(most)))
        number = graph.apply("select", graph.apply("lt", number, float(least)), float(least), number)
        number = graph.apply("select", graph.apply("lt", float(most), number), float(most), number)
        return Integer(number, least, most)

    return convert


OF_INTEGERS: dict[str, Meaning] = {
    "add": _from_bounds("add", lambda a, b: (a[0] + b[0], a[1] + b[1])),
    "sub": _from_bounds("sub", lambda a, b: (a[0] - b[1], a[1] - b[0])),
    "mul": _from_bounds("mul", _product),
    "neg": _from_bounds("neg", lambda a: (-a[1], -a[0])),
    "abs": _from_bounds("abs", _absolute),
    "div": _quotient,
    "rem": _remainder,
    "sign": _sign,
    "max": _extreme(max),
    "min": _extreme(min),
    "lt": lambda graph, params, dtype: lambda a, b: less(graph, a, b),
    "gt": lambda graph, params, dtype: lambda a, b: less(graph, b, a),
    "le": lambda graph, params, dtype: lambda a, b: invert(graph, less(graph, b, a)),
    "ge": lambda graph, params, dtype: lambda a, b: invert(graph, less(graph, a, b)),
    "eq": lambda graph, params, dtype: lambda a, b: equal(graph, a, b),
    "ne": lambda graph, params, dtype: lambda a, b: invert(graph, equal(graph, a, b)),
}
"""Operations on each entry of arrays of integers; comparisons too."""
