"""Open the logs that a problem file names.

Take the rows and channels of a log that a problem file asks for, with times as numbers or as dates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from switchfit.io.logs.log import Log, Options, normalize_time_unit
from switchfit.io.logs.reader import align_starts, read_source
from switchfit.io.problem_file.tables import Contents, DataTable, ExperimentTable, InputTable, LogTable, is_date
from switchfit.io.user_files import build_at
from switchfit.problem.data import FloatArray
from switchfit.problem.dates import SECONDS, Dates, as_date, make_origin
from switchfit.runtime.errors import InputError


def cut_log(
    log: Log, table: DataTable | InputTable, contents: Contents, run: ExperimentTable, what: str
) -> tuple[FloatArray | Dates, FloatArray, tuple[str, ...]]:
    """Return times (K,), which may be dates, and the values of the columns (K, q) in the rows inside the window, and
    their units.

    Parameters
    ----------
    log : Log
    table : DataTable or InputTable
    contents : Contents
    run : ExperimentTable
    what : str
        What is made from them, for messages.
    """
    columns, times, inside = _list_columns(table, contents, run), log.times, np.ones(len(log), dtype=bool)
    if not len(log):  # of a stream
        return times, np.zeros((0, len(columns))), ("",) * len(columns)
    if table.window is not None:
        (first, last), axis = _place_window(log, table, run)
        inside = (axis >= first) & (axis <= last)
        if not inside.any():
            shown = log.dates if any(map(is_date, table.window)) else None
            least, most = (axis.min(), axis.max()) if shown is None else (repr(shown[0]), repr(shown[-1]))
            raise InputError(
                f"{log.source}: no time in column {log.time_name!r} lies in the window [{table.window[0]}, "
                f"{table.window[1]}]; they reach from {least} to {most}."
            )
    times = times[inside]
    _check_order(log, times, log.rows[inside], what)
    values = np.stack([log[name][inside] for name in columns], axis=1)
    units = tuple(log.units[log.find_channel(name)] for name in columns)
    if log.dates is not None and _keep_dates(table, log, run):
        return log.dates[inside], values, units
    offset = times[0] if table.time_offset == "first" else table.time_offset
    return (times - offset) * _find_time_scale(log, table, run.time_unit), values, units


def _place_window(log: Log, table: LogTable, run: ExperimentTable) -> tuple[list[float], FloatArray]:
    """Return the ends of the window, and the times of a log (K,), both as numbers with one origin and one unit."""
    ends = table.window or []
    dated = list(map(is_date, ends))
    if not any(dated):
        return list(ends), log.times + log.offset if table.epoch is not None else log.times
    if not all(dated) or log.dates is None:
        other = "numbers" if log.dates is None else "dates, of which the window has one"
        raise ValueError(f"window = [{ends[0]}, {ends[1]}] has dates, and {log.source} has {other}. Give both alike.")
    zone = run.time_zone or log.time_zone
    dates = log.dates.localize(zone, log.source)
    origin = make_origin(dates.instants[0], zone)
    limits = [float(origin.to_numbers(as_date(end, "window"), "s", "window")) for end in ends]
    return limits, origin.to_numbers(log.dates, "s", log.source)


def _check_order(log: Log, times: FloatArray, rows: NDArray[np.intp], what: str) -> None:
    """Raise for times that do not increase, with the line; a reference may have a time twice."""
    steps = np.diff(times)
    wrong = (steps < 0) if what == "ReferenceSignal" else (steps <= 0)
    if wrong.any():
        k = int(wrong.argmax()) + 1
        repair = "sort" if steps[k - 1] < 0 else "drop-duplicates"
        raise ValueError(
            f"{what} times must increase strictly; in {log.source}, {log.place} {rows[k]}, {times[k]} follows "
            f"{times[k - 1]}. repair = [{repair!r}] mends that, if the log is otherwise right."
        )


def _find_time_scale(log: Log, table: LogTable, time_unit: str) -> float:
    """Return what times are multiplied by; raise if the log states another unit than the experiment."""
    unit = normalize_time_unit(time_unit)
    if table.time_scale is not None or log.time_unit in ("", unit) or unit not in SECONDS:
        return 1.0 if table.time_scale is None else table.time_scale
    scale = SECONDS[log.time_unit] / SECONDS[unit]
    raise InputError(
        f"{log.source}: the times are in {log.time_unit}, but time_unit of the experiment is {time_unit!r}. Set "
        f"time_scale = {scale:.12g} to convert them, or time_unit = {log.time_unit!r}; time_scale = 1 leaves them as "
        "they are."
    )


def _keep_dates(item: LogTable, log: Log, run: ExperimentTable) -> bool:
    """Return whether the times of a log are handed over as dates.

    Those that are written as dates are, unless time_offset or time_scale makes numbers of them; the stamps of a
    recorder, and numbers since 1970, only if the file says that they are dates, or gives a date to compare them with.
    """
    stated = item.epoch is not None or run.origin is not None or run.time_zone is not None or _has_dates(run)
    if item.time_offset == 0.0 and item.time_scale is None:
        return log.has_dates or stated
    if stated:
        raise ValueError(
            f"{log.source} has dates, which are converted to time_unit by themselves: leave out time_offset and "
            "time_scale."
        )
    return False


def _has_dates(run: ExperimentTable) -> bool:
    """Return whether a time of an experiment is given as a date."""
    tables = [*(run.transition_times or ()), *([] if run.tf is None else [run.tf])]
    times = [run.t0, *(time for table in tables for time in (table.value, table.lower, table.upper))]
    return any(map(is_date, [*times, *(time for jump in run.jumps for time in jump.time)]))


Opened = list[tuple[ExperimentTable, list[Log] | ValueError]]
"""The runs of an experiment of a problem file: each with its logs, or with what is wrong with them."""


def open_experiments(
    path: Path, contents: Contents, expanded: Sequence[Sequence[ExperimentTable]], *, streamed: bool = False
) -> list[Opened]:
    """Return the logs of each experiment; raise what is wrong with the first if none of an experiment can be used.

    Parameters
    ----------
    path : Path
        The problem file.
    contents : Contents
    expanded : sequence of sequences of ExperimentTable
        Of each experiment a table for each log that its patterns stand for.
    streamed : bool
        Whether a table without a file has an empty log.
    """
    opened = []
    for k, tables in enumerate(expanded, start=1):
        runs: Opened = []
        for table in tables:
            where = f"{path}: experiments[{k}]"
            try:
                logs = [
                    build_at(f"{where}.{place}", _open_log, path.parent, item, contents, table, streamed)
                    for place, item in table.list_logs().items()
                ]
                runs.append((table, align_starts(logs)))
            except ValueError as error:
                runs.append((table, error))
        errors = [logs for _, logs in runs if isinstance(logs, ValueError)]
        if len(errors) == len(runs):
            raise errors[0]
        opened.append(runs)
    return opened


def _open_log(
    folder: Path, table: DataTable | InputTable, contents: Contents, run: ExperimentTable, streamed: bool
) -> Log:
    columns = list(dict.fromkeys(_list_columns(table, contents, run)))
    if table.file is None and streamed:
        return Log(np.zeros(0), dict.fromkeys(columns, np.zeros(0)), dict.fromkeys(columns, ""), "", "the stream")
    if table.file is None:
        raise ValueError("the key 'file' is missing: name the log, or give logs: switchfit fit LOG ... --problem FILE.")
    given = table.model_dump(include={"time", "topic", "origin", "range_error", "repair"})
    log = read_source(folder / table.file, Options(columns=columns, keep_epoch=True, **given))
    return log if table.epoch is None else _count_from_1970(log, table.epoch)


def _list_columns(table: DataTable | InputTable, contents: Contents, run: ExperimentTable) -> list[str]:
    """Return the columns of a log with values, and after them those that hold sigma, unless parameters do."""
    parameters = {*contents.parameters, *run.parameter_map}
    columns = list(table.columns.values() if isinstance(table.columns, dict) else table.columns)
    given = table.sigma if isinstance(table, DataTable) and isinstance(table.sigma, list) else []
    named = [entry for entry in given if isinstance(entry, str)]
    if not named or all(name in parameters for name in named):
        return columns
    if len(named) < len(given) or any(name in parameters for name in named):
        raise ValueError(
            f"sigma must name columns of the file alone, or parameters and numbers; got {given}, and the "
            f"parameters are {', '.join(sorted(parameters)) or 'none'}."
        )
    return [*columns, *named]


def _count_from_1970(log: Log, unit: str) -> Log:
    """Return a log whose times are numbers since 1970 as one with dates."""
    if log.offset:
        raise ValueError(f"{log.source} has dates already: leave out epoch = {unit!r}.")
    if log.time_unit not in ("", unit):
        raise ValueError(f"{log.source}: the times are in {log.time_unit}, but epoch is {unit!r}.")
    first = float(log.times[0])
    if not first > 0:
        raise ValueError(f"{log.source}: epoch = {unit!r} needs numbers that count from 1970; the first is {first:g}.")
    return replace(log, times=log.times - first, offset=first, time_unit=unit, time_zone="UTC")
