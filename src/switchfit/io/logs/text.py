"""Tables of text as logs: CSV in all its dialects, with what the header and the cells say about themselves."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import compress
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.io.logs.cells import CLOCK_TIME, is_date, is_missing, read_clock_cell, read_date_cell
from switchfit.io.logs.columns import build_log, find_time_name
from switchfit.io.logs.local_frame import FRAME_CHANNELS, find_position
from switchfit.io.logs.log import Event, Log
from switchfit.io.logs.options import Options
from switchfit.io.logs.refusals import refuse_without_times
from switchfit.io.logs.text_table import LONG_INTEGER, TextTable, read_table
from switchfit.problem.validation.messages import join_names, shorten
from switchfit.runtime.errors import InputError
from switchfit.runtime.issue import Issue

SECONDS_PER_DAY = 86400.0  # s
NO_NUMBER = "is not a number; leave the cell empty where a value is missing."
_DATE_NAMES = ("date", "datum", "day")


def read_text(path: Path, options: Options) -> Log:
    """Read a table of text; what separates its fields, decimals, names and units is found out.

    Parameters
    ----------
    path : Path
        May be compressed by gzip.
    options : Options
    """
    drop_broken = "drop-broken-lines" in options.repair
    table = read_table(path, drop_broken)
    names, wanted = table.names, None if options.columns is None else _find_columns(table, options.columns)
    time = _find_time(table, wanted or (), options) if options.time is None else _find_column(table, options.time)
    chosen = [k for k in range(len(names)) if k != time] if wanted is None else list(dict.fromkeys(wanted))
    if drop_broken:
        # Before the times are read: a line whose time is broken must not stop them.
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
        # A column is numbers, or text whose changes are events, or it is left out and reported; one that the user has
        # asked for by name must be numbers, or its first other cell is an error.
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


def _find_column(table: TextTable, name: str) -> int:
    count = table.names.count(name)
    if count > 1:
        raise InputError(f"{table.source} has {count} columns {shorten(name)}; rename all but one.")
    if name not in table.places:
        raise InputError(f"{table.source} has no column {shorten(name)}; its columns are {join_names(table.names)}.")
    return table.places[name]


def _find_columns(table: TextTable, columns: Sequence[str]) -> list[int]:
    """Return the columns of some names; for east, north and up, those of the position on the globe."""
    own = [name for name in columns if name not in FRAME_CHANNELS or name in table.places]
    if len(own) < len(columns):
        hdop = [name for name in table.names if name.lower() == "hdop"]
        own += [name for name in [*(find_position(table.names) or []), *hdop] if name not in own]
    return [_find_column(table, name) for name in own]


def _find_time(table: TextTable, channels: Sequence[int], options: Options) -> int:
    """Return the column with the times: the first one that is called so, or the first one if it never falls."""
    found = find_time_name(table.places, [table.names[k] for k in channels])
    if found is not None:
        return table.places[found]
    with contextlib.suppress(InputError):  # it has neither numbers nor dates
        times = _read_times(table, 0, options).times
        if len(table.names) > 1 and np.all(np.diff(times) >= 0) and times[-1] > times[0]:
            return 0
    refuse_without_times(table.source, table.names)


def _read_times(table: TextTable, column: int, options: Options) -> Log:
    """Return a log with the times of a table, and no channels."""
    name, unit, zone, cells = table.names[column], table.units[column], "", table.columns[column]
    times: NDArray[Any]
    is_text = not isinstance(cells, np.ndarray)
    sample = next((cell for cell in cells if not is_missing(cell)), "") if is_text else ""
    lower = [own.lower() for own in table.names]
    day = next((lower.index(own) for own in _DATE_NAMES if own in lower), None)
    # The first cell that is not missing decides for the column; one of another kind further down is an error.
    is_clock = CLOCK_TIME.fullmatch(sample) is not None
    if is_clock and day is None:
        what = "is not a time of day such as 12:34:56.789, as the others are."
        times, unit = np.array(_read_cells(table, column, cells, read_clock_cell, np.nan, what)), "s"
        times = times + SECONDS_PER_DAY * np.cumsum(
            np.append(0, np.diff(times) < -SECONDS_PER_DAY / 2)
        )  # days go on after midnight
    elif is_date(sample):
        what = "is not a date that can be read; write dates as 2024-05-01T12:34:56.789, or times as numbers."
        if is_clock and day is not None:
            pairs = zip(table.columns[day], cells, strict=True)
            cells = [cell if is_missing(cell) else f"{date} {cell}" for date, cell in pairs]
        dates = _read_cells(table, column, cells, read_date_cell, (None, None), what)
        times = np.array([instant for instant, _ in dates], dtype="datetime64[us]")
        zones = {zone for _, zone in dates} - {None}
        zone = zones.pop() if len(zones) == 1 else "UTC"
    elif is_text and all(map(LONG_INTEGER.fullmatch, cells)):
        # Nanoseconds since 1970 stay integers until the first of them is subtracted.
        times = np.array(list(map(int, cells)))
    else:
        times, bad = table.parse_column(column)
        if bad.any():
            _refuse_cell(table, column, cells, int(bad.argmax()), NO_NUMBER)
    return build_log(table.source, {name: times}, {name: unit}, options._replace(time=name), {name: zone})


def _read_cells(
    table: TextTable, column: int, cells: Sequence[str], read: Callable[[str], object], missing: object, what: str
) -> list[Any]:
    """Return what a function reads in each cell of a column; raise InputError where that is None."""
    found = [missing if is_missing(cell) else read(cell) for cell in cells]
    if None in found:
        _refuse_cell(table, column, cells, found.index(None), what)
    return found


def _refuse_cell(table: TextTable, column: int, cells: Sequence[str], row: int, what: str) -> NoReturn:
    raise InputError(f"{table.source}, line {table.lines[row]}, column {table.names[column]!r}: {cells[row]!r} {what}")


def _drop_text(table: TextTable, time: int, channels: Sequence[int]) -> TextTable:
    """Return the table without the lines that have text in a column of numbers, or no time."""
    # A column of text alone, such as the name of a mode, has no numbers to miss: its cells break no line.
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
