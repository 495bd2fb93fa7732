"""`read_log`: the reader of a file's format, then the local frame, the checks and the repairs.

Positions on the globe become metres to the east, to the north and up from an origin by `pymap3d.geodetic2enu`: one
function that does this and no more, in plain NumPy, exact on the ellipsoid of WGS 84. (pyproj would bring PROJ with its
database of grids for the same numbers.)
"""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.io.logs import BAGS
from switchfit.io.logs.log import FloatArray, Log, Options
from switchfit.problem import validation
from switchfit.problem.dates import LENGTHS, SECONDS
from switchfit.problem.validation import join_names, shorten
from switchfit.runtime.errors import InputError, Issue, import_library
from switchfit.runtime.files import explain_read_errors

REPAIRS = ("sort", "drop-duplicates", "drop-missing-times", "drop-broken-lines")
"""Repairs by name; beside them "unwrap:CHANNEL"."""
GAP = 5.0
"""Length of an interval, in typical ones, from which on it is a gap."""
MOST_GAPS = 0.1
"""Share of the intervals beyond which long ones are no gaps but how the log was sampled."""
NEAR = 5.0
"""By how many typical intervals times may fall where samples were only written in another order."""

_ANGLE = re.compile(r".*(yaw|heading|course|azimuth|theta|psi|angle|hdg|cog|bearing).*|ang", re.IGNORECASE)


def _inspect_log(log: Log, repairs: Sequence[str]) -> Log:
    """Return the log with its issues, and repaired where asked for."""
    issues = list(log.issues)
    for name, find in _FLAWS.items():
        kind, flawed, kept, figures = find(log)
        if not flawed.any():
            continue
        first, repaired = int(flawed.argmax()), name in repairs
        if name == "drop-missing-times" and not repaired:
            raise InputError(
                f"{log.source}, column {log.time_name!r}: the time of sample {first + 1} is missing ({log.place} "
                f"{log.rows[first]}). repair='{name}' leaves such samples out."
            )
        figures |= {"count": flawed.sum(), "time": log.times[first]}
        issues.append(_make_issue(kind, log, first, None, repaired=repaired, **figures))
        log = _pick_samples(log, kept) if repaired else log
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
    far = -steps[falls].min(initial=0.0) > NEAR * _find_typical_step(log.times)  # not so beside NaN
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


LONGEST_NAME = 255
"""Characters of a file's name at most, in most file systems."""


def read_log(
    path: str | Path,
    *,
    columns: Sequence[str] | None = None,
    time: str | None = None,
    time_unit: str | None = None,
    topic: str | None = None,
    origin: Sequence[float] | None = None,
    range_error: float | None = None,
    repair: str | Sequence[str] = (),
) -> Log:
    """Read a log: a table of text in any dialect, Parquet, MATLAB, GPX, NMEA 0183, a ROS bag or MCAP.

    Parameters
    ----------
    path : str or Path
        The file, or the folder of a bag of ROS 2. Text may be compressed by gzip.
    columns : sequence of str, optional
        Names of the channels that are wanted; left out, all that are numbers.
    time : str, optional
        The column with the times; left out, the one that is called so.
    time_unit : {"ns", "us", "ms", "s", "min", "h", "d"}, optional
        Convert the times to this unit. Times of a file that states no unit are taken to be in it.
    topic : str, optional
        The topic of a bag, or the struct of a ``.mat`` file; may be left out where there is one.
    origin : (latitude, longitude) or (latitude, longitude, altitude), optional
        Of the channels east, north and up, in degrees and metres; left out, the first position. In a table they are
        computed if `origin` is given or `columns` names them.
    range_error : float, optional
        Standard deviation of the distance to a satellite in metres, 3 to 6 for a receiver without corrections: HDOP
        times it becomes sigma_east and sigma_north where the log has none.
    repair : str or sequence of str, optional
        What may be changed: "sort" (by time), "drop-duplicates" (of a time, the first sample is kept),
        "drop-missing-times", "drop-broken-lines", "unwrap:CHANNEL" (an angle, in rad or deg). Nothing is repaired
        unless it is asked for; `Log.issues` says what there is.

    Returns
    -------
    Log
        Times that are dates, or count from 1970, begin at 0; `Log.start` has the date.

    Raises
    ------
    InputError
        For anything wrong with the file, with its name and the line; or if the library that reads it is missing.

    See Also
    --------
    Log, Measurements

    Examples
    --------
    >>> from pathlib import Path
    >>> import switchfit as sf
    >>> _ = Path("drive.csv").write_text("Zeit;Weg;\\nms;m;\\n0;0,00;\\n20;0,05;\\n40;0,10;\\n", encoding="latin-1")
    >>> log = sf.read_log("drive.csv", time_unit="s")
    >>> log.times, log["Weg"], log.units["Weg"]
    (array([0.  , 0.02, 0.04]), array([0.  , 0.05, 0.1 ]), 'm')
    >>> data = sf.Measurements(log.times, log[["Weg"]], sigma=0.01)
    >>> data.names
    ('Weg',)
    >>> Path("drive.csv").unlink()
    """
    path = validation.as_path(path, "path")
    if len(path.name) > LONGEST_NAME:
        raise InputError(f"path must name a file, with at most {LONGEST_NAME} characters; got {shorten(str(path))}.")
    return read_source(path, Options(columns, time, time_unit, topic, origin, range_error, repair))


def read_source(path: Path, given: Options) -> Log:
    """Read a log as `read_log` does.

    Parameters
    ----------
    path : Path
    given : Options
    """
    options, origin = _check_options(given), _check_origin(given.origin)
    log = _read_format(path, options)
    wanted = any(name in FRAME and name not in log for name in options.columns or ())
    if wanted or origin is not None or options.range_error is not None or log.has_positions:
        log = _add_local_frame(log, origin, options.range_error)
    log = log if options.columns is None else log[list(options.columns)]
    log = _inspect_log(log, options.repair)
    return log if options.time_unit is None else _convert_times(log, options.time_unit)


def _check_options(given: Options) -> Options:
    """Return arguments with names as tuples; raise InputError if one is wrong."""
    columns, repair, error = given.columns, given.repair, given.range_error
    if columns is not None:
        columns = validation.as_names(
            (columns,) if isinstance(columns, str) else columns, "columns", "a sequence of strings"
        )
    for what in ("time", "topic"):
        if getattr(given, what) is not None:
            validation.as_name(getattr(given, what), what)
    if given.time_unit is not None:
        validation.as_choice(given.time_unit, "time_unit", tuple(SECONDS))
    error = None if error is None else validation.as_positive(error, "range_error")
    repair = validation.as_names((repair,) if isinstance(repair, str) else repair, "repair", "a sequence of strings")
    for name in repair:
        if name not in REPAIRS and not (name.startswith("unwrap:") and len(name) > len("unwrap:")):
            raise InputError(f"repair must be among {', '.join(REPAIRS)} and unwrap:CHANNEL; got {shorten(name)}.")
    return given._replace(columns=columns, range_error=error, repair=repair)


def _convert_times(log: Log, unit: str) -> Log:
    """Return the log with its times in another unit; times without a unit are taken to be in it."""
    if log.time_unit in ("", unit):
        return replace(log, time_unit=unit)
    # A quotient of integers: 40 ms are 0.04 s.
    length, new = (int(LENGTHS[each] / LENGTHS["ns"]) for each in (log.time_unit, unit))
    return _map_times(log, lambda t: t * length / new, offset=log.offset * length / new, time_unit=unit)


def align_starts(logs: Sequence[Log]) -> list[Log]:
    """Return logs of one run, so that 0 is the same moment in all that have dates: the earliest start among them.

    Parameters
    ----------
    logs : sequence of Log
    """
    starts = [log.offset * SECONDS[log.time_unit] for log in logs if log.offset]
    return [_shift_start(log, min(starts)) if log.offset else log for log in logs]


def _shift_start(log: Log, start: float) -> Log:
    shift = log.offset - start / SECONDS[log.time_unit]
    return _map_times(log, lambda t: t + shift, offset=log.offset - shift)


def _map_times(log: Log, change: Callable[[Any], Any], **more: Any) -> Log:
    """Return the log with the times of its samples and its events changed."""
    events = tuple(event._replace(time=change(event.time)) for event in log.events)
    return replace(log, times=change(log.times), events=events, **more)


_TEXT = ("text", "read_text", "a table of text", ("topic",))
_NMEA = ("gps", "read_nmea", "an NMEA 0183 log", ("time", "topic"))
_BAG = ("ros", "read_bag", "a ROS bag", ("time",))
_PARQUET = ("arrays", "read_parquet", "a Parquet file", ("topic",))
_FORMATS: dict[str, tuple[str, str, str, tuple[str, ...]]] = {
    ".gpx": ("gps", "read_gpx", "a GPX track", ("time", "topic")),
    ".mat": ("arrays", "read_mat", "a .mat file", ()),
    ".nmea": _NMEA,
    ".nma": _NMEA,
    ".parquet": _PARQUET,
    ".pq": _PARQUET,
    **dict.fromkeys(BAGS, _BAG),
}
"""By the end of the name: module and reader, what it is, and the options that mean nothing for it."""

_SENTENCE = re.compile(rb"\s*\$[A-Z]{5},")


def _read_format(path: Path, options: Options) -> Log:
    """Read a file of any format, which the end of its name tells, or how it begins."""
    ending = Path(path.name.lower().removesuffix(".gz")).suffix
    form = _BAG if os.path.isfile(path / "metadata.yaml") else _FORMATS.get(ending)
    module, reader, what, lacks = form or (_NMEA if _is_nmea(path) else _TEXT)
    for name in lacks:
        value = getattr(options, name)
        if value is not None:
            raise InputError(f"{path} is {what}, for which {name} means nothing; leave out {name} = {shorten(value)}.")
    log: Log = getattr(importlib.import_module(f"switchfit.io.logs.{module}"), reader)(path, options)
    return log


def _is_nmea(path: Path) -> bool:
    """Return whether the first line of a file is a sentence of NMEA 0183."""
    if not os.path.isfile(path):
        return False
    with explain_read_errors(path), path.open("rb") as file:
        return bool(_SENTENCE.match(file.read(400)))


# --- positions --------------------------------------------------------------------------------------------------------

LOCAL = ("east", "north", "up")
"""Names of the channels of the local frame, in metres."""
SIGMA = ("sigma_east", "sigma_north", "sigma_up")
"""Names of the channels of their standard deviations, in metres."""
FRAME = (*LOCAL, *SIGMA[:2])
"""Channels that can be computed from a position and HDOP."""

_POSITION = (
    re.compile(r"(.*[ ._])?lat(itude)?([ _.]?deg)?", re.IGNORECASE),
    re.compile(r"(.*[ ._])?(lon|lng|long|longitude)([ _.]?deg)?", re.IGNORECASE),
    re.compile(r"(.*[ ._])?(alt|altitude|ele|elevation|height)([ _.]?m)?", re.IGNORECASE),
)


def find_position(names: Sequence[str]) -> list[str] | None:
    """Return the names of latitude and longitude, and of the altitude if there is one; None if one is missing."""
    found = [next((name for name in names if pattern.fullmatch(name)), None) for pattern in _POSITION]
    return [name for name in found if name is not None] if found[0] and found[1] else None


def _check_origin(origin: Sequence[float] | None) -> tuple[float, float, float] | None:
    """Return an origin as (latitude, longitude, altitude), the altitude 0 if it is left out."""
    if origin is None:
        return None
    form = "[latitude, longitude] or [latitude, longitude, altitude]"
    numbers = validation.as_array(origin, "origin", form=form).ravel().tolist()
    if len(numbers) not in (2, 3) or not np.all(np.isfinite(numbers)) or abs(numbers[0]) > 90 or abs(numbers[1]) > 360:
        raise InputError(
            f"origin must be [latitude, longitude] in degrees, or with the altitude in metres; got {shorten(origin)}."
        )
    latitude, longitude, altitude = (*numbers, 0.0)[:3]
    return latitude, longitude, altitude


def _add_local_frame(log: Log, origin: tuple[float, float, float] | None, range_error: float | None) -> Log:
    """Return the log with the channels east, north and up, and their standard deviations where they are known.

    Without an origin, it is the first position.
    """
    names = find_position(log.channels)
    if names is None:
        raise InputError(f"{log.source} has no latitude and longitude; its columns are {', '.join(log.channels)}.")
    latitude, longitude = log[names[0]], log[names[1]]
    altitude = log[names[2]] if len(names) == 3 else np.zeros(len(log))
    known = np.isfinite(latitude) & np.isfinite(longitude)
    if not known.any():
        raise InputError(f"{log.source} has no position: all of {names[0]} and {names[1]} are missing.")
    if np.abs(latitude[known]).max() > 90 or np.abs(longitude[known]).max() > 360:
        raise InputError(f"{log.source}: {names[0]} and {names[1]} must be in degrees; some are beyond 90 or 360.")
    first = int(known.argmax())
    if origin is None:
        height = altitude[first] if np.isfinite(altitude[first]) else 0.0
        origin = (float(latitude[first]), float(longitude[first]), float(height))
    local = np.full((3, len(log)), np.nan)
    heights = np.where(np.isfinite(altitude[known]), altitude[known], origin[2])
    pymap3d = import_library("pymap3d", f"{log.source}: a position", "'switchfit[gps]'")
    local[:, known] = pymap3d.geodetic2enu(latitude[known], longitude[known], heights, *origin)
    local[2, ~np.isfinite(altitude)] = np.nan
    added = LOCAL[: len(names)]
    values = {**log.values, **dict(zip(added, local, strict=False))}
    log = replace(log, values=values, units={**log.units, **dict.fromkeys(added, "m")}, origin=origin)
    return log if range_error is None else _add_sigma(log, range_error)


def _add_sigma(log: Log, range_error: float) -> Log:
    """Return the log with sigma_east and sigma_north from HDOP where they are not known otherwise.

    HDOP**2 is the sum of the two variances in units of the squared range error.
    """
    hdop = next((log[name] for name in log.channels if name.lower() == "hdop"), None)
    if hdop is None:
        raise InputError(
            f"{log.source} has no channel hdop, of which range_error makes a sigma; leave out range_error."
        )
    values, units = dict(log.values), dict(log.units)
    for name in SIGMA[:2]:
        known: FloatArray = values.get(name, np.full(len(log), np.nan))
        values[name] = np.where(np.isfinite(known), known, hdop * range_error / np.sqrt(2))
        units[name] = "m"
    return replace(log, values=values, units=units)
