"""Logs as tables of text: CSV in all its dialects, with what the header and the cells say about themselves."""

from __future__ import annotations

import codecs
import csv
import gzip
import re
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.io.logs.dates import is_date, parse_clock, parse_dates
from switchfit.io.logs.geodesy import FRAME, find_position
from switchfit.io.logs.header import (
    SNIFFED,
    Header,
    Row,
    find_delimiter,
    is_missing,
    read_header,
    split_lines,
)
from switchfit.io.logs.log import Event, FloatArray, Log, Options
from switchfit.io.logs.times import find_time_name, interpret_times, subtract_first
from switchfit.problem.validation import join_names, shorten
from switchfit.runtime.errors import InputError
from switchfit.runtime.files import explain_read_errors
from switchfit.runtime.issue import Issue

GZIP = b"\x1f\x8b"
COMMENTS = ("#", "%")
_DATE_NAMES = ("date", "datum", "day")
_COMMA_NUMBER = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")
_POINT_NUMBER = re.compile(r"[+-]?(?:\d+\.\d*|\.\d+)(?:[eE][+-]?\d+)?")
_EXCEL = re.compile(r"sep=.?")
"""The line in which Excel notes the delimiter; the one that is found is the same."""
_LONG_INTEGER = re.compile(r"\d{16,19}")


@dataclass(frozen=True)
class _Table:
    """Cells of a file.

    Attributes
    ----------
    source : str
    header : Header
    lines : (K,) array of int
        Number of the line of each row.
    columns : list of sequences of str, or of arrays
        The cells of each column; numbers where all of the table are.
    comma : bool
        Whether decimals are behind commas.
    broken : tuple of Issue
        Lines that were dropped.
    """

    source: str
    header: Header
    lines: NDArray[np.intp]
    columns: list[Any]
    comma: bool = False
    broken: tuple[Issue, ...] = ()

    def list_cells(self, column: int) -> list[str]:
        """Return the cells of a column; none where the table has numbers alone."""
        cells = self.columns[column]
        return [] if isinstance(cells, np.ndarray) else list(cells)

    def parse_column(self, column: int) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return a column as numbers, NaN for missing ones, and which of its cells are something else."""
        cells = self.columns[column]
        if isinstance(cells, np.ndarray):
            return cells.copy(), np.zeros(len(cells), dtype=bool)
        texts = ["nan" if is_missing(cell) else cell for cell in self.list_cells(column)]
        texts = [text.replace(",", ".") for text in texts] if self.comma else texts
        try:
            if "_" not in "".join(texts):  # Python would read 1_5 as 15
                return np.array(texts, dtype=np.float64), np.zeros(len(texts), dtype=bool)
        except ValueError:
            pass
        found = list(map(_parse_number, texts))
        numbers = np.array([np.nan if number is None else number for number in found])
        return numbers, np.array([number is None for number in found])


def _parse_number(text: str) -> float | None:
    try:
        return None if "_" in text else float(text)
    except ValueError:
        return None


def read_text(path: Path, options: Options) -> Log:
    """Read a table of text; what separates its fields, decimals, names and units is found out.

    Parameters
    ----------
    path : Path
        May be compressed by gzip.
    options : Options
    """
    columns, time = options.columns, options.time
    table = _read_table(path, options.drop_broken)
    wanted = None if columns is None else _find_columns(table, columns)
    column = _find_time(table, wanted or ()) if time is None else _find_column(table, time)
    if options.drop_broken:
        table = _drop_text(table, column, wanted)
    times, time_unit, offset, zone = _read_times(table, column, options.keep_epoch)
    values: dict[str, FloatArray] = {}
    events: list[Event] = []
    issues = list(table.broken)
    names = table.header.names
    for k in range(len(names)) if wanted is None else wanted:
        if (k == column and wanted is None) or names[k] in values:
            continue
        found, bad = table.parse_column(k)
        if not bad.any() and names.count(names[k]) == 1:
            values[names[k]] = found
        elif wanted is not None:
            _refuse_cell(table, k, int(bad.argmax()))
        elif names.count(names[k]) > 1:
            issues.append(Issue("log: repeated name", (table.source, names[k])))
        elif _is_text(table.list_cells(k), bad):
            events += _list_changes(names[k], table.list_cells(k), times)
        else:
            first = int(bad.argmax())
            figures = {"line": float(table.lines[first]), "count": float(bad.sum())}
            issues.append(Issue("log: text", (table.source, "line", names[k], table.columns[k][first]), figures))
    units = {name: table.header.units[names.index(name)] for name in values}
    labels = {label: names[k] for label, k in table.header.labels.items() if names[k] in values}
    events.sort(key=lambda event: event.time)
    return Log(
        times=times,
        values=values,
        units=units,
        time_unit=time_unit,
        source=table.source,
        issues=tuple(issues),
        events=tuple(events),
        offset=offset,
        labels=labels,
        rows=table.lines,
        place="line",
        time_name=names[column],
        time_zone="UTC" if zone is None else zone,
        has_dates=zone is not None,
    )


# --- from bytes to cells ----------------------------------------------------------------------------------------------


def decode(path: Path) -> str:
    """Return the text of a file: UTF-8 or UTF-16 by its byte order mark, UTF-8, or else Latin-1.

    Raises
    ------
    InputError
        If the file cannot be read or is no text.
    """
    with explain_read_errors(path):
        data = path.read_bytes()
    if data.startswith(GZIP):
        try:
            data = gzip.decompress(data)
        except (EOFError, gzip.BadGzipFile, zlib.error) as error:
            raise InputError(
                f"{path} is compressed by gzip, but damaged or cut off ({error}); compress it anew."
            ) from None
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        try:
            return data.decode("utf-16")
        except UnicodeDecodeError as error:
            raise InputError(f"{path} is not a text file in UTF-16 (byte {error.start}).") from error
    binary = re.search(rb"[\x00-\x08\x0e-\x1a]", data)
    if binary:
        raise InputError(
            f"{path} is not a text file (byte {binary.start()} is {data[binary.start()]}); export it as CSV."
        )
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _read_table(path: Path, drop_broken: bool) -> _Table:
    lines = list(enumerate(re.split(r"\r\n|\n|\r", decode(path)), start=1))
    kept = [(k, line) for k, line in lines if line.strip() and not line.lstrip().startswith(COMMENTS)]
    if kept and _EXCEL.fullmatch(kept[0][1].strip()):
        kept = kept[1:]
    if not kept:
        raise InputError(f"{path} is empty; it needs a line with the names of the columns and one line per sample.")
    delimiter = find_delimiter([line for _, line in kept[:SNIFFED]])
    quoted = any('"' in line for _, line in kept)
    rows = _split_rows(path, kept if quoted else kept[:SNIFFED], delimiter)
    comments = [line for k, line in lines[: kept[0][0] - 1] if line.lstrip().startswith(COMMENTS)]
    header = read_header(rows, _split_comment(comments[-1], delimiter) if comments else [])
    body = kept[header.first :]
    numbers = None if quoted or not body else _parse_block([line for _, line in body], delimiter, len(header.names))
    if numbers is not None:
        return _Table(str(path), header, np.array([k for k, _ in body], dtype=np.intp), list(numbers.T))
    rows = rows[header.first :] if quoted else _split_rows(path, body, delimiter)
    rows, broken = _check_widths(path, header, rows, drop_broken)
    if not rows:
        raise InputError(f"{path} has a header but no rows; there is nothing to read.")
    comma = delimiter != "," and _use_decimal_commas(path, rows)  # between commas, 1,234 is rather a thousand
    places = np.array([line for line, _ in rows], dtype=np.intp)
    return _Table(str(path), header, places, list(zip(*(cells for _, cells in rows), strict=True)), comma, broken)


def _parse_block(lines: list[str], delimiter: str, width: int) -> FloatArray | None:
    """Return lines that have numbers alone as an array; None for all others, which are split into cells.

    NumPy's reader takes a quarter of the time that cells take.
    """
    text = "\n".join(["", *lines, ""])
    if delimiter != " ":
        if lines[0].count(delimiter) == width and all(line.endswith(delimiter) for line in lines):
            text = text.replace(f"{delimiter}\n", "\n")
        for empty in (2 * delimiter, 2 * delimiter, f"\n{delimiter}", f"{delimiter}\n"):  # pairs may overlap
            text = text.replace(empty, f"{empty[0]}nan{empty[1]}")
    if delimiter != "," and "," in text:
        if "." in text:
            return None
        text = text.replace(",", ".")
    if "_" in text or _LONG_INTEGER.search(lines[0]):
        return None
    lines = text.split("\n")[1:-1]
    try:
        numbers = np.loadtxt(lines, delimiter=None if delimiter == " " else delimiter, comments=None, ndmin=2)
    except ValueError:
        return None
    return numbers if numbers.shape == (len(lines), width) else None


def _split_comment(line: str, delimiter: str) -> list[str]:
    try:
        return split_lines([line.strip().lstrip("#%").strip()], delimiter)[0]
    except csv.Error:
        return []


def _split_rows(path: Path, kept: list[tuple[int, str]], delimiter: str) -> list[Row]:
    """Return the number and the cells of each line; of lines that quotes join, the number of the last one."""
    source = (line.strip() if delimiter == " " else line for _, line in kept)
    reader = csv.reader(source, delimiter=delimiter, skipinitialspace=True)
    try:
        return [(kept[reader.line_num - 1][0], [cell.rstrip() for cell in cells]) for cells in reader]
    except csv.Error as error:
        line = kept[min(reader.line_num, len(kept)) - 1][0]
        raise InputError(f"{path}, line {line}: {error}; is a quotation mark missing?") from error


def _check_widths(path: Path, header: Header, rows: list[Row], drop: bool) -> tuple[list[Row], tuple[Issue, ...]]:
    """Return rows that have as many cells as there are names; empty cells at the end do not count."""
    width = len(header.names)
    kept: list[Row] = []
    broken: list[int] = []
    for line, cells in rows:
        while len(cells) > width and not cells[-1]:
            cells.pop()
        if len(cells) == width:
            kept.append((line, cells))
        elif drop:
            broken.append(line)
        else:
            hint = " Are there decimal commas? Then separate fields by semicolons." if len(cells) == 2 * width else ""
            raise InputError(
                f"{path}, line {line}: {len(cells)} fields where the header has {width}; is a field missing?{hint} "
                "repair='drop-broken-lines' leaves such lines out."
            )
    return kept, _list_broken(str(path), broken)


def _list_broken(source: str, lines: Sequence[int]) -> tuple[Issue, ...]:
    if not lines:
        return ()
    figures = {"line": float(lines[0]), "count": float(len(lines)), "repaired": 1.0}
    return (Issue("log: broken lines", (source, "line"), figures),)


def _use_decimal_commas(path: Path, rows: list[Row]) -> bool:
    """Return whether numbers have decimal commas; raise if some have commas and others points."""
    comma = point = None
    for line, cells in rows:
        for cell in cells:
            if comma is None and "," in cell and _COMMA_NUMBER.fullmatch(cell):
                comma = (line, cell)
            elif point is None and "." in cell and _POINT_NUMBER.fullmatch(cell):
                point = (line, cell)
        if comma and point:
            raise InputError(
                f"{path} has numbers with decimal commas and with decimal points: {comma[1]!r} in line {comma[0]}, "
                f"{point[1]!r} in line {point[0]}. Export it with one of them."
            )
    return comma is not None


# --- from cells to numbers --------------------------------------------------------------------------------------------


def _find_column(table: _Table, name: str) -> int:
    names = table.header.names
    if names.count(name) > 1:
        raise InputError(f"{table.source} has {names.count(name)} columns {shorten(name)}; rename all but one.")
    if name in names:
        return names.index(name)
    if name in table.header.labels:
        return table.header.labels[name]
    raise InputError(f"{table.source} has no column {shorten(name)}; its columns are {join_names(names)}.")


def _find_columns(table: _Table, columns: Sequence[str]) -> list[int]:
    """Return the columns of some names; for east, north and up, those of the position on the globe."""
    names = table.header.names
    own = [name for name in columns if name not in FRAME or name in names or name in table.header.labels]
    if len(own) < len(columns):
        hdop = [name for name in names if name.lower() == "hdop"]
        own += [name for name in [*(find_position(names) or []), *hdop] if name not in own]
    return [_find_column(table, name) for name in own]


def _find_time(table: _Table, channels: Sequence[int]) -> int:
    """Return the column with the times: the first one that is called so, or the first one if it never falls."""
    wanted = [table.header.names[k] for k in channels]
    found = find_time_name([*table.header.names, *table.header.labels], wanted)
    if found is not None:
        return table.header.names.index(found) if found in table.header.names else table.header.labels[found]
    numbers, bad = table.parse_column(0)
    if len(table.header.names) > 1 and not bad.any() and np.all(np.diff(numbers) >= 0) and numbers[-1] > numbers[0]:
        return 0
    raise InputError(
        f"{table.source}: no column is called time; its columns are {join_names(table.header.names)}. Name the one "
        "with the times: time = ..."
    )


def _read_times(table: _Table, column: int, keep_epoch: bool) -> tuple[FloatArray, str, float, str | None]:
    """Return times, their unit, what was subtracted from them, and the time zone of dates, None if they are numbers."""
    cells = table.list_cells(column)
    sample = next((cell for cell in cells if not is_missing(cell)), "")
    if is_date(sample):
        return _parse_dated(table, column, cells, sample)
    numbers, bad = table.parse_column(column)
    if bad.any():
        _refuse_cell(table, column, int(bad.argmax()))
    times, unit, offset = interpret_times(
        numbers, table.header.names[column], table.header.units[column], keep_epoch=keep_epoch
    )
    if offset and cells and all(map(_LONG_INTEGER.fullmatch, cells)):
        times, unit, offset = subtract_first(list(map(int, cells)), unit)
    return times, unit, offset, None


def _parse_dated(
    table: _Table, column: int, cells: list[str], sample: str
) -> tuple[FloatArray, str, float, str | None]:
    """Return seconds since the first of dates; those of times of day since midnight, unless a column has the date."""
    places = [f"{table.source}, line {line}, column {table.header.names[column]!r}" for line in table.lines]
    if "-" not in sample and "/" not in sample and sample.count(".") < 2:
        lower = [name.lower() for name in table.header.names]
        day = next((lower.index(name) for name in _DATE_NAMES if name in lower), None)
        if day is None:
            return parse_clock(cells, places), "s", 0.0, None
        cells = [f"{date} {clock}" for date, clock in zip(table.list_cells(day), cells, strict=True)]
    seconds, offset, zone = parse_dates(cells, places)
    return seconds, "s", offset, zone


def _refuse_cell(table: _Table, column: int, row: int) -> None:
    raise InputError(
        f"{table.source}, line {table.lines[row]}, column {table.header.names[column]!r}: "
        f"{table.columns[column][row]!r} is not a number; leave the cell empty where a value is missing."
    )


def _drop_text(table: _Table, time: int, wanted: list[int] | None) -> _Table:
    """Return the table without the lines that have text in a column of numbers, or no time."""
    if isinstance(table.columns[time], np.ndarray):
        return table
    broken = np.zeros(len(table.lines), dtype=bool)
    for k in range(len(table.header.names)) if wanted is None else {time, *wanted}:
        cells = table.list_cells(k)
        bad = table.parse_column(k)[1]
        if k == time and is_date(cells[0]):
            bad = np.array([not is_date(cell) for cell in cells])
        if not _is_text(cells, bad):
            broken |= bad
    columns = [list(compress(column, ~broken)) for column in table.columns]
    issues = table.broken + _list_broken(table.source, table.lines[broken].tolist())
    return replace(table, columns=columns, lines=table.lines[~broken], broken=issues)


def _is_text(cells: Sequence[str], bad: NDArray[np.bool_]) -> bool:
    """Return whether most cells of a column are no numbers; missing ones do not count."""
    return bool(2 * bad.sum() > sum(not is_missing(cell) for cell in cells))


def _list_changes(name: str, cells: Sequence[str], times: FloatArray) -> list[Event]:
    """Return an event wherever the text of a column changes; empty cells say nothing."""
    events: list[Event] = []
    for time, cell in zip(times.tolist(), cells, strict=True):
        if not is_missing(cell) and (not events or events[-1].text != cell):
            events.append(Event(time, name, cell))
    return events
