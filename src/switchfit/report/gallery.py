"""Which function draws which plot of an estimate."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from switchfit.estimation.estimator import Estimate
from switchfit.report.plane import plot_plane
from switchfit.report.plot import plot_course, plot_estimate, plot_timeline
from switchfit.runtime.presentation import draw_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PLOTS: dict[str, Callable[..., Any]] = {
    "fit": plot_estimate,
    "convergence": plot_course,
    "timeline": plot_timeline,
    "plane": plot_plane,
}
"""By the end of the method's name: `Estimate.plot_plane` is "plane", `Estimate.plot` is "fit"."""


@draw_figure.register(Estimate)
def draw_estimate(estimate: Estimate, *, what: str = "fit", **settings: Any) -> Axes | Figure:
    """Draw one of the plots of an estimate.

    Parameters
    ----------
    estimate : Estimate
    what : str
        A name in `PLOTS`.
    settings
        Keyword arguments of its function.
    """
    drawn: Axes | Figure = PLOTS[what](estimate, **settings)
    return drawn
