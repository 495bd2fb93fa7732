"""Checks of samples: times and values against each other, and the names and units of channels."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from switchfit.arrays import FloatArray, Traced
from switchfit.problem.dates import FIRST_DAY, Dates, read_dates
from switchfit.problem.time_units import TIMEDELTA_OF_UNIT
from switchfit.problem.validation.arrays import as_array
from switchfit.problem.validation.names import as_labels
from switchfit.problem.validation.objects import as_callable, set_fields

Observe = Callable[..., Traced]
"""``h(t, x, p) -> (q,)``: the output of a sensor."""


class Observed(Protocol):
    """`Measurements` or a `ReferenceSignal`: data that compare an output of the state."""

    @property
    def observe(self) -> Observe | None:
        """The output; None for the whole state."""


def check_samples(
    times: object,
    values: object,
    what: str,
    *,
    at_least: int,
    breaks: bool = False,
    missing: bool = False,
    columns: bool = True,
) -> tuple[FloatArray | Dates, FloatArray]:
    """Return times (K,) and values (K,) or (K, q) as float64, checked against each other; dates remain dates.

    With `breaks`, a time may occur twice; with `missing`, values may be NaN; without
    `columns`, the shape of the values must be (K,).
    """
    dates = read_dates(times, f"{what} times")
    form = "an array of numbers"
    times = as_array(times, f"{what} times", form=form, finite=True) if dates is None else count_seconds(dates)
    values = as_array(values, f"{what} values", form=form, finite=not missing)
    if values.ndim not in ((1, 2) if columns else (1,)) or times.shape != values.shape[:1]:
        raise ValueError(
            f"{what} needs times of shape (K,) and values of shape (K,){' or (K, q)' if columns else ''}; "
            f"got {times.shape} and {values.shape}."
        )
    if len(times) < at_least or not values.shape[-1]:
        raise ValueError(f"{what} needs {max(at_least, 1)} sample(s) or more; got {len(times)}.")
    if np.isinf(values).any():
        raise ValueError(f"{what} values must be finite, or NaN where a sample is missing; got infinity.")
    # Strictly increasing, but for the breaks of a signal, where a time occurs twice and never three times.
    wrong = np.diff(times) <= 0
    if breaks:
        wrong = (np.diff(times) < 0) | np.append(times[2:] == times[:-2], False)
    if wrong.any():
        k = int(np.argmax(wrong))
        shown = times if dates is None else dates
        is_repeated = what == "Measurements" and times[k] == times[k + 1]
        # Two readings of one time are honest data, of two sensors or of one that was read twice: say what to do with
        # them.
        advice = " Samples of the same time go into a second Measurements of the experiment." if is_repeated else ""
        raise ValueError(
            f"{what} times must increase strictly; got {shown[k]} followed by {shown[k + 1]} at index {k + 1}.{advice}"
        )
    # Arrays are shared by copies of an experiment, and programs have read them: a change would go unseen.
    times.flags.writeable = False
    values.flags.writeable = False
    return times if dates is None else dates, values


def count_seconds(dates: Dates) -> FloatArray:
    """Return the seconds since the first of dates."""
    first = dates.instants.min() if dates.instants.size else FIRST_DAY
    return np.asarray((dates.instants - first) / TIMEDELTA_OF_UNIT["s"])


def check_channels(item: Observed, q: int, names: object, units: object) -> None:
    """Check the function of a data item that makes q channels; set their names and units.

    They are those of a table where they are left out.
    """
    if item.observe is not None:
        as_callable(item.observe, "observe", "a function h(t, x, p)")
    for label, found in (("names", names), ("units", units)):
        given = getattr(item, label)
        set_fields(item, **{label: as_labels(found if given is None else given, label, "channel", q)})
