"""Linear algebra of small matrices, as functions of JAX without loops: LU, Cholesky, triangular systems.

`trace` traces them in place of JAX's operations. The algorithms are those of LAPACK; pivots are chosen at run time. The
matrices are the last two axes of arrays.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.engine.native.entries import Unsupported
from switchfit.engine.native.sorting import find_first

MOST_ROWS_TO_PIVOT = 5
"""Largest number of rows in an LU factorization, whose pivots take selections."""

MOST_ROWS = 6
"""Largest number of rows in a Cholesky factorization, or in a triangular system that depends on the state."""

MOST_KNOWN_ROWS = 30
"""Largest number of rows in a triangular system whose matrix is known."""


def _map_matrices(function: Callable[..., Any], *arrays: Any) -> Any:
    """Map a function of matrices over arrays of matrices."""
    for _ in range(arrays[0].ndim - 2):
        function = jax.vmap(function)
    return function(*arrays)


def _check_rows(rows: int, most: int) -> None:
    if rows > most:
        raise Unsupported(f"works with a matrix of {rows} rows (limit: {most})")


def lu(a: Any, **_: Any) -> Any:
    """Return what `jax.lax.linalg.lu` does: L and U in one matrix, the pivots, the permutation."""
    _check_rows(max(a.shape[-2:]), MOST_ROWS_TO_PIVOT)
    return _map_matrices(_lu, a)


def _lu(a: Any) -> Any:
    order, pivots = jnp.arange(len(a), dtype=np.int32), []
    for k in range(min(a.shape)):
        pivots.append(k + find_first(operator.gt, jnp.abs(a[k:, k]), np.int32))
        a, order = (_exchange_rows(each, k, pivots[k]) for each in (a, order))
        # Like LAPACK, leave a column of zeros unchanged.
        below = a[k + 1 :, k] * (1.0 / jnp.where(a[k, k] == 0.0, 1.0, a[k, k]))
        rest = a[k + 1 :, k + 1 :] - below[:, None] * a[k, k + 1 :]
        a = jnp.concatenate([a[: k + 1], jnp.concatenate([a[k + 1 :, :k], below[:, None], rest], axis=1)])
    return a, jnp.stack(pivots), order


def _exchange_rows(a: Any, k: int, other: Any) -> Any:
    """Exchange row k with another one from k on."""
    is_other = (np.arange(len(a), dtype=np.int32) == other).reshape(-1, *[1] * (a.ndim - 1))
    rows = jnp.where(is_other, a[k], a)
    return jnp.concatenate([rows[:k], jax.lax.dynamic_index_in_dim(a, other), rows[k + 1 :]])


def cholesky(a: Any, **_: Any) -> Any:
    """Return the factor of `jax.lax.linalg.cholesky`; it is NaN if the matrix is not positive definite."""
    _check_rows(a.shape[-1], MOST_ROWS)
    return [_map_matrices(_cholesky, a)]


def _cholesky(a: Any) -> Any:
    n, columns, positive = len(a), [], True
    while len(a):
        positive = positive & (a[0, 0] > 0.0)
        root = jnp.sqrt(a[0, 0])
        below = a[1:, 0] * (1.0 / root)
        columns.append(jnp.concatenate([jnp.zeros(n - len(a)), root[None], below]))
        a = a[1:, 1:] - below[:, None] * below
    undefined = np.tril(np.ones((n, n), bool)) & ~positive
    return jnp.where(undefined, jnp.nan, jnp.stack(columns, axis=1))


def triangular_solve(
    a: Any, b: Any, *, left_side: bool, lower: bool, transpose_a: bool, unit_diagonal: bool, **_: Any
) -> Any:
    """Return the solution of `jax.lax.linalg.triangular_solve`."""
    _check_rows(a.shape[-1], MOST_KNOWN_ROWS if isinstance(a, np.ndarray) else MOST_ROWS)

    def solve(a: Any, b: Any) -> Any:
        if transpose_a == left_side:  # x A = b is A' x' = b'
            a = a.T
        is_lower = lower != (transpose_a == left_side)
        b = b if left_side else b.T
        x = _substitute(a, b, unit_diagonal) if is_lower else _substitute(a[::-1, ::-1], b[::-1], unit_diagonal)[::-1]
        return x if left_side else x.T

    return [_map_matrices(solve, a, b)]


def _substitute(a: Any, b: Any, unit_diagonal: bool) -> Any:
    """Solve a lower triangular system for several right-hand sides (n, m)."""
    x: list[Any] = []
    for i in range(len(b)):
        rest = b[i] - a[i, :i] @ jnp.stack(x) if i else b[i]
        x.append(rest if unit_diagonal else rest * (1.0 / a[i, i]))
    return jnp.stack(x)
