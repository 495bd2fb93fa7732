"""The three algorithms: steepest descent, block-diagonal and exact SQP.

Figure 4: norm of the gradient against iteration, for the simulated vehicle.

The linear time-invariant example that the introduction names: an oscillator whose brake closes at an unknown time. The
results are known from matrix exponentials: with z = (x, x_m), the states of model and truth, z' = G z, G constant
between transitions, so that J = ½ ∫ ‖x − x_m‖² dt is a sum of quadratic forms (C. F. Van Loan, Computing integrals
involving the matrix exponential, IEEE Trans. Automat. Control 23 (1978) 395-404), which JAX differentiates.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import expm

from switchfit.arrays import FloatArray
from switchfit.estimation.local_fit import fit_locally
from switchfit.fit.evaluator import evaluate
from switchfit.optimize.minimization_problem import HessianKind
from switchfit.paper import vehicle
from switchfit.paper.vehicle import BLUE, DARK, LIGHT, RED, Figure, Found, Row, Say
from switchfit.problem.experiment import Experiment, Parameter
from switchfit.problem.functions import use_float64
from switchfit.problem.problem import Problem
from switchfit.problem.reference_signals import ReferenceSignal
from switchfit.problem.system import HybridSystem

KINDS: tuple[HessianKind, ...] = ("none", "block-diagonal", "exact", "descent-first")

LOOKS: dict[str, dict[str, Any]] = {
    "none": {"label": "steepest descent", "color": LIGHT, "linestyle": "-"},
    "block-diagonal": {"label": "SQP: block-diagonal Hessian", "color": BLUE, "linestyle": "--"},
    "exact": {"label": "SQP: exact Hessian", "color": RED, "linestyle": "-", "marker": "o", "markersize": 3},
    "descent-first": {"label": "paper's: descent, then exact", "color": DARK, "linestyle": ":"},
}

#: Largest number of points of a history that are drawn.
DRAWN = 300

CONVERGENCE_LINES = """
* Fig. 4: values found (mu; tau) | (0.7; 6, 10), the correct ones
| ({exact[theta][mu]:.4f}; {exact[theta][tau_1]:.4f}, {exact[theta][tau_2]:.4f})
* Fig. 4: iterations of steepest descent to ‖DJ‖ < 1e-7 | about 1000 | {steepest[iterations]}
| {ratio:.0f} times those with the exact Hessian; in the metric of (s, s, 1) as given, steps halved from 1 until 0.4 of
the predicted decrease is reached (the paper does not print its line search, and the count depends on it)
* Fig. 4: iterations with the block-diagonal Hessian | not quadratic
| {block[iterations]}, linear: a factor of {factor:.3f} each
* Fig. 4: iterations with the exact Hessian | 12 | {exact[iterations]}, order {order:.2f}
| the Hessian is made positive definite where it is not, instead of descending first
* Section II-A: descent until the Hessian is positive definite, then SQP | 12 (the same)
| {first[iterations]}, of which {descents} descents | smallest eigenvalue at the start {eigenvalues_at_start[0]:.1f}
* Fig. 4: second-order sufficient conditions | not printed | {conditions}
"""

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


def fit_kinds(problem: Problem, kinds: Sequence[HessianKind], say: Say) -> dict[str, Found]:
    """Return the fit of a problem by each algorithm, to 1e-7, with its history."""
    found: dict[str, Found] = {}
    for kind in kinds:
        say(kind)
        fit = fit_locally(problem, hessian=kind, max_iterations=20000)
        norms = [record.optimality for record in fit.history]
        found[kind] = {**vehicle.summary(fit), "history": [list(range(len(norms))), norms]}
    return found


def compute_convergence(quick: bool, say: Say) -> Found:
    """Fit with every algorithm, to 1e-7."""
    problem = vehicle.build_simulated_problem()
    found: Found = {
        "eigenvalues_at_start": np.linalg.eigvalsh(evaluate(problem).hessian).tolist(),
        "fits": fit_kinds(problem, KINDS, say),
    }
    first = fit_locally(problem, hessian="descent-first")
    positive = [np.linalg.eigvalsh(evaluate(problem, record.theta).hessian)[0] > 0 for record in first.history]
    found["descents"] = positive.index(True)
    return found


def convergence_figure(fits: Found) -> Figure:
    """Draw the norm of the gradient against iteration, both logarithmic, for several algorithms."""
    figure = vehicle.new_figure(vehicle.COLUMN, 3.0)
    ax = figure.subplots()
    for kind, fit in fits.items():
        iterations, norms = np.array(fit["history"])
        shown = np.unique(np.geomspace(1, len(norms), DRAWN).astype(int)) - 1  # evenly in the logarithm
        ax.loglog(iterations[shown] + 1, np.maximum(norms[shown], 1e-13), linewidth=1.2, **LOOKS[kind])
    ax.axhline(1e-7, color=DARK, linewidth=0.6)
    ax.annotate("tolerance", (1, 1e-7), xytext=(1, 3), textcoords="offset points", fontsize=6)
    vehicle.tidy(ax, "iteration + 1", r"$\|DJ\|$")
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=6.5)
    return figure


def draw_convergence(found: Found) -> dict[str, Figure]:
    """Draw figure 4."""
    return {"fig4-convergence": convergence_figure(found["fits"])}


def order(history: list[list[float]]) -> float:
    """Return the observed order of the last steps above rounding: log(e_{k+1}/e_k) / log(e_k/e_{k-1})."""
    norms = np.array([n for n in history[1] if n > 1e-10])
    slopes = np.diff(np.log(norms))
    return float(slopes[-1] / slopes[-2])


def factor(history: list[list[float]]) -> float:
    """Return the factor by which the norm of the gradient falls in one iteration, over the last half of them."""
    iterations, norms = np.array(history)
    middle = int(np.searchsorted(iterations, iterations[-1] / 2))
    return float((norms[-1] / norms[middle]) ** (1 / (iterations[-1] - iterations[middle])))


def list_convergence(found: Found) -> list[Row]:
    """Return the lines of the table."""
    steepest, block, exact, first = (found["fits"][kind] for kind in KINDS)
    fits = {"steepest": steepest, "block": block, "exact": exact, "first": first}
    rates = {"factor": factor(block["history"]), "order": order(exact["history"])}
    ratio, conditions = steepest["iterations"] / exact["iterations"], vehicle.conditions(exact)
    return vehicle.fill_rows(CONVERGENCE_LINES, ratio=ratio, conditions=conditions, **fits, **rates, **found)


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
            path = np.asarray(jax.vmap(lambda h, A=A: expm(A * h))(jnp.asarray(step))) @ at
        times.append(begin + step)
        states.append(path)
        at = path[-1]
    return ReferenceSignal.from_samples(np.concatenate(times), np.concatenate(states))


def _matrix(k: Any, c: Any) -> Any:
    return jnp.array([[0.0, 1.0], [-k, -c]])


def evaluate_exactly(theta: FloatArray) -> tuple[float, FloatArray, FloatArray]:
    """Return J, its gradient and its Hessian from matrix exponentials, for tau not after that of the truth."""
    first = jax.jacfwd(_cost)
    with use_float64():
        given = jax.jit(lambda theta: (_cost(theta), first(theta), jax.jacfwd(first)(theta)))(jnp.asarray(theta))
        cost, gradient, hessian = map(np.asarray, given)
    return float(cost), gradient, hessian


def _cost(theta: Any) -> Any:
    tau, k, c = theta
    true_tau, true_k, true_c = LTI_TRUTH
    Q = jnp.kron(jnp.array([[1.0, -1.0], [-1.0, 1.0]]), jnp.eye(2))
    z, J = jnp.tile(jnp.array(LTI_INITIAL), 2), 0.0
    for length, damping, true_damping in (
        (tau, 0.0, 0.0),
        (true_tau - tau, c, 0.0),
        (LTI_HORIZON - true_tau, c, true_c),
    ):
        G = jax.scipy.linalg.block_diag(_matrix(k, damping), _matrix(true_k, true_damping))
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
    return {"lti": convergence_figure(found["fits"])}


def list_lti(found: Found) -> list[Row]:
    """Return the lines of the table."""
    return vehicle.fill_rows(LTI_LINES, conditions=vehicle.conditions(found["fits"]["exact"]), **found)
