"""What a cell of a table of text says: a number, a date, a time of day, or that a value is missing."""

from __future__ import annotations

import re

import numpy as np

from switchfit.problem.dates import read_date_text

MISSING = frozenset({"", "NA", "N/A", "NAN", "NULL", "NONE"})
"""Cells that stand for a missing value, in capitals."""

# Either mark of decimals: which one a file uses is decided for all of its cells together.
DECIMAL_NUMBER = re.compile(r"[+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][+-]?\d+)?|[+-]?inf", re.IGNORECASE)
# Loose on purpose: this tells dates from numbers, and `read_date_cell` says whether one can be read.
_DATE = re.compile(r"\d{4}[-/]\d{1,2}[-/]\d{1,2}.*|\d{1,2}[./]\d{1,2}[./]\d{4}.*|\d{8}T.*")
CLOCK_TIME = re.compile(r"(\d{1,2}):(\d{2})(?::(\d{2}(?:[.,]\d+)?))?")
_GERMAN = re.compile(r"^(\d{1,2})\.(\d{1,2})\.(\d{4})")

_ONE_DIGIT = re.compile(r"(?<=[- ])(\d)(?!\d)")
"""A month, a day or an hour that ISO 8601 has with two digits."""


def is_missing(cell: str) -> bool:
    """Return whether a cell stands for a missing value."""
    return cell.upper() in MISSING


def is_date(cell: str) -> bool:
    """Return whether a cell is a date or a time of day."""
    return bool(_DATE.fullmatch(cell) or CLOCK_TIME.fullmatch(cell))


def is_data(cell: str) -> bool:
    """Return whether a cell is a number, a date or a time of day."""
    return bool(DECIMAL_NUMBER.fullmatch(cell)) or is_date(cell)


def read_date_cell(cell: str) -> tuple[np.datetime64, str] | None:
    """Return the instant of a date in ISO 8601, or day.month.year, and its zone, "" if it states none.

    Dates without a zone are counted as if they were UTC.
    """
    # To ISO 8601: day.month.year turned round, slashes and decimal commas replaced, and digits that it wants twice
    # filled up.
    text = _GERMAN.sub(r"\3-\2-\1", cell).replace("/", "-").replace(",", ".").replace(" UTC", "Z")
    return read_date_text(_ONE_DIGIT.sub(r"0\1", text))


def read_clock_cell(cell: str) -> float | None:
    """Return the seconds since midnight of a time of day."""
    match = CLOCK_TIME.fullmatch(cell)
    if match is None:
        return None
    return 3600 * int(match[1]) + 60 * int(match[2]) + float((match[3] or "0").replace(",", "."))


def parse_number(cell: str) -> float | None:
    """Return the number in a cell, NaN for one that is missing; None for anything else."""
    if is_missing(cell):
        return np.nan
    try:
        # Python reads 1_5 as 15, which in a log is a name or a range.
        return None if "_" in cell else float(cell)
    except ValueError:
        return None
