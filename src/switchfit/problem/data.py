"""Data of an experiment: whatever adds to its cost J or constrains its end, with dates converted to numbers."""

from __future__ import annotations

from dataclasses import fields, replace

from switchfit.arrays import Converted
from switchfit.problem.costs import RunningCost, TerminalConstraint, TerminalCost, TransitionCost
from switchfit.problem.dates import Dates, list_dates
from switchfit.problem.measurements import Measurements
from switchfit.problem.origin import Origin
from switchfit.problem.reference_signals import ReferenceSignal

Data = Measurements | ReferenceSignal | RunningCost | TransitionCost | TerminalCost | TerminalConstraint


def count_from(item: Converted, origin: Origin, time_unit: str, what: str = "") -> Converted:
    """Return what an experiment is given, dates as numbers of a unit since the origin; anything else as it is.

    Parameters
    ----------
    item : data, input, jump, time or `Parameter`, or a tuple of these
    origin : Origin
    time_unit : str
    what : str, optional
        What messages call it; of data, inputs and jumps their times.
    """
    if isinstance(item, tuple):
        return tuple(count_from(entry, origin, time_unit, what) for entry in item)
    if isinstance(item, Dates):
        return origin.to_numbers(item, time_unit, what)
    if not any(list_dates(item)):
        return item
    what = what or f"times of {type(item).__name__}"
    own = {each.name: count_from(getattr(item, each.name), origin, time_unit, what) for each in fields(item)}
    return replace(item, **own | ({"signal": None} if isinstance(item, ReferenceSignal) else {}))
