"""Plots over two unknowns: contours of the cost, and joint confidence regions.

Style and rule of plots: `switchfit.report.style`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

from switchfit.estimation.estimator import Estimate
from switchfit.problem.data import FloatArray
from switchfit.report.dates import Timed, list_dated
from switchfit.report.style import FIT, LINE, REFERENCE, SHADE, SMALL, THIN, TRANSITION, draw_on
from switchfit.runtime.progress import Progress
from switchfit.uncertainty.regions import CostGrid, JointRegion, compute_cost_grid, compute_region
from switchfit.uncertainty.residuals import correct_intervals

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Runs: TypeAlias = tuple[Timed | None, Timed | None]
AXES: tuple[Literal["x", "y"], ...] = ("x", "y")

LEVELS = 12
"""Contours of the cost."""
FINE = 200
"""Points along each axis between which a contour is drawn."""


def plot_cost(
    estimate: Estimate, *, first: str, second: str, points: int = 41, ax: Axes | None = None
) -> Axes | Figure:
    """Draw contours of J over two unknowns, all others held at the estimate, with the estimate and the bounds.

    Parameters
    ----------
    estimate : Estimate
    first, second : str
        Unknowns along the axes.
    points : int, optional
        Along each axis.
    ax : matplotlib.axes.Axes, optional
    """
    grid = compute_cost_grid(estimate, first, second, points=points)
    return draw_on(ax, lambda ax: draw_cost(grid, ax, _find_runs(estimate, grid)))


def draw_cost(grid: CostGrid, ax: Axes, runs: Runs = (None, None)) -> Axes:
    """Draw contours of the cost, evenly spaced in the root of its rise, so that they are so for a parabola.

    Parameters
    ----------
    grid : CostGrid
    ax : matplotlib.axes.Axes
    runs : pair of Timed or None, optional
        What shows the values of each of the two as dates.
    """
    rise = grid.costs - grid.cost
    top = float(np.nanmax(rise, initial=0.0))
    if top > 0:
        levels = grid.cost + top * np.linspace(0, 1, LEVELS + 1) ** 2
        lowest = min(float(np.nanmin(grid.costs)), grid.cost)
        filled = ax.contourf(grid.x, grid.y, grid.costs, levels=[lowest, *levels[1:]], cmap="Blues_r")
        ax.contour(grid.x, grid.y, grid.costs, levels=levels[1:], colors="white", linewidths=0.5)
        bar = ax.figure.colorbar(filled, ax=ax, ticks=levels[:: LEVELS // 4], format="%.4g")
        bar.set_label("cost J")
    ax.plot(*grid.optimum, "P", color=FIT, markersize=9, markeredgecolor="white", label="estimate", zorder=4)
    _draw_bounds(grid, ax)
    ax.legend(fontsize=SMALL, loc="upper right")
    return _label_axes(grid, ax, runs)


def plot_region(
    estimate: Estimate,
    *,
    first: str,
    second: str,
    level: float = 0.95,
    points: int = 21,
    callback: Progress | None = None,
    ax: Axes | None = None,
) -> Axes | Figure:
    """Draw the joint confidence region of two unknowns by likelihood ratio, and the ellipse that approximates it.

    Both, and the intervals of each unknown alone, allow for correlated residuals as the report does.

    Parameters
    ----------
    estimate : Estimate
    first, second : str
        Unknowns along the axes.
    level : float, between 0 and 1
    points : int, optional
        Along each axis of the grid on which all other unknowns are fitted again.
    callback : callable, optional
        ``callback(done, total)`` after each fit; a true return value stops.
    ax : matplotlib.axes.Axes, optional
    """
    region = compute_region(estimate, first, second, level=level, points=points, callback=callback)
    intervals = correct_intervals(estimate, level)
    pair = [estimate.theta_names.index(name) for name in region.grid.names]
    return draw_on(ax, lambda ax: draw_region(region, intervals[pair], ax, _find_runs(estimate, region.grid)))


def draw_region(region: JointRegion, intervals: FloatArray, ax: Axes, runs: Runs = (None, None)) -> Axes:
    """Draw a joint region, its ellipse, and the intervals of each of the two by itself.

    Parameters
    ----------
    region : JointRegion
    intervals : (2, 2)
        Low and high end of each of the two.
    ax : matplotlib.axes.Axes
    runs : pair of Timed or None, optional
        What shows the values of each of the two as dates.
    """
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    grid, percent = region.grid, f"{100 * region.level:g} %"
    x, y, ratio = _refine(region)
    ax.contourf(x, y, ratio, levels=[-np.inf, region.threshold], colors=[SHADE], alpha=0.25)
    ax.contour(x, y, ratio, levels=[region.threshold], colors=[FIT], linewidths=LINE)
    handles: list[Any] = [
        Patch(facecolor=SHADE, alpha=0.25, edgecolor=FIT, linewidth=LINE, label=f"{percent} region, likelihood ratio")
    ]
    if region.ellipse is not None:
        handles += ax.plot(*region.ellipse.T, "--", color=REFERENCE, linewidth=LINE, label="ellipse of the covariance")
    alone: dict[str, Any] = {"linestyle": ":", "color": TRANSITION, "linewidth": THIN}
    for draw, ends in zip((ax.axvline, ax.axhline), intervals, strict=True):
        for end in ends:
            draw(end, **alone)
    handles.append(Line2D([], [], label=f"{percent} interval of each alone", **alone))
    handles += ax.plot(*grid.optimum, "P", color=FIT, markersize=9, markeredgecolor="white", label="estimate")
    handles += _draw_bounds(grid, ax)
    ax.legend(
        handles=handles, fontsize=SMALL, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False,
        title="widened, as residuals are correlated" if region.corrected else None, title_fontsize=SMALL,
    )  # fmt: skip
    return _label_axes(grid, ax, runs)


def _refine(region: JointRegion) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the likelihood ratio on a finer grid: nearly a parabola, which a cubic spline follows.

    Where parts of the grid are missing, the grid is left as it is.
    """
    from scipy.interpolate import RectBivariateSpline

    grid, ratio = region.grid, region.ratio
    if not np.isfinite(ratio).all():
        return grid.x, grid.y, ratio
    x, y = (np.linspace(values[0], values[-1], FINE) for values in (grid.x, grid.y))
    return x, y, RectBivariateSpline(grid.y, grid.x, ratio)(y, x)


def _draw_bounds(grid: CostGrid, ax: Axes) -> list[Any]:
    """Draw bounds that are in the map, and return an entry of a legend for them."""
    found: list[Any] = []
    for draw, bounds, values in ((ax.axvline, grid.bounds[0], grid.x), (ax.axhline, grid.bounds[1], grid.y)):
        for bound in bounds:
            if values[0] <= bound <= values[-1]:
                label = "" if found else "bound"
                found.append(draw(bound, color=TRANSITION, linewidth=2 * LINE, label=label, zorder=3, clip_on=False))
    return found[:1]


def _find_runs(estimate: Estimate, grid: CostGrid) -> Runs:
    """Return what shows the values of each of the two unknowns as dates, None where they are no dates."""
    first, second = (list_dated(estimate)[estimate.theta_names.index(name)] for name in grid.names)
    return first, second


def _label_axes(grid: CostGrid, ax: Axes, runs: Runs) -> Axes:
    from switchfit.report.date_axis import label_unknown_axis

    ax.set_xlim(grid.x[0], grid.x[-1])
    ax.set_ylim(grid.y[0], grid.y[-1])
    for along, name, unit, run in zip(AXES, grid.names, grid.units, runs, strict=True):
        label_unknown_axis(ax, name, unit, run, along)
        if run is None:
            ax.locator_params(axis=along, nbins=6)
    return ax
