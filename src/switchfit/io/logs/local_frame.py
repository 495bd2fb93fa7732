"""Positions on the globe in a local frame: metres to the east, to the north and up from an origin.

They are computed by `pymap3d.geodetic2enu`: one function that does this and no more, in plain NumPy, exact on the
ellipsoid of WGS 84. (pyproj would bring PROJ with its database of grids for the same numbers.)
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.io.logs.log import Log
from switchfit.problem.validation import arrays
from switchfit.problem.validation.messages import shorten
from switchfit.runtime.errors import InputError
from switchfit.runtime.extras import import_library

LOCAL_CHANNELS = ("east", "north", "up")
"""Names of the channels of the local frame, in metres."""

SIGMA_CHANNELS = ("sigma_east", "sigma_north", "sigma_up")
"""Names of the channels of their standard deviations, in metres."""

FRAME_CHANNELS = (*LOCAL_CHANNELS, *SIGMA_CHANNELS[:2])
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


def check_origin(origin: Sequence[float] | None) -> tuple[float, float, float] | None:
    """Return an origin as (latitude, longitude, altitude), the altitude 0 if it is left out."""
    if origin is None:
        return None
    form = "[latitude, longitude] or [latitude, longitude, altitude]"
    numbers = arrays.as_array(origin, "origin", form=form).ravel().tolist()
    if len(numbers) not in (2, 3) or not np.all(np.isfinite(numbers)) or abs(numbers[0]) > 90 or abs(numbers[1]) > 360:
        raise InputError(
            f"origin must be [latitude, longitude] in degrees, or with the altitude in metres; got {shorten(origin)}."
        )
    latitude, longitude, altitude = (*numbers, 0.0)[:3]
    return latitude, longitude, altitude


def add_local_frame(log: Log, origin: tuple[float, float, float] | None, range_error: float | None) -> Log:
    """Return the log with the channels east, north and up, and their standard deviations where they are known.

    Without an origin, it is the first position.
    """
    names = find_position(log.channels)
    if names is None:
        raise InputError(f"{log.source} has no latitude and longitude; its columns are {', '.join(log.channels)}.")
    latitude, longitude = log[names[0]], log[names[1]]
    # Without an altitude the ellipsoid's surface is taken: east and north change by 1.6e-7 for each metre.
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
    # A fix in two dimensions has no height; for its east and north that of the origin is near enough.
    heights = np.where(np.isfinite(altitude[known]), altitude[known], origin[2])
    pymap3d = import_library("pymap3d", f"{log.source}: a position", "'switchfit[gps]'")
    local[:, known] = pymap3d.geodetic2enu(latitude[known], longitude[known], heights, *origin)
    local[2, ~np.isfinite(altitude)] = np.nan
    # No channel `up` where the file has no altitude.
    added = LOCAL_CHANNELS[: len(names)]
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
    for name in SIGMA_CHANNELS[:2]:
        known: FloatArray = values.get(name, np.full(len(log), np.nan))
        # A receiver's own standard deviation (GST) is better than one from the geometry alone.
        values[name] = np.where(np.isfinite(known), known, hdop * range_error / np.sqrt(2))
        units[name] = "m"
    return replace(log, values=values, units=units)
