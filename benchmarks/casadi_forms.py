"""The vehicle's (J, gradient, Hessian) in CasADi, written in every form that might be the fastest.

Every form takes theta = (tau_1, tau_2, mu) and takes the rows from `vehicle.table_of_rows`: the same equations, steps,
Runge-Kutta tableau and reference as switchfit. The rows are baked in, so that CasADi neither sorts nor looks up
anything; it must be rebuilt where a transition passes a node (switchfit does that inside the timed call).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from itertools import groupby

import casadi as ca
import numpy as np

from benchmarks.vehicle import Row
from switchfit.discretization.tableaus import EXPLICIT

D = 3
Symbol = ca.SX | ca.MX
Form = Callable[[list[Row], bool], ca.Function]
"""``form(rows, reference) -> Function(theta) -> (J, g, H)``"""

N_DATA = 3 + 24  # start, end, origin, coefficients


def field(mode: str, x: Symbol, mu: Symbol) -> Symbol:
    """Equation (18), written as in `switchfit.models.skid_steer`."""
    m_b, m_w, B_l, B_w, a, b, c_1, c_2, g = 70.0, 2.5, 0.89, 0.55, 0.25, 0.23, 0.72, 0.92, 9.81
    m, inertia = m_b + 4 * m_w, 4 * m_w * (12 * a**2 + 12 * b**2) + m_b * (B_l**2 + B_w**2)
    dX, dY, theta, dtheta = x[1], x[3], x[4], x[5]
    cos, sin = ca.cos(theta), ca.sin(theta)
    if mode == "stick":
        return ca.vertcat(dX, (60.0 * cos - c_1 * dX) / m, dY, (60.0 * sin - c_1 * dY) / m, dtheta, 0.0)
    v = -sin * dX + cos * dY
    ddX = (54.0 * cos - c_2 * dX) / m + g * mu * sin * v
    ddY = (54.0 * sin - c_2 * dY) / m - g * mu * cos * v
    ddtheta = (12 * b * 54.0 - 12 * a**2 * g * m * mu * dtheta) / inertia
    return ca.vertcat(dX, ddX, dY, ddY, dtheta, ddtheta)


def step(row: Row, x: Symbol, theta: Symbol, data: Symbol | np.ndarray, reference: bool) -> tuple[Symbol, Symbol]:
    """State after one row and its cost; `data` holds the row's numbers (its symbols, or the numbers themselves)."""
    start = theta[row.starts_at] if row.starts_at >= 0 else data[0]
    end = theta[row.ends_at] if row.ends_at >= 0 else data[1]
    h = end - start
    slopes: list[Symbol] = []
    total, cost = 0, 0
    for a, b, c in zip(EXPLICIT.a, EXPLICIT.b, EXPLICIT.c, strict=True):
        increment = _combine(a, slopes)
        X = x if increment is None else x + h * increment
        slopes.append(field(row.mode, X, theta[2]))
        if b != 0.0:
            r = X
            if reference:
                s = start + c * h - data[2]
                k = [data[3 + 6 * i : 9 + 6 * i] for i in range(4)]
                r = X - (k[0] + s * (k[1] + s * (k[2] + s * k[3])))
            total, cost = total + b * slopes[-1], cost + b * 0.5 * ca.dot(r, r)
    return x + h * total, h * cost


def _combine(weights: np.ndarray, terms: list[Symbol]) -> Symbol | None:
    parts = [w * K for w, K in zip(weights.tolist(), terms, strict=False) if w != 0.0]
    return sum(parts[1:], parts[0]) if parts else None


def numbers(row: Row) -> np.ndarray:
    """The numbers of a row: (27,)."""
    return np.concatenate([[row.start, row.end, row.origin], row.coefficients.ravel()])


def runs(rows: list[Row]) -> Iterator[tuple[Row, np.ndarray]]:
    """Rows that follow each other and are of one kind: one of them, and the numbers of all (27, K)."""
    for _, group in groupby(rows, key=lambda row: (row.mode, row.starts_at, row.ends_at)):
        members = list(group)
        yield members[0], np.stack([numbers(row) for row in members], axis=1)


# --- everything in one SX graph ---------------------------------------------------------------------------------------


def whole_cost(rows: list[Row], reference: bool, theta: ca.SX) -> ca.SX:
    """J as one SX expression with the numbers of all rows as constants in it, folded by CasADi where possible."""
    x, J = ca.SX.zeros(6), ca.SX(0)
    for row in rows:
        x, cost = step(row, x, theta, ca.SX(numbers(row)), reference)
        J = J + cost
    return J


def whole_sx(gradient_mode: str, hessian_mode: str, cse: bool) -> Form:
    """One SX graph, differentiated by CasADi; modes are "forward", "reverse" or "auto" (`casadi.hessian`)."""

    def build(rows: list[Row], reference: bool) -> ca.Function:
        theta = ca.SX.sym("theta", D)
        J = whole_cost(rows, reference, theta)
        if gradient_mode == "auto":
            H, g = ca.hessian(J, theta)
        else:
            g = _jacobian(J, theta, gradient_mode).T
            H = _jacobian(g, theta, hessian_mode)
        return ca.Function("whole", [theta], [J, g, H], {"cse": cse})

    return build


def _jacobian(y: Symbol, x: Symbol, mode: str) -> Symbol:
    """Jacobian in the mode asked for."""
    if mode == "forward":
        return ca.jtimes(y, x, ca.DM.eye(x.numel()))
    return ca.horzcat(*[ca.jtimes(y, x, ca.DM.eye(y.numel())[:, i], True) for i in range(y.numel())]).T


# --- MX: the SX function of a row, accumulated over the rows ----------------------------------------------------------


def _row_function(row: Row, reference: bool, cse: bool) -> ca.Function:
    x, theta, data = ca.SX.sym("x", 6), ca.SX.sym("theta", D), ca.SX.sym("data", N_DATA)
    after, cost = step(row, x, theta, data, reference)
    return ca.Function("row", [x, theta, data], [after, cost], {"cse": cse})


def mapaccum(second: str, expand: bool = False) -> Form:
    """MX: `mapaccum` of an SX row, differentiated by CasADi as a whole; then, if asked, expanded to SX."""

    def build(rows: list[Row], reference: bool) -> ca.Function:
        theta = ca.MX.sym("theta", D)
        x, J = ca.MX.zeros(6), 0
        for row, data in runs(rows):
            K = data.shape[1]
            over = _row_function(row, reference, True).mapaccum("over", K)
            states, costs = over(x, ca.repmat(theta, 1, K), data)
            x, J = states[:, -1], J + ca.sum2(costs)
        if second == "hessian":
            H, g = ca.hessian(J, theta)
        else:
            g = _jacobian(J, theta, "forward").T
            H = _jacobian(g, theta, "forward")
        function = ca.Function("accumulated", [theta], [J, g, H])
        return function.expand() if expand else function

    return build


# --- derivatives by hand round CasADi's own of one row ----------------------------------------------------------------


PAIRS = [(i, j) for i in range(D) for j in range(i, D)]


def variational(expand: bool, unroll: int = 1) -> Form:
    """Second order forward by hand: an SX row that carries x, x_theta and x_theta_theta, accumulated over the rows."""

    def build(rows: list[Row], reference: bool) -> ca.Function:
        theta = ca.MX.sym("theta", D)
        state = ca.MX.zeros(6 * (1 + D + len(PAIRS)) + 1 + D + len(PAIRS))
        for row, data in runs(rows):
            state = _accumulate(_variational_row(row, reference), state, theta, data, unroll)
        J, g, h = state[-10], state[-9:-6], state[-6:]
        H = ca.MX.zeros(D, D)
        for k, (i, j) in enumerate(PAIRS):
            H[i, j] = H[j, i] = h[k]
        function = ca.Function("variational", [theta], [J, g, H])
        return function.expand("variational", {"cse": True}) if expand else function

    return build


def _variational_row(row: Row, reference: bool) -> ca.Function:
    theta, data = ca.SX.sym("theta", D), ca.SX.sym("data", N_DATA)
    state = ca.SX.sym("state", 70)
    x, X = state[:6], ca.reshape(state[6:24], 6, D)
    XX, sums = ca.reshape(state[24:60], 6, len(PAIRS)), state[60:]
    z = ca.vertcat(x, theta)
    F = ca.vertcat(*step(row, x, theta, data, reference))  # (7,)
    Z = ca.vertcat(X, ca.SX.eye(D))
    first = ca.jtimes(F, z, Z)
    columns = []
    for k, (i, j) in enumerate(PAIRS):
        once = first[:, i]
        held = ca.jtimes(once, z, Z[:, j])
        columns.append(held + ca.jtimes(F, z, ca.vertcat(XX[:, k], ca.SX.zeros(D))))
    second = ca.horzcat(*columns)
    after = ca.vertcat(F[:6], ca.vec(first[:6, :]), ca.vec(second[:6, :]))
    added = sums + ca.vertcat(F[6], first[6, :].T, second[6, :].T)
    return ca.Function("row", [state, theta, data], [ca.vertcat(after, added)], {"cse": True})


def _accumulate(function: ca.Function, state: ca.MX, theta: ca.MX, data: np.ndarray, unroll: int) -> ca.MX:
    """State after all rows of a run; `unroll` rows are made one SX function where there are enough."""
    K = data.shape[1]
    whole = K - K % unroll
    if unroll > 1 and whole:
        s, t, d = ca.SX.sym("s", state.numel()), ca.SX.sym("theta", D), ca.SX.sym("d", N_DATA, unroll)
        after = s
        for k in range(unroll):
            after = function(after, t, d[:, k])
        several = ca.Function("several", [s, t, d], [after], {"cse": True})
        state = several.fold(whole // unroll)(state, ca.repmat(theta, 1, whole // unroll), data[:, :whole])
        data = data[:, whole:]
    if data.shape[1]:
        state = function.fold(data.shape[1])(state, ca.repmat(theta, 1, data.shape[1]), data)
    return state


def adjoint(expand: bool) -> Form:
    """Discrete adjoint by hand: forward (x, x_theta), backward (psi, H), both SX rows accumulated over the rows.

    H is the sum over the rows of Z' D^2 (psi F + L) Z, as in machine code.
    """

    def build(rows: list[Row], reference: bool) -> ca.Function:
        theta = ca.MX.sym("theta", D)
        state = ca.MX.zeros(6 * (1 + D))
        J, g, H, psi = ca.MX(0), ca.MX.zeros(D), ca.MX.zeros(D, D), ca.MX.zeros(6)
        kept = []
        for row, data in runs(rows):
            K = data.shape[1]
            forward, _ = _adjoint_rows(row, reference)
            states, costs = forward.mapaccum("forward", K)(state, ca.repmat(theta, 1, K), data)
            kept.append((row, data, ca.horzcat(state, states[:, :-1])))
            state = states[:, -1]
            sums = ca.sum2(costs)
            J, g = J + sums[0], g + sums[1:]
        for row, data, states in reversed(kept):
            K = data.shape[1]
            _, backward = _adjoint_rows(row, reference)
            given = (states[:, list(range(K))[::-1]], ca.repmat(theta, 1, K), data[:, ::-1].copy())
            costates, parts = backward.mapaccum("backward", K)(psi, *given)
            psi = costates[:, -1]
            H = H + ca.reshape(ca.sum2(parts), D, D)
        function = ca.Function("adjoint", [theta], [J, g, H])
        return function.expand("adjoint", {"cse": True}) if expand else function

    return build


def _adjoint_rows(row: Row, reference: bool) -> tuple[ca.Function, ca.Function]:
    theta, data, psi = ca.SX.sym("theta", D), ca.SX.sym("data", N_DATA), ca.SX.sym("psi", 6)
    state = ca.SX.sym("state", 24)
    x, X = state[:6], ca.reshape(state[6:], 6, D)
    z, Z = ca.vertcat(x, theta), ca.vertcat(X, ca.SX.eye(D))
    after, cost = step(row, x, theta, data, reference)
    first = ca.jtimes(ca.vertcat(after, cost), z, Z)
    forward = ca.Function(
        "forward",
        [state, theta, data],
        [ca.vertcat(after, ca.vec(first[:6, :])), ca.vertcat(cost, first[6, :].T)],
        {"cse": True},
    )
    gradient = ca.jtimes(ca.vertcat(after, cost), z, ca.vertcat(psi, 1.0), True)
    H = ca.mtimes(Z.T, ca.jtimes(gradient, z, Z))
    backward = ca.Function("backward", [psi, state, theta, data], [gradient[:6], ca.vec(H)], {"cse": True})
    return forward, backward


FORMS: dict[str, Form] = {
    "SX, hessian()": whole_sx("auto", "auto", False),
    "SX, hessian(), cse": whole_sx("auto", "auto", True),
    "SX, forward over forward": whole_sx("forward", "forward", False),
    "SX, forward over forward, cse": whole_sx("forward", "forward", True),
    "SX, forward over reverse": whole_sx("reverse", "forward", False),
    "SX, forward over reverse, cse": whole_sx("reverse", "forward", True),
    "SX, reverse over forward, cse": whole_sx("forward", "reverse", True),
    "MX mapaccum of SX rows, hessian()": mapaccum("hessian"),
    "MX mapaccum of SX rows, hessian(), expand()": mapaccum("hessian", True),
    "MX mapaccum of SX rows, forward over forward": mapaccum("forward"),
    "variational SX rows, fold": variational(False),
    "variational SX rows, fold, 4 unrolled": variational(False, 4),
    "variational SX rows, expand(), cse": variational(True),
    "adjoint SX rows, mapaccum": adjoint(False),
    "adjoint SX rows, mapaccum, expand(), cse": adjoint(True),
}


class Timed:
    """A CasADi function called through its buffers: the call without any conversion of arguments or results."""

    def __init__(self, function: ca.Function) -> None:
        self.theta = np.zeros(D)
        self.J, self.g, self.H = np.zeros(1), np.zeros(D), np.zeros(D * D)
        self._buffer, self._call = function.buffer()
        self._buffer.set_arg(0, memoryview(self.theta))
        for i, result in enumerate((self.J, self.g, self.H)):
            if function.nnz_out(i) != result.size:
                raise ValueError("a result is sparse")
            self._buffer.set_res(i, memoryview(result))

    def __call__(self, theta: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        self.theta[:] = theta
        self._call()
        return float(self.J[0]), self.g, self.H.reshape(D, D)


QUICK = ["SX, hessian()", "SX, hessian(), cse", "adjoint SX rows, mapaccum, expand(), cse"]
"""Forms for a quick run: on the machine they were chosen on, the fastest."""
