"""Dates at the way in: what is given as dates becomes numbers of a time unit since an origin.

Everything inside the library computes with float64 numbers. Dates are read here (`as_dates`), kept as integers of
nanoseconds until the experiment knows its origin and its unit, and then converted (`Origin.to_numbers`):
the difference to the origin is exact before it is rounded once to float64, so that no digits go to the years since
1970. `Origin.to_dates` is the way back, for reports, figures and files.

A date has a time zone or has none. One without is the reading of some wall clock: it cannot be compared with one that
has a zone until the experiment's `time_zone` says where the clock hung.

Dates as instants: integers of nanoseconds since the beginning of 1970, and the name of a time zone.

A date without a zone is the reading of some wall clock, and its zone is "".
"""

from __future__ import annotations

import datetime
import re
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields, is_dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple, NoReturn
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.problem.validation import as_array, as_name, is_of_library, shorten

EXAMPLES = "2024-05-01, 2024-05-01T12:34:56 or 2024-05-01T12:34:56+02:00"
FIRST, LAST = "1678-01-01", "2262-01-01"
"""Between which dates nanoseconds since 1970 fit into 64 bits."""
LONGEST = 9.2e9
"""Largest distance from 1970 in seconds."""
EPOCH = datetime.datetime(1970, 1, 1)
_NANOSECONDS = re.compile(r"[.,]\d{6}(\d{1,3})")


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


def read_date_text(text: str) -> tuple[int, str] | None:
    """Return nanoseconds since 1970 and the zone, "" without, of a date in ISO 8601; None if it is none."""
    finer = _NANOSECONDS.search(text)
    try:
        date = datetime.datetime.fromisoformat(text.strip())  # to the microsecond
    except ValueError:
        return None
    return _count(date) + (int(finer[1].ljust(3, "0")) if finer else 0), _name_zone(date)


def format_instant(instant: int, zone: str) -> str:
    """Return an instant in nanoseconds since 1970 in ISO 8601, in a zone or without one."""
    micros, finer = divmod(instant, 1000)
    date = EPOCH + datetime.timedelta(microseconds=micros)
    if zone:
        date = date.replace(tzinfo=datetime.UTC).astimezone(find_zone(zone))
    if not finer:
        return date.isoformat()
    text = date.isoformat(timespec="microseconds")
    return f"{text[:26]}{finer:03d}{text[26:]}"


def read_date(value: Any, what: str, index: int | None = None) -> tuple[int, str]:
    """Return nanoseconds since 1970 and the zone of one date."""
    place = "" if index is None else f" at index {index}"
    if isinstance(value, str):
        found = read_date_text(value)
        if found is None:
            raise ValueError(
                f"{what} must be {'a number or a date' if index is None else 'numbers or dates'}; got "
                f"{shorten(value)}{place}. Write dates as {EXAMPLES}."
            )
    elif isinstance(value, np.datetime64):
        found = int(count_nanoseconds(np.asarray(value), what)), ""
    elif isinstance(value, datetime.datetime) and value == value:  # NaT of pandas differs from itself
        found = _count(value) + int(getattr(value, "nanosecond", 0)), _name_zone(value)
    elif isinstance(value, datetime.date) and value == value:
        found = _count(datetime.datetime.combine(value, datetime.time())), ""
    elif value is None or value != value:
        _refuse_missing(what, index or 0)
    else:
        raise TypeError(f"{what} must be numbers or dates, not both; got {shorten(value)}{place} among dates.")
    if abs(found[0]) > LONGEST * 1e9:
        raise ValueError(f"{what} must lie between {FIRST} and {LAST}; got {shorten(value)}{place}.")
    return found


def _count(date: datetime.datetime) -> int:
    """Return nanoseconds since 1970, of the wall clock if the date has no zone."""
    wall = datetime.datetime(*date.timetuple()[:6], date.microsecond)  # a Timestamp's nanoseconds are left out
    since = wall - EPOCH - (date.utcoffset() or datetime.timedelta(0))
    return 1000 * (since // datetime.timedelta(microseconds=1))


def _name_zone(date: datetime.datetime) -> str:
    """Return the name of a date's zone: that of the IANA database if it has one, else its offset; "" without."""
    offset = date.utcoffset()
    if offset is None:
        return ""
    is_fixed = type(date.tzinfo) is datetime.timezone
    # A zone is written as "UTC+02:00", or as "UTC".
    return (not is_fixed and _name_tzinfo(date.tzinfo)) or str(datetime.timezone(offset))[3:] or "UTC"


def _name_tzinfo(tz: Any) -> str:
    """Return the name of a zone in the IANA database, "" if it has none there."""
    name = getattr(tz, "key", None) or getattr(tz, "zone", None) or str(tz)
    try:
        find_zone(str(name))
    except ValueError:
        return ""
    return str(name)


def _read_column(value: Any, what: str) -> Dates | None:
    """Return an array or a column of datetime64 as dates; None for text and objects."""
    dtype = getattr(value, "dtype", None)
    tz = getattr(dtype, "tz", None) or getattr(dtype, "time_zone", None)  # of pandas, of polars
    if is_of_library(value, "polars") and str(dtype).startswith("Date"):
        value = (value.dt.convert_time_zone("UTC") if tz else value).to_numpy()
    if getattr(getattr(value, "dtype", None), "kind", "") != "M":
        return None
    array = np.asarray(value, dtype="datetime64[ns]" if tz else None)  # in UTC if it has a zone
    zone = tz if isinstance(tz, str) else _name_tzinfo(tz) or "UTC" if tz else ""
    return Dates(count_nanoseconds(array, what), zone)


def count_nanoseconds(array: NDArray[Any], what: str) -> NDArray[np.int64]:
    """Return datetime64 as nanoseconds since 1970, checked: NumPy would let them overflow."""
    missing = np.isnat(array)
    if missing.any():
        _refuse_missing(what, int(np.argmax(missing)))
    if not (np.abs(array.astype("datetime64[s]").astype(np.int64)) <= LONGEST).all():
        raise ValueError(f"{what} must lie between {FIRST} and {LAST}; got {shorten(array.astype(str))}.")
    return array.astype("datetime64[ns]").astype(np.int64)


def _refuse_missing(what: str, index: int) -> NoReturn:
    raise ValueError(f"{what} must not be missing; the date at index {index} is. Leave such samples out.")


def find_offset(minute: int, tz: datetime.tzinfo, zone: str, what: str) -> int:
    """Return the offset of a zone from UTC in nanoseconds at a minute of its wall clock."""
    wall = EPOCH + datetime.timedelta(minutes=minute)
    before, after = (wall.replace(tzinfo=tz, fold=fold).utcoffset() or datetime.timedelta(0) for fold in (0, 1))
    if before != after:
        why = "is skipped as clocks are set forward" if before < after else "occurs twice as clocks are set back"
        raise ValueError(
            f"{what}: {wall.isoformat(' ', 'minutes')} {why} in {zone}. Write these dates with their offset from UTC, "
            "such as 2020-10-25T02:30+01:00, or in UTC."
        )
    return before // datetime.timedelta(microseconds=1) * 1000


FloatArray = NDArray[np.float64]

SECONDS = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
"""Length of a unit of time in seconds."""

NANOSECONDS = {unit: round(seconds * 1e9) for unit, seconds in SECONDS.items()}

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

FAR = 2**63 - 1
"""Largest difference of two dates, in nanoseconds, that 64 bits hold: 292 years."""

_DATE_TYPES = (str, datetime.date, np.datetime64)  # a datetime and a Timestamp of pandas are dates too


# --- dates as they were given -----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Dates:
    """Dates as they were given, until an experiment turns them into numbers.

    Attributes
    ----------
    instants : int64 array, () or (K,)
        Nanoseconds since the beginning of 1970: in UTC, or on the wall clock of dates without a zone.
    time_zone : str
        Such as "Europe/Berlin", "UTC" or "+02:00"; "" for dates without a zone.
    """

    instants: NDArray[np.int64]
    time_zone: str = ""

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array, () for a single date."""
        return self.instants.shape

    def __len__(self) -> int:
        return len(self.instants)

    def __getitem__(self, index: Any) -> Dates:
        return Dates(np.asarray(self.instants[index]), self.time_zone)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """Return a datetime64 array, in UTC if the dates have a zone."""
        array = self.instants.astype("datetime64[ns]")
        return array if dtype is None else array.astype(dtype)

    def __repr__(self) -> str:
        if self.shape == ():
            return format_instant(int(self.instants), self.time_zone)
        if len(self) == 0:
            return "no dates"
        return f"{len(self)} dates from {self[0]!r} to {self[-1]!r}"

    def localize(self, zone: str, what: str) -> Dates:
        """Return dates without a zone as those of a zone; others as they are.

        Parameters
        ----------
        zone : str
        what : str
            Name of the argument, for messages.

        Raises
        ------
        ValueError
            For a time that clocks in this zone skip, or show twice.
        """
        if self.time_zone:
            return self
        tz = find_zone(zone)
        minutes, places = np.unique(self.instants.ravel() // NANOSECONDS["min"], return_inverse=True)
        offsets = np.array([find_offset(int(minute), tz, zone, what) for minute in minutes], dtype=np.int64)
        return Dates(self.instants - offsets[places].reshape(self.shape), zone)


def is_dated(value: Any) -> bool:
    """Return whether a value is to be read as dates: dates, text, and arrays, tables' columns and lists of these."""
    if type(value) is float:  # as are most times
        return False
    if isinstance(value, (Dates, *_DATE_TYPES)):
        return True
    dtype = getattr(value, "dtype", None)
    kind = getattr(dtype, "kind", "")
    if kind in ("f", "i"):
        return False
    if isinstance(value, (list, tuple)) or (kind == "O" and getattr(value, "ndim", 1) == 1):
        return any(issubclass(each, _DATE_TYPES) for each in set(map(type, value)))
    return kind in ("M", "U") or (is_of_library(value, "polars") and str(dtype).startswith(("Date", "String")))


def as_dates(value: Any, what: str) -> Dates:
    """Return what `is_dated` is true of as dates.

    Parameters
    ----------
    value : date, text in ISO 8601, or an array, a column or a list of these
    what : str
        Name of the argument, for messages.

    Raises
    ------
    ValueError
        For text that is no date, missing dates, dates with a zone among dates without, and dates before 1678 or after
        2261.
    TypeError
        For something that is no date among dates.
    """
    if isinstance(value, Dates):
        return value
    if isinstance(value, _DATE_TYPES):
        instant, zone = read_date(value, what)
        return Dates(np.array(instant, dtype=np.int64), zone)
    column = _read_column(value, what)
    if column is not None:
        return column
    entries = value.to_list() if is_of_library(value, "polars") else list(value)
    pairs = [read_date(entry, what, index) for index, entry in enumerate(entries)]
    zones = {zone for _, zone in pairs}
    if "" in zones and len(zones) > 1:
        bare, zoned = (next(e for e, (_, z) in zip(entries, pairs, strict=True) if bool(z) is k) for k in (False, True))
        raise ValueError(
            f"{what} has dates with a time zone and dates without one: {shorten(zoned)} and {shorten(bare)}. Write the "
            "zone into all of them, or into none."
        )
    zone = zones.pop() if len(zones) == 1 else "UTC"
    return Dates(np.array([instant for instant, _ in pairs], dtype=np.int64), zone)


def as_date(value: Any, what: str) -> Dates:
    """Return a single date, as `as_dates` reads it; ValueError for several."""
    date = as_dates(value, what)
    if date.shape != ():
        raise ValueError(f"{what} must be one date; got {date!r}.")
    return date


def list_dates(value: Any) -> Iterator[Dates]:
    """Yield all dates in a value: in the fields of dataclasses, in lists and in tuples."""
    if isinstance(value, Dates):
        yield value
    elif isinstance(value, (list, tuple)):
        for entry in value:
            yield from list_dates(entry)
    elif is_dataclass(value):
        for each in fields(value):
            yield from list_dates(getattr(value, each.name))


def has_dates(value: Any) -> bool:
    """Return whether there are dates in a value, where `list_dates` looks."""
    return next(list_dates(value), None) is not None


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
        `Experiment`; rounded to the nanosecond.

    Raises
    ------
    ValueError
        For an unknown unit, and for numbers that are not finite or lie before 1678 or after 2261.
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
    array = as_array(numbers, "numbers since 1970")
    if not (np.abs(array) * SECONDS[key] <= LONGEST).all():
        raise ValueError(
            f"numbers since 1970 in {key} must be finite, and lie between {FIRST} and {LAST}; got {shorten(numbers)}."
        )
    given = np.asarray(numbers)
    if given.dtype.kind in "iu":  # doubles would round nanoseconds
        return Dates(given.astype(np.int64) * NANOSECONDS[key], "UTC")
    whole = np.floor(array)  # times a length it would be beyond 2**53, where doubles are no longer exact
    finer = np.rint((array - whole) * NANOSECONDS[key]).astype(np.int64)
    return Dates(whole.astype(np.int64) * NANOSECONDS[key] + finer, "UTC")


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
    def instant(self) -> int:
        """Nanoseconds since 1970."""
        return read_date(self.date, "origin")[0]

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
            raise ValueError(
                f"{what}: {dates!r} has a time zone, but the dates of the experiment have none. Leave it out, or give "
                "the experiment a time_zone."
            )
        dates = dates.localize(self.time_zone, what) if self.time_zone else dates
        return count_from_instant(dates.instants, self.instant, NANOSECONDS[normalize_time_unit(time_unit)])

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
        length = NANOSECONDS[normalize_time_unit(time_unit)] / 1000
        start, finer = divmod(self.instant, 1000)
        try:
            moment = EPOCH + datetime.timedelta(microseconds=start + round(finer / 1000 + time * length))
            return moment if self.zone is None else moment.replace(tzinfo=datetime.UTC).astimezone(self.zone)
        except (OverflowError, ValueError):
            return None


def count_from_instant(instants: NDArray[np.int64], first: int, length: int) -> FloatArray:
    """Return by how many times a length instants are after a first one, of the same shape; all in nanoseconds.

    Parameters
    ----------
    instants : int64 array
    first, length : int
    """
    ends = (int(instants.min()), int(instants.max())) if instants.size else (first, first)
    if max(abs(end - first) for end in ends) > FAR:
        instants = instants.astype(object)  # integers of Python do not overflow
    return np.asarray((instants - first) / length, dtype=np.float64)


class Given(NamedTuple):
    """Dates among the arguments of an experiment: what messages call them, and whether they belong to its data."""

    what: str
    dates: Dates
    are_data: bool = False


def choose_origin(given: Sequence[Given], origin: Any, time_zone: Any, t0: Any, *, numbers: str) -> Origin:
    """Return the origin of an experiment: as given, else t0 if that is a date, else the earliest date of the data.

    Parameters
    ----------
    given : sequence of Given
        All dates of the experiment but the origin.
    origin : date, Origin or None
    time_zone : str or None
        Of dates without a zone, and in which all are shown.
    t0 : Dates, or anything else
    numbers : str
        What of the data has numbers for times, "" if nothing has.

    Raises
    ------
    ValueError
        For dates with a zone beside dates without and no `time_zone`, an unknown zone, and numbers whose origin is not
        stated.
    TypeError
        For an origin that is no date, and a `time_zone` that is no string.
    """
    start = _read_origin(origin)
    form = "the name of a time zone, such as 'Europe/Berlin', or an offset such as '+02:00'"
    asked = None if time_zone is None else as_name(time_zone, "time_zone", form)
    if asked is not None:
        find_zone(asked)
    every = [*given, *([] if start is None else [Given("origin", start)])]
    if not every:
        raise ValueError(f"time_zone is {asked!r}, but no time is a date: give origin, the date at which times are 0.")
    bare, zoned = ([one for one in every if bool(one.dates.time_zone) is has] for has in (False, True))
    if asked is None and bare and zoned:
        raise ValueError(
            f"{zoned[0].what} has a time zone ({zoned[0].dates!r}), but {bare[0].what} has none ({bare[0].dates!r}). "
            "Say where those were read, such as time_zone='Europe/Berlin', or write the zone into all dates."
        )
    zones = {one.dates.time_zone for one in zoned}
    zone = asked if asked is not None else "" if bare else zones.pop() if len(zones) == 1 else "UTC"
    start = t0 if start is None and isinstance(t0, Dates) else start
    candidates = [one for one in given if one.are_data] if start is None else [Given("origin", start)]
    if start is None and (numbers or not candidates):
        raise ValueError(
            f"{given[0].what} is a date, but {numbers or 'nothing among the data'} has "
            f"{'numbers for times' if numbers else 'dates'}: give origin, the date at which times are 0."
        )
    dates = [one.dates.localize(zone, one.what) if zone else one.dates for one in candidates]
    return make_origin(min(int(each.instants.min()) for each in dates), zone)


def _read_origin(origin: Any) -> Dates | None:
    """Return the date of an origin that is given."""
    date = origin.date if isinstance(origin, Origin) else origin
    if date is not None and not is_dated(date):
        raise TypeError(f"origin must be a date, such as '2024-05-01T12:00+02:00'; got {shorten(origin)}.")
    return None if date is None else as_date(date, "origin")


def make_origin(instant: int, zone: str) -> Origin:
    """Return the origin at an instant in nanoseconds since 1970."""
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
