"""Integer arithmetic of traced entries, on doubles with known bounds.

If the bounds allow a result to overflow its type, or to be too large for doubles to be exact, the program checks the
result at run time (`Graph.require`), and falls back to JAX if it is too large.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from itertools import product
from typing import Any

import numpy as np

from switchfit.engine.native.scalars.graph import Graph, Node, Scalar
from switchfit.engine.native.tracing.entries import (
    Entry,
    Integer,
    Parameters,
    choose,
    choose_extreme,
    clamp,
    equal,
    less,
)
from switchfit.engine.native.tracing.unsupported import Unsupported

Meaning = Callable[..., Any]
"""What a JAX operation does to entries: takes a graph, the parameters of the operation, the type of the last operand,
then an entry of each operand.
"""

LARGEST_EXACT = 2**51
"""Bound below which sums, products and quotients of doubles are exact for integers."""


def _bounds(dtype: np.dtype[Any]) -> tuple[int, int]:
    info = np.iinfo(dtype)
    return max(info.min, -LARGEST_EXACT), min(info.max, LARGEST_EXACT)


def within(graph: Graph, found: Integer, dtype: np.dtype[Any]) -> Entry:
    """Return an integer as one of a type, clamped to its range: it may be an index of memory."""
    least, most = _bounds(dtype)
    if found.high < least or found.low > most:
        raise Unsupported(f"does arithmetic with integers beyond {most}")
    # First clamped, then required: an evaluation that `require` refuses runs to its end, and must not read outside of
    # a table on its way.
    inside = clamp(graph, found, least, most)
    if found.low < least or found.high > most:
        graph.require(graph.apply("eq", found.node, Integer.of(graph, inside).node))
    return inside


def _exactly(op: str, value: Callable[..., int]) -> Meaning:
    """Return an operation on doubles; its result is between the extremes at the bounds of the operands and at zero."""

    def apply(graph: Graph, params: Parameters, dtype: np.dtype[Any], *given: Entry) -> Entry:
        args = [Integer.of(graph, a) for a in given]
        # Sums, products and sizes are monotonic between the bounds and zero: their extremes are among these corners.
        corners = [value(*c) for c in product(*((a.low, a.high, min(max(0, a.low), a.high)) for a in args))]
        low, high = min(corners), max(corners)
        node = _drop_sign_of_zero(graph, graph.apply(op, *(a.node for a in args)), low, high, op)
        return within(graph, Integer(node, low, high), dtype)

    return apply


def _drop_sign_of_zero(graph: Graph, node: Node, low: int, high: int, op: str) -> Node:
    if op not in ("mul", "neg", "trunc") or low > 0 or high < 0 or node.op == "const":
        return node if node.number != 0.0 else graph.constant(0.0)
    # An integer has no -0.0, but -1 times 0.0 is one as doubles.
    return graph.apply("select", graph.apply("eq", node, 0.0), 0.0, node)


def _divide(graph: Graph, params: Parameters, dtype: np.dtype[Any], one: Entry, other: Entry) -> Entry:
    """Divide, rounded towards zero; division by zero yields -1."""
    a, b = Integer.of(graph, one), Integer.of(graph, other)
    largest = max(abs(a.low), abs(a.high), 1)
    low = 0 if a.low >= 0 and b.low >= 0 else -largest
    node = _drop_sign_of_zero(graph, graph.apply("trunc", a.node / b.node), -largest, largest, "trunc")
    return choose(graph, equal(graph, b, 0), -1, within(graph, Integer(node, low, largest), dtype))


def _find_remainder(graph: Graph, params: Parameters, dtype: np.dtype[Any], one: Entry, other: Entry) -> Entry:
    """Return the remainder with the sign of the dividend; for a division by zero, it is the dividend itself."""
    a, b = Integer.of(graph, one), Integer.of(graph, other)
    # 1 in place of a divisor of zero, so that no NaN arises in what is not chosen.
    nonzero = Integer.of(graph, choose(graph, equal(graph, b, 0), 1, b))
    largest = max(abs(b.low), abs(b.high)) - 1
    node = a.node - nonzero.node * graph.apply("trunc", a.node / nonzero.node)
    low, high = (0 if a.low >= 0 else -max(largest, 0)), (0 if a.high <= 0 else max(largest, 0))
    return choose(graph, equal(graph, b, 0), a, Integer(node, low, high))


def from_double(graph: Graph, kind: np.dtype[Any], a: Scalar) -> Entry:
    """Return a double as an integer of a type: rounded towards zero, NaN to 0, clipped to the bounds."""
    (least, most), rounded = _bounds(kind), graph.apply("trunc", a)
    # NaN fails the comparison and becomes 0, as does -0.0.
    number = graph.apply("select", graph.apply("lt", 0.0, graph.apply("abs", rounded)), rounded, 0.0)
    if kind.itemsize == 8:
        graph.require(graph.apply("le", graph.apply("abs", number), float(most)))
    return clamp(graph, Integer(number, least - 1, most + 1), least, most)


OF_INTEGERS: dict[str, Meaning] = {
    "add": _exactly("add", operator.add),
    "sub": _exactly("sub", operator.sub),
    "mul": _exactly("mul", operator.mul),
    "neg": _exactly("neg", operator.neg),
    "abs": _exactly("abs", abs),
    "div": _divide,
    "rem": _find_remainder,
    "sign": lambda graph, _, __, a: choose(graph, less(graph, a, 0), -1, choose(graph, less(graph, 0, a), 1, 0)),
    "max": lambda graph, _, __, a, b: choose_extreme(graph, max, a, b),
    "min": lambda graph, _, __, a, b: choose_extreme(graph, min, a, b),
    "lt": lambda graph, _, __, a, b: less(graph, a, b),
    "gt": lambda graph, _, __, a, b: less(graph, b, a),
    "le": lambda graph, _, __, a, b: graph.apply("not", less(graph, b, a)),
    "ge": lambda graph, _, __, a, b: graph.apply("not", less(graph, a, b)),
    "eq": lambda graph, _, __, a, b: equal(graph, a, b),
    "ne": lambda graph, _, __, a, b: graph.apply("not", equal(graph, a, b)),
}
"""Operations on each entry of arrays of integers; comparisons too."""
