"""The times of logs in another unit, or counted from the same moment in all logs of a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.io.logs.log import Log
from switchfit.problem.time_units import SECONDS_OF_UNIT, TIMEDELTA_OF_UNIT


def convert_time_unit(log: Log, unit: str) -> Log:
    """Return the log with its times in another unit; times without a unit are taken to be in it."""
    if log.time_unit in ("", unit):
        return replace(log, time_unit=unit)
    # A quotient of integers: 40 ms are 0.04 s.
    length, new = (int(TIMEDELTA_OF_UNIT[each] / TIMEDELTA_OF_UNIT["ns"]) for each in (log.time_unit, unit))
    return _map_times(log, lambda t: t * length / new, log.offset * length / new, unit)


def align_starts(logs: Sequence[Log]) -> list[Log]:
    """Return logs of one run, so that 0 is the same moment in all that have dates: the earliest start among them.

    Parameters
    ----------
    logs : sequence of Log
    """
    # Logs of one run each begin at 0 when they are read; their offsets say how far apart these zeros are.
    starts = [log.offset * SECONDS_OF_UNIT[log.time_unit] for log in logs if log.offset]
    return [_shift_start(log, min(starts)) if log.offset else log for log in logs]


def _shift_start(log: Log, start: float) -> Log:
    shift = log.offset - start / SECONDS_OF_UNIT[log.time_unit]
    return _map_times(log, lambda t: t + shift, log.offset - shift, log.time_unit)


def _map_times(log: Log, change: Callable[[FloatArray], FloatArray], offset: float, time_unit: str) -> Log:
    """Return the log with the times of its samples and its events changed, and what says how to read them."""
    moments = change(np.array([event.time for event in log.events], dtype=np.float64)).tolist()
    events = tuple(event._replace(time=moment) for event, moment in zip(log.events, moments, strict=True))
    return replace(log, times=change(log.times), events=events, offset=offset, time_unit=time_unit)
