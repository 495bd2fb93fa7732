"""Dates and times of day in the cells of a log, as seconds."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta

import numpy as np

from switchfit.io.logs.header import is_missing
from switchfit.io.logs.log import FloatArray
from switchfit.runtime.errors import InputError

_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_DATE = re.compile(r"\d{4}[-/]\d{1,2}[-/]\d{1,2}.*|\d{1,2}[./]\d{1,2}[./]\d{4}.*|\d{8}T.*")
_CLOCK = re.compile(r"(\d{1,2}):(\d{2})(?::(\d{2}(?:[.,]\d+)?))?")
_GERMAN = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4})(.*)")
_YEAR_FIRST = re.compile(r"(\d{4})[-/](\d{1,2})[-/](\d{1,2})(.*)")


def is_date(cell: str) -> bool:
    """Return whether a cell is a date or a time of day."""
    return bool(_DATE.fullmatch(cell) or _CLOCK.fullmatch(cell))


def parse_dates(cells: Sequence[str], places: Sequence[str]) -> tuple[FloatArray, float]:
    """Return the seconds since the first date, NaN where one is missing, and the first one in seconds since 1970.

    Parameters
    ----------
    cells : sequence of str
        ISO 8601, or day.month.year; without a zone they are taken for UTC.
    places : sequence of str
        Where each stands, for messages.

    Raises
    ------
    InputError
        If a cell is something else.
    """
    micros = [
        None if is_missing(cell) else _count_micros(cell, place) for cell, place in zip(cells, places, strict=True)
    ]
    first = next(entry for entry in micros if entry is not None)
    return np.array([np.nan if entry is None else (entry - first) * 1e-6 for entry in micros]), first * 1e-6


def parse_clock(cells: Sequence[str], places: Sequence[str]) -> FloatArray:
    """Return the seconds since midnight of times of day."""
    seconds = np.full(len(cells), np.nan)
    for k, cell in enumerate(cells):
        match = _CLOCK.fullmatch(cell)
        if match:
            seconds[k] = 3600 * int(match[1]) + 60 * int(match[2]) + float((match[3] or "0").replace(",", "."))
        elif not is_missing(cell):
            raise InputError(f"{places[k]}: {cell!r} is not a time of day such as 12:34:56.789, as the others are.")
    return seconds


def _count_micros(cell: str, place: str) -> int:
    """Return the microseconds since 1970 of a date."""
    text = cell.strip()
    if match := _GERMAN.fullmatch(text):
        text = f"{match[3]}-{int(match[2]):02d}-{int(match[1]):02d}{match[4]}"
    elif match := _YEAR_FIRST.fullmatch(text):
        text = f"{match[1]}-{int(match[2]):02d}-{int(match[3]):02d}{match[4]}"
    try:
        date = datetime.fromisoformat(text.replace(",", ".").replace(" UTC", "Z"))
    except ValueError:
        raise InputError(
            f"{place}: {cell!r} is not a date that can be read; write dates as 2024-05-01T12:34:56.789, or times as "
            "numbers."
        ) from None
    return ((date if date.tzinfo else date.replace(tzinfo=UTC)) - _EPOCH) // timedelta(microseconds=1)
