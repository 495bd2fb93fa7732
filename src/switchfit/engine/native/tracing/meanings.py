"""What JAX operations do to each entry of traced arrays: doubles, truth values and integers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import numpy as np

from switchfit.engine.native.scalars.graph import Graph, Node
from switchfit.engine.native.scalars.operations import OPERATIONS
from switchfit.engine.native.tracing import integers, sorting
from switchfit.engine.native.tracing.entries import Entry, Integer, Parameters, choose, less
from switchfit.engine.native.tracing.integers import Meaning
from switchfit.engine.native.tracing.unsupported import Unsupported

OTHER_NAMES = {"while": "jax.lax.while_loop", "eigh": "jnp.linalg.eigh", "eig": "jnp.linalg.eig", "fft": "jnp.fft"}
"""Public names of operations for which it is not ``jax.lax.NAME``."""


def get_meaning(graph: Graph, name: str, params: Parameters, dtype: np.dtype[Any]) -> Callable[..., Any]:
    """Return what an operation does to entries, of arrays of which the last has a type."""
    # Unsigned and signed integers mean the same; their ranges are in `integers.within`.
    table = OF_ALL | {"f": OF_DOUBLES, "b": OF_TRUTH}.get(dtype.kind, integers.OF_INTEGERS)
    if name in table:
        return partial(table[name], graph, params, dtype)
    if dtype.kind in "iu" and name not in OTHER_NAMES:
        raise Unsupported(f"does integer arithmetic ({name}) with what depends on the state")
    raise Unsupported(f"calls {OTHER_NAMES.get(name, f'jax.lax.{name}')}")


# Entries of any type


def _convert(graph: Graph, params: Parameters, dtype: np.dtype[Any], a: Entry) -> Entry:
    kind = np.dtype(params["new_dtype"])
    if kind.kind not in "biu" and kind != np.float64:
        raise Unsupported(f"converts what depends on the state to {kind}")
    if kind.kind == dtype.kind and kind.kind in "bf":
        return a
    if dtype.kind == "f":
        return graph.apply("ne", a, 0.0) if kind.kind == "b" else integers.from_double(graph, kind, a)
    number = Integer.of(graph, a)
    if kind.kind in "iu":
        return integers.within(graph, number, kind)
    return number.node if kind.kind == "f" else graph.apply("ne", number.node, 0.0)


def _raise_to_integer(graph: Graph, params: Parameters, dtype: np.dtype[Any], a: Entry) -> Entry:
    exponent, multiply = int(params["y"]), get_meaning(graph, "mul", {}, dtype)
    # By squares: x^k takes about 2 log2 k products.
    result, square, left = 1, a, abs(exponent)
    while left:
        if left & 1:
            result = multiply(result, square)
        left >>= 1
        square = multiply(square, square) if left else square
    return graph.apply("div", 1.0, result) if exponent < 0 else result


def select_case(
    graph: Graph, params: Parameters | None, dtype: np.dtype[Any] | None, which: Entry, *cases: Entry
) -> Entry:
    """Select one of several cases by a truth value or an integer."""
    if not isinstance(which, Node | Integer):
        return cases[int(which)]
    if isinstance(which, Node):
        return choose(graph, which, cases[1], cases[0])
    result = cases[0]
    for k, case in enumerate(cases[1:], start=1):
        result = choose(graph, less(graph, which, k), result, case)
    return result


def _clamp(graph: Graph, params: Parameters, dtype: np.dtype[Any], low: Entry, a: Entry, high: Entry) -> Entry:
    smaller, larger = (get_meaning(graph, name, {}, dtype) for name in ("min", "max"))
    return smaller(larger(a, low), high)


OF_ALL: dict[str, Meaning] = {
    "clamp": _clamp,
    "convert_element_type": _convert,
    "integer_pow": _raise_to_integer,
    "select_n": select_case,
}
"""Operations on each entry of arrays of any type."""


# Doubles


def _apply_operation(op: str) -> Meaning:
    return lambda graph, params, dtype, *entries: graph.apply(op, *entries)


def _round(graph: Graph, params: Parameters, dtype: np.dtype[Any], a: Entry) -> Entry:
    """Round to the nearest integer; a half to the even one, or away from zero."""
    to_even = params["rounding_method"] == jax.lax.RoundingMethod.TO_NEAREST_EVEN
    return graph.apply("rint" if to_even else "round", a)


def _sign(graph: Graph, params: Parameters, dtype: np.dtype[Any], a: Entry) -> Entry:
    negative = graph.apply("select", graph.apply("lt", a, 0.0), -1.0, a)  # 0 and NaN are unchanged
    return graph.apply("select", graph.apply("lt", 0.0, a), 1.0, negative)


OF_DOUBLES: dict[str, Meaning] = {
    **{name: _apply_operation(op) for op, operation in OPERATIONS.items() for name in operation.primitives},
    "square": lambda graph, _, __, a: a * a,
    "rsqrt": lambda graph, _, __, a: 1.0 / graph.apply("sqrt", a),
    "logistic": lambda graph, _, __, a: 1.0 / (1.0 + graph.apply("exp", -a)),
    "sign": _sign,
    "round": _round,
    "lt_to": lambda graph, _, __, a, b: sorting.compare_in_order(graph, "lt", a, b),
    "le_to": lambda graph, _, __, a, b: sorting.compare_in_order(graph, "le", a, b),
    "is_finite": lambda graph, _, __, a: graph.apply("eq", a - a, 0.0),
}
"""Operations on each entry of arrays of doubles."""


# Truth values


OF_TRUTH: dict[str, Meaning] = integers.OF_INTEGERS | {
    name: _apply_operation(op) for op, operation in OPERATIONS.items() for name in operation.of_truth
}
"""Operations on each entry of arrays of truth values, which are compared as integers are."""
