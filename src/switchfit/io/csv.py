"""Read columns of numbers from CSV files."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from switchfit.problem.data import FloatArray
from switchfit.runtime.errors import InputError
from switchfit.runtime.files import is_device


def read_columns(path: str | Path, columns: Sequence[str]) -> FloatArray:
    """Read some columns of a CSV file that has one header line.

    Fields are separated by commas, semicolons or tabs, whichever is most frequent in the header. Lines that are empty
    or start with ``#`` are skipped. Spaces around names and numbers are ignored.

    Parameters
    ----------
    path : str or Path
    columns : sequence of str
        Names in the header.

    Returns
    -------
    (K, len(columns)) array
        Empty cells, ``NA`` and ``nan`` are NaN.

    Raises
    ------
    InputError
        If the file cannot be read or has no rows, a column is missing or occurs twice, a line has fewer or more
        fields than the header, or a cell is not a number.
    """
    path = Path(path)
    rows = _read_rows(path)
    header = next(rows, None)
    if header is None:
        raise InputError(f"{path} is empty; it needs a line with the names of the columns and one line per sample.")
    names = header[1]
    where = [_find_column(path, names, column) for column in columns]
    table = []
    for line, cells in rows:
        if len(cells) != len(names):
            raise InputError(
                f"{path}, line {line}: {len(cells)} fields where the header has {len(names)}; is a field missing?"
            )
        table.append([_read_number(path, line, names[k], cells[k]) for k in where])
    if not table:
        raise InputError(f"{path} has a header but no rows; there is nothing to read.")
    return np.array(table, dtype=np.float64)


def _read_rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Yield the line number and stripped cells of each line that is neither empty nor a comment."""
    if is_device(path):
        raise InputError(f"{path} is a device; name a CSV file.")
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = file.read().splitlines()
    except FileNotFoundError:
        raise InputError(f"There is no file {path}; check the name and the folder.") from None
    except IsADirectoryError:
        raise InputError(f"{path} is a folder; name a CSV file in it.") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is not a text file in UTF-8 (byte {error.start}); export it as CSV.") from error
    except ValueError as error:
        raise InputError(f"{str(path)!r} is not a file name: {error}.") from error
    kept = [(k, line) for k, line in enumerate(lines, start=1) if line.strip() and not line.lstrip().startswith("#")]
    if not kept:
        return
    delimiter = max(",;\t", key=kept[0][1].count)
    cells_of_lines = csv.reader((line for _, line in kept), delimiter=delimiter, skipinitialspace=True)
    try:
        for cells in cells_of_lines:
            # A quoted cell may span lines; the line number is then that of the last one.
            yield kept[cells_of_lines.line_num - 1][0], [cell.strip() for cell in cells]
    except csv.Error as error:
        line = kept[min(cells_of_lines.line_num, len(kept)) - 1][0]
        raise InputError(f"{path}, line {line}: {error}; is a quotation mark missing?") from error


def _find_column(path: Path, names: list[str], column: str) -> int:
    found = names.count(column)
    if found == 0:
        raise InputError(f"{path} has no column {column!r}; its columns are {', '.join(names)}.")
    if found > 1:
        raise InputError(f"{path} has {found} columns {column!r}; rename all but one.")
    return names.index(column)


def _read_number(path: Path, line: int, column: str, cell: str) -> float:
    if cell == "" or cell.upper() == "NA":
        return np.nan
    try:
        if "_" in cell:  # Python would read 1_5 as 15
            raise ValueError
        return float(cell)
    except ValueError:
        raise InputError(
            f"{path}, line {line}, column {column!r}: {cell!r} is not a number; leave the cell empty where a value "
            "is missing."
        ) from None
