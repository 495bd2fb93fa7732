"""The figure of a fit: every channel over time, measured and fitted, with bands, residuals and shaded modes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeGuard

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.fit.result import Fit
from switchfit.problem.validation.arrays import as_level
from switchfit.problem.validation.objects import as_flag
from switchfit.report import style
from switchfit.report.panels import (
    choose_mode_colours,
    list_outputs,
    plot_bands,
    plot_comparison,
    plot_modes,
    plot_residuals,
    plot_transitions,
)
from switchfit.report.selection import choose_runs, count_worst
from switchfit.report.style import TRANSITION_COLOUR
from switchfit.runtime.presentation import Axes, Figure
from switchfit.strategy.validation import Validation
from switchfit.uncertainty.corrected_errors import find_transition_intervals
from switchfit.uncertainty.judged_fit import JudgedFit
from switchfit.uncertainty.prediction import Prediction, predict

if TYPE_CHECKING:
    from matplotlib.figure import SubFigure

RUNS_SIDE_BY_SIDE, INCHES_OF_EACH_RUN = 4, (0.0, 8.0, 5.5, 4.5, 4.0)
"""Experiments side by side; inches of each of so many."""


def has_bands(fit: Any) -> TypeGuard[JudgedFit]:
    """Return whether there are a model and a covariance, and room for the derivatives that bands need.

    Parameters
    ----------
    fit : Fit
    """
    has_model = getattr(fit, "problem", None) is not None
    return has_model and bool(np.isfinite(fit.standard_errors).all()) and fit.has_room_for_sensitivities()


def plot_fit(fit: Fit, *, bands: bool = True, level: float = 0.95) -> Figure:
    """Draw every channel of every experiment, measured and fitted, with its residuals below; states where there is no
    data.

    Parameters
    ----------
    fit : Fit
    bands : bool, optional
        Whether to draw bands of what is fitted, where there is a model and a covariance.
    level : float, between 0 and 1
        Of the bands, and of the intervals of the transition times. They allow for correlated residuals, as in the
        report; the legend says where.

    Returns
    -------
    matplotlib.figure.Figure
        Save it with ``figure.savefig("fit.png")``. Of more than 10 experiments, the 10 that are explained worst are
        shown, the worst first.
    """
    level, wanted, runs = as_level(level), as_flag(bands, "bands"), choose_runs(fit)
    intervals = {e: find_transition_intervals(fit, e, level) for e in runs}
    drawn = {e: predict(fit, experiment=e) for e in runs} if wanted and has_bands(fit) else {}
    notes = [] if fit.status.successful else [f"Not a minimum: {fit.status.name.lower().replace('_', ' ')}"]
    notes += filter(None, [count_worst(runs, fit.trajectories, "experiments")])
    return plot_runs(fit, intervals, drawn, level=level, notes=notes)


def plot_runs(
    result: Fit | Validation,
    intervals: Mapping[int, FloatArray],
    predictions: Mapping[int, Prediction],
    *,
    level: float,
    label: str = "fitted",
    notes: Sequence[str] = (),
) -> Figure:
    """Draw every channel of some experiments with its residuals below; states where there is no data.

    Parameters
    ----------
    result : Fit or Validation
    intervals : mapping of experiment to (N, 2)
        Of the transition times of those that are shown, in their order.
    predictions : mapping of experiment to Prediction
        Whose bands are drawn.
    level : float, between 0 and 1
        Of the bands and of the intervals.
    label : str, optional
        Of the curves.
    notes : sequence of str, optional
        Above the legend.
    """
    from matplotlib.patches import Patch

    # Rows of experiments side by side; each row is as high as the one with the most outputs needs.
    runs = list(intervals)
    columns = min(max(len(runs), 1), RUNS_SIDE_BY_SIDE)
    blocks = [runs[first : first + columns] for first in range(0, len(runs), columns)]
    panels = [max(len(list_outputs(result, e)) for e in block) for block in blocks]
    heights = [0.6 + 2.5 * number for number in panels]
    figure = style.make_figure(INCHES_OF_EACH_RUN[columns] * columns, 0.7 + sum(heights))
    grid = figure.add_gridspec(len(blocks), columns, height_ratios=heights)
    colours = choose_mode_colours(result.trajectories)
    for place, e in enumerate(runs):
        trajectory = result.trajectories[e]
        block = figure.add_subfigure(grid[divmod(place, columns)])
        axes = _draw_outputs(result, e, block, panels[place // columns], predictions.get(e), level, label)
        for ax in axes:  # labels of transitions in one of them, so that they come last in the legend
            plot_modes(trajectory, ax, colours=colours, labels=ax is axes[0])
            times = [begin for _, begin, _ in trajectory.mode_spans[1:]]
            plot_transitions(times, intervals[e], ax, level=level if ax is axes[-1] else None)
            if ax is not axes[-1]:
                ax.label_outer()
        if len(result.trajectories) > 1:
            block.suptitle(result.run_names[e], fontsize="medium", fontweight="bold")
    handles = style.collect_handles(figure.axes)
    named = {text.get_text() for ax in figure.axes for text in ax.texts}
    drawn = {mode for e in runs for mode, a, b in result.trajectories[e].mode_spans if b > a}
    # Names stand above the modes where there is room for them; only the others need an entry in the legend.
    for mode in (mode for mode in colours if mode in drawn - named):  # too short for a name
        handles[mode] = Patch(facecolor=colours[mode], edgecolor=TRANSITION_COLOUR, linewidth=0.5)
    # The notes are the title of the legend: a title of the figure would have the same place, and overlap with it.
    title: dict[str, Any] = {"title": "; ".join(notes) or None, "title_fontproperties": {"weight": "bold"}}
    figure.draw_legend(handles, most=10, loc="outside upper right", alignment="left", **title)
    return style.turn_off_formulas(figure)


def _draw_outputs(
    result: Fit | Validation,
    e: int,
    block: SubFigure,
    rows: int,
    prediction: Prediction | None,
    level: float,
    label: str,
) -> list[Axes]:
    """Draw each channel of an experiment with its residuals below, leaving rows free at the bottom for others only."""
    outputs, step = list_outputs(result, e), 2 if result.comparisons[e] else 1
    # The same ratios in all experiments of a row, so that their panels are level, whether or not all are used.
    ratios = ([3.0, 1.2] if step == 2 else [1.0]) * rows
    grid = block.add_gridspec(len(ratios), 1, height_ratios=ratios)
    axes: list[Axes] = [block.add_subplot(grid[0])]
    axes += [block.add_subplot(grid[row], sharex=axes[0]) for row in range(1, step * len(outputs))]
    for k, (comparison, channel) in enumerate(outputs):
        plot_comparison(comparison, channel, axes[step * k], label=label)
        if step == 2:
            plot_residuals(comparison, channel, axes[2 * k + 1])
        if prediction is not None:
            for ax in axes[step * k : step * (k + 1)]:
                plot_bands(prediction, k, level, ax, about_zero=ax is not axes[step * k])
    block.align_ylabels(axes)
    return axes
