"""Take the rows and channels of a log that a problem file asks for, with times as numbers or as dates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.io.logs.log import Log
from switchfit.io.logs.units import normalize_time_unit
from switchfit.io.problem_file.logs import list_value_columns
from switchfit.io.problem_file.tables import Contents, DataTable, ExperimentTable, InputTable, LogTable, is_date
from switchfit.problem.dates import Dates, as_date
from switchfit.problem.origin import make_origin
from switchfit.problem.time_units import SECONDS_OF_UNIT
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
    columns, times, inside = list_value_columns(table, contents, run), log.times, np.ones(len(log), dtype=bool)
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
    # Inside the window alone: disorder outside does not matter. With the log's own lines, which `Measurements` does not
    # know.
    _check_order(log, times, log.rows[inside], what)
    values = np.stack([log[name][inside] for name in columns], axis=1)
    units = tuple(log.units[log.find_channel(name)] for name in columns)
    if log.dates is not None and _keep_dates(table, log, run):
        return log.dates[inside], values, units
    # The first row that is used, not the first of the log.
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
    # Window and log may be in different zones, or the log in none: compared as instants.
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
    if table.time_scale is not None or log.time_unit in ("", unit) or unit not in SECONDS_OF_UNIT:
        return 1.0 if table.time_scale is None else table.time_scale
    # Nothing is converted silently: guesses, bounds and min_duration in the file are in the unit of the experiment.
    scale = SECONDS_OF_UNIT[log.time_unit] / SECONDS_OF_UNIT[unit]
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
