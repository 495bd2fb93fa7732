"""Figures and axes of matplotlib. Import this only where matplotlib is needed."""

from __future__ import annotations

import datetime
import io
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib import rcParams
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num, num2date
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.legend import Legend
from matplotlib.ticker import Locator

from switchfit.problem.data import FloatArray
from switchfit.problem.dates import SECONDS, Origin, normalize_time_unit

DOTS = 96
"""Dots per inch in a notebook."""
LETTER, HANDLE = 0.55, 4.8
"""Widths of a letter, and of what is beside the text of an entry, in sizes of the font."""


def fit_legend(labels: list[str], inches: float, most: int, fontsize: str | float) -> dict[str, Any]:
    """Return settings of a legend with as many columns of its widest entry as a width has room for.

    Parameters
    ----------
    labels : list of str
    inches : float
        The width.
    most : int
        Largest number of columns.
    fontsize : str or float
    """
    size = FontProperties(size=fontsize).get_size_in_points()
    widest = size * (HANDLE + LETTER * max(map(len, labels), default=0))
    return {"fontsize": size, "ncols": min(most, max(int(72 * inches / widest), 1)), "frameon": False}


class NotebookFigure(Figure):
    """A matplotlib Figure that shows itself in a notebook, whether or not pyplot is imported."""

    legend_drawn: Legend | None = None
    legend_settings: Mapping[str, Any]

    def _repr_png_(self) -> bytes:
        picture = io.BytesIO()
        self.savefig(picture, format="png", dpi=DOTS)
        return picture.getvalue()

    def draw_legend(self, handles: Mapping[str, Any], *, most: int = 4, **settings: Any) -> None:
        """Draw the legend of all axes, with as many columns as the width has room for, also after it changes.

        Parameters
        ----------
        handles : mapping of label to handle
        most : int, optional
            Largest number of columns.
        settings
            Others of ``Figure.legend``.
        """
        look = fit_legend(list(handles), self.get_figwidth(), most, rcParams["legend.fontsize"])
        self.legend_settings = {"handles": handles, "most": most, **settings}
        self.legend_drawn = self.legend(list(handles.values()), list(handles), **look, **settings)

    def set_size_inches(self, w: Any, h: float | None = None, forward: bool = True) -> None:
        """Set the size in inches, and draw the legend in the columns that it has room for."""
        super().set_size_inches(w, h, forward)
        if self.legend_drawn is not None and self.legend_drawn in self.legends:
            self.legend_drawn.remove()
            self.draw_legend(**self.legend_settings)


MOST_TICKS = 6
"""There is room for as many in a narrow figure; with less than 5, matplotlib finds no interval for some spans."""
FORMATS = ["%Y", "%b", "%d %b", "%H:%M", "%H:%M", "%S.%f"]
ZERO_FORMATS = ["", "%Y", "%d %b", "%d %b", "%H:%M", "%H:%M"]
OFFSETS = ["", "%Y", "%Y", "%Y-%m-%d", "%Y-%m-%d", "%Y-%m-%d %H:%M"]
"""Of years, months, days, hours, minutes and seconds, for ticks, for those where a larger unit begins, and for what
all of them leave out."""

SHORT = 0.25
"""Days of an axis from which on its ticks may begin at another hour of the clock. On shorter ones the change to summer
time is no hour that passes, which matplotlib takes it for."""
LONGEST = 1000 * 365.25
"""Days from 1970 that an axis may reach."""


class DateLocator(Locator):
    """Ticks of an axis of times at round dates of a zone.

    Parameters
    ----------
    origin : Origin
    time_unit : str
    """

    def __init__(self, origin: Origin, time_unit: str) -> None:
        self.zone: datetime.tzinfo = origin.zone or datetime.UTC
        self.start = float(date2num(origin.instant))
        self.length = SECONDS[normalize_time_unit(time_unit)] / SECONDS["d"]
        self.dates = AutoDateLocator(tz=self.zone, minticks=2, maxticks=MOST_TICKS)

    def to_days(self, times: Sequence[float]) -> FloatArray:
        """Return times as days since 1970."""
        return self.start + np.asarray(times, dtype=np.float64) * self.length

    def __call__(self) -> Sequence[float]:
        """Return the ticks of what the axis shows."""
        return self.tick_values(*self.axis.get_view_interval())  # type: ignore[union-attr]  # it is set by then

    def tick_values(self, vmin: float, vmax: float) -> Sequence[float]:
        """Return the ticks between two times."""
        days = np.clip(self.to_days([vmin, vmax]), -LONGEST, LONGEST)
        zone = self.zone
        if np.ptp(days) < SHORT:
            zone = datetime.timezone(num2date(days[0], tz=zone).utcoffset() or datetime.timedelta())
        ticks = self.dates.tick_values(*num2date(np.sort(days), tz=zone))
        return ((np.asarray(ticks) - self.start) / self.length).tolist()


class DateFormatter(ConciseDateFormatter):
    """Dates as short as their neighbours allow.

    Parameters
    ----------
    locator : DateLocator
    """

    def __init__(self, locator: DateLocator) -> None:
        super().__init__(locator.dates, locator.zone, FORMATS, OFFSETS, ZERO_FORMATS)
        self.locator = locator

    def format_data_short(self, value: float) -> str:
        """Return the label of a place under the pointer."""
        return num2date(float(self.locator.to_days([value])[0]), tz=self.locator.zone).strftime("%Y-%m-%d %H:%M:%S")

    def format_ticks(self, values: Sequence[float]) -> list[str]:
        """Return the labels of all ticks."""
        return super().format_ticks(self.locator.to_days(values).tolist())
