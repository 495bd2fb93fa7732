"""CasADi: single shooting with the exact Hessian, every segment in equal Runge-Kutta steps of symbolic length.

Both ways the documentation recommends: all in one SX graph of scalars, which is fast and takes long to build, or
`Function.fold` over an SX step in MX, which is soon built. `hessian()` gives the derivatives, and calls go through
`Function.buffer()`, without conversions. The tableau is that of switchfit (Butcher's, order 5).
"""

from __future__ import annotations

from functools import cache

import casadi as ca
import numpy as np

from benchmarks.models import Model
from benchmarks.peers import Functions

LADDER = (4, 8, 16, 24, 32, 48, 64, 96, 128, 192)
"""Steps in a segment of average length."""

A = ((), (1 / 4,), (1 / 8, 1 / 8), (0, -1 / 2, 1), (3 / 16, 0, 0, 9 / 16), (-3 / 7, 2 / 7, 12 / 7, -12 / 7, 8 / 7))
B = (7 / 90, 0, 32 / 90, 12 / 90, 32 / 90, 7 / 90)


def build(model: Model, steps: int, unrolled: bool) -> Functions:
    """J and its derivatives, as one SX graph or as a loop in MX; each graph is built when first called."""
    theta0, N = model.theta, len(model.times)
    average = (model.horizon[1] - model.horizon[0]) / len(model.sequence)
    counts = [max(1, round(steps * (b - a) / average)) for _, a, b in model.segments(theta0)]
    kind = ca.SX if unrolled else ca.MX
    theta = kind.sym("theta", len(theta0))
    rows = {mode: _step(model, mode) for mode in model.modes}
    z = kind(ca.DM([*model.x0, 0.0]))
    p = theta[N:] if model.p else kind(0, 1)
    for count, (mode, start, end) in zip(counts, model.segments(theta), strict=True):
        h = (end - start) / count
        if unrolled:
            for _ in range(count):
                z = rows[mode](z, h, p)
        else:
            z = rows[mode].fold(count)(z, ca.repmat(h, 1, count), ca.repmat(p, 1, count))
    J = z[-1]
    options = {"cse": True} if unrolled else {}

    def cost() -> Buffered:
        return Buffered(ca.Function("J", [theta], [J], options))

    def gradient() -> Buffered:
        return Buffered(ca.Function("g", [theta], [J, ca.densify(ca.gradient(J, theta))], options))

    def hessian() -> Buffered:
        H, g = ca.hessian(J, theta)
        return Buffered(ca.Function("H", [theta], [J, ca.densify(g), ca.densify(H)], options))

    cost, gradient, hessian = cache(cost), cache(gradient), cache(hessian)
    return Functions(
        f"{'SX' if unrolled else 'MX fold of SX steps'}, {sum(counts)} steps",
        lambda theta: cost()(theta)[0],
        lambda theta: gradient()(theta),
        lambda theta: hessian()(theta),
    )


def _step(model: Model, mode: str) -> ca.Function:
    """One Runge-Kutta step of a mode, the cost as the last state."""
    z, h, p = ca.SX.sym("z", len(model.x0) + 1), ca.SX.sym("h"), ca.SX.sym("p", len(model.p))
    slopes: list[ca.SX] = []
    for row in A:
        at = z
        for a, slope in zip(row, slopes, strict=True):
            at = at + h * a * slope if a else at
        x = [at[i] for i in range(len(model.x0))]
        slopes.append(ca.vertcat(*model.field(mode, x, ca.vertsplit(p) if model.p else [], ca), model.density(x)))
    total = sum((b * slope for b, slope in zip(B, slopes, strict=True) if b), ca.SX.zeros(z.numel()))
    return ca.Function("step", [z, h, p], [z + h * total], {"cse": True})


class Buffered:
    """A CasADi function of theta called through its buffers; the first result is a number."""

    def __init__(self, function: ca.Function) -> None:
        self._function = function
        self._theta = np.zeros(function.nnz_in(0))
        self._results = [np.zeros(function.size_out(k), order="F") for k in range(function.n_out())]
        self._buffer, self._run = function.buffer()
        self._buffer.set_arg(0, memoryview(self._theta))
        for k, result in enumerate(self._results):
            self._buffer.set_res(k, memoryview(result.reshape(-1, order="F")))

    def __call__(self, theta: np.ndarray) -> tuple:
        self._theta[:] = theta
        self._run()
        J, *rest = self._results
        return (float(J[0, 0]), *(matrix[:, 0].copy() if matrix.shape[1] == 1 else matrix.copy() for matrix in rest))
