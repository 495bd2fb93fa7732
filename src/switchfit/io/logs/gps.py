"""Tracks of GPS receivers: GPX files, and NMEA 0183 sentences (GGA, RMC, GNS and GST)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from types import ModuleType
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from switchfit.io.logs.columns import build_log
from switchfit.io.logs.decoding import decode
from switchfit.io.logs.log import Event, Log
from switchfit.io.logs.options import Options
from switchfit.runtime.errors import InputError
from switchfit.runtime.extras import import_library
from switchfit.runtime.issue import Issue

GPS_UNITS = {
    "latitude": "deg", "longitude": "deg", "altitude": "m", "speed": "m/s", "course": "deg", "hdop": "", "quality": "",
    "satellites": "", "sigma_east": "m", "sigma_north": "m", "sigma_up": "m",
}  # fmt: skip

KNOT = 1852 / 3600
"""Metres per second."""

MICROSECONDS_PER_DAY = 86_400_000_000
"""Microseconds."""

EPOCH = date(1970, 1, 1)

Sentence: TypeAlias = Any
"""A sentence as pynmea2 parses it, with an attribute for each of its fields."""

_CHANNELS = {
    "GGA": {"altitude": "altitude", "quality": "gps_qual", "satellites": "num_sats", "hdop": "horizontal_dil"},
    "GNS": {"altitude": "altitude", "satellites": "num_sats", "hdop": "hdop"},
    "RMC": {"speed": "spd_over_grnd", "course": "true_course"},
    "GST": {"sigma_east": "std_dev_longitude", "sigma_north": "std_dev_latitude", "sigma_up": "std_dev_altitude"},
}
"""Of each kind of sentence, the channels besides the position, and what pynmea2 calls them."""


def read_gpx(path: Path, options: Options) -> Log:
    """Read the points of all tracks of a GPX file; named waypoints with a time are events.

    Raises
    ------
    InputError
        If the file cannot be read, or has no points with a time.
    """
    text = decode(path)
    gpxpy = import_library("gpxpy", f"{path}: GPX", "'switchfit[gps]'")
    try:
        gpx = gpxpy.parse(text)
    except Exception as error:  # of the parser of XML, of numbers, of dates
        raise InputError(f"{path} is no GPX file: {error}.") from error
    points = [point for track in gpx.tracks for segment in track.segments for point in segment.points]
    # A planned route has points without times: there is nothing to fit it to.
    if not any(point.time for point in points):
        raise InputError(f"{path} has no track with times: of {len(points)} points, none has a time.")
    times = np.array([None if p.time is None else _count_micros(p.time) for p in points], dtype="datetime64[us]")
    fields = {"altitude": "elevation", "hdop": "horizontal_dilution"}
    records = [{name: getattr(point, fields.get(name, name), None) for name in GPS_UNITS} for point in points]
    log = _build_log(path, times, records, options)
    named = [point for point in gpx.waypoints if point.time and point.name]
    events = [Event(_count_micros(point.time) * 1e-6 - log.offset, "waypoint", point.name) for point in named]
    return replace(log, place="point", events=tuple(events))


def read_nmea(path: Path, options: Options) -> Log:
    """Read the fixes of a file of NMEA 0183 sentences, one for each time that they state.

    Latitude, longitude and altitude are missing where the receiver says that it has no fix. Sentences with a wrong
    checksum are left out, as the standard has it, and reported.

    Raises
    ------
    InputError
        If there is no fix.
    """
    pynmea2 = import_library("pynmea2", f"{path}: NMEA 0183", "'switchfit[gps]'")
    fixes: list[dict[str, Any]] = []
    damaged: list[int] = []
    day: date | None = None
    for line, sentence in _parse_sentences(pynmea2, decode(path), damaged):
        clock = getattr(sentence, "timestamp", None)
        # Sentences of one epoch have one time of day, and are one sample: GGA with the position, RMC with the date and
        # the speed, GST with the errors. What an earlier sentence of the epoch says is kept.
        if sentence.sentence_type not in _CHANNELS or not hasattr(clock, "hour"):
            continue
        if not fixes or fixes[-1]["clock"] != clock:
            fixes.append({"clock": clock, "line": line, "day": None})
        if sentence.sentence_type == "RMC" and isinstance(sentence.datestamp, date):
            # RMC alone has the date, and not every receiver sends it.
            day = fixes[-1]["day"] = sentence.datestamp
        fixes[-1] = _read_channels(sentence) | fixes[-1]
    if not any("latitude" in fix for fix in fixes):
        raise InputError(
            f"{path} has no GGA, RMC or GNS sentence with a position and a time; there is nothing to read."
        )
    micros = _count_fixes(fixes)
    # Without a date anywhere the times are seconds since the first midnight.
    times = micros.astype("datetime64[us]") if day else micros * 1e-6
    rows = np.array([fix["line"] for fix in fixes], dtype=np.intp)
    issues: tuple[Issue, ...] = ()
    if damaged:
        figures = {"line": float(damaged[0]), "count": float(len(damaged))}
        issues = (Issue("log: damaged sentences", (str(path), "line"), figures),)
    return replace(_build_log(path, times, fixes, options), rows=rows, place="line", issues=issues)


def _parse_sentences(pynmea2: ModuleType, text: str, damaged: list[int]) -> Iterator[tuple[int, Sentence]]:
    """Yield the number of each line and its sentence; lines that are none, or damaged, are listed."""
    for line, raw in enumerate(re.split(r"\r\n|\n|\r", text), start=1):
        start = raw.find("$")  # loggers put times of their own before
        if start < 0:
            continue
        try:
            yield line, pynmea2.parse(raw[start:].strip(), check=True)
        except pynmea2.SentenceTypeError:  # a sentence that the library does not know
            continue
        except (pynmea2.ParseError, ValueError, TypeError):
            damaged.append(line)


def _read_channels(sentence: Sentence) -> dict[str, float]:
    """Return the channels that a sentence has; the position only if there is a fix."""
    numbers = {name: _read_float(getattr(sentence, own)) for name, own in _CHANNELS[sentence.sentence_type].items()}
    # An empty field is a missing value. The altitude is that of the last fix where there is none now.
    found = {name: number for name, number in numbers.items() if number is not None}
    if "speed" in found:
        found["speed"] *= KNOT
    if not _has_fix(sentence):
        found.pop("altitude", None)
    elif sentence.lat and sentence.lon:
        found |= {"latitude": sentence.latitude, "longitude": sentence.longitude}
    return found


def _has_fix(sentence: Sentence) -> bool:
    if sentence.sentence_type == "GGA":
        return bool(_read_float(sentence.gps_qual))
    if sentence.sentence_type == "GNS":
        # One letter for each system of satellites; N is no fix, and one system is enough for a position.
        return any(mode not in "N" for mode in sentence.mode_indicator or "")
    return sentence.sentence_type == "RMC" and bool(sentence.status == "A")


def _read_float(given: str | float | None) -> float | None:
    try:
        return None if given is None else float(given)
    except (TypeError, ValueError):
        return None


def _count_fixes(fixes: list[dict[str, Any]]) -> NDArray[np.int64]:
    """Return microseconds of all fixes, since 1970 if a sentence states the date; days go on after midnight."""
    clocks = np.array([_count_micros(datetime.combine(EPOCH, fix["clock"].replace(tzinfo=UTC))) for fix in fixes])
    # The time of day falls at midnight only, by almost a day: half a day tells this from sentences that come out of
    # order.
    midnights = np.cumsum(np.append(0, np.diff(clocks) < -MICROSECONDS_PER_DAY // 2))
    # The first date, counted back to the first sample, which may lie before it by some midnights.
    dated = ((fix["day"] - EPOCH).days - night for fix, night in zip(fixes, midnights, strict=True) if fix["day"])
    return (midnights + next(dated, 0)) * MICROSECONDS_PER_DAY + clocks


def _count_micros(moment: datetime) -> int:
    moment = moment if moment.tzinfo else moment.replace(tzinfo=UTC)
    return (moment - datetime(1970, 1, 1, tzinfo=UTC)) // timedelta(microseconds=1)


def _build_log(path: Path, times: NDArray[Any], records: list[dict[str, Any]], options: Options) -> Log:
    """Return a log of the channels that have a value; its times are stamps of a receiver."""
    columns = {name: np.array([record.get(name) for record in records], dtype=np.float64) for name in GPS_UNITS}
    kept = {name: column for name, column in columns.items() if np.isfinite(column).any()}
    log = build_log(str(path), {"time": times, **kept}, GPS_UNITS | {"time": "s"}, options, zones={"time": "UTC"})
    return replace(log, has_positions=True, has_dates=False)
