"""Dates and times of day in the cells of a log, as seconds."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from switchfit.io.logs.header import is_missing
from switchfit.io.logs.log import FloatArray
from switchfit.problem.instants import read_text
from switchfit.runtime.errors import InputError

_DATE = re.compile(r"\d{4}[-/]\d{1,2}[-/]\d{1,2}.*|\d{1,2}[./]\d{1,2}[./]\d{4}.*|\d{8}T.*")
_CLOCK = re.compile(r"(\d{1,2}):(\d{2})(?::(\d{2}(?:[.,]\d+)?))?")
_GERMAN = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4})(.*)")
_YEAR_FIRST = re.compile(r"(\d{4})[-/](\d{1,2})[-/](\d{1,2})(.*)")


def is_date(cell: str) -> bool:
    """Return whether a cell is a date or a time of day."""
    return bool(_DATE.fullmatch(cell) or _CLOCK.fullmatch(cell))


def parse_dates(cells: Sequence[str], places: Sequence[str]) -> tuple[FloatArray, float, str]:
    """Return the seconds since the first date, NaN where one is missing, the first one in seconds since 1970, and the
    zone: "" if none states one, "UTC" if they state several.

    Parameters
    ----------
    cells : sequence of str
        ISO 8601, or day.month.year; without a zone they are counted as if they were UTC.
    places : sequence of str
        Where each stands, for messages.

    Raises
    ------
    InputError
        If a cell is something else.
    """
    found = [None if is_missing(cell) else _read_date(cell, place) for cell, place in zip(cells, places, strict=True)]
    zones = {entry[1] for entry in found if entry is not None}
    first = next(entry[0] for entry in found if entry is not None)
    seconds = np.array([np.nan if entry is None else (entry[0] - first) // 1000 * 1e-6 for entry in found])
    return seconds, first // 1000 * 1e-6, zones.pop() if len(zones) == 1 else "UTC"


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


def _read_date(cell: str, place: str) -> tuple[int, str]:
    """Return the nanoseconds since 1970 of a date, and its zone, "" if it states none."""
    text = cell.strip()
    if match := _GERMAN.fullmatch(text):
        text = f"{match[3]}-{int(match[2]):02d}-{int(match[1]):02d}{match[4]}"
    elif match := _YEAR_FIRST.fullmatch(text):
        text = f"{match[1]}-{int(match[2]):02d}-{int(match[3]):02d}{match[4]}"
    date = read_text(text.replace(",", ".").replace(" UTC", "Z"))
    if date is None:
        raise InputError(
            f"{place}: {cell!r} is not a date that can be read; write dates as 2024-05-01T12:34:56.789, or times as "
            "numbers."
        )
    return date
