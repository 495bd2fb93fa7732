"""Make a `Log` of named columns, of which one has the times: which one, in which unit, from when on."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.io.logs.log import Log
from switchfit.io.logs.options import Options
from switchfit.io.logs.refusals import refuse_without_times
from switchfit.io.logs.units import normalize_time_unit, split_unit
from switchfit.problem.time_units import SECONDS_OF_UNIT, TIME_UNITS
from switchfit.problem.validation.messages import join_names, shorten
from switchfit.runtime.errors import InputError

EPOCH_SECONDS = (9.4e8, 2.6e9)
"""Between which numbers seconds since 1970 lie: the years 1999 to 2052."""

_NAMES = (
    re.compile(
        r"_*(t|times?|timestamps?|stamp|zeit|utc|clock|date_?time|secs?|seconds|millis|micros|elapsed.*|.*[ _]elapsed)"
    ),
    re.compile(
        r"_*(t_(rel|abs|[num]?s|sec|min|h)|(time|timestamp|stamp|zeit)[ _.\-/].*|.*[ _./](time|timestamp|stamp))"
    ),
    re.compile(r"date|datum|days?|hours?|hrs|minutes|mins"),
)
"""Names of columns of times: those of the first kind before those of the second."""

TEMPERATURE = "T"
"""Rather the name of a temperature; of times only if no other column has such a name, as with MATLAB's ``[T, Y]``."""


def find_time_name(names: Iterable[str], channels: Collection[str] = ()) -> str | None:
    """Return the name that is most clearly one of times; None if there is none.

    Parameters
    ----------
    names : iterable of str
    channels : collection of str
        Names that are known to be those of measured values.
    """
    given = list(names)
    # By kind first, then by place: `t` anywhere in the header comes before `elapsed time` in the first column, and that
    # before a column `day`.
    for kind in _NAMES:
        for name in given:
            if kind.fullmatch(name.strip().lower()) and name.strip() != TEMPERATURE:
                return name
    return next((name for name in given if name.strip() == TEMPERATURE and name not in channels), None)


def _find_epoch_unit(time: float) -> str | None:
    """Return the unit in which a number is a time since 1970, None if it is too small for one."""
    low, high = EPOCH_SECONDS
    # The four ranges do not overlap: 53 years are a factor of 2.8, units differ by 1000. So the size of a number tells
    # its unit, if it counts from 1970 at all.
    return next((unit for unit in ("s", "ms", "us", "ns") if low <= time * SECONDS_OF_UNIT[unit] < high), None)


def _are_uptimes(times: FloatArray) -> bool:
    """Return whether times that could be seconds since 1970 are rather microseconds since a start: whole, far apart."""
    steps = np.diff(times)
    if len(steps) == 0 or _find_epoch_unit(float(times[0])) != "s":
        return False
    # 1e9 may be the year 2001, or 1000 s in microseconds. Microseconds of a clock are whole and far apart; seconds of
    # dates are so, too, but then in minutes, as a station logs them.
    step = float(np.median(steps))
    return bool(np.all(times == np.rint(times)) and step >= 1000 and step % 60 != 0)


def build_log(
    source: str,
    columns: Mapping[str, NDArray[Any]],
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
        refuse_without_times(source, columns)
    if time not in columns:
        raise InputError(f"{source} has no column {shorten(time)}; its columns are {join_names(columns)}.")
    # A unit of its own, as a second line of the header has it, is preferred to one in the name.
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
        rows=np.arange(1, len(times) + 1),
        time_name=time,
        time_zone=(zones or {}).get(time, "") if columns[time].dtype.kind == "M" else "UTC",
        has_dates=columns[time].dtype.kind == "M",
    )


def _convert_times(column: NDArray[Any], name: str, unit: str, keep_epoch: bool) -> tuple[FloatArray, str, float]:
    """Return times, their unit, and what was subtracted from them: the first one, if they count from 1970.

    Integers are subtracted as such; doubles would round them. With `keep_epoch` numbers are left as they are.
    """
    second = np.timedelta64(1, "s")
    if column.dtype.kind == "M":
        # Relative to the first date: times as large as 1.7e9 s keep 2e-7 s as doubles, while differences of
        # `datetime64` are exact.
        first = column[~np.isnat(column)][0]
        micros = first.astype("datetime64[us]").astype(np.int64)
        return (column - first) / second, "s", float(micros) / 1e6
    if column.dtype.kind == "m":
        return column / second, "s", 0.0
    numbers = np.asarray(column, dtype=np.float64)
    unit = normalize_time_unit(unit)
    if unit not in SECONDS_OF_UNIT:  # it may be a word in the name, such as in seconds_elapsed or millis
        words = re.split(r"[ _.\-/]", name.lower())
        unit = next((TIME_UNITS[word] for word in words if len(word) > 3 and word in TIME_UNITS), "")
    finite = numbers[np.isfinite(numbers)]
    # A stated unit and the size of the numbers must agree for them to be dates: 1.7e9 stated as ms is 20 days of
    # uptime.
    epoch = _find_epoch_unit(float(finite[0])) if len(finite) else None
    if epoch is None or (unit and unit != epoch) or (not unit and _are_uptimes(finite)):
        return numbers, unit, 0.0
    if keep_epoch:
        return numbers, epoch, 0.0
    # Nanoseconds since 1970 have 19 digits, doubles 15: subtracted as integers, no sample moves.
    if column.dtype.kind in "iu":
        return (column.astype(np.int64) - int(column[0])).astype(np.float64), epoch, float(column[0])
    return numbers - finite[0], epoch, float(finite[0])
