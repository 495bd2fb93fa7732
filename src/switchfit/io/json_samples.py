"""Samples as lines of JSON, for an online estimator: what ``switchfit online --stdin`` reads."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from switchfit.problem.dates import as_date
from switchfit.problem.experiment import Experiment
from switchfit.problem.validation import shorten

KEYS = ("t", "y", "u")
"""Of a sample; y and u may be missing."""

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
    except (ValueError, RecursionError) as error:
        raise ValueError(f"a sample is one line of JSON, such as {EXAMPLE}; got {_quote(line)} ({error}).") from error
    if not isinstance(given, dict) or "t" not in given or not set(given) <= set(KEYS):
        raise ValueError(f"a sample has the keys t, y and u, as in {EXAMPLE}; got {_quote(line)}.")
    t, y, u = (given.get(key) for key in KEYS)
    if isinstance(t, str) and run.origin is not None:
        t = float(run.origin.to_numbers(as_date(t, "t"), run.time_unit, "t"))
    return t, _fill(y), u


def _fill(y: Any) -> Any:
    """Return values with NaN for null."""
    if isinstance(y, dict):
        return {name: np.nan if value is None else value for name, value in y.items()}
    return [np.nan if value is None else value for value in y] if isinstance(y, list) else y


def _quote(line: bytes) -> str:
    return shorten(line.decode(errors="replace").strip())
