"""SciPy: `solve_ivp` mode by mode in plain Python, the cost as a last state, derivatives by finite differences.

What one writes without a library of derivatives. DOP853 is what `solve_ivp`'s documentation recommends for high
accuracy, Radau for stiff problems. The gradient is `scipy.optimize.approx_fprime`'s formula (forward differences, one
solve an unknown), with steps that suit the noise of the solver; the Hessian differences twice, d(d + 1)/2 more solves.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import scipy.integrate

from benchmarks.models import Model
from benchmarks.peers import Functions

LADDER = (1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12)


def build(model: Model, rtol: float) -> Functions:
    """J by `solve_ivp` with `rtol` and atol = rtol/100, and differences of it."""
    method = "Radau" if model.stiff else "DOP853"
    cost = cost_of(model, rtol)
    scale = np.maximum(np.abs(model.theta), 1e-3)
    forward, second = scale * math.sqrt(rtol), scale * rtol ** (1 / 4)

    def gradient(theta: np.ndarray) -> tuple[float, np.ndarray]:
        J = cost(theta)
        moved = theta + np.diag(forward)
        return J, (np.array([cost(at) for at in moved]) - J) / forward

    def hessian(theta: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        d, J = len(theta), cost(theta)
        steps = np.diag(second)
        up, down = (np.array([cost(theta + sign * step) for step in steps]) for sign in (1.0, -1.0))
        H = np.diag((up - 2 * J + down) / second**2)
        for i in range(d):
            for j in range(i):
                both = cost(theta + steps[i] + steps[j])
                H[i, j] = H[j, i] = (both - up[i] - up[j] + J) / (second[i] * second[j])
        return J, (up - down) / (2 * second), H

    return Functions(f"{method}, rtol {rtol:.0e}", cost, gradient, hessian)


def cost_of(model: Model, rtol: float, atol: float | None = None) -> Callable[[np.ndarray], float]:
    """J as a function of theta; infinite where the switches are out of order."""
    settings = {"rtol": rtol, "atol": rtol / 100 if atol is None else atol}
    settings["method"] = "Radau" if model.stiff else "DOP853"

    def rates(mode: str, p: list[float]) -> Callable[[float, np.ndarray], list[float]]:
        def f(t: float, y: np.ndarray) -> list[float]:
            x = y.tolist()[:-1]
            return [*model.field(mode, x, p, math), model.density(x)]

        return f

    def cost(theta: np.ndarray) -> float:
        p = [float(value) for value in model.parameters(theta)]
        y = np.array([*model.x0, 0.0])
        for mode, start, end in model.segments(theta):
            if end < start:
                return math.inf
            if end > start:
                y = scipy.integrate.solve_ivp(rates(mode, p), (start, end), y, **settings).y[:, -1]
        return float(y[-1])

    return cost
