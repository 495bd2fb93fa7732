"""CasADi with CVODES: `casadi.integrator` from switch to switch, its sensitivities by forward and adjoint equations.

Each segment is integrated over one unit of a scaled time, so that its ends may be symbols; `hessian()` gives the
derivatives, as the documentation recommends. The cost is a quadrature.
"""

from __future__ import annotations

import casadi as ca

from benchmarks.models import Model
from benchmarks.peers import Functions
from benchmarks.peers.casadi_shooting import Buffered

LADDER = (1e-7, 1e-8, 1e-9, 1e-10, 1e-11, 1e-12)
STEPS = 1_000_000


def build(model: Model, rtol: float) -> Functions:
    """J and its derivatives, with `rtol` and atol = rtol/100."""
    theta = ca.MX.sym("theta", len(model.theta))
    p = theta[len(model.times) :]
    x, J = ca.DM(model.x0), ca.MX(0)
    solvers = {mode: _integrator(model, mode, rtol) for mode in model.modes}
    for mode, start, end in model.segments(theta):
        found = solvers[mode](x0=x, p=ca.vertcat(end - start, p))
        x, J = found["xf"], J + found["qf"]
    cost = Buffered(ca.Function("J", [theta], [J]))
    gradient = Buffered(ca.Function("g", [theta], [J, ca.densify(ca.gradient(J, theta))]))
    H, g = ca.hessian(J, theta)
    hessian = Buffered(ca.Function("H", [theta], [J, ca.densify(g), ca.densify(H)]))
    return Functions(f"CVODES, rtol {rtol:.0e}", lambda theta: cost(theta)[0], gradient, hessian)


def _integrator(model: Model, mode: str, rtol: float) -> ca.Function:
    """The solution of a mode from x0 over the time p[0]."""
    x, p = ca.SX.sym("x", len(model.x0)), ca.SX.sym("p", 1 + len(model.p))
    entries = ca.vertsplit(x)
    slope = ca.vertcat(*model.field(mode, entries, ca.vertsplit(p)[1:], ca))
    problem = {"x": x, "p": p, "ode": p[0] * slope, "quad": p[0] * model.density(entries)}
    options = {"reltol": rtol, "abstol": rtol / 100, "max_num_steps": STEPS, "quad_err_con": True}
    return ca.integrator("segment", "cvodes", problem, 0.0, 1.0, options)
