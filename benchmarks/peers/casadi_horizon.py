"""CasADi and IPOPT: moving horizon estimation with a relaxed mode.

The last samples are fitted by multiple shooting (Runge-Kutta, two steps a sample interval). The unknowns are the
states, the parameter, and for each interval the share w in [0, 1] of the second mode; the model is exact otherwise, so
that there is no process noise. What older samples say is the arrival cost of an extended Kalman filter, which takes
each sample as it leaves, with the share that it left with. Each solution starts from the last one, shifted, with its
multipliers.
"""

from __future__ import annotations

from collections.abc import Sequence

import casadi as ca
import numpy as np

from benchmarks.models import Model, integrate_sample
from benchmarks.peers.casadi_collocation import OPTIONS

SAMPLES = 30
WARM = {
    "ipopt.tol": 1e-6,
    "ipopt.warm_start_init_point": "yes",
    "ipopt.mu_init": 1e-3,
    "ipopt.max_iter": 100,
    "expand": True,
}


class Program:
    """The compiled functions of a model with two modes; `Horizon` uses them.

    Parameters
    ----------
    observed : places of the measured states
    sigma : noise of each of these
    bounds : of the parameter
    smooth : weight of squared differences of neighbouring shares
    """

    def __init__(
        self, model: Model, period: float, observed: Sequence[int], sigma: Sequence[float],
        bounds: tuple[float, float], smooth: float,
    ) -> None:  # fmt: skip
        self.model, self.sigma = model, np.array(sigma)
        n = self.n = len(model.x0)
        D = n + 1
        self.H = np.eye(D)[list(observed)]
        z, w = ca.SX.sym("z", D), ca.SX.sym("w")
        after = self._step(z, w, period)
        self.step = ca.Function("step", [z, w], [after])
        self.tangent = ca.Function("tangent", [z, w], [after, ca.jacobian(after, z)])
        X, p, W = ca.SX.sym("X", n, SAMPLES + 1), ca.SX.sym("p"), ca.SX.sym("W", SAMPLES)
        Y, mean, root = ca.SX.sym("Y", len(sigma), SAMPLES), ca.SX.sym("mean", D), ca.SX.sym("root", D, D)
        gaps, cost = [], ca.sumsqr(root @ (ca.vertcat(X[:, 0], p) - mean)) / 2
        for k in range(SAMPLES):
            gaps.append(X[:, k + 1] - self.step(ca.vertcat(X[:, k], p), W[k])[:n])
            cost += ca.sumsqr((X[list(observed), k + 1] - Y[:, k]) / self.sigma) / 2
        cost += smooth / 2 * ca.sumsqr(W[1:] - W[:-1])
        nlp = {"x": ca.vertcat(ca.vec(X), p, W), "f": cost, "g": ca.vertcat(*gaps)}
        nlp["p"] = ca.vertcat(ca.vec(Y), mean, ca.vec(root))
        self.solve = ca.nlpsol("horizon", "ipopt", nlp, OPTIONS | WARM)
        free = np.full(n * (SAMPLES + 1), np.inf)
        lower, upper = bounds
        self.limits = {
            "lbx": np.concatenate([-free, [lower], np.zeros(SAMPLES)]),
            "ubx": np.concatenate([free, [upper], np.ones(SAMPLES)]),
            "lbg": 0.0,
            "ubg": 0.0,
        }

    def _step(self, z: ca.SX, w: ca.SX, period: float) -> ca.SX:
        """Return states and parameter a sample interval later."""

        def rates(z: ca.SX) -> ca.SX:
            x, p = ca.vertsplit(z[: self.n]), [z[self.n]]
            first, second = (ca.vertcat(*self.model.field(mode, x, p, ca)) for mode in self.model.modes)
            return ca.vertcat((1 - w) * first + w * second, 0)

        return integrate_sample(rates, z, period)


class Horizon:
    """The estimator. The first mode is taken to be known until a horizon is full.

    `spread` is the standard deviation of the first guess of the parameter.
    """

    def __init__(self, program: Program, spread: float = 0.3) -> None:
        model, n = program.model, program.n
        self._program = program
        self._mean = np.array([*model.x0, *model.p])  # of the state before the horizon, and its covariance
        self._P = np.diag([1e-8] * n + [spread**2])
        self._values: list[np.ndarray] = []
        self._solution: dict[str, np.ndarray] | None = None

    def update(self, t: float, y: np.ndarray) -> tuple[np.ndarray, float]:
        """Return the share of the second mode in each interval of the horizon, and the parameter."""
        program, n = self._program, self._program.n
        self._values.append(y)
        if len(self._values) < SAMPLES:
            return np.zeros(SAMPLES), float(self._mean[n])
        if len(self._values) > SAMPLES:
            self._leave()
        root = np.linalg.cholesky(np.linalg.inv(self._P)).T
        given = np.concatenate([np.ravel(self._values), self._mean, root.ravel(order="F")])
        start = self._guess() if self._solution is None else self._shift()
        found = program.solve(p=given, **start, **program.limits)
        self._solution = {name: found[name].full().ravel() for name in ("x", "lam_x", "lam_g")}
        return self._solution["x"][-SAMPLES:], float(self._solution["x"][n * (SAMPLES + 1)])

    def _leave(self) -> None:
        """Move the arrival cost by a sample, linearised where the last solution was."""
        program, n, x = self._program, self._program.n, self._solution["x"]
        p, H = x[n * (SAMPLES + 1)], program.H
        after, F = (each.full() for each in program.tangent(np.append(x[:n], p), x[-SAMPLES]))
        mean = after.ravel() + F @ (self._mean - np.append(x[:n], p))
        P = F @ self._P @ F.T
        gain = np.linalg.solve(H @ P @ H.T + np.diag(program.sigma**2), H @ P).T
        self._mean = mean + gain @ (self._values.pop(0) - H @ mean)
        keep = np.eye(n + 1) - gain @ H
        self._P = keep @ P @ keep.T + gain @ np.diag(program.sigma**2) @ gain.T + 1e-9 * np.eye(n + 1)

    def _guess(self) -> dict[str, np.ndarray]:
        states = [self._mean]
        for _ in range(SAMPLES):
            states.append(self._program.step(states[-1], 0.0).full().ravel())
        n = self._program.n
        return {"x0": np.concatenate([np.ravel([z[:n] for z in states]), self._mean[n:], np.full(SAMPLES, 0.01)])}

    def _shift(self) -> dict[str, np.ndarray]:
        """Return the last solution one sample later, its last interval twice."""
        n, s = self._program.n, self._solution
        x, lam_x = s["x"], s["lam_x"]
        last = self._program.step(np.append(x[n * SAMPLES : n * (SAMPLES + 1)], x[n * (SAMPLES + 1)]), x[-1]).full()
        place = n * (SAMPLES + 1)

        def move(v: np.ndarray, tail: np.ndarray) -> np.ndarray:
            return np.concatenate([v[n:place], tail, v[place : place + 1], v[place + 2 :], v[-1:]])

        lam_g = s["lam_g"]
        return {
            "x0": move(x, last.ravel()[:n]),
            "lam_x0": move(lam_x, np.zeros(n)),
            "lam_g0": np.append(lam_g[n:], lam_g[-n:]),
        }
