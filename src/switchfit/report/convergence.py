"""The figure of the convergence of a fit: its optimality by iteration."""

from __future__ import annotations

import numpy as np

from switchfit.fit.result import Fit
from switchfit.report import style
from switchfit.report.style import FIT_COLOUR, LINE
from switchfit.runtime.presentation import Axes, Figure


def plot_convergence(estimate: Fit, *, ax: Axes | None = None) -> Axes | Figure:
    """Draw the optimality of a fit against iteration on a logarithmic scale, with its tolerance.

    Parameters
    ----------
    estimate : Fit
        An optimality of 0 in its history is left out.
    ax : matplotlib.axes.Axes, optional
    """
    drawn, ax = style.open_axes(ax, (6.4, 3.4))
    optimality = np.array([record.optimality for record in estimate.history], dtype=np.float64)
    # A logarithmic axis has no 0, which an exactly solved problem has.
    shown = np.where(optimality > 0, optimality, np.nan)
    ax.set_yscale("log")
    ax.plot(
        [record.iteration for record in estimate.history], shown, "o-", color=FIT_COLOUR, markersize=4, linewidth=LINE
    )
    style.draw_level(ax, "tolerance", estimate.tolerance, "left")  # where the curve is far above it
    ax.locator_params(axis="x", integer=True)
    ax.set_xlabel("iteration")
    ax.set_ylabel("optimality (KKT residual)")
    return style.turn_off_formulas(drawn)
