"""A file of text as a table of cells, or of numbers where it has nothing else."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.io.logs.cells import DECIMAL_NUMBER, parse_number
from switchfit.io.logs.decoding import decode
from switchfit.io.logs.header import NumberedRow, find_delimiter, read_header, split_lines
from switchfit.runtime.errors import InputError

SNIFFED = 100
"""Lines that are looked at."""

COMMENTS = ("#", "%")

_EXCEL = re.compile(r"sep=.?")
"""The line in which Excel notes the delimiter; the one that is found is the same."""

LONG_INTEGER = re.compile(r"\d{16,19}")
"""Such as nanoseconds since 1970, which doubles would round."""


@dataclass(frozen=True)
class TextTable:
    """Cells of a file.

    Attributes
    ----------
    source : str
    names, units : list of str
    places : dict of str to int
        The column of each name, and of other names that the header has for it.
    lines : (K,) array of int
        Number of the line of each row.
    columns : list of sequence of str, or of (K,) array
        The cells of each column; numbers where the whole table has nothing else.
    comma : bool
        Whether decimals are behind commas.
    broken : list of int
        Lines that were dropped.
    """

    source: str
    names: list[str]
    units: list[str]
    places: dict[str, int]
    lines: NDArray[np.intp]
    columns: list[Any]
    comma: bool = False
    broken: Sequence[int] = ()

    def parse_column(self, column: int) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return a column as numbers, NaN for missing ones, and which of its cells are something else."""
        cells = self.columns[column]
        if isinstance(cells, np.ndarray):
            return cells, np.zeros(len(cells), dtype=bool)
        if self.comma:
            cells = [cell.replace(",", ".") for cell in cells]
        try:
            if "_" not in "".join(cells):  # Python would read 1_5 as 15
                return np.fromiter(map(float, cells), dtype=np.float64), np.zeros(len(cells), dtype=bool)
        except ValueError:
            pass
        # Cell by cell, which is slower, only if one is no number.
        found = list(map(parse_number, cells))
        return np.array(found, dtype=np.float64), np.array([number is None for number in found])


def read_table(path: Path, drop_broken: bool) -> TextTable:
    """Read a file of text: its head, and the lines of data."""
    lines = list(enumerate(re.split(r"\r\n|\n|\r", decode(path)), start=1))
    kept = [(k, line) for k, line in lines if line.strip() and not line.lstrip().startswith(COMMENTS)]
    if kept and _EXCEL.fullmatch(kept[0][1].strip()):
        kept = kept[1:]
    if not kept:
        raise InputError(f"{path} is empty; it needs a line with the names of the columns and one line per sample.")
    # From the first lines, header included, as the whole file would take longer than reading it.
    delimiter = find_delimiter(kept[:SNIFFED])
    # The last comment before the header may have the names: `# t, x, y`, as NumPy writes them.
    comments = [
        (k, line.strip().lstrip("#% \t")) for k, line in lines[: kept[0][0] - 1] if line.lstrip().startswith(COMMENTS)
    ]
    try:
        head, notes = split_lines(kept[:SNIFFED], delimiter), split_lines(comments[-1:], delimiter)
        names, units, places, first = read_header([cells for _, cells in head], notes[0][1] if notes else [])
        width, body = len(names), kept[first:]
        # Two ways to the same table. A file of numbers alone is read as a block. Any other one, with text, missing
        # cells in words, commas as decimals or broken lines, is split into cells, which keep what a message has to
        # show.
        numbers = None if drop_broken else _parse_block([line for _, line in body], delimiter, width)
        if numbers is not None:
            return TextTable(str(path), names, units, places, np.array([k for k, _ in body]), list(numbers.T.copy()))
        rows, broken = _check_widths(split_lines(kept, delimiter)[first:], width, drop_broken)
    except ValueError as error:
        raise InputError(f"{path}, {error}") from error
    if not rows:
        raise InputError(f"{path} has a header but no rows; there is nothing to read.")
    comma = delimiter != "," and _use_decimal_commas(path, rows)  # between commas, 1,234 is rather a thousand
    columns: list[Any] = list(zip(*(cells for _, cells in rows), strict=True))
    return TextTable(str(path), names, units, places, np.array([line for line, _ in rows]), columns, comma, broken)


def _parse_block(lines: list[str], delimiter: str, width: int) -> FloatArray | None:
    """Return lines that have numbers alone as an array, (K, width); None for all others, which are split into cells.

    NumPy's reader takes a quarter of the time that cells take.
    """
    # Empty fields become nan in the text itself. The lines around it, which are empty, make the first and the last
    # field of every line stand between two marks.
    text = "\n".join(["", *lines, ""])
    if delimiter != "," and "." not in text:
        text = text.replace(",", ".")
    if delimiter != " ":
        for empty in (2 * delimiter, 2 * delimiter, f"\n{delimiter}", f"{delimiter}\n"):  # pairs may overlap
            text = text.replace(empty, f"{empty[0]}nan{empty[1]}")
    lines = text.split("\n")[1:-1]
    # Doubles would round them: cells keep them as text, from which integers are read.
    if not lines or LONG_INTEGER.search(lines[0]):
        return None
    try:
        numbers = np.loadtxt(lines, delimiter=None if delimiter == " " else delimiter, comments=None, ndmin=2)
    except ValueError:
        return None
    return numbers if numbers.shape[1] == width else None


def _check_widths(rows: list[NumberedRow], width: int, drop: bool) -> tuple[list[NumberedRow], list[int]]:
    """Return rows that have as many cells as there are names, and the lines that have not and are dropped.

    Empty cells at the end do not count.
    """
    kept: list[NumberedRow] = []
    broken: list[int] = []
    for line, cells in rows:
        # Spreadsheets end lines with delimiters of columns that were cleared.
        while len(cells) > width and not cells[-1]:
            cells.pop()
        if len(cells) == width:
            kept.append((line, cells))
        elif drop:
            broken.append(line)
        else:
            hint = " Are there decimal commas? Then separate fields by semicolons." if len(cells) == 2 * width else ""
            raise ValueError(
                f"line {line}: {len(cells)} fields where the header has {width}; is a field missing?{hint} "
                "repair='drop-broken-lines' leaves such lines out."
            )
    return kept, broken


def _use_decimal_commas(path: Path, rows: list[NumberedRow]) -> bool:
    """Return whether numbers have decimal commas; raise if some have commas and others points."""

    def find(mark: str) -> tuple[int, str] | None:
        numbers = (
            (line, cell) for line, cells in rows for cell in cells if mark in cell and DECIMAL_NUMBER.fullmatch(cell)
        )
        return next(numbers, None)

    comma, point = find(","), find(".")
    if comma and point:
        raise InputError(
            f"{path} has numbers with decimal commas and with decimal points: {comma[1]!r} in line {comma[0]}, "
            f"{point[1]!r} in line {point[0]}. Export it with one of them."
        )
    return comma is not None
