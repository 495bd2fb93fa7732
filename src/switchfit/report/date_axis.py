"""Ticks of matplotlib at dates, along an axis of numbers. Import this only where matplotlib is needed."""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num, num2date
from matplotlib.ticker import Formatter, Locator

from switchfit.problem.data import FloatArray
from switchfit.problem.dates import SECONDS, Origin, normalize_time_unit
from switchfit.report.dates import Timed, label_time, label_unknown

FEWEST_TICKS, MOST_TICKS = 5, 8
"""Between which numbers of ticks the largest is chosen: with less than 5, matplotlib finds no interval for some
spans."""
ROOM = 0.7
"""How many inches each tick needs."""
FORMATS = ["%Y", "%b", "%d %b", "%H:%M", "%H:%M", "%S.%f"]
ZERO_FORMATS = ["", "%Y", "%d %b", "%d %b", "%H:%M", "%H:%M"]
OFFSETS = ["", "%Y", "%Y", "%Y-%m-%d", "%Y-%m-%d", "%Y-%m-%d %H:%M"]
"""Of years, months, days, hours, minutes and seconds, for ticks, for those where a larger unit begins, and for what
all of them leave out."""

LONGEST = 1000 * 365.25
"""Days from 1970 that an axis may reach."""


def label_axis(ax: Axes, run: Timed) -> Axes:
    """Label an axis of times; where they are dates, put its ticks at dates. What is drawn remains in numbers.

    Parameters
    ----------
    ax : matplotlib.axes.Axes
    run : Timed
    """
    ax.set_xlabel(label_time(run))
    return put_ticks(ax, run)


def put_ticks(ax: Axes, run: Timed) -> Axes:
    """Put the ticks of the horizontal axis at dates, where times are dates.

    Parameters
    ----------
    ax : matplotlib.axes.Axes
    run : Timed
    """
    if run.origin is not None:
        scale = _Scale(run.origin, run.time_unit)
        if np.all(np.abs(scale.to_days(ax.xaxis.get_view_interval())) < LONGEST):
            locator = DateLocator(scale)
            ax.xaxis.set_major_locator(locator)
            ax.xaxis.set_major_formatter(DateFormatter(scale, locator))
    return ax


def label_unknown_axis(ax: Axes, name: str, unit: str, run: Timed | None) -> Axes:
    """Label a horizontal axis of values of an unknown, with ticks at dates if it is a time of a run with dates.

    Parameters
    ----------
    ax : matplotlib.axes.Axes
    name, unit : str
    run : Timed or None
    """
    ax.set_xlabel(label_unknown(name, unit, run))
    if run is not None:
        return put_ticks(ax, run)
    ax.ticklabel_format(axis="x", useOffset=False)
    return ax


class _Scale:
    """Times as the days of matplotlib, and back."""

    def __init__(self, origin: Origin, time_unit: str) -> None:
        self.zone: datetime.tzinfo = origin.zone or datetime.UTC
        self.start = float(date2num(np.datetime64(origin.instant, "ns")))
        self.length = SECONDS[normalize_time_unit(time_unit)] / SECONDS["d"]

    def to_days(self, times: Sequence[float]) -> FloatArray:
        return self.start + np.asarray(times, dtype=np.float64) * self.length

    def to_times(self, days: Sequence[float]) -> FloatArray:
        return (np.asarray(days, dtype=np.float64) - self.start) / self.length


class DateLocator(Locator):
    """Ticks at round dates of a zone.

    Parameters
    ----------
    scale : _Scale
    """

    def __init__(self, scale: _Scale) -> None:
        self.scale = scale
        self.dates = AutoDateLocator(tz=scale.zone, minticks=2, maxticks=MOST_TICKS)

    def __call__(self) -> Sequence[float]:
        """Return the ticks of what the axis shows."""
        axes: Any = self.axis.axes  # type: ignore[union-attr]  # it is set by then
        most = int(np.clip(axes.bbox.width / axes.figure.dpi / ROOM, FEWEST_TICKS, MOST_TICKS))
        self.dates.maxticks = dict.fromkeys(self.dates.maxticks, most)
        return self.tick_values(*self.axis.get_view_interval())  # type: ignore[union-attr]

    def tick_values(self, vmin: float, vmax: float) -> Sequence[float]:
        """Return the ticks between two times."""
        days = np.clip(self.scale.to_days([vmin, vmax]), -LONGEST, LONGEST)
        ends = num2date(np.sort(days), tz=self.scale.zone)
        return self.scale.to_times(self.dates.tick_values(*ends)).tolist()


class DateFormatter(Formatter):
    """Dates as short as their neighbours allow.

    Parameters
    ----------
    scale : _Scale
    locator : DateLocator
    """

    def __init__(self, scale: _Scale, locator: DateLocator) -> None:
        self.scale = scale
        self.dates = ConciseDateFormatter(
            locator.dates, tz=scale.zone, formats=FORMATS, zero_formats=ZERO_FORMATS, offset_formats=OFFSETS
        )

    def __call__(self, x: float, pos: int | None = None) -> str:
        """Return the label of one tick, or of a place under the pointer."""
        return num2date(float(self.scale.to_days([x])[0]), tz=self.scale.zone).strftime("%Y-%m-%d %H:%M:%S")

    def format_ticks(self, values: Sequence[float]) -> list[str]:
        """Return the labels of all ticks."""
        return self.dates.format_ticks(self.scale.to_days(values).tolist())

    def get_offset(self) -> str:
        """Return what all labels leave out, such as the year."""
        return str(self.dates.get_offset())
