"""Figures of a fit over time: measured against fitted with the modes shaded, residuals, modes; and its convergence.

Which functions take an ``ax`` is said in `switchfit.report.style`, with the style that all figures share. `plot_fit`
puts the parts together.

The path in the plane where two positions are measured. Style and rule of plots: `switchfit.report.style`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeGuard

import numpy as np
from numpy.typing import ArrayLike

from switchfit.estimation.estimator import Estimate
from switchfit.fit.result import Fit
from switchfit.fit.trajectory import Comparison, Trajectory, find_delay
from switchfit.problem.data import FloatArray
from switchfit.problem.validation import as_flag, as_index, as_level, as_names, join_names, shorten
from switchfit.report import style
from switchfit.report.formats import count_worst, format_unit, label_quantity, wrap_quantity
from switchfit.report.style import DATA, FIT, LINE, LINE_COLOURS, MODE_COLOURS, REFERENCE, SMALL, THIN, TRANSITION
from switchfit.runtime.presentation import Axes, Figure, draw_figure
from switchfit.strategy.validation import Validation
from switchfit.uncertainty.prediction import Prediction, predict
from switchfit.uncertainty.residuals import find_transition_intervals, rank_runs

LARGEST_FIGURE = 10
"""Experiments that one figure shows."""
LARGEST_DRAWN = 1e100
"""Numbers beyond this overflow in matplotlib."""
COLUMNS, WIDTHS = 4, (0.0, 8.0, 5.5, 4.5, 4.0)
"""Experiments side by side; inches of each of so many."""
LONGEST_TIMELINE = 30
"""Experiments in one timeline."""


def has_bands(fit: Any) -> TypeGuard[Estimate]:
    """Return whether there are a model and a covariance, and room for the derivatives that bands need.

    Parameters
    ----------
    fit : Fit
    """
    has_model = getattr(fit, "problem", None) is not None
    return has_model and bool(np.isfinite(fit.standard_errors).all()) and fit.has_room_for_sensitivities()


def choose_runs(fit: Fit, most: int = LARGEST_FIGURE) -> list[int]:
    """Return the indices of the experiments that one figure shows: all of them, or those that are explained worst.

    Parameters
    ----------
    fit : Fit
    most : int, optional
        Number of them.
    """
    return rank_runs(fit)[:most] if len(fit.trajectories) > most else list(range(len(fit.trajectories)))


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

    runs = list(intervals)
    columns = min(max(len(runs), 1), COLUMNS)
    blocks = [runs[first : first + columns] for first in range(0, len(runs), columns)]
    panels = [max(len(list_outputs(result, e)) for e in block) for block in blocks]
    heights = [0.6 + 2.5 * number for number in panels]
    figure = style.make_figure(WIDTHS[columns] * columns, 0.7 + sum(heights))
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
    for mode in (mode for mode in colours if mode in drawn - named):  # too short for a name
        handles[mode] = Patch(facecolor=colours[mode], edgecolor=TRANSITION, linewidth=0.5)
    # The notes are the title of the legend: a title of the figure would have the same place, and overlap with it.
    title: dict[str, Any] = {"title": "; ".join(notes) or None, "title_fontproperties": {"weight": "bold"}}
    figure.draw_legend(handles, most=10, loc="outside upper right", alignment="left", **title)
    return style.turn_off_formulas(figure)


def _draw_outputs(
    result: Fit | Validation, e: int, block: Any, rows: int, prediction: Prediction | None, level: float, label: str
) -> list[Axes]:
    """Draw each channel of an experiment with its residuals below, leaving rows free at the bottom for others only."""
    outputs, step = list_outputs(result, e), 2 if result.comparisons[e] else 1
    ratios = ([3.0, 1.2] if step == 2 else [1.0]) * rows
    grid = block.add_gridspec(len(ratios), 1, height_ratios=ratios)
    axes: list[Axes] = [block.add_subplot(grid[0])]
    axes += [block.add_subplot(row, sharex=axes[0]) for row in list(grid)[1 : step * len(outputs)]]
    for k, (comparison, channel) in enumerate(outputs):
        plot_comparison(comparison, channel, axes[step * k], label=label)
        if step == 2:
            plot_residuals(comparison, channel, axes[2 * k + 1])
        if prediction is not None:
            for ax in axes[step * k : step * (k + 1)]:
                plot_bands(prediction, k, level, ax, about_zero=ax is not axes[step * k])
    block.align_ylabels(axes)
    return axes


def plot_comparison(comparison: Comparison, channel: int, ax: Axes, *, label: str = "fitted") -> None:
    """Draw one channel over time: samples as dots (a reference signal dashed) and the fitted output as a line.

    Parameters
    ----------
    comparison : Comparison
    channel : int
        Which channel, from 0.
    ax : matplotlib.axes.Axes
    label : str, optional
        Of the line.
    """
    measured = replace_infinities(comparison.measured[:, channel])
    draw_measured(comparison, comparison.times, measured, ax)
    _mark_outliers(comparison, measured, channel, ax)
    times, curve = break_at_transitions(comparison.curve_times, replace_infinities(comparison.curve[:, channel]))
    ax.plot(times, curve, "-", color=FIT, linewidth=LINE, label=label, zorder=4)
    ax.set_ylabel(wrap_quantity(comparison.names[channel], comparison.units[channel]))


def plot_residuals(comparison: Comparison, channel: int, ax: Axes) -> None:
    """Draw measured less fitted of one channel over time, with a band of one sigma to either side where it is known.

    Parameters
    ----------
    comparison : Comparison
    channel : int
        Which channel, from 0.
    ax : matplotlib.axes.Axes
    """
    residual = replace_infinities(comparison.residuals[:, channel])
    ax.axhline(0.0, color=FIT, linewidth=THIN, zorder=2)
    draw_measured(comparison, comparison.times, residual, ax)
    _mark_outliers(comparison, residual, channel, ax)
    if comparison.sigma is not None:
        sigma = replace_infinities(comparison.sigma[:, channel])
        for side, label in ((sigma, "± sigma"), (-sigma, "")):
            ax.plot(comparison.times, side, ":", color=TRANSITION, linewidth=THIN, zorder=2, label=label)
    unit = format_unit(comparison.units[channel])
    ax.set_ylabel(f"residual\n({unit})" if unit else "residual")
    ax.margins(y=0.12)


def plot_modes(
    trajectory: Trajectory, ax: Axes, *, colours: Mapping[str, str] | None = None, labels: bool = True
) -> None:
    """Shade the time in which each mode is active, and name the modes above; label the axis of times.

    Parameters
    ----------
    trajectory : Trajectory
    ax : matplotlib.axes.Axes
    colours : mapping of mode to colour, optional
        As from `choose_mode_colours`, so that several axes agree; left out, in the order of this trajectory's modes.
    labels : bool, optional
        False leaves the names out. A name that is wider than its mode's time is turned by 90 degrees.
    """
    colours = choose_mode_colours([trajectory]) if colours is None else colours
    spans = trajectory.mode_spans
    inches = ax.bbox.width / ax.figure.dpi
    for mode, begin, end in (span for span in spans if span[2] > span[1]):
        ax.axvspan(begin, end, color=colours[mode], linewidth=0, zorder=0)
        room = inches * (end - begin) / (spans[-1][2] - spans[0][1])
        if labels and room > 0.1:
            rotation = 90 if room < 0.085 * len(mode) else 0
            above: dict[str, Any] = {"transform": ax.get_xaxis_transform(), "ha": "center", "va": "bottom"}
            ax.text((begin + end) / 2, 1.02, mode, fontsize=SMALL, rotation=rotation, **above)
    ax.set_xlim(float(trajectory.times[0]), float(trajectory.times[-1]))
    style.label_axis(ax, trajectory)


def plot_transitions(times: ArrayLike, intervals: ArrayLike, ax: Axes, *, level: float | None = None) -> None:
    """Draw the transition times as vertical lines, each in a band that is its interval.

    Parameters
    ----------
    times : (N,) array_like
    intervals : (N, 2) array_like
        Low and high end of each. No band is drawn where one is NaN, or where they are equal.
    ax : matplotlib.axes.Axes
    level : float, between 0 and 1, optional
        Of the intervals; lines and bands have labels for a legend where it is given.
    """
    ends: FloatArray = np.asarray(intervals, dtype=np.float64).reshape(-1, 2)
    line, band = (None, None) if level is None else ("transition", f"transition, {100 * level:g} % interval")
    for time, (low, high) in zip(np.asarray(times).tolist(), ends.tolist(), strict=True):
        ax.axvline(time, color=TRANSITION, linewidth=THIN, zorder=2, label=line)
        if np.isfinite(high - low) and high > low:
            ax.axvspan(low, high, color=TRANSITION, alpha=0.22, linewidth=0, zorder=1, label=band)


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
    shown = np.where(optimality > 0, optimality, np.nan)
    ax.set_yscale("log")
    ax.plot([record.iteration for record in estimate.history], shown, "o-", color=FIT, markersize=4, linewidth=LINE)
    style.draw_level(ax, "tolerance", estimate.tolerance, "left")  # where the curve is far above it
    ax.locator_params(axis="x", integer=True)
    ax.set_xlabel("iteration")
    ax.set_ylabel("optimality (KKT residual)")
    return style.turn_off_formulas(drawn)


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
    inches = ax.bbox.width / ax.figure.dpi / (last - first)
    for row, (e, run) in enumerate(zip(runs, trajectories, strict=True)):  # the first on top
        for mode, begin, end in (span for span in run.mode_spans if span[2] > span[1]):
            fits = inches * (end - begin) > 0.085 * len(mode) + 0.1
            bar: dict[str, Any] = {"color": colours[mode], "edgecolor": TRANSITION, "linewidth": THIN / 2}
            ax.barh(row, end - begin, 0.7, begin, label="" if fits else mode, **bar)
            if fits:
                ax.text((begin + end) / 2, row - 0.15, mode, ha="center", va="center", fontsize=SMALL, clip_on=True)
        for low, high in find_transition_intervals(estimate, e, level).tolist():
            if np.isfinite(high - low):
                look: dict[str, Any] = {"color": FIT, "linewidth": 2 * LINE, "markersize": 7, "zorder": 4}
                look["label"] = f"transition time, {100 * level:g} % interval"
                ax.plot([low, high], [row + 0.2] * 2, "|-", **look)
    style.label_axis(ax, trajectories[0])
    ax.set_xlim(first, last)
    ax.set_ylim(len(runs) - 0.5, -0.5)
    ax.set_yticks(range(len(runs)), [estimate.run_names[e] for e in runs] if len(estimate.trajectories) > 1 else [""])
    ax.tick_params(axis="y", length=0)
    style.draw_legend_above(ax, title=count_worst(runs, estimate.trajectories, "experiments"))
    return style.turn_off_formulas(drawn)


def choose_mode_colours(trajectories: Sequence[Trajectory], *, lines: bool = False) -> dict[str, str]:
    """Return a colour for each mode that occurs, in the order of first occurrence.

    Parameters
    ----------
    trajectories : sequence of Trajectory
    lines : bool, optional
        Whether they are for lines, which need stronger colours than what is shaded.
    """
    names = (mode for trajectory in trajectories for mode, _, _ in trajectory.mode_spans)
    return style.assign_colours(names, LINE_COLOURS if lines else MODE_COLOURS)


def list_outputs(result: Fit | Validation, e: int) -> list[tuple[Comparison, int]]:
    """Return the outputs of an experiment, each as one of its data and the channel of that; its states without data.

    Parameters
    ----------
    result : Fit or Validation
    e : int, from 0
    """
    own, none = result.trajectories[e], result.trajectories[e].states[:0]
    units = own.state_units
    states = Comparison("states", own.state_names, own.times[:0], none, none, None, own.times, own.states, units=units)
    return [(data, k) for data in result.comparisons[e] or (states,) for k in range(len(data.names))]


# --- parts ------------------------------------------------------------------------------------------------------------


def plot_bands(prediction: Prediction, k: int, level: float, ax: Axes, *, about_zero: bool = False) -> None:
    """Draw both bands of one output, of a new sample and of the curve; without data, that of a state.

    Parameters
    ----------
    prediction : Prediction
    k : int, from 0
        Which output.
    level : float, between 0 and 1
    ax : matplotlib.axes.Axes
    about_zero : bool, optional
        Draw them about the zero of the residuals, since about the curve they are often too narrow to be seen.
    """
    e, order, limits = prediction.experiment, np.argsort(prediction.times, kind="stable"), ax.get_ylim()
    late = find_delay(list_outputs(prediction.fit, e)[k][0], prediction.fit.trajectories[e])
    bands = [
        ("prediction", prediction.prediction_band(level), 0.12),
        ("confidence", prediction.output_band(level), 0.3),
    ]
    if not prediction.output_names:
        bands = [("confidence", prediction.state_band(level), 0.3)]
    for kind, ends, alpha in bands:
        band = (ends[:, k] - (prediction.outputs[:, [k]] if about_zero else 0.0))[order]
        widened = ", widened" if prediction.corrected and kind == "confidence" else ""
        plot_band(prediction.times[order] + late, band, ax, alpha=alpha, label=f"{100 * level:g} % {kind}{widened}")
        if about_zero and np.isfinite(band).any():
            reach = 1.1 * np.nanmax(np.abs(band))
            limits = min(limits[0], -reach), max(limits[1], reach)
    if about_zero:
        ax.set_ylim(limits)


def plot_band(times: FloatArray, band: FloatArray, ax: Axes, *, alpha: float, label: str) -> None:
    """Draw a band about a fitted curve, broken at the transitions, where it jumps.

    Parameters
    ----------
    times : (L,)
        In order; those of transitions stand there twice.
    band : (L, 2)
    ax : matplotlib.axes.Axes
    alpha : float
    label : str
        For the legend.
    """
    if np.isfinite(band).any():
        times, low, high = break_at_transitions(times, *band.T)
        ax.fill_between(times, low, high, color=FIT, alpha=alpha, linewidth=0, zorder=2, label=label)


def draw_measured(comparison: Comparison, x: FloatArray, y: FloatArray, ax: Axes) -> None:
    """Draw samples as dots, smaller the more there are, or a reference signal as a dashed line.

    Thousands of dots are one picture in a vector file.

    Parameters
    ----------
    comparison : Comparison
        Whose measured values they are.
    x, y : (K,)
    ax : matplotlib.axes.Axes
    """
    if comparison.kind == "measurements":
        size = 4.5 if len(x) <= 100 else 3.0 if len(x) <= 400 else 1.5
        look: dict[str, Any] = {"alpha": 0.8 if len(x) <= 400 else 0.5, "rasterized": len(x) > 5000}
        ax.plot(x, y, "o", color=DATA, markersize=size, markeredgewidth=0, label="measured", zorder=3, **look)
    elif comparison.kind == "reference":
        ax.plot(x, y, "--", color=REFERENCE, linewidth=LINE, label="reference signal", zorder=3)


def _mark_outliers(comparison: Comparison, values: FloatArray, channel: int, ax: Axes) -> None:
    """Draw circles round the samples that a robust loss weighs down."""
    there = None if comparison.downweighted is None else comparison.downweighted[:, channel]
    if there is not None and there.any():
        look: dict[str, Any] = {"color": FIT, "markersize": 8, "markerfacecolor": "none", "markeredgewidth": 1.0}
        ax.plot(comparison.times[there], values[there], "o", zorder=5, label="weighed down", **look)


def replace_infinities(values: FloatArray) -> FloatArray:
    """Return values with NaN where they are too large for an axis, as a sigma of 1e308 is that takes a sample out.

    Parameters
    ----------
    values : array
    """
    return np.where(np.abs(values) < LARGEST_DRAWN, values, np.nan)


def break_at_transitions(times: FloatArray, *values: FloatArray) -> list[FloatArray]:
    """Return times and values with a gap at each transition, whose time stands there twice: curves may jump there.

    Parameters
    ----------
    times : (L,)
        In order.
    values : (L,) each
    """
    inner = np.flatnonzero(np.diff(times) == 0) + 1
    return [np.insert(times, inner, times[inner]), *(np.insert(each, inner, np.nan) for each in values)]


LENGTHS = {"", "1", "m", "mm", "cm", "km", "ft", "in", "mi", "px", "µm", "um", "nm"}
PAIRS = ({"x": "y"}, {"east": "north"}, {"e": "n"}, {"easting": "northing"}, {"lon": "lat"}, {"longitude": "latitude"})
NO_POSITIONS = {"v", "vel", "velocity", "speed", "a", "acc", "acceleration", "force", "f", "rate", "d", "dot"}
"""Parts of names that say that a channel is no position."""


def find_plane(names: Sequence[str], units: Sequence[str]) -> tuple[int, int] | None:
    """Return the two channels that are positions in a plane, told by their names and units; None if there are none.

    Parameters
    ----------
    names, units : sequence of str
    """
    parts = [re.findall(r"[^\W\d_]+", name.lower()) for name in names]
    for k, one in enumerate(parts):
        for pair in PAIRS if units[k] in LENGTHS and not NO_POSITIONS & set(one) else ():
            other = [pair.get(part, part) for part in one]
            if other != one and other in parts and units[parts.index(other)] == units[k]:
                return k, parts.index(other)
    return None


def plot_plane(
    estimate: Estimate, *, channels: tuple[str, str] | None = None, experiment: int = 0, ax: Axes | None = None
) -> Axes | Figure:
    """Draw two measured positions against one another: samples, fitted path with its modes.

    Parameters
    ----------
    estimate : Estimate
    channels : (str, str), optional
        Names of the two channels; left out, they are told by names such as X and Y or east and north.
    experiment : int, optional
    ax : matplotlib.axes.Axes, optional

    Raises
    ------
    ValueError
        If no two channels of the same data are positions, or those that are named do not exist.
    """
    experiment = as_index(experiment, "experiment", len(estimate.trajectories))
    named = None if channels is None else as_names(channels, "channels", "two names of channels")
    if named is not None and len(named) != 2:
        raise ValueError(f"channels must be two names; got {shorten(channels)}.")
    (comparison, plane), trajectory = _choose_plane(estimate, experiment, named), estimate.trajectories[experiment]
    drawn, ax = style.open_axes(ax, (6.4, 5.6))
    x, y = comparison.measured[:, plane].T
    draw_measured(comparison, x, y, ax)
    colours = choose_mode_colours([trajectory], lines=True)
    segments = zip(trajectory.mode_spans, trajectory.segments[:-1], trajectory.segments[1:], strict=True)
    for (mode, begin, end), first, last in segments:
        label = f"fitted: {mode}" if end > begin else ""
        ax.plot(*comparison.curve[first:last, plane].T, color=colours[mode], linewidth=2 * LINE, zorder=4, label=label)
    ends = comparison.curve[trajectory.segments[1:-1] - 1][:, plane]
    if len(ends):
        marks: dict[str, Any] = {"color": "white", "markeredgecolor": DATA, "markersize": 6, "linestyle": "none"}
        ax.plot(*ends.T, "D", label="transition", zorder=5, **marks)
    labels = [label_quantity(comparison.names[k], comparison.units[k]) for k in plane]
    ax.set(xlabel=labels[0], ylabel=labels[1])
    ax.set_aspect("equal", adjustable="datalim")
    style.draw_legend_above(ax)
    return style.turn_off_formulas(drawn)


def _choose_plane(estimate: Estimate, e: int, channels: tuple[str, ...] | None) -> tuple[Comparison, list[int]]:
    """Return the data with the two channels that are named, or that are positions by their names, and their places."""
    for comparison in estimate.comparisons[e]:
        if channels is not None and set(channels) <= set(comparison.names):
            return comparison, [comparison.names.index(name) for name in channels]
        found = None if channels is not None else find_plane(comparison.names, comparison.units)
        if found is not None:
            return comparison, list(found)
    names = join_names([name for comparison in estimate.comparisons[e] for name in comparison.names])
    what = "are positions in a plane by their names" if channels is None else f"are {shorten(channels)}"
    raise ValueError(
        f"no two channels of the same data {what}; they are {names or 'none'}. Name two: channels=('X', 'Y')."
    )


PLOTS: dict[str, Callable[..., Axes | Figure]]
PLOTS = {"fit": plot_fit, "convergence": plot_convergence, "timeline": plot_timeline, "plane": plot_plane}
"""Plots of an estimate by the end of the method's name: `Estimate.plot_plane` is "plane", `Estimate.plot` is "fit"."""


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
    return PLOTS[what](estimate, **settings)
