"""The figure of the modes of all experiments over time, with the intervals of the transition times."""

from __future__ import annotations

from typing import Any

import numpy as np

from switchfit.fit.result import Fit
from switchfit.report import style
from switchfit.report.panels import choose_mode_colours
from switchfit.report.selection import choose_runs, count_worst
from switchfit.report.style import FIT_COLOUR, LINE, SMALL, THIN, TRANSITION_COLOUR
from switchfit.runtime.presentation import Axes, Figure
from switchfit.uncertainty.corrected_errors import find_transition_intervals

LONGEST_TIMELINE = 30
"""Experiments in one timeline."""


def plot_timeline(estimate: Fit, *, level: float = 0.95, ax: Axes | None = None) -> Axes | Figure:
    """Draw which mode is active when, a row for each experiment, and the intervals of the transition times.

    Parameters
    ----------
    estimate : Fit
    level : float, between 0 and 1
        Of the intervals, which allow for correlated residuals, as in the report.
    ax : matplotlib.axes.Axes, optional
    """
    runs = choose_runs(estimate, LONGEST_TIMELINE)
    drawn, ax = style.open_axes(ax, (8.0, 1.3 + 0.4 * len(runs)))
    trajectories, colours = [estimate.trajectories[e] for e in runs], choose_mode_colours(estimate.trajectories)
    first = float(min(run.times[0] for run in trajectories))
    last = float(max(run.times[-1] for run in trajectories))
    # Inches of a unit of time: a name is written into its bar where it fits, else it is in the legend.
    inches = ax.bbox.width / ax.figure.dpi / (last - first)
    for row, (e, run) in enumerate(zip(runs, trajectories, strict=True)):  # the first on top
        for mode, begin, end in (span for span in run.mode_spans if span[2] > span[1]):
            fits = inches * (end - begin) > 0.085 * len(mode) + 0.1
            bar: dict[str, Any] = {"color": colours[mode], "edgecolor": TRANSITION_COLOUR, "linewidth": THIN / 2}
            ax.barh(row, end - begin, 0.7, begin, label="" if fits else mode, **bar)
            if fits:
                ax.text((begin + end) / 2, row - 0.15, mode, ha="center", va="center", fontsize=SMALL, clip_on=True)
        for low, high in find_transition_intervals(estimate, e, level).tolist():
            if np.isfinite(high - low):
                look: dict[str, Any] = {"color": FIT_COLOUR, "linewidth": 2 * LINE, "markersize": 7, "zorder": 4}
                look["label"] = f"transition time, {100 * level:g} % interval"
                ax.plot([low, high], [row + 0.2] * 2, "|-", **look)
    style.label_axis(ax, trajectories[0])
    ax.set_xlim(first, last)
    ax.set_ylim(len(runs) - 0.5, -0.5)
    ax.set_yticks(range(len(runs)), [estimate.run_names[e] for e in runs] if len(estimate.trajectories) > 1 else [""])
    ax.tick_params(axis="y", length=0)
    style.draw_legend_above(ax, title=count_worst(runs, estimate.trajectories, "experiments"))
    return style.turn_off_formulas(drawn)
