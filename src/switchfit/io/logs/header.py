"""The head of a table of text: what separates the fields, which lines are names and units, and where the data begin."""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from switchfit.io.logs.units import is_unit, split_unit, strip_brackets

DELIMITERS = (";", "\t", ",", "|", " ")
"""What may separate fields; of two that split all lines alike, the first one: commas are decimals then."""
SNIFFED = 100
"""Lines that are looked at."""
MOST_HEADER_LINES = 12

MISSING = frozenset({"", "NA", "N/A", "NAN", "NULL", "NONE"})
"""Cells that stand for a missing value, in capitals."""

_NUMBER = re.compile(r"[+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][+-]?\d+)?|[+-]?inf", re.IGNORECASE)
_DATE = re.compile(r"(?:\d{4}[-/]\d{1,2}[-/]\d{1,2}|\d{1,2}[./]\d{1,2}[./]\d{4}|\d{1,2}:\d{2}\b).*")

Row = tuple[int, list[str]]
"""Number of a line, and its cells."""


@dataclass(frozen=True)
class Header:
    """Names and units of the columns.

    Attributes
    ----------
    names : list of str
    units : list of str
        "" where none is stated.
    labels : dict of str to int
        Other names, and the column of each.
    first : int
        Index of the first row of data.
    """

    names: list[str]
    units: list[str]
    labels: dict[str, int] = field(default_factory=dict)
    first: int = 0


def find_delimiter(lines: Sequence[str]) -> str:
    """Return the delimiter that splits most of the lines into the same number of fields, more than one."""

    def share(delimiter: str) -> float:
        try:
            counts = Counter(len(cells) for cells in split_lines(lines, delimiter))
        except csv.Error:
            return 0.0
        fields, often = counts.most_common(1)[0]
        return often / len(lines) if fields > 1 else 0.0

    return max(DELIMITERS, key=share) if any(map(share, DELIMITERS)) else ","


def split_lines(lines: Sequence[str], delimiter: str) -> list[list[str]]:
    """Return the stripped cells of lines; those of a line that ends in a space have no empty one at the end."""
    source = [line.strip() for line in lines] if delimiter == " " else lines
    return [[cell.strip() for cell in row] for row in csv.reader(source, delimiter=delimiter, skipinitialspace=True)]


def is_missing(cell: str) -> bool:
    """Return whether a cell stands for a missing value."""
    return cell.upper() in MISSING


def is_data(cell: str) -> bool:
    """Return whether a cell is a number, a date or a time of day."""
    return bool(_NUMBER.fullmatch(cell) or _DATE.fullmatch(cell))


def has_text(cells: Sequence[str]) -> bool:
    """Return whether there is a cell that is neither missing nor a number or date."""
    return any(not is_missing(cell) and not is_data(cell) for cell in cells)


def read_header(rows: Sequence[Row], comment: list[str]) -> Header:
    """Return the header of a table.

    Parameters
    ----------
    rows : sequence of (line, cells)
    comment : list of str
        Cells of the last line of comments before the rows: the names, if no row has any and the number is right.
    """
    begin = _skip_preamble(rows)
    first = begin
    while first < min(len(rows), begin + MOST_HEADER_LINES) and _is_header(rows[first][1], first == begin):
        first += 1
    lines = [_strip_end(cells) for _, cells in rows[begin:first]]
    if not lines:
        width = len(rows[begin][1])
        numbered = [f"column {k}" for k in range(1, width + 1)]
        lines = [comment if len(comment) == width else numbered]
    return _assign_lines(lines, first)


def _skip_preamble(rows: Sequence[Row]) -> int:
    """Return the index of the first row that has as many fields as most, if it is text; 0 otherwise."""
    widths = Counter(len(cells) for _, cells in rows[:SNIFFED])
    common = widths.most_common(1)[0][0]
    width = max((len(_strip_end(cells)) for _, cells in rows[:SNIFFED] if len(cells) == common), default=0)
    for k, (_, cells) in enumerate(rows[:SNIFFED]):
        if len(_strip_end(cells)) == width:
            return k if _is_header(cells, True) else 0
    return 0


def _is_header(cells: list[str], first: bool) -> bool:
    """Return whether cells are names or units; numbers may be names in the first line, but not in its first field."""
    if first:
        return has_text(cells) and not is_data(cells[0])
    return has_text(cells) and not any(map(is_data, cells))


def _strip_end(cells: list[str]) -> list[str]:
    """Return cells without the empty ones at the end."""
    kept = list(cells)
    while kept and not kept[-1]:
        kept.pop()
    return kept


def _assign_lines(lines: list[list[str]], first: int) -> Header:
    """Tell names from units among the lines of a header."""
    width = max(map(len, lines))
    lines = [[*line, *[""] * (width - len(line))] for line in lines]
    unit_lines = [line for line in lines if _is_unit_line(line)] if len(lines) > 1 else []
    name_lines = [line for line in lines if line not in unit_lines] or unit_lines[:1]
    unique = [line for line in name_lines if len(set(line)) == width]
    if unique:
        chosen = max(unique, key=lambda line: sum(cell.isidentifier() for cell in line))
    elif len(name_lines) > 1:  # groups above names, each in a line
        chosen = [".".join(filter(None, cells)) for cells in zip(*name_lines, strict=True)]
    else:
        chosen = name_lines[0]
    names, units = _split_units(chosen)
    if unit_lines:
        units = [strip_brackets(cell) or unit for cell, unit in zip(unit_lines[0], units, strict=True)]
    names = [name or f"column {k}" for k, name in enumerate(names, start=1)]
    labels: dict[str, int] = {}
    for line in [chosen, *name_lines]:
        once = {cell for cell, count in Counter(line).items() if cell and count == 1}
        labels |= {cell: k for k, cell in enumerate(line) if cell in once and cell not in names and cell not in labels}
    return Header(names, units, labels, first)


def _is_unit_line(cells: list[str]) -> bool:
    """Return whether most of the cells are units."""
    filled = [cell for cell in cells if cell]
    return bool(filled) and sum(map(is_unit, filled)) > 0.6 * len(filled)


def _split_units(cells: list[str]) -> tuple[list[str], list[str]]:
    """Return names and units; names are left whole where they would not differ without their units."""
    pairs = [split_unit(cell) for cell in cells]
    names = [name for name, _ in pairs]
    whole = len(set(names)) < len(set(cells))
    return (list(cells) if whole else names), [unit for _, unit in pairs]
