"""The options of `read_log`: which there are, and their check."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from switchfit.problem.time_units import SECONDS_OF_UNIT
from switchfit.problem.validation import arrays, names
from switchfit.problem.validation.messages import shorten
from switchfit.runtime.errors import InputError

REPAIRS = ("sort", "drop-duplicates", "drop-missing-times", "drop-broken-lines")
"""Repairs by name; beside them "unwrap:CHANNEL"."""


class Options(NamedTuple):
    """The arguments of `read_log`, which readers of a format are told.

    Attributes
    ----------
    columns, time, time_unit, topic, origin, range_error, repair
        As of `read_log`.
    keep_epoch : bool
        Leave numbers that count from 1970 as they are.
    """

    columns: Sequence[str] | None = None
    time: str | None = None
    time_unit: str | None = None
    topic: str | None = None
    origin: Sequence[float] | None = None
    range_error: float | None = None
    repair: str | Sequence[str] = ()
    keep_epoch: bool = False


def check_options(given: Options) -> Options:
    """Return arguments with names as tuples; raise InputError if one is wrong."""
    columns, repair, error = given.columns, given.repair, given.range_error
    if columns is not None:
        columns = names.as_names(
            (columns,) if isinstance(columns, str) else columns, "columns", "a sequence of strings"
        )
    for what in ("time", "topic"):
        if getattr(given, what) is not None:
            names.as_name(getattr(given, what), what)
    if given.time_unit is not None:
        names.as_choice(given.time_unit, "time_unit", tuple(SECONDS_OF_UNIT))
    error = None if error is None else arrays.as_positive(error, "range_error")
    repair = names.as_names((repair,) if isinstance(repair, str) else repair, "repair", "a sequence of strings")
    for name in repair:
        if name not in REPAIRS and not (name.startswith("unwrap:") and len(name) > len("unwrap:")):
            raise InputError(f"repair must be among {', '.join(REPAIRS)} and unwrap:CHANNEL; got {shorten(name)}.")
    return given._replace(columns=columns, range_error=error, repair=repair)
