"""CasADi and IPOPT: direct collocation of a switched model that is measured at sample times, held inputs, resets.

Samples and inputs stay where they are in time while the transitions move. So each mode of the sequence runs through all
intervals between them, with the length of interval j in mode i

    h_ij = max(0, min(tau_i+1, t_j+1) - max(tau_i, t_j)),

which is zero where the mode is not active. An observed state at a sample is the initial one plus what each mode adds up
to there. So J is exactly the sum of squares that switchfit minimizes, continuous in the transition times with a kink at
each sample, and CasADi has its exact derivatives on both sides. States of all elements and collocation points are
variables of one sparse NLP, as in `casadi_collocation`; the first guess is a simulation at the guess of theta.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
import scipy.integrate

from benchmarks.peers.casadi_collocation import DEGREE, OPTIONS, Solution

LONGEST = 20.0
"""Seconds of CPU after which IPOPT stops. From a good start it takes one; where it is lost in its restoration phase an
iteration takes nearly as long, and three hundred some minutes."""

Field = Callable[[str, Sequence[Any], Sequence[Any], Sequence[Any], Any], list[Any]]
Reset = Callable[[Sequence[Any], Any], list[Any]]


@dataclass(frozen=True, eq=False)
class SampledModel:
    """A switched model with states that are measured at sample times.

    Attributes
    ----------
    field : ``field(mode, x, p, u, functions) -> list``; `functions` has sin and cos
    sequence, horizon, x0 : modes in turn, (t0, tf), initial state (n,)
    bounds : lower and upper bounds of the parameters, (M,) each
    times, values, observed, sigma : sample times (K,), values (K, q), places of the observed states (q,), noise
    input_times, inputs : times (L,) from which inputs (L, m) are held
    resets : ``reset(x, functions) -> list`` by pair of modes; it must not change observed states
    elements : elements of the collocation in each interval
    """

    field: Field
    sequence: tuple[str, ...]
    horizon: tuple[float, float]
    x0: tuple[float, ...]
    bounds: tuple[np.ndarray, np.ndarray]
    times: np.ndarray
    values: np.ndarray
    observed: tuple[int, ...]
    sigma: float
    input_times: tuple[float, ...] = ()
    inputs: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    resets: Mapping[tuple[str, str], Reset] = field(default_factory=dict)
    elements: int = 1

    @property
    def grid(self) -> np.ndarray:
        """Ends of all elements: (E + 1,)."""
        t0, tf = self.horizon
        inside = [t for t in (*self.times, *self.input_times) if t0 < t < tf]
        ends = np.unique([t0, *inside, tf])
        parts = np.arange(self.elements) / self.elements
        return np.append((ends[:-1, None] + np.diff(ends)[:, None] * parts).ravel(), tf)

    def input_of(self, starts: np.ndarray) -> np.ndarray:
        """Inputs in the elements that start at these times: (m, E)."""
        if not len(self.inputs):
            return np.zeros((0, len(starts)))
        return self.inputs[np.searchsorted(self.input_times, starts, "right") - 1].T

    def reset_between(self, before: str, after: str) -> Reset:
        """What happens to the state between two modes."""
        return self.resets.get((before, after), lambda x, functions: list(x))


class SampledCollocation:
    """The NLP of one model, built once; called with a first guess of theta it returns a `Solution`."""

    def __init__(self, model: SampledModel) -> None:
        self.model, self.n, self.grid = model, len(model.x0), model.grid
        self.E, self.M = len(self.grid) - 1, len(model.bounds[0])
        self.points = np.array(ca.collocation_points(DEGREE, "legendre"))
        N = len(model.sequence) - 1
        theta = ca.MX.sym("theta", N + self.M)
        X = [ca.MX.sym(f"X{i}", self.n, self.E + 1) for i in range(N + 1)]
        Z = [ca.MX.sym(f"Z{i}", self.n, self.E * DEGREE) for i in range(N + 1)]
        ends = ca.vertcat(model.horizon[0], theta[:N], model.horizon[1])
        p = theta[N:] if self.M else ca.MX(0, 1)
        u = ca.DM(model.input_of(self.grid[:-1]))
        left, right = ca.DM(self.grid[:-1]).T, ca.DM(self.grid[1:]).T
        gaps = [X[0][:, 0] - ca.DM(model.x0)]
        for i, mode in enumerate(model.sequence):
            if i:
                reset = model.reset_between(model.sequence[i - 1], mode)
                gaps.append(X[i][:, 0] - ca.vertcat(*reset(ca.vertsplit(X[i - 1][:, -1]), ca)))
            h = ca.fmax(0, ca.fmin(ends[i + 1], right) - ca.fmax(ends[i], left))
            element = self._build_element(mode).map(self.E)
            defects, after = element(X[i][:, :-1], Z[i], h, ca.repmat(p, 1, self.E), u)
            gaps += [ca.vec(defects), ca.vec(after - X[i][:, 1:])]
        at = np.searchsorted(self.grid, model.times).tolist()
        seen = list(model.observed)
        found = ca.repmat(ca.DM(model.x0)[seen], 1, len(at)) + sum(x[seen, at] - x[seen, [0] * len(at)] for x in X)
        residuals = (found - ca.DM(model.values).T) / model.sigma
        lengths = ends[1:] - ends[:-1]
        variables = ca.vertcat(theta, *map(ca.vec, X), *map(ca.vec, Z))
        nlp = {"x": variables, "f": 0.5 * ca.sumsqr(residuals), "g": ca.vertcat(*gaps, lengths)}
        self._solver = ca.nlpsol("fit", "ipopt", nlp, OPTIONS | {"expand": True, "ipopt.max_cpu_time": LONGEST})
        zeros = sum(gap.numel() for gap in gaps)
        free = np.full(variables.numel() - N - self.M, np.inf)
        self._limits = {
            "lbx": np.concatenate([np.full(N, model.horizon[0]), model.bounds[0], -free]),
            "ubx": np.concatenate([np.full(N, model.horizon[1]), model.bounds[1], free]),
            "lbg": 0.0,
            "ubg": np.concatenate([np.zeros(zeros), np.full(N + 1, np.inf)]),
        }

    def _build_element(self, mode: str) -> ca.Function:
        """Defects and end of one element from its start, its points, length, parameters and input."""
        model = self.model
        C, D, _ = ca.collocation_coeff(self.points.tolist())
        z0, Z, h = ca.SX.sym("z0", self.n), ca.SX.sym("Z", self.n, DEGREE), ca.SX.sym("h")
        p, u = ca.SX.sym("p", self.M), ca.SX.sym("u", model.inputs.shape[1])
        given = ca.vertsplit(p) if self.M else [], ca.vertsplit(u) if model.inputs.shape[1] else []
        whole = ca.horzcat(z0, Z)
        rates = [ca.vertcat(*model.field(mode, ca.vertsplit(Z[:, j]), *given, ca)) for j in range(DEGREE)]
        return ca.Function("element", [z0, Z, h, p, u], [whole @ C - h * ca.horzcat(*rates), whole @ D])

    def __call__(self, theta: np.ndarray) -> Solution:
        """Fit from theta."""
        found = self._solver(x0=np.concatenate([theta, *self._simulate(theta)]), **self._limits)
        stats = self._solver.stats()
        at = found["x"].full().ravel()[: len(theta)]
        return Solution(at, float(found["f"]), int(stats["iter_count"]), bool(stats["success"]))

    def _simulate(self, theta: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """States at the elements' ends and at the points, mode by mode, by `solve_ivp` at theta."""
        model, x = self.model, np.array(self.model.x0)
        N = len(model.sequence) - 1
        knots, p = [model.horizon[0], *theta[:N], model.horizon[1]], theta[N:].tolist()
        u = model.input_of(self.grid[:-1]).T.tolist()
        ends, inside = [], []
        for i, (mode, (begin, end)) in enumerate(zip(model.sequence, pairwise(knots), strict=True)):
            if i:
                x = np.array(model.reset_between(model.sequence[i - 1], mode)(x.tolist(), math))
            ends.append(x)
            for k, (a, b) in enumerate(pairwise(np.clip(self.grid, begin, end).tolist())):
                states = self._solve(mode, p, u[k] if u else [], x, a, b)
                inside.append(states[:, :-1].T.ravel())
                x = states[:, -1]
                ends.append(x)
        return np.concatenate(ends), np.concatenate(inside)

    def _solve(self, mode: str, p: list[float], u: list[float], x: np.ndarray, a: float, b: float) -> np.ndarray:
        """States (n, degree + 1) at the points and at the end of an element from a to b."""
        if b <= a:
            return np.repeat(x[:, None], DEGREE + 1, axis=1)
        times = np.minimum(a + (b - a) * np.append(self.points, 1.0), b)

        def rates(t: float, y: np.ndarray) -> list[float]:
            return self.model.field(mode, y.tolist(), p, u, math)

        return scipy.integrate.solve_ivp(rates, (a, b), x, "RK45", t_eval=times, rtol=1e-6, atol=1e-8).y
