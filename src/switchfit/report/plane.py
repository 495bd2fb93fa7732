"""The path in the plane where two positions are measured."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from switchfit.fit.comparison import Comparison
from switchfit.problem.validation.arrays import as_index
from switchfit.problem.validation.messages import join_names, shorten
from switchfit.problem.validation.names import as_names
from switchfit.report import style
from switchfit.report.numbers import label_quantity
from switchfit.report.panels import choose_mode_colours, draw_measured
from switchfit.report.style import DATA_COLOUR, LINE
from switchfit.runtime.presentation import Axes, Figure
from switchfit.uncertainty.judged_fit import JudgedFit

LENGTH_UNITS = {"", "1", "m", "mm", "cm", "km", "ft", "in", "mi", "px", "µm", "um", "nm"}
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
        # East before north: the first of a pair is the horizontal axis, whatever the order of the channels.
        for pair in PAIRS if units[k] in LENGTH_UNITS and not NO_POSITIONS & set(one) else ():
            # The partner's name has y where this one has x, as a part: pos_x and pos_y, but not max and may.
            other = [pair.get(part, part) for part in one]
            if other != one and other in parts and units[parts.index(other)] == units[k]:
                return k, parts.index(other)
    return None


def plot_plane(
    estimate: JudgedFit, *, channels: tuple[str, str] | None = None, experiment: int = 0, ax: Axes | None = None
) -> Axes | Figure:
    """Draw two measured positions against one another: samples, fitted path with its modes.

    Parameters
    ----------
    estimate : JudgedFit
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
    # A curve for each mode, from its first node to its last: the nodes at a transition are two.
    segments = zip(trajectory.mode_spans, trajectory.segments[:-1], trajectory.segments[1:], strict=True)
    for (mode, begin, end), first, last in segments:
        label = f"fitted: {mode}" if end > begin else ""
        ax.plot(*comparison.curve[first:last, plane].T, color=colours[mode], linewidth=2 * LINE, zorder=4, label=label)
    # The last node before each transition: what is measured may jump there.
    ends = comparison.curve[trajectory.segments[1:-1] - 1][:, plane]
    if len(ends):
        marks: dict[str, Any] = {"color": "white", "markeredgecolor": DATA_COLOUR, "markersize": 6, "linestyle": "none"}
        ax.plot(*ends.T, "D", label="transition", zorder=5, **marks)
    labels = [label_quantity(comparison.names[k], comparison.units[k]) for k in plane]
    ax.set(xlabel=labels[0], ylabel=labels[1])
    ax.set_aspect("equal", adjustable="datalim")
    style.draw_legend_above(ax)
    return style.turn_off_formulas(drawn)


def _choose_plane(estimate: JudgedFit, e: int, channels: tuple[str, ...] | None) -> tuple[Comparison, list[int]]:
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
