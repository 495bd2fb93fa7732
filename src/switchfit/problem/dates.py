"""Dates at the way in: what is given as dates becomes numbers of a time unit since an origin.

Everything inside the library computes with float64 numbers. Dates are read here (`read_dates`), kept to the microsecond
until the experiment knows its origin and its unit, and then converted (`Origin.to_numbers`): the difference to the
origin is exact before it is rounded once to float64, so that no digits go to the years since 1970. `Origin.to_dates` is
the way back, for reports, figures and files.

A date has a time zone or has none. One without is the reading of some wall clock: it cannot be compared with one that
has a zone until the experiment's `time_zone` says where the clock hung.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from functools import cached_property, lru_cache
from typing import Any, NoReturn
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.problem.validation import FloatArray, as_array, as_name, is_of_library, shorten

Instants = NDArray[np.datetime64]
"""In microseconds: in UTC, or on the wall clock of dates without a zone."""

EXAMPLES = "2024-05-01, 2024-05-01T12:34:56 or 2024-05-01T12:34:56+02:00"
FIRST, LAST = np.datetime64("0001-01-01"), np.datetime64("9999-12-31")
"""The days that a `datetime` may have."""

SECONDS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
"""Length of a unit of time in seconds."""

LENGTHS: dict[str, np.timedelta64] = {
    unit: np.timedelta64(1, "ns") if unit == "ns" else np.timedelta64(round(1e6 * seconds), "us")
    for unit, seconds in SECONDS.items()
}
"""The same, by which a difference of dates is divided."""

_SPELLINGS = {
    "ns": ("ns", "nsec", "nsecs", "nanosecond", "nanoseconds"),
    "us": ("us", "µs", "μs", "usec", "usecs", "micros", "microsecond", "microseconds"),
    "ms": ("ms", "msec", "msecs", "millis", "millisecond", "milliseconds"),
    "s": ("s", "sec", "secs", "second", "seconds"),
    "min": ("min", "mins", "minute", "minutes"),
    "h": ("h", "hr", "hrs", "hour", "hours"),
    "d": ("d", "day", "days"),
}
TIME_UNITS = {spelling: unit for unit, spellings in _SPELLINGS.items() for spelling in spellings}
"""The key of `SECONDS` that a word stands for."""

_DATE_TYPES = (str, datetime.date, np.datetime64)  # a datetime and a Timestamp of pandas are dates too


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


def _name_tzinfo(tz: Any) -> str:
    """Return the name of a zone in the IANA database, "" if it has none there."""
    name = getattr(tz, "key", None) or getattr(tz, "zone", None) or str(tz)
    try:
        find_zone(str(name))
    except ValueError:
        return ""
    return str(name)


def _read_date(value: Any, what: str, place: str = "") -> tuple[Any, str]:
    """Return the instant and the zone of one date; `place` says where it stands among several."""
    if isinstance(value, str):
        found = read_date_text(value)
        if found is None:
            wanted = "numbers or dates" if place else "a number or a date"
            raise ValueError(f"{what} must be {wanted}; got {shorten(value)}{place}. Write dates as {EXAMPLES}.")
        return found
    if value is None or str(value) in ("NaT", "<NA>", "nan"):
        _refuse_missing(what, place)
    if isinstance(value, np.datetime64):
        return _as_instants(np.asarray(value), what)[()], ""
    if isinstance(value, datetime.datetime):
        return _split(value)
    if isinstance(value, datetime.date):
        return np.datetime64(value, "us"), ""
    raise TypeError(f"{what} must be numbers or dates, not both; got {shorten(value)}{place} among dates.")


def _as_instants(array: NDArray[Any], what: str) -> Instants:
    """Return datetime64 in microseconds, checked: NumPy would let them overflow."""
    missing = np.isnat(array)
    if missing.any():
        _refuse_missing(what, f" at index {np.argmax(missing)}")
    days = array.astype("datetime64[D]")
    if not ((days >= FIRST) & (days <= LAST)).all():
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

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
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


def format_instant(instant: Any, zone: str) -> str:
    """Return a date of `Dates.instants` in ISO 8601, in a zone or without one."""
    date: datetime.datetime = instant.item()
    if zone:
        date = date.replace(tzinfo=datetime.UTC).astimezone(find_zone(zone))
    return date.isoformat()


def read_dates(value: Any, what: str) -> Dates | None:
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
        instant, zone = _read_date(value, what)
        return Dates(np.array(instant), zone)
    dtype = getattr(value, "dtype", None)
    tz = getattr(dtype, "tz", None) or getattr(dtype, "time_zone", None)  # of pandas, of polars
    if tz or is_of_library(value, "polars"):
        value = np.asarray(value, dtype="datetime64[us]" if tz else None)  # in UTC if it has a zone
    kind = getattr(getattr(value, "dtype", None), "kind", "")
    if kind == "M":
        zone = tz if isinstance(tz, str) else _name_tzinfo(tz) or "UTC" if tz else ""
        return Dates(_as_instants(np.asarray(value), what), zone)
    is_list = isinstance(value, (list, tuple)) or (kind == "O" and getattr(value, "ndim", 1) == 1)
    if kind == "U" or (is_list and any(issubclass(each, _DATE_TYPES) for each in set(map(type, value)))):
        return _read_entries(list(value), what)
    return None


def _read_entries(entries: list[Any], what: str) -> Dates:
    """Return entries, each a date or text, as dates."""
    pairs = [_read_date(entry, what, f" at index {index}") for index, entry in enumerate(entries)]
    zones = {zone for _, zone in pairs}
    if "" in zones and len(zones) > 1:
        raise ValueError(f"{what} must all have a time zone, or none; got {shorten(entries)}.")
    zone = zones.pop() if len(zones) == 1 else "UTC"
    return Dates(np.array([instant for instant, _ in pairs], dtype="datetime64[us]"), zone)


def read_date(value: Any, what: str) -> Any:
    """Return a single date as `Dates`, ValueError for several; anything else as it is."""
    date = read_dates(value, what)
    if date is not None and date.instants.shape != ():
        raise ValueError(f"{what} must be one date; got {date!r}.")
    return value if date is None else date


def as_date(value: Any, what: str) -> Dates:
    """Return a single date; TypeError for anything else."""
    date = read_date(value, what)
    if not isinstance(date, Dates):
        raise TypeError(f"{what} must be a date, such as '2024-05-01T12:00+02:00'; got {shorten(value)}.")
    return date


Given = tuple[str, Dates]
"""Dates among the arguments of an experiment, and what messages call them."""


def list_dates(value: Any, what: str = "") -> Iterator[Given]:
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
    >>> import switchfit as sf
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
        raise ValueError(f"unit must be one of {', '.join(SECONDS)}; got {shorten(unit)}.")
    micros = as_array(numbers, "numbers since 1970") * (1e6 * SECONDS[key])
    first, last = (day.astype("datetime64[us]").astype(np.int64) for day in (FIRST, LAST))
    if not ((micros >= first) & (micros <= last)).all():
        raise ValueError(f"numbers since 1970 in {key} must lie in the years 1 to 9999; got {shorten(numbers)}.")
    return Dates(np.rint(micros).astype(np.int64).astype("datetime64[us]"), "UTC")


# --- the origin of an experiment --------------------------------------------------------------------------------------


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
    def instant(self) -> Any:
        """The date in microseconds: in UTC, or on the wall clock if it has no zone."""
        return _read_date(self.date, "origin")[0]

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
        return np.asarray((instants - self.instant) / LENGTHS[normalize_time_unit(time_unit)])

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
        length = 1e6 * SECONDS[normalize_time_unit(time_unit)]
        try:
            moment: datetime.datetime = self.instant.item() + datetime.timedelta(microseconds=round(time * length))
            return moment if self.zone is None else moment.replace(tzinfo=datetime.UTC).astimezone(self.zone)
        except (OverflowError, ValueError):
            return None


def choose_origin(given: Sequence[Given], data: Sequence[Given], origin: Any, time_zone: Any, t0: Any) -> Origin:
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
    zones = {dates.time_zone for _, dates in zoned}
    zone = asked if asked is not None else "" if bare else zones.pop() if len(zones) == 1 else "UTC"
    start = t0 if start is None and isinstance(t0, Dates) else start
    candidates = data if start is None else [("origin", start)]
    if not candidates:
        raise ValueError(
            f"{given[0][0]} is a date, but not all times of the data are: give origin, the date of time 0."
        )
    located = [dates.localize(zone, what) for what, dates in candidates]
    return make_origin(min(each.instants.min() for each in located), zone)


def make_origin(instant: Any, zone: str) -> Origin:
    """Return the origin at a date of `Dates.instants`."""
    return Origin(format_instant(instant, zone), zone)


def normalize_time_unit(unit: str) -> str:
    """Return the key of `SECONDS` that a unit of times that are dates stands for.

    Raises
    ------
    ValueError
        For any other unit.
    """
    if unit.lower() in TIME_UNITS:
        return TIME_UNITS[unit.lower()]
    raise ValueError(f"time_unit must be one of {', '.join(SECONDS)} where times are dates; got {shorten(unit)}.")
