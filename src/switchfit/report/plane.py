"""The path in the plane where two positions are measured. Style and rule of plots: `switchfit.report.style`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

from switchfit.estimation.estimator import Estimate
from switchfit.problem.validation import as_index, as_names, join_names, shorten
from switchfit.report import style
from switchfit.report.numbers import get_unit, label_quantity
from switchfit.report.plot import PLOTS, choose_mode_colours, draw_dots
from switchfit.report.style import DATA, LINE, REFERENCE
from switchfit.runtime.presentation import Axes, Figure

LENGTHS = {"", "m", "mm", "cm", "km", "ft", "in", "mi", "px", "µm", "um", "nm"}
PAIRS = ({"x": "y"}, {"east": "north"}, {"e": "n"}, {"easting": "northing"}, {"lon": "lat"}, {"longitude": "latitude"})
NO_POSITIONS = {"v", "vel", "velocity", "speed", "a", "acc", "acceleration", "force", "f", "rate", "d", "dot"}
"""Parts of names that say that a channel is no position."""


class Plane(NamedTuple):
    """Two channels of one of the data of an experiment: which data, and which channels."""

    data: int
    x: int
    y: int


def find_plane(names: Sequence[str], units: Sequence[str]) -> tuple[int, int] | None:
    """Return the two channels that are positions in a plane, told by their names and units; None if there are none.

    Parameters
    ----------
    names, units : sequence of str

    Examples
    --------
    >>> from switchfit.report.plane import find_plane
    >>> find_plane(("heading", "X", "Y"), ("rad", "m", "m"))
    (1, 2)
    >>> find_plane(("T1", "T2"), ("K", "K")) is None
    True
    """
    parts = [re.findall(r"[^\W\d_]+", name.lower()) for name in names]
    for k, one in enumerate(parts):
        if NO_POSITIONS & set(one) or units[k] not in LENGTHS:
            continue
        for pair in PAIRS:
            other = [pair.get(part, part) for part in one]
            if other != one and other in parts and units[parts.index(other)] == units[k]:
                return k, parts.index(other)
    return None


def plot_plane(
    estimate: Estimate,
    *,
    channels: tuple[str, str] | None = None,
    experiment: int = 0,
    ax: Axes | None = None,
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
    if channels is not None:
        names = as_names(channels, "channels", "two names of channels")
        if len(names) != 2:
            raise ValueError(f"channels must be two names; got {shorten(channels)}.")
        channels = names[0], names[1]
    plane = _choose_plane(estimate, experiment, channels)
    return style.draw_on(ax, lambda ax: _draw_plane(estimate, experiment, plane, ax), (6.4, 5.6))


def _choose_plane(estimate: Estimate, e: int, channels: tuple[str, str] | None) -> Plane:
    """Return the two channels that are named, or that are positions by their names; ValueError if there are none."""
    trajectory = estimate.trajectories[e]
    for number, comparison in enumerate(estimate.comparisons[e]):
        units = [get_unit(comparison, k, trajectory) for k in range(len(comparison.names))]
        if channels is not None and set(channels) <= set(comparison.names):
            return Plane(number, *(comparison.names.index(name) for name in channels))
        found = None if channels is not None else find_plane(comparison.names, units)
        if found is not None:
            return Plane(number, *found)
    names = join_names([name for comparison in estimate.comparisons[e] for name in comparison.names])
    what = "are positions in a plane by their names" if channels is None else f"are {shorten(channels)}"
    raise ValueError(
        f"no two channels of the same data {what}; they are {names or 'none'}. Name two: channels=('X', 'Y')."
    )


def _draw_plane(estimate: Estimate, e: int, plane: Plane, ax: Axes) -> Axes:
    trajectory, comparison = estimate.trajectories[e], estimate.comparisons[e][plane.data]
    both = [plane.x, plane.y]
    if comparison.kind == "measurements":
        ax.plot(*comparison.measured[:, both].T, label="measured", zorder=2, **draw_dots(len(comparison.times)))
    else:
        ax.plot(*comparison.measured[:, both].T, "--", color=REFERENCE, linewidth=LINE, label="reference signal")
    colours = choose_mode_colours([trajectory], lines=True)
    segments = zip(trajectory.mode_spans, trajectory.segments[:-1], trajectory.segments[1:], strict=True)
    for (mode, begin, end), first, last in segments:
        label = f"fitted: {mode}" if end > begin else ""
        ax.plot(*comparison.curve[first:last, both].T, color=colours[mode], linewidth=2 * LINE, zorder=4, label=label)
    ends = comparison.curve[trajectory.segments[1:-1] - 1][:, both]
    if len(ends):
        marks: dict[str, Any] = {"color": "white", "markeredgecolor": DATA, "markersize": 6, "linestyle": "none"}
        ax.plot(*ends.T, "D", label="transition", zorder=5, **marks)
    ax.set_xlabel(label_quantity(comparison.names[plane.x], get_unit(comparison, plane.x, trajectory)))
    ax.set_ylabel(label_quantity(comparison.names[plane.y], get_unit(comparison, plane.y, trajectory)))
    ax.set_aspect("equal", adjustable="datalim")
    return style.draw_legend_above(ax)


PLOTS["plane"] = plot_plane
