"""Linear systems of implicit rows: elimination in straight-line code, or a routine for large and dense ones.

Straight-line code leaves zeros of the Jacobians out and takes the states in an order in which few arise (minimum
degree). It has no pivots: its diagonal is 1 minus a few terms, which are negative in a stable mode.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.discretization.rows import couple
from switchfit.engine.native.llvm.routines import count_doubles
from switchfit.engine.native.scalars.graph import Graph, Node, Objects, Scalar, as_objects
from switchfit.engine.native.tracing.entries import known_number

MOST_PRODUCTS = 150
"""Products for each equation from which elimination is left to a routine: those of 7 states that all depend on each
other, which compile in 1.5 s then, not 5 s, and take 1.5 times as long to evaluate. A chain of states takes 36."""

KEPT_POINTER = "kept"
"""Name of the pointer to what the forward step of a row keeps for the backward one."""


def eliminate(a: FloatArray, h: Node, f_x: Sequence[Objects], place: int | None = None) -> Elimination | Routine:
    """Factorize the matrix of the coupled equations: see `switchfit.discretization.rows`.

    With a place behind `KEPT_POINTER`, another function can `load` the factors from there, once their `stores` are
    written.
    """
    filled = np.any([[[known_number(value) != 0.0 for value in row] for row in J] for J in f_x], axis=0)
    order, products = order_states(filled)
    n, s = len(order), len(a)
    if _takes_routine(products, n, s):
        entries = [value for J in f_x for value in J.reshape(-1)]
        return Routine(h.graph.call("factors", n, tuple(map(tuple, a.tolist())), place, h, *entries))
    # By states, with the stages of each next to one another: fill-in then follows the pattern of D_1 f.
    order = [n * j + state for state in order for j in range(s)]
    return Elimination(_factorize(np.block(couple(a, h, f_x))[np.ix_(order, order)]), order, place or 0)


def count_factors(n: int, s: int) -> int:
    """Return how many doubles the factors for n states and s stages take at most."""
    of_dense = sum(k**2 for k in range(1, n + 1))
    return count_doubles(n * s) if _takes_routine(of_dense, n, s) else (n * s) ** 2


def _takes_routine(products: int, n: int, s: int) -> bool:
    return products * s**2 > MOST_PRODUCTS * n


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


def _factorize(a: Objects) -> Objects:
    """Replace a matrix (m, m) by its factors L and U, with 1 / U on the diagonal."""
    for k in range(len(a)):
        a[k, k] = 1.0 / a[k, k]
        after = [j for j in range(k + 1, len(a)) if a[k, j].number != 0.0]
        for i in range(k + 1, len(a)):
            if a[i, k].number == 0.0:
                continue
            # L is stored below the diagonal, which is 1 there, and U above it; structural zeros are skipped.
            a[i, k] = a[i, k] * a[k, k]
            for j in after:
                a[i, j] = a[i, j] - a[i, k] * a[k, j]
    return a


class Elimination:
    """The factors of a matrix (m, m), its rows and columns in this order, as nodes."""

    def __init__(self, factors: Objects, order: list[int], place: int) -> None:
        self._factors, self._order, self._place = factors, order, place

    @property
    def stores(self) -> list[tuple[str, int, Node]]:
        """Stores of all factors but known numbers."""
        unknown = [node for node in self._factors.reshape(-1).tolist() if node.number is None]
        return [(KEPT_POINTER, k, node) for k, node in enumerate(unknown, self._place)]

    def load(self, graph: Graph) -> Elimination:
        """Load the factors in another graph."""
        loads = (graph.load(KEPT_POINTER, k, certain=False) for _, k, _ in self.stores)
        nodes = self._factors.reshape(-1).tolist()
        factors = [next(loads) if node.number is None else graph.constant(node.number) for node in nodes]
        return Elimination(as_objects(factors).reshape(self._factors.shape), self._order, self._place)

    def solve(self, right: Sequence[Objects], *, transposed: bool = False) -> list[Any]:
        """Return the solution for a right-hand side of s vectors (n,) of scalars or vectors."""
        x = np.concatenate(list(right))[self._order]
        order, a = range(len(x)), self._factors.T if transposed else self._factors
        # P A P' = L U: forward with L, backward with U; transposed, U' L': the diagonal of U goes with the forward
        # part.
        for i in order:
            x[i] = _subtract(x[i], a[i, :i], x[:i]) * (a[i, i] if transposed else 1.0)
        for i in reversed(order):
            x[i] = _subtract(x[i], a[i, i + 1 :], x[i + 1 :]) * (1.0 if transposed else a[i, i])
        return np.split(x[np.argsort(self._order)], len(right))


def _subtract(value: Scalar, factors: Objects, others: Objects) -> Scalar:
    for factor, other in zip(factors, others, strict=True):
        if factor.number != 0.0:
            value = value - factor * other
    return value


class Routine:
    """The factors of a matrix in memory, by the functions of `switchfit.engine.native.llvm`."""

    stores = ()

    def __init__(self, factors: Node) -> None:
        self._factors = factors

    def load(self, graph: Graph) -> Routine:
        """Load the factors in another graph."""
        return Routine(graph.call("factors", *self._factors.args[:3]))

    def solve(self, right: Sequence[Objects], *, transposed: bool = False) -> list[Any]:
        """Return the solution for a right-hand side of s vectors (n,) of scalars or vectors."""
        values = np.concatenate(list(right))
        vector = any(isinstance(value, Node) and value.vector for value in values)
        graph: Graph = self._factors.graph
        solution = graph.call("solution", self._factors, transposed, *values, vector=vector)
        x = [graph.call("entry", solution, k, vector=vector) for k in range(len(values))]
        return np.split(as_objects(x), len(right))
