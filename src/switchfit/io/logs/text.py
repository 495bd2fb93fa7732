"""Logs as tables of text: CSV in all its dialects, with what the header and the cells say about themselves."""

from __future__ import annotations

import codecs
import contextlib
import csv
import gzip
import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from switchfit.io.logs import explain_damage, refuse_without_times
from switchfit.io.logs.log import Event, Log, Options, build_log, find_time_name, is_unit, split_unit, strip_brackets
from switchfit.io.logs.reader import FRAME, find_position
from switchfit.problem.dates import FloatArray, read_date_text
from switchfit.problem.validation import join_names, shorten
from switchfit.runtime.errors import InputError, Issue
from switchfit.runtime.files import explain_read_errors

DELIMITERS = (";", "\t", ",", "|", " ")
"""What may separate fields; of two that split all lines alike, the first one: commas are decimals then."""
SNIFFED = 100
"""Lines that are looked at."""

MISSING = frozenset({"", "NA", "N/A", "NAN", "NULL", "NONE"})
"""Cells that stand for a missing value, in capitals."""

_NUMBER = re.compile(r"[+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][+-]?\d+)?|[+-]?inf", re.IGNORECASE)
_DATE = re.compile(r"\d{4}[-/]\d{1,2}[-/]\d{1,2}.*|\d{1,2}[./]\d{1,2}[./]\d{4}.*|\d{8}T.*")
_CLOCK = re.compile(r"(\d{1,2}):(\d{2})(?::(\d{2}(?:[.,]\d+)?))?")
_GERMAN = re.compile(r"^(\d{1,2})\.(\d{1,2})\.(\d{4})")
_ONE_DIGIT = re.compile(r"(?<=[- ])(\d)(?!\d)")
"""A month, a day or an hour that ISO 8601 has with two digits."""

Line = tuple[int, str]
"""Number of a line, and its text."""
Row = tuple[int, list[str]]
"""Number of a line, and its cells."""


# --- the header -------------------------------------------------------------------------------------------------------


def find_delimiter(lines: Sequence[Line]) -> str:
    """Return the delimiter that splits most of the lines into the same number of fields, more than one."""

    def share(delimiter: str) -> float:
        try:
            counts = Counter(len(cells) for _, cells in split_lines(lines, delimiter))
        except ValueError:
            return 0.0
        fields, often = counts.most_common(1)[0]
        return often / len(lines) if fields > 1 else 0.0

    return max(DELIMITERS, key=share) if any(map(share, DELIMITERS)) else ","


def split_lines(lines: Sequence[Line], delimiter: str) -> list[Row]:
    """Return the number and the cells of each line; of lines that quotes join, the number of the last one."""
    texts = [text.strip() if delimiter == " " else text for _, text in lines]
    reader = csv.reader(texts, delimiter=delimiter, skipinitialspace=True)
    try:
        rows = [(lines[reader.line_num - 1][0], cells) for cells in reader]
        if any(" " in text or "\t" in text for text in texts):
            rows = [(line, [cell.rstrip() for cell in cells]) for line, cells in rows]
        return rows
    except csv.Error as error:
        line = lines[min(reader.line_num, len(lines)) - 1][0]
        raise ValueError(f"line {line}: {error}; is a quotation mark missing?") from error


def is_missing(cell: str) -> bool:
    """Return whether a cell stands for a missing value."""
    return cell.upper() in MISSING


def is_date(cell: str) -> bool:
    """Return whether a cell is a date or a time of day."""
    return bool(_DATE.fullmatch(cell) or _CLOCK.fullmatch(cell))


def is_data(cell: str) -> bool:
    """Return whether a cell is a number, a date or a time of day."""
    return bool(_NUMBER.fullmatch(cell)) or is_date(cell)


def read_header(rows: Sequence[list[str]], comment: list[str]) -> tuple[list[str], list[str], dict[str, int], int]:
    """Return the names of the columns, their units, the column of each name in the header, and the first row of data.

    Parameters
    ----------
    rows : sequence of list of str
        The cells of the first lines.
    comment : list of str
        Cells of the last line of comments before them: the names, if no row has any and the number is right.
    """
    begin = _skip_preamble(rows)
    first = begin
    while first < len(rows) and _is_header(rows[first], first == begin):
        first += 1
    width = len(rows[begin])
    lines = [_strip_end(cells) for cells in rows[begin:first]] or [comment if len(comment) == width else [""] * width]
    return *_assign_lines(lines), first


def _skip_preamble(rows: Sequence[list[str]]) -> int:
    """Return the index of the first row that has as many fields as most, if it is text; 0 otherwise."""
    common = Counter(map(len, rows)).most_common(1)[0][0]
    widths = [len(_strip_end(cells)) for cells in rows]
    width = max(own for own, cells in zip(widths, rows, strict=True) if len(cells) == common)
    k = widths.index(width)
    return k if _is_header(rows[k], True) else 0


def _is_header(cells: list[str], first: bool) -> bool:
    """Return whether cells are names or units; numbers may be names in the first line, but not in its first field."""
    has_text = any(not is_missing(cell) and not is_data(cell) for cell in cells)
    return has_text and not any(map(is_data, cells[:1] if first else cells))


def _strip_end(cells: list[str]) -> list[str]:
    """Return cells without the empty ones at the end."""
    filled = [k for k, cell in enumerate(cells, start=1) if cell]
    return cells[: max(filled, default=0)]


def _assign_lines(lines: list[list[str]]) -> tuple[list[str], list[str], dict[str, int]]:
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
    names, units = map(list, zip(*map(split_unit, chosen), strict=True))
    if len(set(names)) < len(set(chosen)):  # they would not differ without their units
        names = chosen
    if unit_lines:
        units = [strip_brackets(cell) or unit for cell, unit in zip(unit_lines[0], units, strict=True)]
    names = [name or f"column {k}" for k, name in enumerate(names, start=1)]
    places = {name: names.index(name) for name in names}
    for line in [chosen, *name_lines]:
        once = {cell for cell, count in Counter(line).items() if cell and count == 1}
        places |= {cell: k for k, cell in enumerate(line) if cell in once and cell not in places}
    return names, units, places


def _is_unit_line(cells: list[str]) -> bool:
    """Return whether most of the cells are units."""
    filled = [cell for cell in cells if cell]
    return sum(map(is_unit, filled)) > 0.6 * len(filled)


def _read_date(cell: str) -> tuple[np.datetime64, str] | None:
    """Return the instant of a date in ISO 8601, or day.month.year, and its zone, "" if it states none.

    Dates without a zone are counted as if they were UTC.
    """
    text = _GERMAN.sub(r"\3-\2-\1", cell).replace("/", "-").replace(",", ".").replace(" UTC", "Z")
    return read_date_text(_ONE_DIGIT.sub(r"0\1", text))


def _read_clock(cell: str) -> float | None:
    """Return the seconds since midnight of a time of day."""
    match = _CLOCK.fullmatch(cell)
    if match is None:
        return None
    return 3600 * int(match[1]) + 60 * int(match[2]) + float((match[3] or "0").replace(",", "."))


DAY = 86400.0  # s

GZIP = b"\x1f\x8b"
COMMENTS = ("#", "%")
NO_NUMBER = "is not a number; leave the cell empty where a value is missing."
_DATE_NAMES = ("date", "datum", "day")
_EXCEL = re.compile(r"sep=.?")
"""The line in which Excel notes the delimiter; the one that is found is the same."""
_LONG_INTEGER = re.compile(r"\d{16,19}")
"""Such as nanoseconds since 1970, which doubles would round."""


@dataclass(frozen=True)
class _Table:
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
        found = list(map(_parse_number, cells))
        return np.array(found, dtype=np.float64), np.array([number is None for number in found])


def _parse_number(cell: str) -> float | None:
    """Return the number in a cell, NaN for one that is missing; None for anything else."""
    if is_missing(cell):
        return np.nan
    try:
        return None if "_" in cell else float(cell)
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
    drop_broken = "drop-broken-lines" in options.repair
    table = _read_table(path, drop_broken)
    names, wanted = table.names, None if options.columns is None else _find_columns(table, options.columns)
    time = _find_time(table, wanted or (), options) if options.time is None else _find_column(table, options.time)
    chosen = [k for k in range(len(names)) if k != time] if wanted is None else list(dict.fromkeys(wanted))
    if drop_broken:
        table = _drop_text(table, time, chosen)
    log = _read_times(table, time, options)
    values: dict[str, FloatArray] = {}
    events: list[Event] = []
    issues = []
    if table.broken:
        figures = {"line": float(min(table.broken)), "count": float(len(table.broken)), "repaired": 1.0}
        issues.append(Issue("log: broken lines", (table.source, "line"), figures))
    for k in chosen:
        found, bad = table.parse_column(k)
        if not bad.any() and names.count(names[k]) == 1:
            values[names[k]] = found
        elif wanted is not None:
            _refuse_cell(table, k, table.columns[k], int(bad.argmax()), NO_NUMBER)
        elif names.count(names[k]) > 1:
            issues.append(Issue("log: repeated name", (table.source, names[k])))
        elif _is_text(table.columns[k], bad):
            events += _list_changes(names[k], table.columns[k], log.times)
        else:
            first = int(bad.argmax())
            figures = {"line": float(table.lines[first]), "count": float(bad.sum())}
            issues.append(Issue("log: text", (table.source, "line", names[k], table.columns[k][first]), figures))
    units = {name: table.units[names.index(name)] for name in values}
    labels = {label: names[k] for label, k in table.places.items() if names[k] in values and label not in names}
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
        with explain_damage(path, "a file that is compressed by gzip"):
            data = gzip.decompress(data)
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        with explain_damage(path, "text in UTF-16"):
            return data.decode("utf-16")
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
    delimiter = find_delimiter(kept[:SNIFFED])
    comments = [
        (k, line.strip().lstrip("#% \t")) for k, line in lines[: kept[0][0] - 1] if line.lstrip().startswith(COMMENTS)
    ]
    try:
        head, notes = split_lines(kept[:SNIFFED], delimiter), split_lines(comments[-1:], delimiter)
        names, units, places, first = read_header([cells for _, cells in head], notes[0][1] if notes else [])
        width, body = len(names), kept[first:]
        numbers = None if drop_broken else _parse_block([line for _, line in body], delimiter, width)
        if numbers is not None:
            return _Table(str(path), names, units, places, np.array([k for k, _ in body]), list(numbers.T.copy()))
        rows, broken = _check_widths(split_lines(kept, delimiter)[first:], width, drop_broken)
    except ValueError as error:
        raise InputError(f"{path}, {error}") from error
    if not rows:
        raise InputError(f"{path} has a header but no rows; there is nothing to read.")
    comma = delimiter != "," and _use_decimal_commas(path, rows)  # between commas, 1,234 is rather a thousand
    columns: list[Any] = list(zip(*(cells for _, cells in rows), strict=True))
    return _Table(str(path), names, units, places, np.array([line for line, _ in rows]), columns, comma, broken)


def _parse_block(lines: list[str], delimiter: str, width: int) -> FloatArray | None:
    """Return lines that have numbers alone as an array, (K, width); None for all others, which are split into cells.

    NumPy's reader takes a quarter of the time that cells take.
    """
    text = "\n".join(["", *lines, ""])
    if delimiter != "," and "." not in text:
        text = text.replace(",", ".")
    if delimiter != " ":
        for empty in (2 * delimiter, 2 * delimiter, f"\n{delimiter}", f"{delimiter}\n"):  # pairs may overlap
            text = text.replace(empty, f"{empty[0]}nan{empty[1]}")
    lines = text.split("\n")[1:-1]
    if not lines or _LONG_INTEGER.search(lines[0]):
        return None
    try:
        numbers = np.loadtxt(lines, delimiter=None if delimiter == " " else delimiter, comments=None, ndmin=2)
    except ValueError:
        return None
    return numbers if numbers.shape[1] == width else None


def _check_widths(rows: list[Row], width: int, drop: bool) -> tuple[list[Row], list[int]]:
    """Return rows that have as many cells as there are names, and the lines that have not and are dropped.

    Empty cells at the end do not count.
    """
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
            raise ValueError(
                f"line {line}: {len(cells)} fields where the header has {width}; is a field missing?{hint} "
                "repair='drop-broken-lines' leaves such lines out."
            )
    return kept, broken


def _use_decimal_commas(path: Path, rows: list[Row]) -> bool:
    """Return whether numbers have decimal commas; raise if some have commas and others points."""

    def find(mark: str) -> tuple[int, str] | None:
        numbers = ((line, cell) for line, cells in rows for cell in cells if mark in cell and _NUMBER.fullmatch(cell))
        return next(numbers, None)

    comma, point = find(","), find(".")
    if comma and point:
        raise InputError(
            f"{path} has numbers with decimal commas and with decimal points: {comma[1]!r} in line {comma[0]}, "
            f"{point[1]!r} in line {point[0]}. Export it with one of them."
        )
    return comma is not None


# --- from cells to numbers --------------------------------------------------------------------------------------------


def _find_column(table: _Table, name: str) -> int:
    count = table.names.count(name)
    if count > 1:
        raise InputError(f"{table.source} has {count} columns {shorten(name)}; rename all but one.")
    if name not in table.places:
        raise InputError(f"{table.source} has no column {shorten(name)}; its columns are {join_names(table.names)}.")
    return table.places[name]


def _find_columns(table: _Table, columns: Sequence[str]) -> list[int]:
    """Return the columns of some names; for east, north and up, those of the position on the globe."""
    own = [name for name in columns if name not in FRAME or name in table.places]
    if len(own) < len(columns):
        hdop = [name for name in table.names if name.lower() == "hdop"]
        own += [name for name in [*(find_position(table.names) or []), *hdop] if name not in own]
    return [_find_column(table, name) for name in own]


def _find_time(table: _Table, channels: Sequence[int], options: Options) -> int:
    """Return the column with the times: the first one that is called so, or the first one if it never falls."""
    found = find_time_name(table.places, [table.names[k] for k in channels])
    if found is not None:
        return table.places[found]
    with contextlib.suppress(InputError):  # it has neither numbers nor dates
        times = _read_times(table, 0, options).times
        if len(table.names) > 1 and np.all(np.diff(times) >= 0) and times[-1] > times[0]:
            return 0
    refuse_without_times(table.source, table.names)


def _read_times(table: _Table, column: int, options: Options) -> Log:
    """Return a log with the times of a table, and no channels."""
    name, unit, zone, cells = table.names[column], table.units[column], "", table.columns[column]
    times: NDArray[Any]
    is_text = not isinstance(cells, np.ndarray)
    sample = next((cell for cell in cells if not is_missing(cell)), "") if is_text else ""
    lower = [own.lower() for own in table.names]
    day = next((lower.index(own) for own in _DATE_NAMES if own in lower), None)
    is_clock = _CLOCK.fullmatch(sample) is not None
    if is_clock and day is None:
        what = "is not a time of day such as 12:34:56.789, as the others are."
        times, unit = np.array(_read_cells(table, column, cells, _read_clock, np.nan, what)), "s"
        times = times + DAY * np.cumsum(np.append(0, np.diff(times) < -DAY / 2))  # days go on after midnight
    elif is_date(sample):
        what = "is not a date that can be read; write dates as 2024-05-01T12:34:56.789, or times as numbers."
        if is_clock and day is not None:
            pairs = zip(table.columns[day], cells, strict=True)
            cells = [cell if is_missing(cell) else f"{date} {cell}" for date, cell in pairs]
        dates = _read_cells(table, column, cells, _read_date, (None, None), what)
        times = np.array([instant for instant, _ in dates], dtype="datetime64[us]")
        zones = {zone for _, zone in dates} - {None}
        zone = zones.pop() if len(zones) == 1 else "UTC"
    elif is_text and all(map(_LONG_INTEGER.fullmatch, cells)):
        times = np.array(list(map(int, cells)))
    else:
        times, bad = table.parse_column(column)
        if bad.any():
            _refuse_cell(table, column, cells, int(bad.argmax()), NO_NUMBER)
    return build_log(table.source, {name: times}, {name: unit}, options._replace(time=name), {name: zone})


def _read_cells(
    table: _Table, column: int, cells: Sequence[str], read: Callable[[str], Any], missing: Any, what: str
) -> list[Any]:
    """Return what a function reads in each cell of a column; raise InputError where that is None."""
    found = [missing if is_missing(cell) else read(cell) for cell in cells]
    if None in found:
        _refuse_cell(table, column, cells, found.index(None), what)
    return found


def _refuse_cell(table: _Table, column: int, cells: Sequence[str], row: int, what: str) -> NoReturn:
    raise InputError(f"{table.source}, line {table.lines[row]}, column {table.names[column]!r}: {cells[row]!r} {what}")


def _drop_text(table: _Table, time: int, channels: Sequence[int]) -> _Table:
    """Return the table without the lines that have text in a column of numbers, or no time."""
    broken = np.zeros(len(table.lines), dtype=bool)
    for k in (time, *channels):
        cells, bad = table.columns[k], table.parse_column(k)[1]
        if k == time and is_date(cells[0]):
            bad = np.array([not is_date(cell) for cell in cells])
        if not _is_text(cells, bad):
            broken |= bad
    columns = [list(compress(cells, ~broken)) for cells in table.columns]
    lines = [*table.broken, *table.lines[broken].tolist()]
    return replace(table, lines=table.lines[~broken], columns=columns, broken=lines)


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
