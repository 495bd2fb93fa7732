"""Columns of numbers that a library has read, as a log."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from switchfit.io.logs.log import FloatArray, Log, Options
from switchfit.io.logs.times import find_time_name, interpret_times, subtract_first
from switchfit.io.logs.units import SECONDS, split_unit
from switchfit.problem.validation import join_names, shorten
from switchfit.runtime.errors import InputError


def stack_records(records: Sequence[Mapping[str, float]]) -> dict[str, FloatArray]:
    """Return the entries of all records by name, NaN where a record lacks one; in the order in which they appear."""
    names = dict.fromkeys(name for record in records for name in record)
    return {name: np.array([record.get(name, np.nan) for record in records], dtype=np.float64) for name in names}


def build_log(
    source: str,
    columns: Mapping[str, Any],
    units: Mapping[str, str],
    options: Options,
    zones: Mapping[str, str] | None = None,
) -> Log:
    """Return a log from columns, one of which has the times.

    Parameters
    ----------
    source : str
    columns : mapping of str to (K,) array
        Of numbers, or of ``datetime64`` where they are dates.
    units : mapping of str to str
        Those that are stated; others may stand in the names.
    options : Options
    zones : mapping of str to str, optional
        Time zones of columns of dates, which are in UTC then.

    Raises
    ------
    InputError
        If there is no such column.
    """
    time = find_time_name(list(columns)) if options.time is None else options.time
    if time is None:
        raise InputError(
            f"{source}: no column is called time; its columns are {join_names(columns)}. Name the one with the times: "
            "time = ..."
        )
    if time not in columns:
        raise InputError(f"{source} has no column {shorten(time)}; its columns are {join_names(columns)}.")
    stated = {name: units.get(name, "") or split_unit(name)[1] for name in columns}
    if columns[time].dtype.kind not in "biufMm":
        raise InputError(
            f"{source}: column {time!r} has neither numbers nor dates. Name the one with the times: time = ..."
        )
    times, time_unit, offset = _convert_times(columns[time], time, stated[time], options.keep_epoch)
    values = {
        name: np.asarray(column, dtype=np.float64)
        for name, column in columns.items()
        if name != time and column.dtype.kind in "biuf"
    }
    labels = {name: split_unit(name)[0] for name in values}
    return Log(
        times=times,
        values=values,
        units={name: stated[name] for name in values},
        time_unit=time_unit,
        source=source,
        offset=offset,
        labels={short: name for name, short in labels.items() if short not in values},
        time_name=time,
        time_zone=(zones or {}).get(time, "") if columns[time].dtype.kind == "M" else "UTC",
        has_dates=columns[time].dtype.kind == "M",
    )


def _convert_times(column: Any, name: str, unit: str, keep_epoch: bool) -> tuple[FloatArray, str, float]:
    if column.dtype.kind == "M":
        nanoseconds = column.astype("datetime64[ns]")
        missing = np.isnat(nanoseconds)
        times, _, first = subtract_first(nanoseconds.astype(np.int64)[~missing].tolist(), "ns")
        seconds = np.full(len(column), np.nan)
        seconds[~missing] = times * SECONDS["ns"]
        return seconds, "s", first * SECONDS["ns"]
    if column.dtype.kind == "m":
        return column.astype("timedelta64[ns]").astype(np.int64) * SECONDS["ns"], "s", 0.0
    return interpret_times(np.asarray(column, dtype=np.float64), name, unit, keep_epoch=keep_epoch)
