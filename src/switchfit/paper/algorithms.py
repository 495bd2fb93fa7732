"""The algorithms that the paper compares: steepest descent, block-diagonal and exact SQP; fits by each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from switchfit.fit.local_fit import fit_locally
from switchfit.optimize.minimization_problem import HessianKind
from switchfit.paper import figure_style, fit_summary
from switchfit.paper.figure_style import BLUE, DARK, LIGHT, RED
from switchfit.paper.table_rows import Found, Say
from switchfit.problem.problem import Problem
from switchfit.runtime.presentation import Figure

ALGORITHM_LOOKS: dict[str, dict[str, Any]] = {
    "none": {"label": "steepest descent", "color": LIGHT, "linestyle": "-"},
    "block-diagonal": {"label": "SQP: block-diagonal Hessian", "color": BLUE, "linestyle": "--"},
    "exact": {"label": "SQP: exact Hessian", "color": RED, "linestyle": "-", "marker": "o", "markersize": 3},
    "descent-first": {"label": "paper's: descent, then exact", "color": DARK, "linestyle": ":"},
}

#: Largest number of points of a history that are drawn.
DRAWN = 300


def fit_kinds(problem: Problem, kinds: Sequence[HessianKind], say: Say) -> dict[str, Found]:
    """Return the fit of a problem by each algorithm, to 1e-7, with its history."""
    found: dict[str, Found] = {}
    for kind in kinds:
        say(kind)
        # One fit, and no strategy: what is compared is the algorithm. Steepest descent needs a thousand iterations and
        # more.
        fit = fit_locally(problem, hessian=kind, max_iterations=20000)
        norms = [record.optimality for record in fit.history]
        found[kind] = {**fit_summary.summary(fit), "history": [list(range(len(norms))), norms]}
    return found


def draw_gradient_norms(fits: Found) -> Figure:
    """Draw the norm of the gradient against iteration, both logarithmic, for several algorithms."""
    figure = figure_style.new_figure(figure_style.COLUMN, 3.0)
    ax = figure.subplots()
    for kind, fit in fits.items():
        iterations, norms = np.array(fit["history"])
        shown = np.unique(np.geomspace(1, len(norms), DRAWN).astype(int)) - 1  # evenly in the logarithm
        ax.loglog(iterations[shown] + 1, np.maximum(norms[shown], 1e-13), linewidth=1.2, **ALGORITHM_LOOKS[kind])
    ax.axhline(1e-7, color=DARK, linewidth=0.6)
    ax.annotate("tolerance", (1, 1e-7), xytext=(1, 3), textcoords="offset points", fontsize=6)
    figure_style.tidy(ax, "iteration + 1", r"$\|DJ\|$")
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=6.5)
    return figure
