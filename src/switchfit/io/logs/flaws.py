"""Flaws of logs, found and repaired where asked for: disordered times, gaps, wrapped angles, constants."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.io.logs.log import Log
from switchfit.problem.validation.messages import join_names, shorten
from switchfit.runtime.errors import InputError
from switchfit.runtime.issue import Issue

GAP = 5.0
"""Length of an interval, in typical ones, from which on it is a gap."""

MOST_GAPS = 0.1
"""Share of the intervals beyond which long ones are no gaps but how the log was sampled."""

REORDERED_WITHIN_STEPS = 5.0
"""By how many typical intervals times may fall where samples were only written in another order."""

_ANGLE = re.compile(r".*(yaw|heading|course|azimuth|theta|psi|angle|hdg|cog|bearing).*|ang", re.IGNORECASE)


def inspect_log(log: Log, repairs: Sequence[str]) -> Log:
    """Return the log with its issues, and repaired where asked for."""
    issues = list(log.issues)
    # The order of `_FLAWS` matters: without times there is no order, and only in sorted times do equal ones stand side
    # by side. Each search sees what the repairs before it have left.
    for name, find in _FLAWS.items():
        kind, flawed, kept, figures = find(log)
        if not flawed.any():
            continue
        first, repaired = int(flawed.argmax()), name in repairs
        # A sample without a time has no place; all other flaws leave a log that can be looked at, and are reported.
        if name == "drop-missing-times" and not repaired:
            raise InputError(
                f"{log.source}, column {log.time_name!r}: the time of sample {first + 1} is missing ({log.place} "
                f"{log.rows[first]}). repair='{name}' leaves such samples out."
            )
        figures |= {"count": flawed.sum(), "time": log.times[first]}
        issues.append(_make_issue(kind, log, first, None, repaired=repaired, **figures))
        log = _pick_samples(log, kept) if repaired else log
    # After the repairs: a pause that only disorder has hidden is a gap now.
    issues += _find_gaps(log)
    wrapped = [repair.removeprefix("unwrap:") for repair in repairs if repair.startswith("unwrap:")]
    log = _handle_angles(log, [log.find_channel(name) for name in wrapped], issues)
    issues += _find_constants(log)
    return replace(log, issues=tuple(issues))


def _find_missing(log: Log) -> tuple[str, NDArray[np.bool_], NDArray[Any], dict[str, float]]:
    missing = ~np.isfinite(log.times)
    return "log: missing times", missing, ~missing, {}


def _find_falls(log: Log) -> tuple[str, NDArray[np.bool_], NDArray[Any], dict[str, float]]:
    steps = np.append(0.0, np.diff(log.times))[: len(log)]
    falls = steps < 0
    # A logger of several sensors writes samples out of turn by a few intervals; a clock that is set, or a second
    # recording in the same file, falls farther. Sorting repairs the first, and mixes the second.
    far = -steps[falls].min(initial=0.0) > REORDERED_WITHIN_STEPS * _find_typical_step(log.times)  # not so beside NaN
    kind = "log: clock jump" if far else "log: unsorted times"
    return kind, falls, np.argsort(log.times, kind="stable"), {"step": -steps[falls][:1].sum()}


def _find_repeats(log: Log) -> tuple[str, NDArray[np.bool_], NDArray[Any], dict[str, float]]:
    same = np.append(False, np.diff(log.times) == 0)[: len(log)]
    return "log: repeated time", same, ~same, {}


_FLAWS = {"drop-missing-times": _find_missing, "sort": _find_falls, "drop-duplicates": _find_repeats}
"""What may be odd about times, by its repair: kind of issue, in which samples, what a repair keeps, more figures."""


def _find_gaps(log: Log) -> list[Issue]:
    steps, typical = np.diff(log.times), _find_typical_step(log.times)
    long = steps > GAP * typical
    # Where a tenth of the intervals is long, the log was sampled in bursts or on events: then nothing is missing. Five
    # intervals are too few to say what is typical.
    if not long.any() or long.sum() > max(1.0, MOST_GAPS * len(steps)) or len(steps) < 5:
        return []
    longest = int(np.argmax(steps))
    figures = {"count": long.sum(), "step": steps[longest], "typical": typical, "time": log.times[longest]}
    return [_make_issue("log: gap", log, longest + 1, **figures)]


def _handle_angles(log: Log, unwrapped: Sequence[str], issues: list[Issue]) -> Log:
    values = dict(log.values)
    for name, samples in log.values.items():
        turn = _find_turn(name, log.units.get(name, ""), samples, name in unwrapped)
        if turn is None:
            continue
        known = np.flatnonzero(np.isfinite(samples))
        steps = np.abs(np.diff(samples[known]))
        jumps = steps > turn / 2
        # A jump of more than half a turn may be a wrap; it is one if most steps are small. A channel that jumps all the
        # time, as noise or a counter does, is left alone.
        if jumps.any() and np.median(steps) < turn / 4:
            first = int(known[int(jumps.argmax()) + 1])
            figures = {"count": jumps.sum(), "turn": turn, "repaired": name in unwrapped}
            issues.append(_make_issue("log: wrapped angle", log, first, name, **figures))
        if name in unwrapped:
            values[name] = samples.copy()
            values[name][known] = np.unwrap(samples[known], period=turn)
    return replace(log, values=values)


def _find_turn(name: str, unit: str, samples: FloatArray, asked: bool) -> float | None:
    """Return a full turn in the unit of a channel, None if it is no angle."""
    known = samples[np.isfinite(samples)]
    if len(known) < 2:
        return None
    if unit in ("deg", "°", "degree", "degrees", "rad"):
        return 2 * np.pi if unit == "rad" else 360.0
    # Without a unit the range decides: an angle that spans more than 2.2 pi cannot be one in rad, wrapped.
    if unit == "" and (asked or _ANGLE.fullmatch(name)):
        return 360.0 if np.ptp(known) > 2.2 * np.pi else 2 * np.pi
    if asked:
        raise InputError(f"repair='unwrap:{name}' needs an angle in rad or deg; its unit is {shorten(unit)}.")
    return None


def _find_constants(log: Log) -> list[Issue]:
    if len(log) < 3:
        return []
    known = {name: samples[np.isfinite(samples)] for name, samples in log.values.items()}
    empty = [name for name, samples in known.items() if len(samples) == 0]
    constant = [name for name, samples in known.items() if len(samples) > 2 and np.all(samples == samples[0])]
    return [
        Issue(kind, (log.source, join_names(names)), {"count": float(len(names))})
        for kind, names in (("log: constant", constant), ("log: empty", empty))
        if names
    ]


def _find_typical_step(times: FloatArray) -> float:
    """Return the median of the intervals that are positive; NaN if none is."""
    steps = np.diff(times)
    rising = steps[steps > 0]
    return float(np.median(rising)) if len(rising) else np.nan


def _pick_samples(log: Log, places: NDArray[np.intp]) -> Log:
    values = {name: samples[places] for name, samples in log.values.items()}
    return replace(log, times=log.times[places], values=values, rows=log.rows[places])


def _make_issue(kind: str, log: Log, sample: int, channel: str | None = None, **figures: float) -> Issue:
    """Return an issue about a sample; its last subject is the channel, or the unit of the times."""
    subject = log.time_unit if channel is None else channel
    numbers = {name: float(value) for name, value in figures.items()}
    return Issue(kind, (log.source, log.place, subject), {"line": float(log.rows[sample]), **numbers})
