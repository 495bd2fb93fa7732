"""Sentences for what is odd about a log."""

from __future__ import annotations

from functools import partial

from switchfit.report.wording import Sentence, Words, get_figure
from switchfit.runtime.issue import Issue


def _locate(issue: Issue) -> str:
    """Return the file and the line, with how many more lines there are of the kind."""
    source, place = issue.subjects[:2]
    count = get_figure(issue, "count")
    more = f" (and {count - 1:.0f} more)" if count > 1 else ""
    return f"{source}, {place} {get_figure(issue, 'line'):.0f}{more}"


def _add_unit(issue: Issue, name: str) -> str:
    unit = issue.subjects[2]
    return f"{get_figure(issue, name):.6g} {unit}".rstrip()


_REPAIRS = {
    "log: unsorted times": ("repair='sort' sorts by time", "sorted"),
    "log: clock jump": (
        "if these are two recordings, split the file there; if lines are out of order, repair='sort' sorts them",
        "sorted by time",
    ),
    "log: repeated time": ("repair='drop-duplicates' keeps the first sample of each", "the first sample is kept"),
    "log: wrapped angle": ("repair='unwrap:{2}' makes it continuous", "unwrapped"),
}
"""What repairs it, and what to say once that is done."""


def _write_repair(issue: Issue) -> str:
    remedy, repaired = _REPAIRS[issue.kind]
    return repaired if get_figure(issue, "repaired") == 1.0 else remedy.format(*issue.subjects)


LOG_WORDS: Words = {
    "where": _locate,
    "repair": _write_repair,
    **{name: partial(_add_unit, name=name) for name in ("time", "step", "typical")},
}
"""Fields of the sentences."""

LOG_ISSUES: dict[str, Sentence] = {
    "log: unsorted times": "{where}: times are not in order, {time} is written too late; {repair}.",
    "log: clock jump": "{where}: the clock jumps back by {step}, to {time}; {repair}.",
    "log: repeated time": "{where}: the time {time} stands there twice; {repair}.",
    "log: missing times": "{where}: without a time; left out.",
    "log: broken lines": "{where}: broken; left out.",
    "log: damaged sentences": "{where}: no sentence, or with a wrong checksum; left out.",
    "log: no stamps": "{0}: messages of {1} have no stamps; the times are those of the recorder.",
    "log: refused": "Left out: {0}",
    "log: gap": "{where}: a gap of {step} after {time}, where samples are typically {typical} apart.",
    "log: wrapped angle": "{where}: the angle {2!r} jumps by a turn of {turn:.6g}; {repair}.",
    "log: text": "{where}: {3!r} in column {2!r} is not a number, and the column is left out; leave the cell "
    "empty, or repair='drop-broken-lines' leaves out such lines.",
    "log: constant": "{0}: constant in all samples: {1}.",
    "log: empty": "{0}: without any value: {1}.",
    "log: repeated name": "{0} has several columns {1!r}, which are left out; rename all but one.",
}
"""Kind of an issue -> its sentence."""
