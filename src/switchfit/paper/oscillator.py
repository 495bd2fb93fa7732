"""The linear time-invariant example of the introduction: an oscillator whose brake closes at an unknown time.

The results are known from matrix exponentials: with z = (x, x_m), the states of model and truth, z' = G z, G constant
between transitions, so that J = ½ ∫ ‖x − x_m‖² dt is a sum of quadratic forms (C. F. Van Loan, Computing integrals
involving the matrix exponential, IEEE Trans. Automat. Control 23 (1978) 395-404), which JAX differentiates.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import expm

from switchfit.arrays import FloatArray, Traced
from switchfit.fit.evaluation import evaluate
from switchfit.optimize.minimization_problem import HessianKind
from switchfit.paper import fit_summary, table_rows
from switchfit.paper.algorithms import draw_gradient_norms, fit_kinds
from switchfit.paper.table_rows import Found, Say, TableRow
from switchfit.problem.experiment import Experiment, Parameter
from switchfit.problem.functions import use_float64
from switchfit.problem.problem import Problem
from switchfit.problem.reference_signals import ReferenceSignal
from switchfit.problem.system import HybridSystem
from switchfit.runtime.presentation import Figure

#: tau (s), stiffness k (1/s²), damping c (1/s).
LTI_TRUTH, LTI_START = (4.0, 2.0, 1.0), (3.5, 1.8, 0.6)

LTI_HORIZON = 10.0
LTI_INITIAL = (1.0, 0.0)
LTI_KINDS: tuple[HessianKind, ...] = ("none", "block-diagonal", "exact")

LTI_LINES = """
* LTI: the correct values are found | converges to the correct values | largest error {error:.0e}
| tau 4 s, k 2, c 1 from (3.5, 1.8, 0.6)
* LTI: J, DJ, D²J against matrix exponentials | not printed
| relative gaps {gaps[0]:.0e}, {gaps[1]:.0e}, {gaps[2]:.0e} | the reference is a spline through exact samples
* LTI: iterations to ‖DJ‖ < 1e-7 (steepest descent, block-diagonal, exact) | far fewer with the exact Hessian
| {fits[none][iterations]}, {fits[block-diagonal][iterations]}, {fits[exact][iterations]}
* LTI: second-order sufficient conditions | not printed | {conditions}
"""


def build_oscillator(start: tuple[float, float, float] = LTI_START) -> Problem:
    """Return the problem of tau, k and c, measured by the whole state; the reference is a spline through exact samples,
    broken at its switch.
    """
    system = HybridSystem(
        modes={
            "free": lambda t, x, p: jnp.stack([x[1], -p["k"] * x[0]]),
            "braked": lambda t, x, p: jnp.stack([x[1], -p["k"] * x[0] - p["c"] * x[1]]),
        },
        initial_state=LTI_INITIAL,
        state_names=("q", "dq"),
        state_units=("m", "m/s"),
    )
    run = Experiment(_reference(), ("free", "braked"), start[:1], 0.0, LTI_HORIZON)
    parameters = {"k": Parameter(start[1], lower=0.1, upper=10.0), "c": Parameter(start[2], lower=0.0, upper=10.0)}
    return Problem(system, run, parameters)


def _reference() -> ReferenceSignal:
    tau, k, c = LTI_TRUTH
    times, states, at = [], [], np.array(LTI_INITIAL)
    for begin, end, damping in ((0.0, tau, 0.0), (tau, LTI_HORIZON, c)):
        step = np.linspace(0.0, end - begin, 501)
        with use_float64():
            A = _matrix(k, damping)
            # Exact samples: each state is exp(A h) times that at the begin of the segment, and not a step from the last
            # one.
            path = np.asarray(jax.vmap(lambda h, A=A: expm(A * h))(jnp.asarray(step))) @ at
        times.append(begin + step)
        states.append(path)
        at = path[-1]
    return ReferenceSignal.from_samples(np.concatenate(times), np.concatenate(states))


def _matrix(k: Traced, c: Traced) -> jax.Array:
    return jnp.array([[0.0, 1.0], [-k, -c]])


def evaluate_exactly(theta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return J, its gradient and its Hessian from matrix exponentials, for tau not after that of the truth."""
    # Forward over forward: there are three unknowns.
    first = jax.jacfwd(_cost)
    with use_float64():
        given = jax.jit(lambda theta: (_cost(theta), first(theta), jax.jacfwd(first)(theta)))(jnp.asarray(theta))
        cost, gradient, hessian = map(np.asarray, given)
    return float(cost), gradient, hessian


def _cost(theta: jax.Array) -> Traced:
    tau, k, c = theta
    true_tau, true_k, true_c = LTI_TRUTH
    # z'Qz = |x - x_m|^2 with z = (x, x_m).
    Q = jnp.kron(jnp.array([[1.0, -1.0], [-1.0, 1.0]]), jnp.eye(2))
    z, J = jnp.tile(jnp.array(LTI_INITIAL), 2), 0.0
    # Three segments: both free, the model braked and the truth not yet, both braked.
    for length, damping, true_damping in (
        (tau, 0.0, 0.0),
        (true_tau - tau, c, 0.0),
        (LTI_HORIZON - true_tau, c, true_c),
    ):
        G = jax.scipy.linalg.block_diag(_matrix(k, damping), _matrix(true_k, true_damping))
        # Van Loan: exp([[-G', Q], [0, G]] h) = [[., F], [0, E]] with E = exp(G h), and E'F is the integral of exp(G't)
        # Q exp(G t) over the segment.
        blocks = expm(jnp.block([[-G.T, Q], [jnp.zeros((4, 4)), G]]) * length)
        forward = blocks[4:, 4:]
        J = J + 0.5 * z @ forward.T @ blocks[:4, 4:] @ z
        z = forward @ z
    return J


def compute_lti(quick: bool, say: Say) -> Found:
    """Return derivatives against the closed form, and the three algorithms."""
    here = build_oscillator()
    say("derivatives")
    ours = evaluate(here)
    cost, gradient, hessian = evaluate_exactly(np.array(LTI_START))
    found: Found = {
        "gaps": [
            abs(ours.cost - cost) / cost,
            float(np.linalg.norm(ours.gradient - gradient) / np.linalg.norm(gradient)),
            float(np.linalg.norm(ours.hessian - hessian) / np.linalg.norm(hessian)),
        ],
        "fits": fit_kinds(here, LTI_KINDS, say),
    }
    exact_fit = found["fits"]["exact"]["theta"]
    found["error"] = float(np.max(np.abs(np.array(list(exact_fit.values())) - LTI_TRUTH)))
    return found


def draw_lti(found: Found) -> dict[str, Figure]:
    """Draw the gradient norm against iteration."""
    return {"lti": draw_gradient_norms(found["fits"])}


def list_lti(found: Found) -> list[TableRow]:
    """Return the lines of the table."""
    return table_rows.fill_rows(LTI_LINES, conditions=fit_summary.conditions(found["fits"]["exact"]), **found)
