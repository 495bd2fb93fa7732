"""Straight-line functions of the forward propagation of many hypotheses.

Names of the pointers are those of `switchfit.engine.native.kernels`; x, Z, J, g, H and check are those of one
hypothesis. All derivatives are propagated forward, so that a cost of (t, x, p) adds ``Z' g_x + g_p`` to g and its
Gauss-Newton matrix to H at once, without a costate. Further pointers:

    K           f and the running cost ell at a birth, (n + 1,)
    error       largest estimate of the error of a step so far, relative to the tolerances, which are the entries of
    tolerances  relative; size of a state at which the relative and the absolute error count the same; information of a
                guard on the time of its transition
    moved       the sum of all changes of the unknowns so far, (D,)
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from switchfit.engine.native.kernels import Kernels, Store, store_all
from switchfit.engine.native.scalars.graph import Graph, Namespace, Objects

SMALLEST_RATE = 1e-30
"""Square of the rate of a guard below which it says nothing on the time."""


class HypothesisKernels(Kernels):
    """Writes the straight-line functions of hypotheses; the order of derivatives is that of Gauss-Newton."""

    adjoint = False

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
        c, c_t, c_x, c_p = (np.ravel(each) for each in found[:4])
        # c changes by rate dtau: an error sigma_t of the time is one of rate sigma_t of c. J gets c^2 / (2 (rate
        # sigma_t)^2), in its own units.
        rate = (c_x * graph.loads("K", self.sizes.n)).sum() + c_t.item()
        weight = graph.load("tolerances", 2) / (rate * rate + SMALLEST_RATE)
        slopes = np.concatenate([c_t, c_x, c_p])
        first = np.split(weight * c.item() * slopes, [1, 1 + self.sizes.n])
        return self._cost(graph, [0.5 * weight * c * c, *first, weight * np.outer(slopes, slopes)], moving)

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
        g = graph.loads("g", D)
        after = np.array([g[i] + (graph.loads("H", D, i * width) * d).sum() for i in range(D)])
        J = graph.load("J", 0) + 0.5 * (d * (g + after)).sum()
        stores = [("J", 0, J), *store_all("x", 0, x), *store_all("g", 0, after), *store_all("moved", 0, moved + d)]
        p = graph.loads("p", self.sizes.M) + d[N:]
        self.module.write_straight_line("shift", stores + store_all("p", 0, p))
