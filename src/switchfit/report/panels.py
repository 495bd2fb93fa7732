"""Parts of figures over time: samples and curve of a channel, residuals, bands, shaded modes, transition times.

Each function draws into the axes that it is given. The rule for ``ax`` is in `switchfit.report.style`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray
from switchfit.fit.comparison import Comparison, find_delay
from switchfit.fit.result import Fit
from switchfit.fit.trajectory import Trajectory
from switchfit.report import style
from switchfit.report.numbers import format_unit, wrap_quantity
from switchfit.report.style import (
    DATA_COLOUR,
    FIT_COLOUR,
    LINE,
    LINE_COLOURS,
    MODE_COLOURS,
    REFERENCE_COLOUR,
    SMALL,
    THIN,
    TRANSITION_COLOUR,
)
from switchfit.runtime.presentation import Axes
from switchfit.strategy.validation import Validation
from switchfit.uncertainty.prediction import Prediction

LARGEST_DRAWN = 1e100
"""Numbers beyond this overflow in matplotlib."""


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
    times, curve = _break_at_transitions(comparison.curve_times, replace_infinities(comparison.curve[:, channel]))
    ax.plot(times, curve, "-", color=FIT_COLOUR, linewidth=LINE, label=label, zorder=4)
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
    ax.axhline(0.0, color=FIT_COLOUR, linewidth=THIN, zorder=2)
    draw_measured(comparison, comparison.times, residual, ax)
    _mark_outliers(comparison, residual, channel, ax)
    if comparison.sigma is not None:
        sigma = replace_infinities(comparison.sigma[:, channel])
        for side, label in ((sigma, "± sigma"), (-sigma, "")):
            ax.plot(comparison.times, side, ":", color=TRANSITION_COLOUR, linewidth=THIN, zorder=2, label=label)
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
    # A letter of small text is about 0.085 inches wide: a name that is wider than its mode is turned, and one without
    # any room is left out.
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
        ax.axvline(time, color=TRANSITION_COLOUR, linewidth=THIN, zorder=2, label=line)
        if np.isfinite(high - low) and high > low:
            ax.axvspan(low, high, color=TRANSITION_COLOUR, alpha=0.22, linewidth=0, zorder=1, label=band)


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
    # Without data the states are drawn as if they were outputs, so that one path draws both.
    states = Comparison("states", own.state_names, own.times[:0], none, none, None, own.times, own.states, units=units)
    return [(data, k) for data in result.comparisons[e] or (states,) for k in range(len(data.names))]


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
    # Bands are wider than residuals where the model is uncertain: limits grow with them, and do not shrink.
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
        times, low, high = _break_at_transitions(times, *band.T)
        ax.fill_between(times, low, high, color=FIT_COLOUR, alpha=alpha, linewidth=0, zorder=2, label=label)


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
        ax.plot(x, y, "o", color=DATA_COLOUR, markersize=size, markeredgewidth=0, label="measured", zorder=3, **look)
    elif comparison.kind == "reference":
        ax.plot(x, y, "--", color=REFERENCE_COLOUR, linewidth=LINE, label="reference signal", zorder=3)


def _mark_outliers(comparison: Comparison, values: FloatArray, channel: int, ax: Axes) -> None:
    """Draw circles round the samples that a robust loss weighs down."""
    there = None if comparison.downweighted is None else comparison.downweighted[:, channel]
    if there is not None and there.any():
        look: dict[str, Any] = {"color": FIT_COLOUR, "markersize": 8, "markerfacecolor": "none", "markeredgewidth": 1.0}
        ax.plot(comparison.times[there], values[there], "o", zorder=5, label="weighed down", **look)


def replace_infinities(values: FloatArray) -> FloatArray:
    """Return values with NaN where they are too large for an axis, as a sigma of 1e308 is that takes a sample out.

    Parameters
    ----------
    values : array
    """
    return np.where(np.abs(values) < LARGEST_DRAWN, values, np.nan)


def _break_at_transitions(times: FloatArray, *values: FloatArray) -> list[FloatArray]:
    """Return times and values with a gap at each transition, whose time stands there twice: curves may jump there."""
    # A NaN between the two: matplotlib breaks a line there, and a band as well.
    inner = np.flatnonzero(np.diff(times) == 0) + 1
    return [np.insert(times, inner, times[inner]), *(np.insert(each, inner, np.nan) for each in values)]
