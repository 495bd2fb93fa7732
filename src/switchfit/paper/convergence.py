"""Figure 4: norm of the gradient against iteration, for the simulated vehicle."""

from __future__ import annotations

import numpy as np

from switchfit.fit.evaluation import evaluate
from switchfit.fit.local_fit import fit_locally
from switchfit.optimize.minimization_problem import HessianKind
from switchfit.paper import fit_summary, table_rows, vehicle
from switchfit.paper.algorithms import draw_gradient_norms, fit_kinds
from switchfit.paper.table_rows import Found, Say, TableRow
from switchfit.runtime.presentation import Figure

ALGORITHMS: tuple[HessianKind, ...] = ("none", "block-diagonal", "exact", "descent-first")

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


def compute_convergence(quick: bool, say: Say) -> Found:
    """Fit with every algorithm, to 1e-7."""
    problem = vehicle.build_simulated_problem()
    found: Found = {
        "eigenvalues_at_start": np.linalg.eigvalsh(evaluate(problem).hessian).tolist(),
        "fits": fit_kinds(problem, ALGORITHMS, say),
    }
    first = fit_locally(problem, hessian="descent-first")
    # Section II-A: descent until D2J is positive definite. The history says at which theta each iteration began.
    positive = [np.linalg.eigvalsh(evaluate(problem, record.theta).hessian)[0] > 0 for record in first.history]
    found["descents"] = positive.index(True)
    return found


def draw_convergence(found: Found) -> dict[str, Figure]:
    """Draw figure 4."""
    return {"fig4-convergence": draw_gradient_norms(found["fits"])}


def measure_order(history: list[list[float]]) -> float:
    """Return the observed order of the last steps above rounding: log(e_{k+1}/e_k) / log(e_k/e_{k-1})."""
    # With e_{k+1} = C e_k^q, the ratio of successive slopes of log e is q. Below 1e-10 the norm is rounding.
    norms = np.array([n for n in history[1] if n > 1e-10])
    slopes = np.diff(np.log(norms))
    return float(slopes[-1] / slopes[-2])


def measure_factor(history: list[list[float]]) -> float:
    """Return the factor by which the norm of the gradient falls in one iteration, over the last half of them."""
    # The last half: the first iterations are far from the linear rate.
    iterations, norms = np.array(history)
    middle = int(np.searchsorted(iterations, iterations[-1] / 2))
    return float((norms[-1] / norms[middle]) ** (1 / (iterations[-1] - iterations[middle])))


def list_convergence(found: Found) -> list[TableRow]:
    """Return the lines of the table."""
    steepest, block, exact, first = (found["fits"][kind] for kind in ALGORITHMS)
    fits = {"steepest": steepest, "block": block, "exact": exact, "first": first}
    rates = {"factor": measure_factor(block["history"]), "order": measure_order(exact["history"])}
    ratio, conditions = steepest["iterations"] / exact["iterations"], fit_summary.conditions(exact)
    return table_rows.fill_rows(CONVERGENCE_LINES, ratio=ratio, conditions=conditions, **fits, **rates, **found)
