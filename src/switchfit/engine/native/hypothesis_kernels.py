"""Straight-line functions of the forward propagation of many hypotheses; see `switchfit.engine.native.hypotheses`.

Names of pointers are those of `switchfit.engine.native.kernels`; x, Z, J, g, H and check are those of one hypothesis.
All derivatives are propagated forward, so that a cost of (t, x, p) adds ``Z' g_x + g_p`` to g and its Gauss-Newton
matrix to H at once, without a costate. Further pointers:

    K           f and the running cost ell at a birth, (n + 1,)
    error       largest estimate of the error of a step so far, relative to the tolerances, which are the entries of
    tolerances  relative; size of a state at which the relative and the absolute error count the same; information of a
                guard on the time of its transition
    along       derivative of a guard along theta, a vector, and its information
    shift       a change of the unknowns, (D,), and moved the sum of all changes so far
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from switchfit.discretization.rows import (
    EXPLICIT_ERROR,
    Stages,
    Tableau,
    Tangent,
    combine,
    estimate_error,
    times_vector,
)
from switchfit.engine.native.elimination import eliminate
from switchfit.engine.native.kernels import Kernels, Store, as_vector, list_entries, store_all
from switchfit.engine.native.scalars import Graph, Namespace, Node, Objects, Template
from switchfit.engine.native.templates import F_X, GRADIENT, SECOND, F

SMALLEST_RATE = 1e-30
"""Square of the rate of a guard below which it says nothing on the time."""


class HypothesisKernels(Kernels):
    """Writes the straight-line functions of hypotheses; the order of derivatives is that of Gauss-Newton."""

    def step(self, mode: int, stage: Template, costs: bool) -> list[tuple[int, int]]:
        """Write a step in a mode: state, tangents, running costs and the estimate of the error.

        Its ends do not move: births change Z by `move` and `hold`, between steps. Return which second derivatives of
        the running costs are stored for each stage, as `Kernels.backward_row`.
        """
        self._chosen: list[tuple[int, int]] = []
        if self.library.implicit[mode]:
            self.newton(f"newton_{mode}", stage)
        self.forward_row(f"step_{mode}", stage, False, costs, self.tableau(mode))
        return self._chosen

    def _add_to_row(
        self, graph: Graph, stage: Template, tableau: Tableau, found: Stages, along: Tangent, costs: bool
    ) -> list[Store]:
        """Return stores of the largest error so far, and of what the running costs add to g and H."""
        at, (start, _, h), x = self._row(graph), self._load_times(graph), graph.loads("x", self.sizes.n)
        if tableau.coupled:
            slope, jacobian = stage(graph, *at(start, x), only=(F, F_X), checked=True)
            error = estimate_error(h, self.load_increments(graph), slope, jacobian, eliminate)
        else:
            error = h * combine(EXPLICIT_ERROR, found.slopes)
        stores = [("error", 0, self._largest_error(graph, error, x))]
        if not costs:
            return stores
        g, second = graph.load("g", 0, vector=True), []
        for j, (weight, t, X, X_d) in enumerate(zip(tableau.b.tolist(), *found[:2], along.states, strict=True)):
            # With w = 0 the second derivatives of w . f + h b_j ell are those of the running cost alone, weighted as in
            # J.
            given = at(t, X, hb=h * weight)
            g_x, g_p, S = stage(graph, *given, only=(*GRADIENT[1:], *SECOND), checked=True)
            # Forward, g' = sum_j h b_j (D_x ell X_j' + D_p ell p'): no costate, since thousands of children share no
            # future.
            g = g + (g_x * X_d).sum() + self._along_p(graph, g_p)
            second.append(list_entries(S, with_time=False))
            stores += store_all("XZ", j * self.sizes.n, [as_vector(graph, value) for value in X_d])
        self._chosen, entries = self._store_entries(graph, tableau, second)
        return [*stores, ("g", 0, as_vector(graph, g)), *entries]

    def _largest_error(self, graph: Graph, errors: Objects, x: Objects) -> Node:
        """Return the larger of the error so far and that of a step, relative to ``rtol (smallest + |x|)``."""
        rtol, smallest = graph.loads("tolerances", 2)
        largest = graph.load("error", 0)
        xp = Namespace(graph)
        for relative in xp.abs(errors) / (rtol * (smallest + xp.abs(x))):
            largest = xp.where(relative <= largest, largest, relative)  # false for NaN, which then is the error
        return largest

    def move(self, name: str, sign: float, costs: bool) -> None:
        """Write ``Z += sign * f moves'`` and ``g += sign * ell moves``.

        With 1 this leads from derivatives at a fixed time to those at the time of a transition, with -1 back.
        """
        graph, n = Graph(), self.sizes.n
        moves = graph.load("moves", 0, vector=True)
        Z = graph.loads("Z", n, vector=True) + sign * graph.loads("K", n) * moves
        stores = store_all("Z", 0, Z)
        if costs:
            stores.append(("g", 0, graph.load("g", 0, vector=True) + sign * graph.load("K", n) * moves))
        self.module.write_straight_line(name, stores)

    def _constraint(self, graph: Graph, found: Sequence[Objects], moving: bool) -> list[Store]:
        """Return stores of a guard as a measurement ``c(tau, x(tau-), p) = 0``, so precise that it determines tau.

        Its sigma is a small time, given by `tolerances`, times the rate ``D_t c + D_x c f`` at which c changes.
        """
        c, c_t, c_x, c_p = found[:4]
        # Derivative of c along theta at a tau that moves: Z is that of x(tau-), after `move`.
        along = times_vector(c_x, graph.loads("Z", self.sizes.n, vector=True)) + self._along_p(graph, c_p)
        along = as_vector(graph, (along + c_t * graph.load("moves", 0, vector=True)).item())
        # c changes by rate dtau: an error sigma_t of the time is one of rate sigma_t of c. J gets c^2 / (2 (rate
        # sigma_t)^2), in its own units.
        rate = (times_vector(c_x, graph.loads("K", self.sizes.n)) + c_t).item()
        weight = graph.load("tolerances", 2) / (rate * rate + SMALLEST_RATE)
        g = graph.load("g", 0, vector=True) + weight * c.item() * along
        J = graph.load("J", 0) + 0.5 * weight * c.item() * c.item()
        return [("along", 0, along), ("information", 0, weight), ("g", 0, as_vector(graph, g)), ("J", 0, J)]

    def square(self) -> None:
        """Write ``H += information along along'``."""
        graph = Graph()
        weight, along = graph.load("information", 0), graph.load("along", 0, vector=True)
        rows = [graph.load("H", d, vector=True) + weight * graph.load("along", d) * along for d in range(self.sizes.D)]
        self.module.write_straight_line("square", store_all("H", 0, rows))

    def _cost(self, graph: Graph, found: Sequence[Objects], moving: bool) -> list[Store]:
        """Return stores that add a cost of (t, x, p), given with its derivatives, to J, g and H."""
        cost, *derivatives = found
        Z = graph.loads("Z", self.sizes.n, vector=True)
        # `_scalar` leaves g_x to a costate, which hypotheses do not have: it is added by Z.
        (pointer, offset, g), *rows = self._scalar(graph, derivatives, moving)
        g = as_vector(graph, g + (derivatives[1] * Z).sum())
        return [("J", 0, graph.load("J", 0) + cost.item()), (pointer, offset, g), *rows]

    def shift(self) -> None:
        """Write the change d of the point of linearisation to the minimum of the cost, inside its bounds: ``x += Z d``,
        ``g+ = g + H d``, then ``J += (g + g+)'d / 2`` and ``p += d``.

        It follows from the rows that `score` has eliminated. Those of p are the last: birth times are the best for p
        inside its bounds.
        """
        graph, n, D, N, width = Graph(), self.sizes.n, self.sizes.D, self.sizes.N, self.sizes.width
        W = [graph.loads("rows", D, k * width) for k in range(D)]
        reduced, moved, low, high, most = (graph.loads(name, D) for name in ("reduced", "moved", "low", "high", "most"))
        xp, d = Namespace(graph), np.full(D, graph.constant(0.0), dtype=object)
        # Backward from the last unknown: step_k = (reduced_k + sum_{j > k} W_kj d_j) / W_kk, whose d_j are final. So an
        # unknown at its limit is a limit for those before it: the birth times are the best for the p that was possible.
        for k in reversed(range(D)):
            step = (reduced[k] + (W[k][k + 1 :] * d[k + 1 :]).sum()) / W[k][k]
            # First the limit of one move, then the bounds, which hold in any case.
            target = xp.minimum(xp.maximum(moved[k] - step, moved[k] - most[k]), moved[k] + most[k])
            d[k] = xp.minimum(xp.maximum(target, low[k]), high[k]) - moved[k]
        # The quadratic model at the new point: g+ = g + H d and J + g'd + d'H d / 2 = J + (g + g+)'d / 2; H stays.
        x = [graph.load("x", i) + (graph.loads("Z", D, i * width) * d).sum() for i in range(n)]
        g = graph.load("g", 0, vector=True) + (graph.loads("H", D, vector=True) * d).sum()
        stores = [*store_all("x", 0, x), ("g_after", 0, as_vector(graph, g)), *store_all("shift", 0, d)]
        self.module.write_straight_line("shift", stores)

        graph = Graph()
        # A second function: J needs the entries of g+ one by one, and g+ is a vector until it has been stored.
        d, g, after = (graph.loads(name, D) for name in ("shift", "g", "g_after"))
        J = graph.load("J", 0) + 0.5 * (d * (g + after)).sum()
        moved, p = graph.loads("moved", D) + d, graph.loads("p", self.sizes.M) + d[N:]
        stores = [("J", 0, J), *store_all("g", 0, after), *store_all("moved", 0, moved), *store_all("p", 0, p)]
        self.module.write_straight_line("shift_back", stores)
