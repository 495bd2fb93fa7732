"""Ticks of matplotlib at dates, along an axis of numbers.

Import this only where matplotlib is needed.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence

import numpy as np
from matplotlib.dates import AutoDateLocator, ConciseDateFormatter, date2num, num2date
from matplotlib.ticker import Locator

from switchfit.arrays import FloatArray
from switchfit.problem.origin import Origin
from switchfit.problem.time_units import SECONDS_OF_UNIT, normalize_time_unit

MOST_TICKS = 6
"""There is room for as many in a narrow figure; with less than 5, matplotlib finds no interval for some spans."""

FORMATS = ["%Y", "%b", "%d %b", "%H:%M", "%H:%M", "%S.%f"]
ZERO_FORMATS = ["", "%Y", "%d %b", "%d %b", "%H:%M", "%H:%M"]

OFFSETS = ["", "%Y", "%Y", "%Y-%m-%d", "%Y-%m-%d", "%Y-%m-%d %H:%M"]
"""Of years, months, days, hours, minutes and seconds, for ticks, for those where a larger unit begins, and for what
all of them leave out."""

SHORT_AXIS_IN_DAYS = 0.25
"""Days of an axis from which on its ticks may begin at another hour of the clock. On shorter ones the change to summer
time is no hour that passes, which matplotlib takes it for."""

FARTHEST_DATE_IN_DAYS = 1000 * 365.25
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
        self.length = SECONDS_OF_UNIT[normalize_time_unit(time_unit)] / SECONDS_OF_UNIT["d"]
        # matplotlib finds round dates; what is drawn stays in numbers of the experiment, in which users read and zoom.
        self.dates = AutoDateLocator(tz=self.zone, minticks=2, maxticks=MOST_TICKS)

    def to_days(self, times: Sequence[float]) -> FloatArray:
        """Return times as days since 1970."""
        return self.start + np.asarray(times, dtype=np.float64) * self.length

    def __call__(self) -> Sequence[float]:
        """Return the ticks of what the axis shows."""
        return self.tick_values(*self.axis.get_view_interval())  # type: ignore[union-attr]  # it is set by then

    def tick_values(self, vmin: float, vmax: float) -> Sequence[float]:
        """Return the ticks between two times."""
        # Years outside of 1 to 9999 have no date in Python; an empty axis or a drag with the mouse gets there.
        days = np.clip(self.to_days([vmin, vmax]), -FARTHEST_DATE_IN_DAYS, FARTHEST_DATE_IN_DAYS)
        zone = self.zone
        if np.ptp(days) < SHORT_AXIS_IN_DAYS:
            # The offset at the left end for the whole axis: clocks that change within it would leave out or repeat a
            # tick.
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
