"""Which function draws which plot of an estimate."""

from __future__ import annotations

from collections.abc import Callable

from switchfit.report.convergence import plot_convergence
from switchfit.report.fit_figure import plot_fit
from switchfit.report.plane import plot_plane
from switchfit.report.timeline import plot_timeline
from switchfit.runtime.presentation import Axes, Figure, draw_figure
from switchfit.uncertainty.judged_fit import JudgedFit

PLOTS: dict[str, Callable[..., Axes | Figure]] = {
    "fit": plot_fit,
    "convergence": plot_convergence,
    "timeline": plot_timeline,
    "plane": plot_plane,
}
"""Plots of an estimate by the end of the method's name: `Estimate.plot_plane` is "plane", `Estimate.plot` is "fit"."""


@draw_figure.register(JudgedFit)
def draw_estimate(estimate: JudgedFit, *, what: str = "fit", **settings: object) -> Axes | Figure:
    """Draw one of the plots of an estimate.

    Parameters
    ----------
    estimate : JudgedFit
    what : str
        A name in `PLOTS`.
    settings
        Keyword arguments of its function.
    """
    return PLOTS[what](estimate, **settings)
