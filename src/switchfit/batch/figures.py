"""Figures of many fits: intervals of the unknowns, histograms of estimates, and J by start."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from switchfit.batch.bootstrap_study import Bootstrap
from switchfit.batch.fits import Fits
from switchfit.batch.monte_carlo_study import MonteCarlo
from switchfit.batch.starts import Multistart
from switchfit.batch.tables import TOO_FEW, count_minima, list_dated_unknowns, select_unknowns_of_fits
from switchfit.report import selection, style
from switchfit.report.style import DATA_COLOUR, FIT_COLOUR, GROUP_COLOURS, LINE, SHADE_COLOUR, SMALL, THIN
from switchfit.runtime.presentation import Axes, Figure, draw_figure, format_count

OTHERS = "#bbbbbb"
"""Of a line that joins starts."""

LEVEL_COLOURS = {"good": "#1a7f4b", "doubtful": "#c07800", "bad": "#bb2a20"}

DRAWN_FITS, DRAWN_UNKNOWNS = 40, 6
"""Fits and unknowns in a figure: the worst fits, and of more unknowns first those that are no transition times."""

FARTHEST = 30.0
"""Length of one side of an interval, in the median of all, beyond which a figure cuts it off: a parameter on a
logarithmic scale that is not determined has an end of 1e166."""


@draw_figure.register(Fits)
def plot_fits(fits: Fits) -> Figure:
    """Draw a panel for each unknown: its histogram, or a row for each fit of a log.

    Parameters
    ----------
    fits : Fits
    """
    shown, width, height, most, title = list(range(len(fits.theta_names))), 3.4, 2.7, 3, ""
    draw: Callable[[int, Axes], None]
    if isinstance(fits, Bootstrap):
        draw = partial(_draw_bootstrap, fits)
        shown, title = np.flatnonzero(fits.resampled).tolist(), f"Bootstrap: {fits.resample}"
    elif isinstance(fits, MonteCarlo):
        failed = int((~fits.success).sum())
        draw, title = (
            partial(_draw_monte_carlo, fits),
            f"{failed} runs that did not converge are left out" if failed else "",
        )
    else:
        # Of many logs, those to look at: fits that are bad, not those in the middle.
        order = fits.worst_first[:DRAWN_FITS]
        draw, title = partial(_draw_rows, fits, order=order), selection.count_worst(order, fits, "fits")
        width, height, most = 2.9, 0.9 + 0.2 * max(len(order), 5), DRAWN_UNKNOWNS
        shown = select_unknowns_of_fits(fits, DRAWN_UNKNOWNS)
    # A histogram of one estimate says nothing; the figure is empty then, with its title as the reason.
    if isinstance(fits, MonteCarlo | Bootstrap) and fits.success.sum() < 2:
        shown, title = [], TOO_FEW
    columns = max(min(len(shown), most), 1)
    rows = max(-(-len(shown) // columns), 1)
    figure = style.make_figure(width * columns + 0.5, height * rows + 0.5)
    axes = [figure.add_subplot(rows, columns, number + 1) for number in range(len(shown))]
    for number, panel in enumerate(axes):
        draw(shown[number], panel)
        if number % columns:
            panel.set_ylabel("")
            panel.tick_params(labelleft=False)
    # All panels have the same entries.
    figure.draw_legend(style.collect_handles(axes[:1]), most=3, loc="outside upper center", title=title)
    return style.turn_off_formulas(figure)


def _draw_rows(fits: Fits, k: int, ax: Axes, *, order: NDArray[np.intp]) -> None:
    """Draw one unknown with its 95 % intervals, a row for each of the given fits, the first on top."""
    rows, intervals, levels = np.arange(len(order)), fits.confidence_intervals()[order, k], fits.levels[order]
    for level, colour in LEVEL_COLOURS.items():
        here = levels == level
        if here.any():
            ax.hlines(rows[here], *intervals[here].T, color=colour, linewidth=LINE, alpha=0.6)
            ax.scatter(fits.theta[order[here], k], rows[here], s=18, color=colour, label=level, zorder=2)
    theta = fits.theta[order, k, None]
    size = np.abs(intervals - theta)
    known = size[(size > 0) & (size < np.inf)]
    # Intervals go on beyond the axis, and are cut off there.
    if len(known) and known.max() > (most := FARTHEST * np.median(known)):
        near = np.where(size <= most, intervals, theta)
        margin = 0.05 * (np.nanmax(near) - np.nanmin(near))
        ax.set_xlim(np.nanmin(near) - margin, np.nanmax(near) + margin)
    ax.grid(axis="x", linewidth=THIN / 2, alpha=0.6)
    ax.set_yticks(rows, [str(run) for run in fits.runs[order]])
    ax.set_ylabel("run")
    ax.set_ylim(max(len(order), 1) - 0.5, -0.5)
    _label_axis(fits, k, ax)


def _draw_bootstrap(study: Bootstrap, k: int, ax: Axes) -> None:
    """Draw the histogram of one unknown: estimates of the resampled data, the estimate, its 95 % interval."""
    _draw_histogram(study, k, study.estimate[k], ax)
    ax.axvline(study.estimate[k], color=FIT_COLOUR, linewidth=LINE, label="estimate")
    for side, edge in enumerate(study.intervals()[k]):
        ax.axvline(edge, color=DATA_COLOUR, linestyle=":", linewidth=LINE, label="" if side else "95 % interval (BCa)")


def _draw_monte_carlo(study: MonteCarlo, k: int, ax: Axes) -> None:
    """Draw the histogram of one unknown: estimates, truth, the normal density of the reported standard error."""
    _draw_histogram(study, k, study.truth[k], ax, density=True)
    error = float(np.median(study.standard_errors[study.success, k]))
    if np.isfinite(error) and error > 0:
        x = np.linspace(*ax.get_xlim(), 300)
        normal = np.exp(-0.5 * ((x - study.truth[k]) / error) ** 2) / (np.sqrt(2 * np.pi) * error)
        ax.plot(x, normal, color=DATA_COLOUR, linewidth=LINE, label="normal, reported error")
    ax.axvline(study.truth[k], color=FIT_COLOUR, linestyle="--", linewidth=LINE, label="truth")


def _draw_histogram(study: Fits, k: int, centre: float, ax: Axes, *, density: bool = False) -> None:
    """Draw the histogram of the estimates of unknown k: all but the farthest hundredth, with a margin."""
    values = study.theta[study.success, k]
    # A fit that ended in another minimum would make all others one bar.
    low, high = np.percentile(values, [0.5, 99.5])
    # Estimates that are all equal, as of a parameter at its bound, still need an axis with a width.
    margin = 0.25 * max(float(high - low), 1e-12 * abs(centre), np.finfo(float).tiny)
    limits, label = (low - margin, high + margin), f"{len(values)} estimates"
    ax.hist(values, bins=40, range=limits, density=density, color=SHADE_COLOUR, alpha=0.7, label=label)
    ax.set_xlim(limits)
    ax.set_yticks([])
    ax.set_ylabel("density" if density else "fits")
    _label_axis(study, k, ax)


def _label_axis(fits: Fits, k: int, ax: Axes) -> None:
    """Label the horizontal axis with the name and unit of unknown k, with few ticks, at dates if it is a date."""
    clock = list_dated_unknowns(fits)[k]
    style.label_unknown_axis(ax, fits.theta_names[k], fits.theta_units[k], clock)
    if clock is None:
        ax.locator_params(axis="x", nbins=4)


@draw_figure.register(Multistart)
def plot_starts(study: Multistart, *, ax: Axes | None = None) -> Axes | Figure:
    """Draw the final cost of each start above the best, ascending; those of one minimum share a colour.

    Parameters
    ----------
    study : Multistart
    ax : matplotlib.axes.Axes, optional
    """
    drawn, ax = style.open_axes(ax, (7.0, 3.6))
    # Starts that failed come last.
    order = np.argsort(np.where(np.isfinite(study.cost), study.cost, np.inf), kind="stable")
    costs, labels, rank = study.cost[order], study.clusters[order], np.arange(1, len(order) + 1)
    floor = max(1e-12 * abs(costs[0]), 1e-300)  # differences below are rounding
    height = np.where(np.isfinite(costs), np.maximum(costs - costs[0], floor), np.nan)
    ax.plot(rank, height, color=OTHERS, linewidth=THIN, zorder=1)
    for k in range(count_minima(study)):
        here, colour = labels == k, GROUP_COLOURS[min(k, len(GROUP_COLOURS) - 1)]
        label = f"J = {costs[here][0]:.6g}: {format_count(int(here.sum()), 'start')}"
        label = label if k < len(GROUP_COLOURS) - 1 else ""
        ax.scatter(rank[here], height[here], s=22, color=colour, label=label, zorder=2)
    failed = labels < 0
    if failed.any():
        ax.scatter(rank[failed], height[failed], s=24, marker="x", color=DATA_COLOUR, label="not converged")
    ax.set_yscale("log")
    # All in one minimum: a few decades, not one tick.
    ax.set_ylim(floor / 3, max(3 * np.nanmax(height, initial=floor), 1e3 * floor))
    ax.locator_params(axis="x", integer=True)
    ax.set_xlim(0.5, len(order) + 0.5)
    ax.set_xlabel("starts, in the order of the cost at their end")
    ax.set_ylabel("cost above the best")
    ax.legend(frameon=False, fontsize=SMALL, loc="upper left")
    return style.turn_off_formulas(drawn)
