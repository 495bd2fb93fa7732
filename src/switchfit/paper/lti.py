"""The linear time-invariant example that the introduction names: an oscillator whose brake closes at an unknown time.

The results are known from matrix exponentials: with z = (x, x_m), the states of model and truth, z' = G z, G constant
between transitions, so that J = ½ ∫ ‖x − x_m‖² dt is a sum of quadratic forms (C. F. Van Loan, Computing integrals
involving the matrix exponential, IEEE Trans. Automat. Control 23 (1978) 395-404), which JAX differentiates.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import expm

from switchfit.fit.evaluator import evaluate
from switchfit.optimize.problem import HessianKind
from switchfit.paper.convergence import convergence_figure, fit_kinds
from switchfit.paper.vehicle import Figure, Found, Row, Say, conditions, fill_rows
from switchfit.problem.data import FloatArray, ReferenceSignal
from switchfit.problem.experiment import Experiment, Parameter
from switchfit.problem.functions import use_float64
from switchfit.problem.problem import Problem
from switchfit.problem.system import HybridSystem

TITLE = "Linear time-invariant example"
#: tau (s), stiffness k (1/s²), damping c (1/s).
TRUTH, START = (4.0, 2.0, 1.0), (3.5, 1.8, 0.6)
HORIZON = 10.0
INITIAL = (1.0, 0.0)
KINDS: tuple[HessianKind, ...] = ("none", "block-diagonal", "exact")


def problem(start: tuple[float, float, float] = START) -> Problem:
    """Return the problem of tau, k and c, measured by the whole state; the reference is a spline through exact samples,
    broken at its switch.
    """
    system = HybridSystem(
        modes={
            "free": lambda t, x, p: jnp.stack([x[1], -p["k"] * x[0]]),
            "braked": lambda t, x, p: jnp.stack([x[1], -p["k"] * x[0] - p["c"] * x[1]]),
        },
        initial_state=INITIAL,
        state_names=("q", "dq"),
        state_units=("m", "m/s"),
    )
    run = Experiment(_reference(), ("free", "braked"), start[:1], 0.0, HORIZON)
    parameters = {"k": Parameter(start[1], lower=0.1, upper=10.0), "c": Parameter(start[2], lower=0.0, upper=10.0)}
    return Problem(system, run, parameters)


def _reference() -> ReferenceSignal:
    tau, k, c = TRUTH
    times, states, at = [], [], np.array(INITIAL)
    for begin, end, damping in ((0.0, tau, 0.0), (tau, HORIZON, c)):
        step = np.linspace(0.0, end - begin, 501)
        with use_float64():
            A = _matrix(k, damping)
            path = np.asarray(jax.vmap(lambda h, A=A: expm(A * h))(jnp.asarray(step))) @ at
        times.append(begin + step)
        states.append(path)
        at = path[-1]
    return ReferenceSignal.from_samples(np.concatenate(times), np.concatenate(states))


def _matrix(k: Any, c: Any) -> Any:
    return jnp.array([[0.0, 1.0], [-k, -c]])


def exact(theta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return J, its gradient and its Hessian from matrix exponentials, for tau not after that of the truth."""
    with use_float64():
        cost, gradient, hessian = _exact(jnp.asarray(theta))
        return float(cost), np.asarray(gradient), np.asarray(hessian)


@jax.jit
def _exact(theta: Any) -> tuple[Any, Any, Any]:
    return _cost(theta), jax.jacfwd(_cost)(theta), jax.jacfwd(jax.jacfwd(_cost))(theta)


def _cost(theta: Any) -> Any:
    tau, k, c = theta
    true_tau, true_k, true_c = TRUTH
    Q = jnp.kron(jnp.array([[1.0, -1.0], [-1.0, 1.0]]), jnp.eye(2))
    z, J = jnp.tile(jnp.array(INITIAL), 2), 0.0
    for length, damping, true_damping in ((tau, 0.0, 0.0), (true_tau - tau, c, 0.0), (HORIZON - true_tau, c, true_c)):
        G = jax.scipy.linalg.block_diag(_matrix(k, damping), _matrix(true_k, true_damping))
        blocks = expm(jnp.block([[-G.T, Q], [jnp.zeros((4, 4)), G]]) * length)
        forward = blocks[4:, 4:]
        J = J + 0.5 * z @ forward.T @ blocks[:4, 4:] @ z
        z = forward @ z
    return J


def compute(quick: bool, folder: Path, say: Say) -> Found:
    """Return derivatives against the closed form, and the three algorithms."""
    here = problem()
    say("derivatives")
    ours = evaluate(here)
    cost, gradient, hessian = exact(np.array(START))
    found: Found = {
        "gaps": [
            abs(ours.cost - cost) / cost,
            float(np.linalg.norm(ours.gradient - gradient) / np.linalg.norm(gradient)),
            float(np.linalg.norm(ours.hessian - hessian) / np.linalg.norm(hessian)),
        ],
        "fits": fit_kinds(here, KINDS, say),
    }
    exact_fit = found["fits"]["exact"]["theta"]
    found["error"] = float(np.max(np.abs(np.array(list(exact_fit.values())) - TRUTH)))
    return found


def draw(found: Found) -> dict[str, Figure]:
    """Draw the gradient norm against iteration."""
    return {"lti": convergence_figure(found["fits"])}


LINES = """
* LTI: the correct values are found | converges to the correct values | largest error {error:.0e}
| tau 4 s, k 2, c 1 from (3.5, 1.8, 0.6)
* LTI: J, DJ, D²J against matrix exponentials | not printed
| relative gaps {gaps[0]:.0e}, {gaps[1]:.0e}, {gaps[2]:.0e} | the reference is a spline through exact samples
* LTI: iterations to ‖DJ‖ < 1e-7 (steepest descent, block-diagonal, exact) | far fewer with the exact Hessian
| {fits[none][iterations]}, {fits[block-diagonal][iterations]}, {fits[exact][iterations]}
* LTI: second-order sufficient conditions | not printed | {conditions}
"""


def rows(found: Found) -> list[Row]:
    """Return the lines of the table."""
    return fill_rows(LINES, conditions=conditions(found["fits"]["exact"]), **found)
