"""Lines of JSON of `switchfit online`: a sample that is read, an answer that is written."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from switchfit.cli.summaries import pick_attributes
from switchfit.online.state import Now
from switchfit.problem.dates import as_date
from switchfit.problem.experiment import Experiment
from switchfit.problem.validation.messages import shorten
from switchfit.report import times

EXAMPLE = '{"t": 0.1, "y": [1.2, 0.3]} or {"t": 0.1, "y": {"X": 1.2}, "u": {"force": 4.0}}'


def read_sample(line: bytes, run: Experiment) -> tuple[Any, Any, Any]:
    """Return t, y and u of a line, for `OnlineEstimator.update`; null is a missing value.

    Parameters
    ----------
    line : bytes
    run : Experiment
        If it has an origin, t may be a date.

    Raises
    ------
    ValueError
        If the line is no JSON object with t; what the values must be, the estimator checks.
    """
    try:
        given = json.loads(line)
    # Also text in no encoding, and lists in lists without end: a stream may send anything.
    except (ValueError, RecursionError):
        given = None
    if not isinstance(given, dict) or "t" not in given or not set(given) <= {"t", "y", "u"}:
        got = shorten(line.decode(errors="replace").strip())
        raise ValueError(f"a sample is one line of JSON with the keys t, y and u, such as {EXAMPLE}; got {got}.")
    t, y, u = (given.get(key) for key in "tyu")
    # Without an origin a text as t is left to the estimator, whose message says what it must be.
    if isinstance(t, str) and run.origin is not None:
        t = float(run.origin.to_numbers(as_date(t, "t"), run.time_unit, "t"))
    return t, _fill(y), u


def _fill(y: object) -> object:
    """Return values with NaN for null."""
    if isinstance(y, dict):
        return {name: np.nan if value is None else value for name, value in y.items()}
    return [np.nan if value is None else value for value in y] if isinstance(y, list) else y


def summarize_now(now: Now, run: Experiment) -> dict[str, Any]:
    """Return what an online estimator says after a sample; where times are dates, also its date and that of the mode.

    Parameters
    ----------
    now : Now
    run : Experiment
    """
    found = {
        "t": now.time,
        **pick_attributes(now, "mode", "since", "mode_sequence", "transition_times", "mode_probability"),
        **pick_attributes(now, "parameters", "standard_errors", "statistic", "threshold"),
        "status": now.status.name,
        "alarm": None if now.alarm is None else now.alarm._asdict(),
        "retracted": None if now.retracted is None else now.retracted._asdict(),
        "seconds": now.seconds,
    }
    if run.origin is not None:
        found |= {"date": times.format_iso(now.time, run), "since_date": times.format_iso(now.since, run)}
    return found
