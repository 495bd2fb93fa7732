"""Linear systems of implicit rows: elimination in straight-line code, or a routine for large and dense systems.

Straight-line code leaves zeros of the Jacobians out and takes the states in an order in which few arise (minimum
degree). It has no pivots: its diagonal is 1 minus a few terms, which are negative in a stable mode.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.discretization.implicit_rows import Factors, couple
from switchfit.discretization.tableaus import FloatArray
from switchfit.engine.native.scalars import Graph, Node, Objects, as_objects

MOST_PRODUCTS = 150
"""Products for each equation from which elimination is left to a routine: those of 7 states that all depend on each
other, which compile in 1.5 s then, not 5 s, and take 1.5 times as long to evaluate. A chain of states takes 36."""


def eliminate(a: FloatArray, h: Node, f_x: Sequence[Objects]) -> Factors:
    """Factorize the matrix of the coupled equations: see `switchfit.discretization.implicit_rows`."""
    filled = np.any([[[_is_entry(value) for value in row] for row in J] for J in f_x], axis=0)
    order, products = order_states(filled)
    n, s = len(order), len(a)
    if products * s**2 > MOST_PRODUCTS * n:
        return _Routine(a, h, f_x)
    # By states, with the stages of each next to one another: fill-in then follows the pattern of D_1 f.
    return _Elimination(np.block(couple(a, h, f_x)), [n * j + state for state in order for j in range(s)])


def _is_entry(value: Any) -> bool:
    return (value.number if isinstance(value, Node) else value) != 0.0


def order_states(filled: NDArray[np.bool_]) -> tuple[list[int], int]:
    """Return an order of elimination for a matrix with these entries and a diagonal, and the products that it takes.

    The next state is one with the fewest products.
    """
    filled, left, order, products = filled | np.eye(len(filled), dtype=bool), list(range(len(filled))), [], 0
    while left:
        inner = filled[np.ix_(left, left)]
        each = inner.sum(axis=0) * inner.sum(axis=1)
        products += int(each.min())
        state = left.pop(int(each.argmin()))
        order.append(state)
        # Eliminating a state joins all that depend on it with all that it depends on.
        filled |= np.outer(filled[:, state], filled[state])
    return order, products


class _Elimination:
    """The factors L and U of a matrix (m, m) of nodes, its rows and columns in this order."""

    def __init__(self, matrix: Objects, order: list[int]) -> None:
        a = matrix[np.ix_(order, order)]
        self._order, self._factors, self._inverse = order, a, as_objects([0.0] * len(a))
        for k in range(len(a)):
            self._inverse[k] = 1.0 / a[k, k]
            after = [j for j in range(k + 1, len(a)) if a[k, j].number != 0.0]
            for i in range(k + 1, len(a)):
                if a[i, k].number == 0.0:
                    continue
                # L is stored below the diagonal, which is 1, and U above and on it; entries that are structural zeros
                # are skipped.
                a[i, k] = a[i, k] * self._inverse[k]
                for j in after:
                    a[i, j] = a[i, j] - a[i, k] * a[k, j]

    def solve(self, right: Sequence[Objects], *, transposed: bool = False) -> list[Any]:
        """Return the solution for a right-hand side of s vectors (n,) of scalars or vectors."""
        x = np.concatenate(list(right))[self._order]
        order, a = range(len(x)), self._factors.T if transposed else self._factors
        # P A P' = L U: forward with L, backward with U; transposed, U' L': the diagonal of U goes with the forward
        # part.
        for i in order:
            x[i] = _subtract(x[i], a[i, :i], x[:i]) * (self._inverse[i] if transposed else 1.0)
        for i in reversed(order):
            x[i] = _subtract(x[i], a[i, i + 1 :], x[i + 1 :]) * (1.0 if transposed else self._inverse[i])
        return np.split(x[np.argsort(self._order)], len(right))


def _subtract(value: Any, factors: Objects, others: Objects) -> Any:
    for factor, other in zip(factors, others, strict=True):
        if factor.number != 0.0:
            value = value - factor * other
    return value


class _Routine:
    """The factors of a matrix in memory, by the functions of `switchfit.engine.native.routines`."""

    def __init__(self, a: FloatArray, h: Node, f_x: Sequence[Objects]) -> None:
        self._graph: Graph = h.graph
        entries = [value for J in f_x for value in J.reshape(-1)]
        self._factors = self._graph.call("factors", len(f_x[0]), tuple(map(tuple, a.tolist())), h, *entries)

    def solve(self, right: Sequence[Objects], *, transposed: bool = False) -> list[Any]:
        """Return the solution for a right-hand side of s vectors (n,) of scalars or vectors."""
        values = np.concatenate(list(right))
        vector = any(isinstance(value, Node) and value.vector for value in values)
        solution = self._graph.call("solution", self._factors, transposed, *values, vector=vector)
        x = [self._graph.call("entry", solution, k, vector=vector) for k in range(len(values))]
        return np.split(as_objects(x), len(right))
