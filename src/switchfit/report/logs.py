"""Sentences for what is odd about a log."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from switchfit.runtime.issue import Issue


def _get(issue: Issue, name: str) -> float:
    value = issue.figures.get(name, np.nan)
    return np.nan if isinstance(value, tuple) else value


def _locate(issue: Issue) -> str:
    """Return the file and the line, with how many more lines there are of the kind."""
    source, place = issue.subjects[:2]
    count = _get(issue, "count")
    more = f" (and {count - 1:.0f} more)" if count > 1 else ""
    return f"{source}, {place} {_get(issue, 'line'):.0f}{more}"


def _add_unit(issue: Issue, name: str) -> str:
    unit = issue.subjects[2]
    return f"{_get(issue, name):.6g} {unit}".rstrip()


def _add_repair(issue: Issue, remedy: str, repaired: str) -> str:
    return repaired if _get(issue, "repaired") == 1.0 else remedy


def _describe_order(issue: Issue) -> str:
    remedy = _add_repair(issue, "repair='sort' sorts by time", "sorted")
    return f"{_locate(issue)}: times are not in order, {_add_unit(issue, 'time')} is written too late; {remedy}."


def _describe_jump(issue: Issue) -> str:
    remedy = _add_repair(
        issue,
        "if these are two recordings, split the file there; if lines are out of order, repair='sort' sorts them",
        "sorted by time",
    )
    step, time = _add_unit(issue, "step"), _add_unit(issue, "time")
    return f"{_locate(issue)}: the clock jumps back by {step}, to {time}; {remedy}."


def _describe_repeated_time(issue: Issue) -> str:
    remedy = _add_repair(issue, "repair='drop-duplicates' keeps the first sample of each", "the first sample is kept")
    return f"{_locate(issue)}: the time {_add_unit(issue, 'time')} stands there twice; {remedy}."


def _describe_gap(issue: Issue) -> str:
    return (
        f"{_locate(issue)}: a gap of {_add_unit(issue, 'step')} after {_add_unit(issue, 'time')}, where samples are "
        f"typically {_add_unit(issue, 'typical')} apart."
    )


def _describe_wrapped_angle(issue: Issue) -> str:
    name = issue.subjects[2]
    remedy = _add_repair(issue, f"repair='unwrap:{name}' makes it continuous", "unwrapped")
    return f"{_locate(issue)}: the angle {name!r} jumps by a turn of {_get(issue, 'turn'):.6g}; {remedy}."


def _describe_text(issue: Issue) -> str:
    *_, name, cell = issue.subjects
    return (
        f"{_locate(issue)}: {cell!r} in column {name!r} is not a number, and the column is left out; leave the cell "
        "empty, or repair='drop-broken-lines' leaves out such lines."
    )


LOG_ISSUES: dict[str, Callable[[Issue], str]] = {
    "log: unsorted times": _describe_order,
    "log: clock jump": _describe_jump,
    "log: repeated time": _describe_repeated_time,
    "log: missing times": lambda issue: f"{_locate(issue)}: without a time; left out.",
    "log: broken lines": lambda issue: f"{_locate(issue)}: broken; left out.",
    "log: damaged sentences": lambda issue: f"{_locate(issue)}: no sentence, or with a wrong checksum; left out.",
    "log: no stamps": lambda issue: (
        f"{issue.subjects[0]}: messages of {issue.subjects[1]} have no stamps; the times are those of the recorder."
    ),
    "log: refused": lambda issue: f"Left out: {issue.subjects[0]}",
    "log: gap": _describe_gap,
    "log: wrapped angle": _describe_wrapped_angle,
    "log: text": _describe_text,
    "log: constant": lambda issue: f"{issue.subjects[0]}: constant in all samples: {issue.subjects[1]}.",
    "log: empty": lambda issue: f"{issue.subjects[0]}: without any value: {issue.subjects[1]}.",
    "log: repeated name": lambda issue: (
        f"{issue.subjects[0]} has several columns {issue.subjects[1]!r}, which are left out; rename all but one."
    ),
}
"""Kind of an issue -> its sentence."""
