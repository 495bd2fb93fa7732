"""Figure 4: norm of the gradient against iteration, for steepest descent, block-diagonal and exact SQP."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from switchfit.estimation.estimator import Estimate
from switchfit.estimation.local_fit import fit_locally
from switchfit.fit.evaluator import evaluate
from switchfit.optimize.problem import HessianKind
from switchfit.paper import vehicle
from switchfit.paper.vehicle import BLUE, DARK, LIGHT, RED, Figure, Found, Row, Say
from switchfit.problem.problem import Problem

TITLE = "Convergence (Fig. 4)"
KINDS: tuple[HessianKind, ...] = ("none", "block-diagonal", "exact", "descent-first")
LOOKS: dict[str, dict[str, Any]] = {
    "none": {"label": "steepest descent", "color": LIGHT, "linestyle": "-"},
    "block-diagonal": {"label": "SQP: block-diagonal Hessian", "color": BLUE, "linestyle": "--"},
    "exact": {"label": "SQP: exact Hessian", "color": RED, "linestyle": "-", "marker": "o", "markersize": 3},
    "descent-first": {"label": "paper's: descent, then exact", "color": DARK, "linestyle": ":"},
}
#: Largest number of points of a history that are stored.
KEPT = 300


def thin(fit: Estimate) -> list[list[Any]]:
    """Return iterations and norms of the gradient; a long history is thinned evenly in the logarithm."""
    norms = [record.optimality for record in fit.history]
    last = len(norms) - 1
    kept = np.arange(last + 1) if last < KEPT else np.unique(np.geomspace(1, last + 1, KEPT).astype(int)) - 1
    return [kept.tolist(), [norms[k] for k in kept]]


def fit_kinds(problem: Problem, kinds: Sequence[HessianKind], say: Say) -> dict[str, Found]:
    """Return the fit of a problem by each algorithm, to 1e-7, with its history."""
    found: dict[str, Found] = {}
    for kind in kinds:
        say(kind)
        fit = fit_locally(problem, hessian=kind, max_iterations=20000)
        found[kind] = {**vehicle.summary(fit), "history": thin(fit)}
    return found


def compute(quick: bool, folder: Path, say: Say) -> Found:
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
        iterations, norms = fit["history"]
        ax.loglog(np.array(iterations) + 1, np.maximum(norms, 1e-13), linewidth=1.2, **LOOKS[kind])
    ax.axhline(1e-7, color=DARK, linewidth=0.6)
    ax.annotate("tolerance", (1, 1e-7), xytext=(1, 3), textcoords="offset points", fontsize=6)
    vehicle.tidy(ax, "iteration + 1", r"$\|DJ\|$")
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=6.5)
    return figure


def draw(found: Found) -> dict[str, Figure]:
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


LINES = """
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


def rows(found: Found) -> list[Row]:
    """Return the lines of the table."""
    steepest, block, exact, first = (found["fits"][kind] for kind in KINDS)
    fits = {"steepest": steepest, "block": block, "exact": exact, "first": first}
    rates = {"factor": factor(block["history"]), "order": order(exact["history"])}
    ratio, conditions = steepest["iterations"] / exact["iterations"], vehicle.conditions(exact)
    return vehicle.fill_rows(LINES, ratio=ratio, conditions=conditions, **fits, **rates, **found)
