"""Linear systems of implicit rows in straight-line code: elimination without pivoting."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from switchfit.engine.native.scalars import Objects, as_objects


def eliminate(blocks: list[list[Objects]]) -> Elimination:
    """Factorize a matrix given by its rows of blocks: see `switchfit.discretization.implicit_rows`."""
    return Elimination(np.block(blocks))


class Elimination:
    """The factors L and U of a matrix (m, m) of nodes, without the zeros of its structure.

    Its diagonal is 1 minus a few terms, which are negative in a stable mode.
    """

    def __init__(self, matrix: Objects) -> None:
        a = matrix.copy()
        self._factors, self._inverse = a, as_objects([0.0] * len(a))
        for k in range(len(a)):
            self._inverse[k] = 1.0 / a[k, k]
            for i in range(k + 1, len(a)):
                if a[i, k].number == 0.0:
                    continue
                a[i, k] = a[i, k] * self._inverse[k]
                for j in range(k + 1, len(a)):
                    a[i, j] = a[i, j] - a[i, k] * a[k, j]

    def solve(self, right: Sequence[Objects], *, transposed: bool = False) -> list[Any]:
        """Return the solution for a right-hand side of s vectors (n,) of scalars or vectors."""
        x = np.concatenate(list(right))
        order, a = range(len(x)), self._factors
        if transposed:
            for i in order:
                x[i] = _subtract(x[i], a[:i, i], x[:i]) * self._inverse[i]
            for i in reversed(order):
                x[i] = _subtract(x[i], a[i + 1 :, i], x[i + 1 :])
        else:
            for i in order:
                x[i] = _subtract(x[i], a[i, :i], x[:i])
            for i in reversed(order):
                x[i] = _subtract(x[i], a[i, i + 1 :], x[i + 1 :]) * self._inverse[i]
        return np.split(x, len(right))


def _subtract(value: Any, factors: Objects, others: Objects) -> Any:
    for factor, other in zip(factors, others, strict=True):
        if factor.number != 0.0:
            value = value - factor * other
    return value
