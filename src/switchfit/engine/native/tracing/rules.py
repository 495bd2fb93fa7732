"""What JAX operations do to whole traced arrays: products, reductions, extremes, and changes at indices."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from switchfit.engine.native.scalars.graph import Graph, Node, Objects, as_objects
from switchfit.engine.native.scalars.operations import OPERATIONS
from switchfit.engine.native.tracing import indexing, matrices, sorting
from switchfit.engine.native.tracing.entries import Entry, Integer, TracedArray, choose, known_number
from switchfit.engine.native.tracing.meanings import get_meaning
from switchfit.engine.native.tracing.unsupported import Unsupported
from switchfit.runtime.jax_internals import Equation, array_type

SUMS = {"sum": "add", "prod": "mul", "max": "max", "min": "min"}


# Whole arrays


def _dot(graph: Graph, equation: Equation, a: TracedArray, b: TracedArray) -> Objects:
    if any(array_type(variable).dtype != np.float64 for variable in equation.invars):
        raise Unsupported("multiplies matrices of truth values or integers that depend on the state")
    (sum_a, sum_b), (batch_a, batch_b) = equation.params["dimension_numbers"]
    of_a, of_b = list(range(a.ndim)), list(range(a.ndim, a.ndim + b.ndim))
    # einsum's labels: axes that are summed, or shared as batch, get that of a.
    for one, other in zip((*sum_a, *batch_a), (*sum_b, *batch_b), strict=True):
        of_b[other] = one
    kept = [k for k in (*batch_a, *of_a, *of_b) if k not in sum_a]
    a, b = (np.asarray(each, dtype=object) for each in (a, b))
    return np.einsum(a, of_a, b, of_b, list(dict.fromkeys(kept)))


def _reduce(name: str) -> Callable[..., Any]:
    """Reduce over axes by an operation."""

    def over(graph: Graph, equation: Equation, a: TracedArray) -> TracedArray:
        combine = np.frompyfunc(get_meaning(graph, name, {}, array_type(equation.invars[0]).dtype), 2, 1)
        for axis in sorted(equation.params["axes"], reverse=True):
            a = combine.reduce(a, axis=axis, dtype=object)
        return a

    return over


def _accumulate(name: str) -> Callable[..., Any]:
    """Accumulate along an axis by an operation."""

    def along(graph: Graph, equation: Equation, a: TracedArray) -> TracedArray:
        axis, turned = equation.params["axis"], equation.params["reverse"]
        combine = np.frompyfunc(get_meaning(graph, name, {}, array_type(equation.invars[0]).dtype), 2, 1)
        ordered = np.flip(a, axis) if turned else a
        result = combine.accumulate(ordered, axis=axis, dtype=object)
        return np.flip(result, axis) if turned else result

    return along


def _find_first(name: str) -> Callable[..., Any]:
    """Find the index of the largest (smallest) entry along an axis, the first of several; NaN counts as extreme."""

    def along(graph: Graph, equation: Equation, a: TracedArray) -> TracedArray:
        (axis,), dtype = equation.params["axes"], array_type(equation.invars[0]).dtype
        reaches = get_meaning(graph, name, {}, dtype)  # false for NaN, which is beyond any number

        def first(row: TracedArray) -> Entry:
            best, found = row[0], 0
            for k, value in enumerate(row[1:], start=1):
                better = graph.apply("not", reaches(best, value))
                if dtype.kind == "f":
                    better = graph.apply("and", better, graph.apply("eq", best, best))  # the first NaN stays
                best, found = choose(graph, better, value, best), choose(graph, better, k, found)
            return found

        rows = np.moveaxis(a, axis, -1)
        return as_objects([first(row) for row in rows.reshape(-1, rows.shape[-1])]).reshape(rows.shape[:-1])

    return along


def _scatter(name: str | None) -> Callable[..., Any]:
    """Return a scatter that combines old entries with updates by an operation, or replaces them."""

    def scatter_entries(
        graph: Graph, equation: Equation, a: TracedArray, indices: TracedArray, updates: TracedArray
    ) -> Objects:
        dtype = array_type(equation.outvars[0]).dtype

        def combine(here: Entry, old: Entry, update: Entry) -> Entry:
            if name is None:
                return choose(graph, here, update, old)
            # Known place, known numbers: no node at all.
            if known_number(here) is True and not any(isinstance(a, Node | Integer) for a in (old, update)):
                return OPERATIONS[name].value(old, update)
            return choose(graph, here, get_meaning(graph, name, {}, dtype)(old, update), old)

        return indexing.scatter(graph, equation, a, indices, updates, combine)

    return scatter_entries


INDEXED: dict[str, Callable[..., Any]] = {
    "gather": indexing.gather,
    "dynamic_slice": indexing.dynamic_slice,
    "dynamic_update_slice": indexing.dynamic_update_slice,
    "scatter": _scatter(None),
    "scatter-add": _scatter("add"),
    "scatter-mul": _scatter("mul"),
    "scatter-max": _scatter("max"),
    "scatter-min": _scatter("min"),
}
"""Operations at indices."""


ARRAY_RULES: dict[str, Callable[..., Any]] = {
    "argmax": _find_first("ge"),
    "argmin": _find_first("le"),
    "lu": matrices.lu,
    "cholesky": matrices.cholesky,
    "triangular_solve": matrices.triangular_solve,
    "sort": sorting.sort,
    "dot_general": _dot,
    **{f"reduce_{name}": _reduce(op) for name, op in SUMS.items()},
    **{f"reduce_{name}": _reduce(name) for name in ("and", "or", "xor")},
    **{f"cum{name}": _accumulate(op) for name, op in SUMS.items()},
    **INDEXED,
}
"""Operations on whole arrays; each rule takes a graph, the equation and its operands."""
