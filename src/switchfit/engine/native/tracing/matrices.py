"""Linear algebra of small traced matrices, unrolled: LU with pivots, Cholesky, triangular systems.

Pivots are chosen at run time. The algorithms are those of LAPACK, for the matrices in the last two axes of arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from switchfit.engine.native.scalars.graph import Graph, Node, Objects, as_objects
from switchfit.engine.native.tracing.entries import TracedArray, choose, equal, known_number, pick
from switchfit.engine.native.tracing.indexing import Index
from switchfit.engine.native.tracing.unsupported import check_size
from switchfit.runtime.jax_internals import Equation

MOST_ROWS_TO_PIVOT = 5
"""Largest number of rows in an LU factorization, whose pivots take selections."""

MOST_ROWS = 6
"""Largest number of rows in a Cholesky factorization, or in a triangular system that depends on the state."""

MOST_KNOWN_ROWS = 30
"""Largest number of rows in a triangular system whose matrix is known."""


def _map_matrices(graph: Graph, function: Callable[..., tuple[Objects, ...]], *arrays: TracedArray) -> list[Objects]:
    """Map a function of matrices of nodes over arrays of matrices."""
    batch, to_node = arrays[0].shape[:-2], lambda value: value if isinstance(value, Node) else graph.constant(value)
    given = [np.asarray(np.frompyfunc(to_node, 1, 1)(a), dtype=object) for a in arrays]
    parts = [function(*(a[place] for a in given)) for place in np.ndindex(*batch)]
    return [np.stack(column).reshape(*batch, *np.shape(column[0])) for column in zip(*parts, strict=True)]


def _check_rows(rows: int, most: int) -> None:
    check_size(rows, most, f"works with a matrix of {rows} rows")


def lu(graph: Graph, equation: Equation, a: TracedArray) -> list[Objects]:
    """Trace `jax.lax.linalg.lu`: L and U in one matrix, the pivots, the permutation."""
    _check_rows(max(a.shape[-2:]), MOST_ROWS_TO_PIVOT)
    return _map_matrices(graph, partial(_lu, graph), a)


def _lu(graph: Graph, a: Objects) -> tuple[Objects, ...]:
    order = np.array(range(len(a)), dtype=object)
    pivots: list[Index] = []
    for k in range(min(a.shape)):
        pivots.append(_find_largest(graph, a[:, k], k))
        a = _exchange_rows(graph, a, k, pivots[k])
        order = _exchange_rows(graph, order[:, None], k, pivots[k])[:, 0]
        # Like LAPACK, leave a column of zeros unchanged.
        inverse = 1.0 / choose(graph, graph.apply("eq", a[k, k], 0.0), 1.0, a[k, k])
        a[k + 1 :, k] = a[k + 1 :, k] * inverse
        a[k + 1 :, k + 1 :] = a[k + 1 :, k + 1 :] - np.outer(a[k + 1 :, k], a[k, k + 1 :])
    return a, as_objects(pivots), order


def _find_largest(graph: Graph, column: Objects, k: int) -> Index:
    """Return the index of the largest entry from k on, the first of several; entries known to be zero are skipped."""
    size, found = graph.apply("abs", column[k]), k
    for i in range(k + 1, len(column)):
        other = graph.apply("abs", column[i])
        if known_number(other) == 0.0:
            continue
        larger = graph.apply("lt", size, other)
        size, found = graph.apply("select", larger, other, size), choose(graph, larger, i, found)
    return found


def _exchange_rows(graph: Graph, a: Objects, k: int, other: Index) -> Objects:
    """Exchange row k with another one from k on, whose index is known or an `Integer`."""
    result = a.copy()
    if isinstance(other, int):
        result[[k, other]] = a[[other, k]]
        return result
    for i in range(k + 1, len(a)):
        result[i] = [choose(graph, equal(graph, other, i), up, down) for up, down in zip(a[k], a[i], strict=True)]
    # Row k becomes that of the pivot; the bounds of its index say among which rows it is.
    result[k] = [pick(graph, column.tolist(), other) for column in a[other.low : other.high + 1].T]
    return result


def cholesky(graph: Graph, equation: Equation, a: TracedArray) -> Objects:
    """Trace `jax.lax.linalg.cholesky` for a symmetric matrix; L is NaN if the matrix is not positive definite."""
    _check_rows(a.shape[-1], MOST_ROWS)
    return _map_matrices(graph, lambda matrix: (_cholesky(graph, matrix),), a)[0]


def _cholesky(graph: Graph, a: Objects) -> Objects:
    n = len(a)
    L, positive = np.full((n, n), 0.0, dtype=object), graph.constant(True)
    for k in range(n):
        positive = graph.apply("and", positive, graph.apply("lt", 0.0, a[0, 0]))
        L[k, k] = graph.apply("sqrt", a[0, 0])
        L[k + 1 :, k] = a[1:, 0] * (1.0 / L[k, k])
        a = a[1:, 1:] - np.outer(L[k + 1 :, k], L[k + 1 :, k])
    for i in range(n):
        L[i, : i + 1] = [choose(graph, positive, entry, float("nan")) for entry in L[i, : i + 1]]
    return L


def triangular_solve(graph: Graph, equation: Equation, a: TracedArray, b: TracedArray) -> Objects:
    """Trace `jax.lax.linalg.triangular_solve`."""
    _check_rows(a.shape[-1], MOST_ROWS if a.dtype == object else MOST_KNOWN_ROWS)
    params = equation.params
    turned = params["transpose_a"] == params["left_side"]  # x A = b is A' x' = b'
    is_lower, unit = params["lower"] != turned, params["unit_diagonal"]

    def solve(a: Objects, b: Objects) -> tuple[Objects, ...]:
        a, b = a.T if turned else a, b if params["left_side"] else b.T
        x = _substitute(a, b, unit) if is_lower else _substitute(a[::-1, ::-1], b[::-1], unit)[::-1]
        return (x if params["left_side"] else x.T,)

    return _map_matrices(graph, solve, a, b)[0]


def _substitute(a: Objects, b: Objects, unit_diagonal: bool) -> Objects:
    """Solve a lower triangular system for several right-hand sides (n, m)."""
    x = b.copy()
    for i in range(len(b)):
        if i:
            x[i] = x[i] - (0.0 + a[i, :i] @ x[:i])  # a sum is never -0.0
        if not unit_diagonal:
            x[i] = x[i] * (1.0 / a[i, i])
    return x
