"""Unrolled linear algebra of small matrices: LU with pivots chosen at run time, Cholesky, triangular systems.

The algorithms are those of LAPACK; the matrices are the last two axes of arrays.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from switchfit.engine.native.entries import Unsupported, both, choose, equal, known_number, pick
from switchfit.engine.native.scalars import Graph, Objects

MOST_ROWS_TO_PIVOT = 5
"""Largest number of rows in an LU factorization, whose pivots take selections."""

MOST_ROWS = 6
"""Largest number of rows in a Cholesky factorization, or in a triangular system that depends on the state."""

MOST_KNOWN_ROWS = 30
"""Largest number of rows in a triangular system whose matrix is known."""


def _map_matrices(function: Callable[..., tuple[Any, ...]], *arrays: Any) -> list[Any]:
    """Map a function of matrices over arrays of matrices."""
    batch = arrays[0].shape[:-2]
    parts = [function(*(np.asarray(a[place], dtype=object) for a in arrays)) for place in np.ndindex(*batch)]
    return [np.stack(column).reshape(*batch, *np.shape(column[0])) for column in zip(*parts, strict=True)]


def lu(graph: Graph, equation: Any, a: Any) -> list[Any]:
    """Trace `jax.lax.linalg.lu`: L and U in one matrix, the pivots, the permutation."""
    _check_rows(max(a.shape[-2:]), MOST_ROWS_TO_PIVOT)
    return _map_matrices(lambda matrix: _lu(graph, matrix), a)


def _lu(graph: Graph, matrix: Objects) -> tuple[Any, ...]:
    a = matrix.copy()
    rows, columns = a.shape
    order: Any = np.array(range(rows), dtype=object)
    pivots: Any = np.empty(min(rows, columns), dtype=object)
    for k in range(min(rows, columns)):
        pivots[k] = _find_largest(graph, a[:, k], k)
        if pivots[k] != k:
            a = _exchange_rows(graph, a, k, pivots[k])
            order = _exchange_rows(graph, order[:, None], k, pivots[k])[:, 0]
        pivot = a[k, k]
        # Like LAPACK, leave a column of zeros unchanged.
        inverse = graph.apply("div", 1.0, choose(graph, graph.apply("eq", pivot, 0.0), 1.0, pivot))
        for i in range(k + 1, rows):
            a[i, k] = graph.apply("mul", a[i, k], inverse)
            a[i, k + 1 :] = [
                graph.apply("sub", a[i, j], graph.apply("mul", a[i, k], a[k, j])) for j in range(k + 1, columns)
            ]
    return a, pivots, order


def _find_largest(graph: Graph, column: Objects, k: int) -> Any:
    """Return the index of the largest entry from k on, the first of several; entries known to be zero are skipped."""
    size, found = graph.apply("abs", column[k]), k
    for i in range(k + 1, len(column)):
        other = graph.apply("abs", column[i])
        if known_number(other) == 0.0:
            continue
        larger = graph.apply("lt", size, other)
        size, found = graph.apply("select", larger, other, size), choose(graph, larger, i, found)
    return found


def _exchange_rows(graph: Graph, a: Any, k: int, other: Any) -> Any:
    """Exchange row k with another one from k on, whose index is known or an `Integer`."""
    result = a.copy()
    if isinstance(other, int):
        result[[k, other]] = a[[other, k]]
        return result
    for i in range(k + 1, len(a)):
        result[i] = [choose(graph, equal(graph, other, i), up, down) for up, down in zip(a[k], a[i], strict=True)]
    result[k] = [pick(graph, column.tolist(), other) for column in a[other.low : other.high + 1].T]
    return result


def cholesky(graph: Graph, equation: Any, a: Any) -> list[Any]:
    """Trace `jax.lax.linalg.cholesky` for a symmetric matrix; L is NaN if the matrix is not positive definite."""
    _check_rows(a.shape[-1], MOST_ROWS)
    return _map_matrices(lambda matrix: (_cholesky(graph, matrix),), a)


def _check_rows(rows: int, most: int) -> None:
    if rows > most:
        raise Unsupported(f"works with a matrix of {rows} rows (limit: {most})")


def _cholesky(graph: Graph, matrix: Objects) -> Objects:
    n = len(matrix)
    L = np.full((n, n), 0.0, dtype=object)
    positive: Any = True
    for j in range(n):
        rest = [graph.apply("sub", matrix[i, j], _sum_of_products(graph, L[i, :j], L[j, :j])) for i in range(j, n)]
        positive = both(graph, positive, graph.apply("lt", 0.0, rest[0]))
        L[j, j] = graph.apply("sqrt", rest[0])
        inverse = 1.0 / L[j, j]
        for i in range(j + 1, n):
            L[i, j] = graph.apply("mul", rest[i - j], inverse)
    for i in range(n):
        L[i, : i + 1] = [choose(graph, positive, entry, float("nan")) for entry in L[i, : i + 1]]
    return L


def _sum_of_products(graph: Graph, a: Any, b: Any) -> Any:
    total: Any = graph.constant(0.0)
    for x, y in zip(a, b, strict=True):
        total = total + graph.apply("mul", x, y)
    return total


def triangular_solve(graph: Graph, equation: Any, a: Any, b: Any) -> list[Any]:
    """Trace `jax.lax.linalg.triangular_solve`."""
    params = equation.params
    _check_rows(a.shape[-1], MOST_ROWS if a.dtype == object else MOST_KNOWN_ROWS)
    lower = params["lower"] != params["transpose_a"]

    def solve(matrix: Objects, right: Objects) -> tuple[Any, ...]:
        matrix = matrix.T if params["transpose_a"] else matrix
        if params["left_side"]:
            return (_substitute(graph, matrix, right, lower, params["unit_diagonal"]),)
        # x A = b is A' x' = b'
        return (_substitute(graph, matrix.T, right.T, not lower, params["unit_diagonal"]).T,)

    return _map_matrices(solve, a, b)


def _substitute(graph: Graph, a: Objects, b: Objects, lower: bool, unit_diagonal: bool) -> Objects:
    x = b.copy()
    n = len(a)
    for i in range(n) if lower else reversed(range(n)):
        before = slice(0, i) if lower else slice(i + 1, n)
        for j in range(x.shape[1]):
            x[i, j] = graph.apply("sub", x[i, j], _sum_of_products(graph, a[i, before], x[before, j]))
        if not unit_diagonal:
            inverse = graph.apply("div", 1.0, a[i, i])
            x[i] = [graph.apply("mul", entry, inverse) for entry in x[i]]
    return x


MATRICES: dict[str, Callable[[Graph, Any, Any], list[Any]] | Callable[..., list[Any]]] = {
    "lu": lu,
    "cholesky": cholesky,
    "triangular_solve": triangular_solve,
}
"""Operations on matrices; each returns a list of arrays."""
