"""Origin of an experiment: the date at which its times are 0, and the conversion of dates to numbers and back.

The difference of a date to the origin is exact before it is rounded once to float64, so that no digits go to the years
since 1970 (`Origin.to_numbers`). `Origin.to_dates` is the way back, for reports, figures and files.
"""

from __future__ import annotations

import datetime
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray
from switchfit.problem.dates import Dates, Given, as_date, find_zone, format_instant, read_instant
from switchfit.problem.time_units import SECONDS_OF_UNIT, TIMEDELTA_OF_UNIT, normalize_time_unit
from switchfit.problem.validation.names import as_name


@dataclass(frozen=True)
class Origin:
    """The date at which the times of an experiment are 0, and the zone in which its dates are shown.

    Attributes
    ----------
    date : str
        ISO 8601, with its offset from UTC unless it has no zone.
    time_zone : str
        Such as "Europe/Berlin", "UTC" or "+02:00"; "" for dates without a zone.
    """

    date: str
    time_zone: str

    @cached_property
    def instant(self) -> np.datetime64:
        """The date in microseconds: in UTC, or on the wall clock if it has no zone."""
        return read_instant(self.date, "origin")[0]

    @cached_property
    def zone(self) -> datetime.tzinfo | None:
        """The zone as a tzinfo; None for dates without one."""
        return find_zone(self.time_zone) if self.time_zone else None

    def to_numbers(self, dates: Dates, time_unit: str, what: str = "times") -> FloatArray:
        """Return dates as numbers of a unit since the origin, of the same shape.

        Parameters
        ----------
        dates : Dates
            Those without a zone are of the origin's.
        time_unit : str
        what : str, optional
            Name of the argument, for messages.

        Raises
        ------
        ValueError
            For dates with a zone if the origin has none, and for times that clocks skip or show twice.
        """
        if dates.time_zone and not self.time_zone:
            raise ValueError(f"{what}: {dates!r} has a time zone, but the dates of the experiment have none.")
        instants = dates.localize(self.time_zone, what).instants
        return np.asarray((instants - self.instant) / TIMEDELTA_OF_UNIT[normalize_time_unit(time_unit)])

    def to_dates(self, times: ArrayLike, time_unit: str) -> list[datetime.datetime]:
        """Return times (K,) as dates in the experiment's zone, to the microsecond.

        Parameters
        ----------
        times : (K,) array_like
            In `time_unit` since the origin.
        time_unit : str

        Raises
        ------
        ValueError
            For times that are not finite, or before the year 1 or after 9999.
        """
        found = []
        for time in np.atleast_1d(np.asarray(times, dtype=np.float64)).tolist():
            date = self.find_date(time, time_unit)
            if date is None:
                raise ValueError(f"{time:g} {time_unit} since {self.date} is no date of the years 1 to 9999.")
            found.append(date)
        return found

    def find_date(self, time: float, time_unit: str) -> datetime.datetime | None:
        """Return a time as a date in the experiment's zone; None if it is not finite or beyond the years 1 to 9999."""
        length = 1e6 * SECONDS_OF_UNIT[normalize_time_unit(time_unit)]
        try:
            start: datetime.datetime = self.instant.item()  # type: ignore[assignment]  # of microseconds
            moment = start + datetime.timedelta(microseconds=round(time * length))
            return moment if self.zone is None else moment.replace(tzinfo=datetime.UTC).astimezone(self.zone)
        except (OverflowError, ValueError):
            return None


def choose_origin(
    given: Sequence[Given], data: Sequence[Given], origin: object, time_zone: object, t0: object
) -> Origin:
    """Return the origin of an experiment: as given, else t0 if that is a date, else the earliest date of the data.

    Parameters
    ----------
    given : sequence of Given
        All dates of the experiment but the origin.
    data : sequence of Given
        Those of its data; empty unless all times of the data are dates.
    origin : date, Origin or None
    time_zone : str or None
        Of dates without a zone, and in which all are shown.
    t0 : Dates, or anything else

    Raises
    ------
    ValueError
        For dates with a zone beside dates without and no `time_zone`, an unknown zone, and numbers whose origin is not
        stated.
    TypeError
        For an origin that is no date, and a `time_zone` that is no string.
    """
    start = None if origin is None else as_date(origin.date if isinstance(origin, Origin) else origin, "origin")
    form = "the name of a time zone, such as 'Europe/Berlin', or an offset such as '+02:00'"
    asked = None if time_zone is None else as_name(time_zone, "time_zone", form)
    if asked is not None:
        find_zone(asked)
    # Each date counts, the origin too: one with a zone among those without is an error here, and not a shift by hours.
    every = [*given, *([] if start is None else [("origin", start)])]
    if not every:
        raise ValueError(f"time_zone is {asked!r}, but no time is a date: give origin, the date of time 0.")
    bare, zoned = ([one for one in every if bool(one[1].time_zone) is has] for has in (False, True))
    if asked is None and bare and zoned:
        (what, dates), (other, others) = zoned[0], bare[0]
        raise ValueError(
            f"{what} has a time zone ({dates!r}), but {other} has none ({others!r}): give time_zone='Europe/Berlin', "
            "or whatever it is, for those."
        )
    # The zone in which all are shown: as asked for; none if a date has none; that of all dates, or UTC if they differ.
    zones = {dates.time_zone for _, dates in zoned}
    zone = asked if asked is not None else "" if bare else zones.pop() if len(zones) == 1 else "UTC"
    start = t0 if start is None and isinstance(t0, Dates) else start
    candidates = data if start is None else [("origin", start)]
    if not candidates:
        raise ValueError(
            f"{given[0][0]} is a date, but not all times of the data are: give origin, the date of time 0."
        )
    # Dates of several zones are compared as instants: the earliest one on a wall clock need not be the first.
    located = [dates.localize(zone, what) for what, dates in candidates]
    return make_origin(min(each.instants.min() for each in located), zone)


def make_origin(instant: np.datetime64, zone: str) -> Origin:
    """Return the origin at a date of `Dates.instants`."""
    return Origin(format_instant(instant, zone), zone)
