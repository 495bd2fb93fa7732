"""Units of time: their spellings, and their lengths as numbers and as differences of dates."""

from __future__ import annotations

import numpy as np

from switchfit.problem.validation.messages import shorten

SECONDS_OF_UNIT = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
"""Length of a unit of time in seconds."""

TIMEDELTA_OF_UNIT: dict[str, np.timedelta64] = {
    unit: np.timedelta64(1, "ns") if unit == "ns" else np.timedelta64(round(1e6 * seconds), "us")
    for unit, seconds in SECONDS_OF_UNIT.items()
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
"""The key of `SECONDS_OF_UNIT` that a word stands for."""


def normalize_time_unit(unit: str) -> str:
    """Return the key of `SECONDS_OF_UNIT` that a unit of times that are dates stands for.

    Raises
    ------
    ValueError
        For any other unit.
    """
    if unit.lower() in TIME_UNITS:
        return TIME_UNITS[unit.lower()]
    raise ValueError(
        f"time_unit must be one of {', '.join(SECONDS_OF_UNIT)} where times are dates; got {shorten(unit)}."
    )
