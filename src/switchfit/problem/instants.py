"""Dates as instants: integers of nanoseconds since the beginning of 1970, and the name of a time zone.

A date without a zone is the reading of some wall clock, and its zone is "".
"""

from __future__ import annotations

import datetime
import re
from functools import lru_cache
from typing import Any, NoReturn
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from switchfit.problem.tables import is_of_library
from switchfit.problem.validation import shorten

EXAMPLES = "2024-05-01, 2024-05-01T12:34:56 or 2024-05-01T12:34:56+02:00"
FIRST, LAST = "1678-01-01", "2262-01-01"
"""Between which dates nanoseconds since 1970 fit into 64 bits."""
LONGEST = 9.2e9
"""Largest distance from 1970 in seconds."""
EPOCH = datetime.datetime(1970, 1, 1)
_FRACTION = re.compile(r"([.,]\d{6})(\d{1,3})\d*")
_OFFSET = re.compile(r"([+-])(\d{2}):(\d{2})(?::(\d{2}))?")


@lru_cache(maxsize=64)
def find_zone(name: str) -> datetime.tzinfo:
    """Return the time zone of a name of the IANA database, such as "Europe/Berlin", or of an offset such as "+02:00".

    Raises
    ------
    ValueError
        If there is none.
    """
    if name in ("UTC", "Z"):
        return datetime.UTC
    if match := _OFFSET.fullmatch(name):
        seconds = 3600 * int(match[2]) + 60 * int(match[3]) + int(match[4] or 0)
        if seconds < 86400:
            return datetime.timezone(datetime.timedelta(seconds=-seconds if match[1] == "-" else seconds))
    try:
        return ZoneInfo(name)
    except Exception:  # ZoneInfoNotFoundError, ValueError or OSError, by the name
        raise ValueError(
            f"time_zone {shorten(name)} is not known; give a name such as 'Europe/Berlin', 'UTC', or an offset such as "
            "'+02:00'. (If none is known on this system: pip install tzdata.)"
        ) from None


def read_text(text: str) -> tuple[int, str] | None:
    """Return nanoseconds since 1970 and the zone, "" without, of a date in ISO 8601; None if it is none."""
    match = _FRACTION.search(text)
    finer = int(match[2].ljust(3, "0")) if match else 0
    try:
        date = datetime.datetime.fromisoformat(_FRACTION.sub(r"\1", text.strip()))
    except ValueError:
        return None
    return _count(date) + finer, _name_zone(date)


def is_iso_date(text: str) -> bool:
    """Return whether a text is a date in ISO 8601."""
    return read_text(text) is not None


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
        found = read_text(value)
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
        found = _count(datetime.datetime(value.year, value.month, value.day)), ""
    elif value is None or value != value:
        _refuse_missing(what, index or 0)
    else:
        raise TypeError(f"{what} must be numbers or dates, not both; got {shorten(value)}{place} among dates.")
    if abs(found[0]) > LONGEST * 1e9:
        raise ValueError(f"{what} must lie between {FIRST} and {LAST}; got {shorten(value)}{place}.")
    return found


def _count(date: datetime.datetime) -> int:
    """Return nanoseconds since 1970, of the wall clock if the date has no zone."""
    offset = date.utcoffset()
    wall = date.replace(tzinfo=None, fold=0)
    if type(wall) is not datetime.datetime:  # a Timestamp, which counts its nanoseconds itself
        wall = datetime.datetime(*wall.timetuple()[:6], wall.microsecond)
    micros = (wall - (offset or datetime.timedelta(0)) - EPOCH) // datetime.timedelta(microseconds=1)
    return 1000 * micros


def _name_zone(date: datetime.datetime) -> str:
    """Return the name of a date's zone: that of the IANA database if it has one, else its offset; "" without."""
    if date.tzinfo is None or date.utcoffset() is None:
        return ""
    name = _name_tzinfo(date.tzinfo)
    if name:
        return name
    offset = date.utcoffset() or datetime.timedelta(0)
    if not offset:
        return "UTC"
    seconds = abs(int(offset.total_seconds()))
    text = f"{'-' if offset < datetime.timedelta(0) else '+'}{seconds // 3600:02d}:{seconds // 60 % 60:02d}"
    return f"{text}:{seconds % 60:02d}" if seconds % 60 else text


def _name_tzinfo(tz: Any) -> str:
    """Return the name of a zone in the IANA database, "" if it has none there."""
    name = getattr(tz, "key", None) or getattr(tz, "zone", None) or str(tz)
    try:
        find_zone(str(name))
    except ValueError:
        return ""
    return str(name)


def as_datetime64(value: Any) -> NDArray[Any] | None:
    """Return an array or a column of dates as datetime64, in UTC if it has a zone; None for text and objects."""
    if is_of_library(value, "pandas"):
        return np.asarray(value, dtype="datetime64[ns]") if getattr(value.dtype, "kind", "") == "M" else None
    if is_of_library(value, "polars"):
        if not str(value.dtype).startswith("Date"):
            return None
        bare = value.dt.convert_time_zone("UTC") if getattr(value.dtype, "time_zone", None) else value
        return np.asarray(bare.to_numpy())
    array = np.asarray(value) if hasattr(value, "__array__") else None
    return array if array is not None and array.dtype.kind == "M" else None


def find_zone_of_column(value: Any) -> str:
    """Return the zone of a column of pandas or polars, "" if it has none."""
    dtype = getattr(value, "dtype", None)
    tz = getattr(dtype, "tz", None) or getattr(dtype, "time_zone", None)
    if tz is None:
        return ""
    if isinstance(tz, str):
        return tz
    return _name_tzinfo(tz) or "UTC"


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
