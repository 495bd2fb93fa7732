"""Numbers, times and tables as text.

Times as text: dates where the times of an experiment are dates, otherwise numbers with their unit.

A date is written to a resolution that its standard error allows: days, hours, minutes, seconds and their fractions.
The zone is said once, where the times of an experiment are introduced, and again only beside a date that the clocks of
the zone show twice.
"""

from __future__ import annotations

import datetime
import sys
import textwrap
from collections.abc import Collection, Iterable, Sequence, Sized
from typing import Any, NamedTuple, Protocol

import numpy as np

from switchfit.batch.fits import Fits
from switchfit.fit.result import Fit
from switchfit.fit.trajectory import Comparison, Trajectory
from switchfit.problem.data import FloatArray
from switchfit.problem.dates import SECONDS, Origin, normalize_time_unit
from switchfit.problem.parameter import unit_suffix
from switchfit.problem.problem import Problem
from switchfit.runtime.presentation import format_count


def format_rounded(value: float, error: float) -> tuple[str, str, str]:
    """Return value, "± error" and "(relative error)" as text, the value to the two significant digits of its error.

    Parameters
    ----------
    value, error : float
        An error that is NaN is left away; one of 0 says that the value is held.
    """
    if not np.isfinite(error) or error <= 0.0 or not np.isfinite(value):
        return f"{value:.8g}", "held" if error == 0.0 else "", ""
    last = 1 - _find_exponent(error)  # decimal place of the second digit of the error
    if value != 0.0:
        last = max(last, 1 - _find_exponent(value))
    relative = f"({100 * error / abs(value):.2g} %)" if abs(value) > error / 10 else ""
    if 1e-4 <= max(abs(value), error) < 1e7:
        return f"{value:.{max(last, 0)}f}", f"± {error:.{max(last, 0)}f}", relative
    digits = max(last + _find_exponent(value), 1) if value != 0.0 else 1
    return f"{value:.{digits}e}", f"± {error:.1e}", relative


def _find_exponent(number: float) -> int:
    return int(np.floor(np.log10(abs(number))))


def format_unit(unit: str) -> str:
    """Return a unit as it is shown: nothing for "1", a pure number."""
    return "" if unit == "1" else unit


def label_quantity(name: str, unit: str) -> str:
    """Return the label of an axis: name and unit, such as "tau_1 (h)"; the name alone for a pure number.

    Parameters
    ----------
    name, unit : str
    """
    unit = format_unit(unit)
    return f"{name} ({unit})" if unit else name


def wrap_quantity(name: str, unit: str = "") -> str:
    """Return the label of an upright axis, as `label_quantity`, in lines no longer than a panel is high.

    Parameters
    ----------
    name, unit : str
    """
    return textwrap.fill(label_quantity(name, unit), 20)


def get_unit(comparison: Comparison, channel: int, trajectory: Trajectory) -> str:
    """Return the unit of a channel as it is shown: its own, or that of the state of the same name.

    "" if it is unknown, and for a pure number.

    Parameters
    ----------
    comparison : Comparison
    channel : int
        Which channel, from 0.
    trajectory : Trajectory
        Of the same experiment.
    """
    if comparison.units and comparison.units[channel]:
        return format_unit(comparison.units[channel])
    units = dict(zip(trajectory.state_names, trajectory.state_units, strict=True))
    return format_unit(units.get(comparison.names[channel], ""))


ENOUGH = 5.0
"""Standard error in units of the last place that is shown, at least: 1.3 days are shown to the hour."""
PLACES = ((86400.0, ""), (3600.0, " %Hh"), (60.0, " %H:%M"), (1.0, " %H:%M:%S"))
"""Seconds of the last place that is shown, and what is shown behind the day."""


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
    unit = SECONDS[normalize_time_unit(run.time_unit)]
    if np.isfinite(error) and error > 0:
        return format_date(date, error * unit)
    return format_date(date, ENOUGH * unit / 1000, short=True)


def format_date(date: datetime.datetime, error: float, *, short: bool = False) -> str:
    """Return a date to the place that a standard error in seconds allows.

    Parameters
    ----------
    date : datetime
    error : float
    short : bool, optional
        Leave out hours, minutes and seconds that are zero.
    """
    seconds, form = next(((s, form) for s, form in PLACES if error >= ENOUGH * s), (0.0, " %H:%M:%S.%f"))
    digits = 0 if seconds else min(max(int(np.ceil(-np.log10(max(error, 1e-6) / ENOUGH))), 1), 6)
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


def list_dated(result: Fit | Problem | Fits) -> list[Timed | None]:
    """Return what has each unknown that is a time with dates as a time: its run; None for every other unknown."""
    if isinstance(result, Fits):
        origins = zip(result.date_origins, result.theta_units, strict=True)
        return [None if origin is None else Clock(origin, unit) for origin, unit in origins]
    if isinstance(result, Problem):
        pairs: Iterable[tuple[Timed, Any]] = zip(result.experiments, result.unknowns.times, strict=True)
    else:
        places = map(np.append, result.transition_places, result.final_places)
        pairs = zip(result.trajectories, places, strict=True)
    found: list[Timed | None] = [None] * len(result.theta_names)
    for run, own in pairs:
        for place in own[own >= 0].tolist() if run.origin is not None else ():
            found[place] = run
    return found


def _tell_apart(date: datetime.datetime) -> str:
    """Return the offset from UTC of a date that the clocks of its zone show twice; "" for any other."""
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
    offset = zone.utcoffset(None) if isinstance(zone, datetime.timezone) else None
    shift = 0.0 if offset is None else 1e3 * offset.total_seconds()
    length = 1e3 * SECONDS[normalize_time_unit(run.time_unit)]
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


Row = Sequence[str]
Rows = Sequence[Row]


class Table(NamedTuple):
    """Cells as text.

    Attributes
    ----------
    rows : sequence of sequences of str, of the same length each
    alignment : str
        A character for each column: "<" aligns it to the left, ">" to the right.
    titles : sequence of str
        Of the columns; empty for a table without a header.
    """

    rows: Rows
    alignment: str
    titles: Row = ()

    @property
    def columns(self) -> list[int]:
        """Columns that have an entry in some row; the others are left out."""
        return [k for k in range(len(self.alignment)) if any(row[k] for row in self.rows)]


WIDTH = 100
"""Columns of a report, where names allow it."""

MOST_JUMPS = 6
"""Times of jumps that are listed; of more, the first ones and the last."""


def format_table(
    rows: Rows, alignment: str, titles: Row = (), *, indent: str = "  ", most: int = sys.maxsize, where: str = ""
) -> list[str]:
    """Return the lines of a table with its columns aligned, two spaces between them.

    Parameters
    ----------
    rows, alignment, titles
        As of `Table`.
    indent : str, optional
        What every line begins with.
    most : int, optional
        Of more rows the first are listed, and the others counted.
    where : str, optional
        Where the others are, behind their number.
    """
    shown = rows[:most]
    columns, written = Table(shown, alignment).columns, [titles, *shown] if titles and rows else shown
    widths = {k: max(len(row[k]) for row in written) for k in columns}
    lines = [(indent + "  ".join(f"{row[k]:{alignment[k]}{widths[k]}}" for k in columns)).rstrip() for row in written]
    return lines + ([f"{indent}and {len(rows) - most} more{where}"] if len(rows) > most else [])


def join_sections(*sections: Sequence[str]) -> str:
    """Return sections as text, with an empty line between them; those without a line are left out.

    Parameters
    ----------
    sections : sequence of str
        The lines of each.
    """
    return "\n\n".join("\n".join(lines) for lines in sections if lines)


def wrap_text(text: str, first: str = "", others: str = "  ", width: int = WIDTH) -> list[str]:
    """Return text as lines of at most so many columns, where names allow it.

    Parameters
    ----------
    text : str
    first, others : str, optional
        What the first line and the others begin with.
    width : int, optional
    """
    return textwrap.wrap(
        text, width, initial_indent=first, subsequent_indent=others, break_long_words=False, break_on_hyphens=False
    )


def list_jumps(times: FloatArray, run: Timed) -> str:
    """Return how many jumps there are, and when; empty if there are none.

    Parameters
    ----------
    times : (K,) array
    run : Timed
        Of which they are: dates if its times are dates.
    """
    shown = [format_time(time, run) for time in times.tolist()]
    if len(shown) > MOST_JUMPS:
        shown = [*shown[: MOST_JUMPS - 2], "...", shown[-1]]
    return f"{format_count(len(times), 'jump')} at {', '.join(shown)}{suffix_time(run)}" if shown else ""


def select_unknowns(is_time: Sequence[bool], most: int, marked: Collection[int] = ()) -> list[int]:
    """Return the indices of the unknowns that are listed, in their order.

    If there are more than `most`, those that are marked come first. Then come the transition times, which are what is
    asked for, unless they fill more than half of the table, as those of many runs do; then parameters.

    Parameters
    ----------
    is_time : sequence of bool
        Of each unknown, whether it is a transition time.
    most : int
    marked : collection of int, optional
    """
    few = 2 * sum(is_time) <= most
    return sorted(sorted(range(len(is_time)), key=lambda i: (i not in marked, is_time[i] != few))[:most])


def count_worst(shown: Sized, every: Sized, what: str) -> str:
    """Return of how many the worst are shown; "" if all are.

    Parameters
    ----------
    shown, every : sized
    what : str
        The plural of what they are.
    """
    return f"the worst {len(shown)} of {len(every)} {what}" if len(shown) < len(every) else ""
