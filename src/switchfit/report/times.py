"""Times as text: dates where the times of an experiment are dates, otherwise numbers with their unit.

A date is written to a resolution that its standard error allows: days, hours, minutes, seconds and their fractions.
The zone is said once, where the times of an experiment are introduced, and again only beside a date that the clocks of
the zone show twice.
"""

from __future__ import annotations

import datetime
from collections.abc import Iterable
from typing import Any, NamedTuple, Protocol

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.fit.result import Fit
from switchfit.problem.origin import Origin
from switchfit.problem.problem import Problem
from switchfit.problem.time_units import SECONDS_OF_UNIT, normalize_time_unit
from switchfit.problem.validation.messages import unit_suffix
from switchfit.report.numbers import format_rounded, label_quantity
from switchfit.runtime.presentation import format_count

LEAST_ERROR_IN_LAST_PLACES = 5.0
"""Standard error in units of the last place that is shown, at least: 1.3 days are shown to the hour."""

DATE_PLACES = ((86400.0, ""), (3600.0, " %Hh"), (60.0, " %H:%M"), (1.0, " %H:%M:%S"))
"""Seconds of the last place that is shown, and what is shown behind the day."""

MOST_JUMPS = 6
"""Times of jumps that are listed; of more, the first ones and the last."""


class Timed(Protocol):
    """What has times: a trajectory, an experiment, residuals of a channel."""

    @property
    def origin(self) -> Origin | None:
        """The date at which times are 0; None where they are no dates."""

    @property
    def time_unit(self) -> str:
        """Unit of the times."""


class Clock(NamedTuple):
    """What has times where there is no run at hand."""

    origin: Origin | None
    time_unit: str


def format_time(time: float, run: Timed | None, error: float = np.nan, *, digits: int = 6) -> str:
    """Return a time, or the value of an unknown, as text: a date, or a number without its unit.

    Parameters
    ----------
    time : float
    run : Timed or None
        None for what is no time.
    error : float, optional
        Its standard error, from which the resolution of a date follows; if it is not known, a date is written to a
        thousandth of the time unit, as far as there is something to be written.
    digits : int, optional
        Significant digits of a number.
    """
    date = None if run is None or run.origin is None else run.origin.find_date(time, run.time_unit)
    if run is None or date is None:
        return f"{time:.{digits}g}"
    unit = SECONDS_OF_UNIT[normalize_time_unit(run.time_unit)]
    # A date to the place that its error allows; a known one as short as it can be written.
    if np.isfinite(error) and error > 0:
        return format_date(date, error * unit)
    return format_date(date, LEAST_ERROR_IN_LAST_PLACES * unit / 1000, short=True)


def format_date(date: datetime.datetime, error: float, *, short: bool = False) -> str:
    """Return a date to the place that a standard error in seconds allows.

    Parameters
    ----------
    date : datetime
    error : float
    short : bool, optional
        Leave out hours, minutes and seconds that are zero.
    """
    seconds, form = next(
        ((s, form) for s, form in DATE_PLACES if error >= LEAST_ERROR_IN_LAST_PLACES * s), (0.0, " %H:%M:%S.%f")
    )
    digits = 0 if seconds else min(max(int(np.ceil(-np.log10(max(error, 1e-6) / LEAST_ERROR_IN_LAST_PLACES))), 1), 6)
    # Half of the last place is added, and the rest cut off: rounding, which may carry into the next day. Days alone are
    # not rounded: noon belongs to its day.
    half = 0.0 if form == "" else 0.5 * (seconds or 10.0**-digits)
    rounded = date.replace(tzinfo=None) + datetime.timedelta(seconds=half)
    text = rounded.strftime(form)
    text = text[: len(text) - 6 + digits] if digits else text
    if short:
        text = text.rstrip("0").rstrip(".") if "." in text else text
        text = text[:6] if text.endswith(":00") and text.count(":") == 2 else text
        text = "" if text in (" 00:00", " 00h") else text
    return f"{rounded:%Y-%m-%d}{text}{_tell_apart(date) if text else ''}"


def format_iso(time: float, run: Timed) -> str:
    """Return a time of a run with dates as a date in ISO 8601, "" if it is no date, as one that is not finite."""
    date = None if run.origin is None else run.origin.find_date(time, run.time_unit)
    return "" if date is None else date.isoformat()


def format_span(first: float, last: float, run: Timed) -> str:
    """Return two times as text: "0 to 6 h", or "2020-03-02 to 2020-04-21"."""
    return f"{format_time(first, run)} to {format_time(last, run)}{suffix_time(run)}"


def suffix_time(run: Timed) -> str:
    """Return what stands behind a time: its unit, such as " h"; nothing behind a date."""
    return unit_suffix(run.time_unit) if run.origin is None else ""


def describe_origin(run: Timed) -> str:
    """Return what the numbers of dated times are, such as "d since 2020-02-29, Europe/Berlin"; "" for other times."""
    if run.origin is None:
        return ""
    zone = f", {run.origin.time_zone}" if run.origin.time_zone else ", no time zone"
    return f"{run.time_unit} since {format_time(0.0, run, 0.0)}{zone}"


def label_time(run: Timed, name: str = "time") -> str:
    """Return the label of an axis of times, such as "time (min)"; with the zone where times are dates."""
    return label_quantity(name, run.time_unit if run.origin is None else run.origin.time_zone)


def list_dated(result: Fit | Problem) -> list[Timed | None]:
    """Return what has each unknown that is a time with dates as a time: its run; None for every other unknown."""
    if isinstance(result, Problem):
        pairs: Iterable[tuple[Timed, Any]] = zip(result.experiments, result.unknowns.times, strict=True)
    else:
        places = map(np.append, result.transition_places, result.final_places)
        pairs = zip(result.trajectories, places, strict=True)
    # Places of -1 are times that are known.
    found: list[Timed | None] = [None] * len(result.theta_names)
    for run, own in pairs:
        for place in own[own >= 0].tolist() if run.origin is not None else ():
            found[place] = run
    return found


def _tell_apart(date: datetime.datetime) -> str:
    """Return the offset from UTC of a date that the clocks of its zone show twice; "" for any other."""
    # Both foldings of the hour that is repeated in autumn have the same text but for the offset.
    if date.tzinfo is None or date.replace(fold=0).utcoffset() == date.replace(fold=1).utcoffset():
        return ""
    return f"{date:%z}"


def describe_clock(run: Timed) -> dict[str, Any] | None:
    """Return how a page's script shows times as dates; None where they are no dates.

    It is given the milliseconds since 1970 at 0, those of a unit, the zone, and its name as the user gave it. Browsers
    know names of zones, but not all of them know offsets: these are added to the start.

    Parameters
    ----------
    run : Timed
    """
    if run.origin is None:
        return None
    named, zone = run.origin.time_zone, run.origin.zone
    # A fixed offset is a `datetime.timezone`; a named zone has no offset without a date.
    offset = zone.utcoffset(None) if isinstance(zone, datetime.timezone) else None
    shift = 0.0 if offset is None else 1e3 * offset.total_seconds()
    length = 1e3 * SECONDS_OF_UNIT[normalize_time_unit(run.time_unit)]
    known = "UTC" if offset is not None else named or "UTC"
    return {"start": run.origin.instant.astype(np.int64) / 1e3 + shift, "length": length, "zone": known, "named": named}


def format_estimate(value: float, error: float, run: Timed | None) -> tuple[str, str]:
    """Return the estimate of an unknown, a date or rounded, and "± error".

    Parameters
    ----------
    value, error : float
        With its standard error.
    run : Timed or None
    """
    number, spread, _ = format_rounded(value, error)
    return number if run is None or run.origin is None else format_time(value, run, error), spread


def list_jumps(times: FloatArray, run: Timed) -> str:
    """Return how many jumps there are, and when; empty if there are none.

    Parameters
    ----------
    times : (K,) array
    run : Timed
        Of which they are: dates if its times are dates.
    """
    shown = [format_time(time, run) for time in times.tolist()]
    # Doses of weeks: the first ones show the pattern, the last one the end.
    if len(shown) > MOST_JUMPS:
        shown = [*shown[: MOST_JUMPS - 2], "...", shown[-1]]
    return f"{format_count(len(times), 'jump')} at {', '.join(shown)}{suffix_time(run)}" if shown else ""
