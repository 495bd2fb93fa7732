"""Take the rows and channels of a log that a problem file asks for, with times as numbers or as dates."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.io.logs.log import Log
from switchfit.io.logs.units import SECONDS, normalize_time_unit
from switchfit.io.problem_file.tables import ExperimentTable, LogTable, is_date
from switchfit.problem.data import FloatArray
from switchfit.problem.dates import Dates, as_dates, make_origin
from switchfit.runtime.errors import InputError


def cut_log(
    log: Log, table: LogTable, columns: Sequence[str], run: ExperimentTable, what: str
) -> tuple[FloatArray | Dates, FloatArray, tuple[str, ...]]:
    """Return times (K,), which may be dates, and the values of some columns (K, q) in the rows inside the window, and
    their units.

    Parameters
    ----------
    log : Log
    table : LogTable
    columns : sequence of str
    run : ExperimentTable
    what : str
        What is made from them, for messages.
    """
    times, inside = log.times, np.ones(len(log), dtype=bool)
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
    offset = times[0] if table.time_offset is None else table.time_offset
    values = np.stack([log[name][inside] for name in columns], axis=1)
    units = tuple(log.units[log.find_channel(name)] for name in columns)
    if log.dates is not None and _keep_dates(table, log, run):
        return log.dates[inside], values, units
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
    dates = log.dates.localize(zone, log.source) if zone else log.dates
    origin = make_origin(int(dates.instants[0]), zone)
    limits = [float(origin.to_numbers(as_dates(end, "window"), "s", "window")) for end in ends]
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


def find_origin(table: ExperimentTable, logs: Sequence[Log]) -> Any:
    """Return the date at which times are 0: as stated, else t0, else the beginning of the earliest log with dates.

    Parameters
    ----------
    table : ExperimentTable
    logs : sequence of Log
        Of its data and inputs.
    """
    if table.origin is not None or is_date(table.t0):
        return table.origin
    dated = [log for item, log in zip(table.list_logs().values(), logs, strict=True) if _keep_dates(item, log, table)]
    zones = {log.time_zone for log in dated}
    if not dated or ("" in zones and len(zones) > 1 and table.time_zone is None):
        return None  # the experiment says which dates have zones and which have none
    zone = table.time_zone or (zones.pop() if len(zones) == 1 else "UTC")
    starts = [
        as_dates(log.start if log.time_zone else log.start.replace(tzinfo=None), "origin") for log in dated if log.start
    ]
    return make_origin(min(int((start.localize(zone, "origin") if zone else start).instants) for start in starts), zone)


def _keep_dates(item: LogTable, log: Log, run: ExperimentTable) -> bool:
    """Return whether the times of a log are handed over as dates.

    Those that are written as dates are, unless time_offset or time_scale makes numbers of them; the stamps of a
    recorder, and numbers since 1970, only if the file says that they are dates, or gives a date to compare them with.
    """
    if not log.offset:
        return False
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
