"""CasADi and IPOPT: multi-phase direct collocation with free phase lengths, the exact Hessian, for whole fits.

After the documentation's example of direct collocation: Legendre points, `collocation_coeff`, states of all elements
and points as variables of one sparse NLP, one SX function an element that is mapped over the elements of a phase.
IPOPT is `nlpsol`'s default companion; the first guess of the states is a simulation at the guess of theta, as is
advised for fits. A reference signal is a B-spline (`Function.bspline`), cubic and not-a-knot as switchfit's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
import scipy.integrate
import scipy.interpolate

from benchmarks.models import Model

LADDER = (4, 8, 16, 32)
"""Elements in a phase."""

DEGREE = 4
OPTIONS = {
    "print_time": False,
    "error_on_fail": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.tol": 1e-9,
    "ipopt.max_iter": 300,
}


@dataclass(frozen=True)
class Solution:
    """theta where IPOPT stopped, J as collocation sees it, iterations, and whether IPOPT was content."""

    theta: np.ndarray
    cost: float
    iterations: int
    success: bool


class Collocation:
    """The NLP of one model, built once; called with a first guess of theta it returns a `Solution`.

    Parameters
    ----------
    elements : elements of a phase
    bounds : lower and upper bounds of the parameters (M,)
    reference : knots (K,) and values (K, n) of x_m, for the density of x - x_m
    """

    def __init__(
        self,
        model: Model,
        elements: int,
        bounds: tuple[np.ndarray, np.ndarray],
        reference: tuple[np.ndarray, np.ndarray] | None = None,
    ) -> None:
        self.model, self.K, self.n = model, elements, len(model.x0)
        self.points = np.array(ca.collocation_points(DEGREE, "legendre"))
        phases, N, M = len(model.sequence), len(model.times), len(model.p)
        theta = ca.MX.sym("theta", N + M)
        X = ca.MX.sym("X", self.n, phases * elements + 1)
        Z = ca.MX.sym("Z", self.n, phases * elements * DEGREE)
        signal = None if reference is None else _signal(*reference)
        J, gaps = ca.MX(0), [X[:, 0] - ca.DM(model.x0)]
        p = theta[N:] if M else ca.MX(0, 1)
        for i, (mode, start, end) in enumerate(model.segments(theta)):
            h = (end - start) / elements
            here = slice(i * elements, (i + 1) * elements)
            inside = Z[:, here.start * DEGREE : here.stop * DEGREE]
            R = ca.MX.zeros(self.n, elements * DEGREE)
            if signal is not None:
                times = start + h * ca.DM((np.arange(elements)[:, None] + self.points).reshape(1, -1))
                R = signal.map(elements * DEGREE)(times)
            element = self._element(mode).map(elements)
            defects, after, costs = element(X[:, here], inside, ca.repmat(h, 1, elements), ca.repmat(p, 1, elements), R)
            gaps += [ca.vec(defects), ca.vec(after - X[:, here.start + 1 : here.stop + 1])]
            J = J + ca.sum2(costs)
        ends = ca.vertcat(model.horizon[0], theta[:N], model.horizon[1])
        lengths = ends[1:] - ends[:-1]
        variables = ca.vertcat(theta, ca.vec(X), ca.vec(Z))
        nlp = {"x": variables, "f": J, "g": ca.vertcat(*gaps, lengths)}
        options = OPTIONS if signal is not None else OPTIONS | {"expand": True}  # a B-spline cannot be expanded
        self._solver = ca.nlpsol("fit", "ipopt", nlp, options)
        zeros = sum(gap.numel() for gap in gaps)
        free = np.full(variables.numel() - N - M, np.inf)
        self._limits = {
            "lbx": np.concatenate([np.full(N, model.horizon[0]), bounds[0], -free]),
            "ubx": np.concatenate([np.full(N, model.horizon[1]), bounds[1], free]),
            "lbg": 0.0,
            "ubg": np.concatenate([np.zeros(zeros), np.full(phases, np.inf)]),
        }

    def _element(self, mode: str) -> ca.Function:
        """Defects, end and cost of one element from its start, its points, length, parameters and reference."""
        model = self.model
        C, D, B = ca.collocation_coeff(self.points.tolist())
        z0, Z = ca.SX.sym("z0", self.n), ca.SX.sym("Z", self.n, DEGREE)
        h, p, R = ca.SX.sym("h"), ca.SX.sym("p", len(model.p)), ca.SX.sym("R", self.n, DEGREE)
        parameters = ca.vertsplit(p) if model.p else []
        whole = ca.horzcat(z0, Z)
        rates, densities = [], []
        for j in range(DEGREE):
            rates.append(ca.vertcat(*model.field(mode, ca.vertsplit(Z[:, j]), parameters, ca)))
            densities.append(model.density(ca.vertsplit(Z[:, j] - R[:, j])))
        defects = whole @ C - h * ca.horzcat(*rates)
        cost = h * (ca.horzcat(*densities) @ B)
        return ca.Function("element", [z0, Z, h, p, R], [defects, whole @ D, cost])

    def __call__(self, theta: np.ndarray) -> Solution:
        """Fit from theta."""
        found = self._solver(x0=np.concatenate([theta, *self._simulated(theta)]), **self._limits)
        stats = self._solver.stats()
        at = found["x"].full().ravel()[: len(theta)]
        return Solution(at, float(found["f"]), int(stats["iter_count"]), bool(stats["success"]))

    def _simulated(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States at the elements' ends and at the points, by `solve_ivp` at theta."""
        model, x = self.model, np.array(self.model.x0)
        p = [float(value) for value in model.parameters(theta)]
        ends, inside = [x], []
        for mode, start, end in model.segments(theta):
            grid = np.arange(self.K)[:, None] + np.append(self.points, 1.0)
            times = np.clip(start + (end - start) * grid.ravel() / self.K, start, end)
            states = _solved(model, mode, p, x, start, end, times)
            table = states.reshape(self.n, self.K, DEGREE + 1)
            inside.append(table[:, :, :DEGREE].reshape(self.n, -1))
            ends += list(table[:, :, DEGREE].T)
            x = ends[-1]
        return np.concatenate(ends), np.concatenate(inside, axis=1).T.ravel()


def _solved(
    model: Model, mode: str, p: list[float], x: np.ndarray, start: float, end: float, times: np.ndarray
) -> np.ndarray:
    """States (n, len(times)) of one mode."""

    def rates(t: float, y: np.ndarray) -> list[float]:
        return model.field(mode, y.tolist(), p, math)

    if end <= start:
        return np.repeat(x[:, None], len(times), axis=1)
    return scipy.integrate.solve_ivp(rates, (start, end), x, "RK45", t_eval=times, rtol=1e-6, atol=1e-8).y


def _signal(knots: np.ndarray, values: np.ndarray) -> Any:
    """The not-a-knot cubic spline through the values as a CasADi function of time."""
    spline = scipy.interpolate.make_interp_spline(knots, values, k=3)
    return ca.Function.bspline("reference", [spline.t.tolist()], spline.c.ravel().tolist(), [3], values.shape[1])
