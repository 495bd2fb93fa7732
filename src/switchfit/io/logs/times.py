"""Which column has the times, in which unit they are, and whether they count from 1970."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence

import numpy as np

from switchfit.io.logs.log import FloatArray
from switchfit.io.logs.units import SECONDS, find_epoch_unit, find_spelled_unit, normalize_time_unit

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
    for kind in _NAMES:
        for name in given:
            if kind.fullmatch(name.strip().lower()) and name.strip() != TEMPERATURE:
                return name
    return next((name for name in given if name.strip() == TEMPERATURE and name not in channels), None)


def interpret_times(
    numbers: FloatArray, name: str, unit: str, *, keep_epoch: bool = False
) -> tuple[FloatArray, str, float]:
    """Return times, their unit, and what was subtracted from them.

    Parameters
    ----------
    numbers : (K,) array
        As they stand in the file.
    name : str
        Of the column, which may say the unit.
    unit : str
        As the file states it; "" if it does not.
    keep_epoch : bool, optional
        Leave times that count from 1970 as they are; otherwise the first one is subtracted.
    """
    unit = normalize_time_unit(unit)
    unit = unit if unit in SECONDS else find_spelled_unit(name)
    finite = numbers[np.isfinite(numbers)]
    epoch = find_epoch_unit(float(finite[0])) if len(finite) else None
    if epoch is None or (unit and unit != epoch) or (not unit and _are_uptimes(finite)):
        return numbers, unit, 0.0
    return (numbers, epoch, 0.0) if keep_epoch else (numbers - finite[0], epoch, float(finite[0]))


def subtract_first(counts: Sequence[int], unit: str) -> tuple[FloatArray, str, float]:
    """Return integers since 1970 as times from the first one on; doubles would round nanoseconds."""
    integers = np.array(counts, dtype=np.int64)
    return (integers - integers[0]).astype(np.float64), unit, float(integers[0])


def _are_uptimes(times: FloatArray) -> bool:
    """Return whether times that could be seconds since 1970 are rather microseconds since a start: whole, far apart."""
    steps = np.diff(times)
    if len(steps) == 0 or find_epoch_unit(float(times[0])) != "s":
        return False
    step = float(np.median(steps))
    return bool(np.all(times == np.rint(times)) and step >= 1000 and step % 60 != 0)
