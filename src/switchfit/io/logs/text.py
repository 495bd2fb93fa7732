"""Logs as tables of text: CSV in all its dialects, with what the header and the cells say about themselves.

The head of a table of text: what separates the fields, which lines are names and units, and where the data begin.

Dates and times of day in the cells of a log, as seconds.
"""

from __future__ import annotations

import codecs
import csv
import gzip
import re
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import compress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.io.logs.geodesy import FRAME, find_position
from switchfit.io.logs.log import Event, FloatArray, Log, Options, is_unit, split_unit, strip_brackets
from switchfit.io.logs.tables import build_log, find_time_name
from switchfit.problem.dates import read_date_text
from switchfit.problem.validation import join_names, shorten
from switchfit.runtime.errors import InputError, Issue
from switchfit.runtime.files import explain_read_errors

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


_WHOLE_DATE = re.compile(r"\d{4}[-/]\d{1,2}[-/]\d{1,2}.*|\d{1,2}[./]\d{1,2}[./]\d{4}.*|\d{8}T.*")
_CLOCK = re.compile(r"(\d{1,2}):(\d{2})(?::(\d{2}(?:[.,]\d+)?))?")
_GERMAN = re.compile(r"(\d{1,2})\.(\d{1,2})\.(\d{4})(.*)")
_YEAR_FIRST = re.compile(r"(\d{4})[-/](\d{1,2})[-/](\d{1,2})(.*)")


def is_date(cell: str) -> bool:
    """Return whether a cell is a date or a time of day."""
    return bool(_WHOLE_DATE.fullmatch(cell) or _CLOCK.fullmatch(cell))


def parse_dates(cells: Sequence[str], places: Sequence[str]) -> tuple[NDArray[np.datetime64], str]:
    """Return dates in UTC, NaT where one is missing, and their zone: "" if none states one, "UTC" for several.

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
    dates = np.array([None if entry is None else entry[0] for entry in found], dtype="datetime64[us]")
    return dates, zones.pop() if len(zones) == 1 else "UTC"


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


def _read_date(cell: str, place: str) -> tuple[np.datetime64, str]:
    """Return the instant of a date, and its zone, "" if it states none."""
    text = cell.strip()
    if match := _GERMAN.fullmatch(text):
        text = f"{match[3]}-{int(match[2]):02d}-{int(match[1]):02d}{match[4]}"
    elif match := _YEAR_FIRST.fullmatch(text):
        text = f"{match[1]}-{int(match[2]):02d}-{int(match[3]):02d}{match[4]}"
    date = read_date_text(text.replace(",", ".").replace(" UTC", "Z"))
    if date is None:
        raise InputError(
            f"{place}: {cell!r} is not a date that can be read; write dates as 2024-05-01T12:34:56.789, or times as "
            "numbers."
        )
    return date


GZIP = b"\x1f\x8b"
COMMENTS = ("#", "%")
_DATE_NAMES = ("date", "datum", "day")
_COMMA_NUMBER = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")
_POINT_NUMBER = re.compile(r"[+-]?(?:\d+\.\d*|\.\d+)(?:[eE][+-]?\d+)?")
_EXCEL = re.compile(r"sep=.?")
"""The line in which Excel notes the delimiter; the one that is found is the same."""
_LONG_INTEGER = re.compile(r"(?<![\d.])\d{16,19}(?![\d.])")
"""Such as nanoseconds since 1970, which doubles would round."""


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
    log = _read_times(table, column, options)
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
            events += _list_changes(names[k], table.list_cells(k), log.times)
        else:
            first = int(bad.argmax())
            figures = {"line": float(table.lines[first]), "count": float(bad.sum())}
            issues.append(Issue("log: text", (table.source, "line", names[k], table.columns[k][first]), figures))
    units = {name: table.header.units[names.index(name)] for name in values}
    labels = {label: names[k] for label, k in table.header.labels.items() if names[k] in values}
    events.sort(key=lambda event: event.time)
    return replace(
        log, values=values, units=units, issues=tuple(issues), events=tuple(events), labels=labels, rows=table.lines,
        place="line",
    )  # fmt: skip


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
    if "_" in text or _LONG_INTEGER.search(text, 0, text.index("\n", 1)):
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


def _read_times(table: _Table, column: int, options: Options) -> Log:
    """Return a log with the times of a table, and no channels."""
    name, cells = table.header.names[column], table.list_cells(column)
    unit, zone = table.header.units[column], ""
    times: NDArray[Any]
    sample = next((cell for cell in cells if not is_missing(cell)), "")
    if is_date(sample):
        places = [f"{table.source}, line {line}, column {name!r}" for line in table.lines]
        is_clock = "-" not in sample and "/" not in sample and sample.count(".") < 2
        days = _list_days(table) if is_clock else []
        if is_clock and not days:
            times, unit = parse_clock(cells, places), "s"
        else:
            dated = [f"{day} {clock}" for day, clock in zip(days, cells, strict=True)] if is_clock else cells
            times, zone = parse_dates(dated, places)
    elif cells and all(map(_LONG_INTEGER.fullmatch, cells)):
        times = np.array(list(map(int, cells)))
    else:
        times, bad = table.parse_column(column)
        if bad.any():
            _refuse_cell(table, column, int(bad.argmax()))
    return build_log(table.source, {name: times}, {name: unit}, options._replace(time=name), {name: zone})


def _list_days(table: _Table) -> list[str]:
    """Return the cells of the column with the dates of times of day; none if there is no such column."""
    lower = [name.lower() for name in table.header.names]
    day = next((lower.index(name) for name in _DATE_NAMES if name in lower), None)
    return [] if day is None else table.list_cells(day)


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
