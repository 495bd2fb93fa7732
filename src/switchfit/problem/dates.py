"""Dates as they are given: text, datetimes and columns of tables, read as instants with a time zone.

Everything inside the library computes with float64 numbers. Dates are read here (`read_dates`), kept to the microsecond
until the experiment knows its origin and its unit, and then converted (`switchfit.problem.origin`).

A date has a time zone or has none. One without is the reading of some wall clock: it cannot be compared with one that
has a zone until the experiment's `time_zone` says where the clock hung.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from functools import lru_cache
from typing import Any, NoReturn, TypeVar
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from switchfit.problem.time_units import SECONDS_OF_UNIT, TIME_UNITS
from switchfit.problem.validation.arrays import as_array
from switchfit.problem.validation.messages import shorten
from switchfit.problem.validation.names import as_name
from switchfit.problem.validation.tables import is_of_library

Instants = NDArray[np.datetime64]
"""In microseconds: in UTC, or on the wall clock of dates without a zone."""

DATE_EXAMPLES = "2024-05-01, 2024-05-01T12:34:56 or 2024-05-01T12:34:56+02:00"

FIRST_DAY, LAST_DAY = np.datetime64("0001-01-01"), np.datetime64("9999-12-31")
"""The days that a `datetime` may have."""

_DATE_TYPES = (str, datetime.date, np.datetime64)  # a datetime and a Timestamp of pandas are dates too

T = TypeVar("T")


@lru_cache(maxsize=64)
def find_zone(name: str) -> datetime.tzinfo:
    """Return the time zone of a name of the IANA database, such as "Europe/Berlin", or of an offset such as "+02:00".

    Raises
    ------
    ValueError
        If there is none.
    """
    zone: datetime.tzinfo | None = None
    with suppress(Exception):  # ZoneInfoNotFoundError, ValueError or OSError, by the name
        is_offset = name in ("UTC", "Z") or name.startswith(("+", "-"))
        offset = name.removeprefix("UTC") or "Z"
        zone = datetime.time.fromisoformat(f"00:00{offset}").tzinfo if is_offset else ZoneInfo(name)
    if zone is None:
        raise ValueError(
            f"time_zone {shorten(name)} is not known; give a name such as 'Europe/Berlin', 'UTC', or an offset such as "
            "'+02:00'. (If none is known on this system: pip install tzdata.)"
        )
    return zone


# --- dates as they were given -----------------------------------------------------------------------------------------


def read_date_text(text: str) -> tuple[np.datetime64, str] | None:
    """Return the instant and the zone, "" without, of a date in ISO 8601; None if it is none."""
    try:
        return _split(datetime.datetime.fromisoformat(text.strip()))
    except ValueError:
        return None


def _split(date: datetime.datetime) -> tuple[np.datetime64, str]:
    """Return the instant of a date, and its zone: the name in the IANA database if it has one, else the offset."""
    wall, offset = np.datetime64(date.replace(tzinfo=None), "us"), date.utcoffset()
    if offset is None:
        return wall, ""
    name = "" if type(date.tzinfo) is datetime.timezone else _name_tzinfo(date.tzinfo)
    # A zone is written as "UTC+02:00", or as "UTC".
    return wall - np.timedelta64(offset, "us"), name or str(datetime.timezone(offset))[3:] or "UTC"


def _name_tzinfo(tz: object) -> str:
    """Return the name of a zone in the IANA database, "" if it has none there."""
    name = getattr(tz, "key", None) or getattr(tz, "zone", None) or str(tz)
    try:
        find_zone(str(name))
    except ValueError:
        return ""
    return str(name)


def read_instant(value: object, what: str, place: str = "") -> tuple[np.datetime64, str]:
    """Return the instant and the zone of one date; `place` says where it stands among several."""
    if isinstance(value, str):
        found = read_date_text(value)
        if found is None:
            wanted = "numbers or dates" if place else "a number or a date"
            raise ValueError(f"{what} must be {wanted}; got {shorten(value)}{place}. Write dates as {DATE_EXAMPLES}.")
        return found
    if value is None or str(value) in ("NaT", "<NA>", "nan"):
        _refuse_missing(what, place)
    if isinstance(value, np.datetime64):
        return _as_instants(np.asarray(value), what)[()], ""  # type: ignore[return-value]  # of shape ()
    if isinstance(value, datetime.datetime):
        return _split(value)
    if isinstance(value, datetime.date):
        return np.datetime64(value, "us"), ""
    raise TypeError(f"{what} must be numbers or dates, not both; got {shorten(value)}{place} among dates.")


def _as_instants(array: Instants, what: str) -> Instants:
    """Return datetime64 in microseconds, checked: NumPy would let them overflow."""
    missing = np.isnat(array)
    if missing.any():
        _refuse_missing(what, f" at index {np.argmax(missing)}")
    days = array.astype("datetime64[D]")
    if not ((days >= FIRST_DAY) & (days <= LAST_DAY)).all():
        raise ValueError(f"{what} must lie in the years 1 to 9999; got {shorten(array.astype(str))}.")
    return array.astype("datetime64[us]")


def _refuse_missing(what: str, place: str) -> NoReturn:
    raise ValueError(f"{what} must not be missing; the date{place} is. Leave such samples out.")


def _find_offset(wall: datetime.datetime, zone: str, what: str) -> datetime.timedelta:
    """Return the offset of a zone from UTC at a minute of its wall clock."""
    tz = find_zone(zone)
    before, after = (wall.replace(tzinfo=tz, fold=fold).utcoffset() or datetime.timedelta(0) for fold in (0, 1))
    if before != after:
        why = "is skipped as clocks are set forward" if before < after else "occurs twice as clocks are set back"
        raise ValueError(
            f"{what}: {wall.isoformat(' ', 'minutes')} {why} in {zone}. Write these dates with their offset from UTC, "
            "such as 2020-10-25T02:30+01:00, or in UTC."
        )
    return before


@dataclass(frozen=True, eq=False)
class Dates:
    """Dates as they were given, until an experiment turns them into numbers.

    Attributes
    ----------
    instants : datetime64 array, () or (K,)
        In microseconds: in UTC, or on the wall clock of dates without a zone.
    time_zone : str
        Such as "Europe/Berlin", "UTC" or "+02:00"; "" for dates without a zone.
    """

    instants: Instants
    time_zone: str = ""

    def __len__(self) -> int:
        return len(self.instants)

    def __getitem__(self, index: Any) -> Dates:
        return Dates(np.asarray(self.instants[index]), self.time_zone)

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[np.generic]:
        """Return a datetime64 array, in UTC if the dates have a zone."""
        return self.instants if dtype is None else self.instants.astype(dtype)

    def __repr__(self) -> str:
        if self.instants.shape == ():
            return format_instant(self.instants, self.time_zone)
        return f"{len(self)} dates from {self[0]!r} to {self[-1]!r}" if len(self) else "no dates"

    def localize(self, zone: str, what: str) -> Dates:
        """Return dates without a zone as those of a zone; others as they are.

        Parameters
        ----------
        zone : str
            "" leaves all as they are.
        what : str
            Name of the argument, for messages.

        Raises
        ------
        ValueError
            For a time that clocks in this zone skip, or show twice.
        """
        if self.time_zone or not zone:
            return self
        minutes, places = np.unique(self.instants.astype("datetime64[m]").ravel(), return_inverse=True)
        offsets = [_find_offset(minute, zone, what) for minute in minutes.tolist()]
        found = np.array(offsets, dtype="timedelta64[us]")[places].reshape(self.instants.shape)
        return Dates(self.instants - found, zone)


def format_instant(instant: Instants | np.datetime64, zone: str) -> str:
    """Return a date of `Dates.instants` in ISO 8601, in a zone or without one."""
    date: datetime.datetime = instant.item()  # type: ignore[assignment]  # of microseconds
    if zone:
        date = date.replace(tzinfo=datetime.UTC).astimezone(find_zone(zone))
    return date.isoformat()


def read_dates(value: object, what: str) -> Dates | None:
    """Return dates, text, and arrays, columns of tables and lists of these as dates; None for anything else.

    Parameters
    ----------
    value : object
        Text is in ISO 8601.
    what : str
        Name of the argument, for messages.

    Raises
    ------
    ValueError
        For text that is no date, missing dates, dates with a zone among dates without, and dates beyond the years 1 to
        9999.
    TypeError
        For something that is no date among dates.
    """
    if type(value) is float:  # as are most times
        return None
    if isinstance(value, Dates):
        return value
    if isinstance(value, _DATE_TYPES):
        instant, zone = read_instant(value, what)
        return Dates(np.array(instant), zone)
    dtype = getattr(value, "dtype", None)
    tz = getattr(dtype, "tz", None) or getattr(dtype, "time_zone", None)  # of pandas, of polars
    if tz or is_of_library(value, "polars"):
        value = np.asarray(value, dtype="datetime64[us]" if tz else None)  # in UTC if it has a zone
    column: Any = value  # of any library, or a list
    kind = getattr(getattr(column, "dtype", None), "kind", "")
    if kind == "M":
        zone = tz if isinstance(tz, str) else _name_tzinfo(tz) or "UTC" if tz else ""
        return Dates(_as_instants(np.asarray(column), what), zone)
    is_list = isinstance(column, (list, tuple)) or (kind == "O" and getattr(column, "ndim", 1) == 1)
    if kind == "U" or (is_list and any(issubclass(each, _DATE_TYPES) for each in set(map(type, column)))):
        return _read_entries(list(column), what)
    return None


def _read_entries(entries: list[object], what: str) -> Dates:
    """Return entries, each a date or text, as dates."""
    pairs = [read_instant(entry, what, f" at index {index}") for index, entry in enumerate(entries)]
    zones = {zone for _, zone in pairs}
    if "" in zones and len(zones) > 1:
        raise ValueError(f"{what} must all have a time zone, or none; got {shorten(entries)}.")
    zone = zones.pop() if len(zones) == 1 else "UTC"
    return Dates(np.array([instant for instant, _ in pairs], dtype="datetime64[us]"), zone)


def read_date(value: T, what: str) -> T | Dates:
    """Return a single date as `Dates`, ValueError for several; anything else as it is."""
    date = read_dates(value, what)
    if date is not None and date.instants.shape != ():
        raise ValueError(f"{what} must be one date; got {date!r}.")
    return value if date is None else date


def as_date(value: object, what: str) -> Dates:
    """Return a single date; TypeError for anything else."""
    date = read_date(value, what)
    if not isinstance(date, Dates):
        raise TypeError(f"{what} must be a date, such as '2024-05-01T12:00+02:00'; got {shorten(value)}.")
    return date


Given = tuple[str, Dates]
"""Dates among the arguments of an experiment, and what messages call them."""


def list_dates(value: object, what: str = "") -> Iterator[Given]:
    """Yield all dates in a value, in the fields of dataclasses and in tuples, and what to call them."""
    if isinstance(value, Dates):
        yield what, value
    elif isinstance(value, tuple):
        for entry in value:
            yield from list_dates(entry, what)
    elif is_dataclass(value):
        for each in fields(value):
            yield from list_dates(getattr(value, each.name), what or f"times of {type(value).__name__}")


def from_epoch(numbers: ArrayLike, unit: str = "s") -> Dates:
    """Return numbers that count from the beginning of 1970 (UTC) as dates.

    Numbers are never taken for dates by their size; with this function you say what they are.

    Parameters
    ----------
    numbers : array_like
        Seconds, milliseconds, ... since 1970-01-01T00:00Z, as clocks count them, without leap seconds.
    unit : {"s", "ms", "us", "ns", "min", "h", "d"}, optional

    Returns
    -------
    Dates
        For the `times` of `Measurements`, `ReferenceSignal.from_samples` and `Input`, and for all times of an
        `Experiment`; rounded to the microsecond.

    Raises
    ------
    ValueError
        For an unknown unit, and for numbers that are not finite or lie beyond the years 1 to 9999.
    TypeError
        If they are not numbers.

    See Also
    --------
    Experiment, Measurements, read_log

    Examples
    --------
    >>> stamps = sf.from_epoch([1585000800000, 1585004400000, 1585008000000], "ms")
    >>> stamps
    3 dates from 2020-03-23T22:00:00+00:00 to 2020-03-24T00:00:00+00:00
    >>> log = sf.Measurements(stamps, [0.9, 1.8, 1.2], sigma=0.1)
    >>> run = sf.Experiment(log, ("on", "off"), ("2020-03-23T23:30Z",), time_unit="h")
    >>> run.initial_times
    array([1.5])
    """
    key = TIME_UNITS.get(as_name(unit, "unit"), "")
    if not key:
        raise ValueError(f"unit must be one of {', '.join(SECONDS_OF_UNIT)}; got {shorten(unit)}.")
    micros = as_array(numbers, "numbers since 1970") * (1e6 * SECONDS_OF_UNIT[key])
    first, last = (day.astype("datetime64[us]").astype(np.int64) for day in (FIRST_DAY, LAST_DAY))
    if not ((micros >= first) & (micros <= last)).all():
        raise ValueError(f"numbers since 1970 in {key} must lie in the years 1 to 9999; got {shorten(numbers)}.")
    return Dates(np.rint(micros).astype(np.int64).astype("datetime64[us]"), "UTC")
