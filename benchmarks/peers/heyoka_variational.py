"""heyoka: order-2 variational equations of each mode (`var_ode_sys`), chained over the switches by hand.

As its tutorial on variational equations recommends, the equations are made by `var_ode_sys` and compiled once; it is
run again by setting `time`, `state` and `pars`. All unknowns theta are variational parameters: the switches do not
appear in the equations, so that their columns obey the homogeneous equations and start where x jumps in theta. With
f, g the fields before and after the switch tau = theta[i], and x_j, x_jk the derivatives of the state at fixed time,

    x_j + f delta_ij   and   x_jk + (f_x x_j + f_j) delta_ik + (f_x x_k + f_k) delta_ij + f_x f delta_ij delta_ik

(the total derivatives of x(tau, theta)) are the same on both sides. The cost is a state of its own.
"Compact mode" compiles in a fraction of a second where the default, which unrolls everything, takes minutes; the
documentation recommends it for large systems. Where the default is quick it is used: it runs faster.
"""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import heyoka as hy
import numpy as np

from benchmarks.models import Model
from benchmarks.peers import Functions, symmetric

LADDER = (1e-6, 1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12)
COMPACT_FROM = 100
"""Equations from which compact mode is used."""


def build(model: Model, tolerance: float) -> Functions:
    """J and its derivatives with the integrator's tolerance given; integrators are compiled when first called."""
    chained = cache(partial(Chained, model, tolerance=tolerance))
    return Functions(
        f"tolerance {tolerance:.0e}",
        lambda theta: chained(0)(theta)[0],
        lambda theta: chained(1)(theta),
        lambda theta: chained(2)(theta),
    )


class Chained:
    """The modes' variational equations of one order, one integrator a mode, run after each other."""

    def __init__(self, model: Model, order: int, tolerance: float) -> None:
        self.model, self.order = model, order
        self.n, self.d, self.N = len(model.x0) + 1, len(model.theta), len(model.times)
        names = [f"x{i:02d}" for i in range(self.n)]
        x = hy.make_vars(*names)
        p = [hy.par[i] for i in range(self.N, self.d)]
        self._integrators, self._fields = {}, {}
        for mode in model.modes:
            rates = [*model.field(mode, x[:-1], p, hy), model.density(x[:-1])]
            rates = [rate if isinstance(rate, hy.expression) else hy.expression(rate) for rate in rates]
            system = list(zip(x, rates, strict=True))
            equations = system
            if order:
                equations = hy.var_ode_sys(system, [hy.par[i] for i in range(self.d)], order=order)
            count = self._count()
            self._integrators[mode] = hy.taylor_adaptive(
                equations, [*model.x0, 0.0], tol=tolerance, compact_mode=count > COMPACT_FROM
            )
            if order:
                slopes = [hy.diff(rate, z) for rate in rates for z in [*x, *p]]
                self._fields[mode] = hy.cfunc([*rates, *slopes], vars=x)
        if order == 2:
            self._second_order_places()

    def _count(self) -> int:
        pairs = self.d * (self.d + 1) // 2 if self.order == 2 else 0
        return self.n * (1 + (self.d if self.order else 0) + pairs)

    def _second_order_places(self) -> None:
        """Where each pair (j, k) stands among the second derivatives of a state."""
        integrator = next(iter(self._integrators.values()))
        span = integrator.get_vslice(order=2)
        self.pairs = []
        for place in range(span.start, span.start + self.d * (self.d + 1) // 2):
            exponents = integrator.get_mindex(place)[1:]
            self.pairs.append(tuple(j for j, times in enumerate(exponents) for _ in range(times)))
        self._place = {pair: k for k, pair in enumerate(self.pairs)}

    def __call__(self, theta: np.ndarray) -> Any:
        """(J, gradient, Hessian) as far as the order goes."""
        n, d = self.n, self.d
        state = np.zeros(self._count())
        state[: n - 1] = self.model.x0
        before = None
        for i, (mode, start, end) in enumerate(self.model.segments(theta)):
            if before is not None:
                self._jump(i - 1, before, mode, state, theta)
            before = mode
            integrator = self._integrators[mode]
            integrator.pars[:] = theta[: len(integrator.pars)]
            integrator.time = start
            integrator.state[:] = state
            integrator.propagate_until(end)
            state = integrator.state.copy()
        J = float(state[n - 1])
        if self.order == 0:
            return (J,)
        gradient = state[n : n + n * d].reshape(n, d)[-1].copy()
        if self.order == 1:
            return J, gradient
        return J, gradient, symmetric(d, self.pairs, state[n + n * d :].reshape(n, -1)[-1])

    def _jump(self, i: int, before: str, after: str, state: np.ndarray, theta: np.ndarray) -> None:
        """The derivatives of the state just after switch i from those just before, in place."""
        if self.order == 0:
            return
        n, d = self.n, self.d
        first = state[n : n + n * d].reshape(n, d)
        f, Df, Dfp = self._field(before, state[:n], theta)
        g, Dg, Dgp = self._field(after, state[:n], theta)
        rate_before = Df @ first + Dfp  # d/dt of the first derivatives
        first[:, i] += f - g
        if self.order == 1:
            return
        rate_after = Dg @ first + Dgp
        second = state[n + n * d :].reshape(n, -1)
        change = rate_before - rate_after
        for j in range(d):
            second[:, self._place[min(i, j), max(i, j)]] += change[:, j] * (2.0 if j == i else 1.0)
        second[:, self._place[i, i]] += Df @ f - Dg @ g

    def _field(self, mode: str, x: np.ndarray, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The field (n,), its Jacobian in x (n, n) and in theta (n, d)."""
        n, d = self.n, self.d
        field = self._fields[mode]
        values = field(x, pars=theta[: field.nparams]) if field.nparams else field(x)
        slopes = values[n:].reshape(n, -1)
        in_theta = np.zeros((n, d))
        in_theta[:, self.N :] = slopes[:, n:]
        return values[:n], slopes[:, :n], in_theta
