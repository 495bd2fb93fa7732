"""`read_log`: the reader of a file's format, then the local frame, the checks and the repairs."""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Sequence
from pathlib import Path

from switchfit.io.logs.files import BAGS
from switchfit.io.logs.flaws import inspect_log
from switchfit.io.logs.local_frame import FRAME_CHANNELS, add_local_frame, check_origin
from switchfit.io.logs.log import Log
from switchfit.io.logs.options import Options, check_options
from switchfit.io.logs.times import convert_time_unit
from switchfit.problem.validation import objects
from switchfit.problem.validation.messages import shorten
from switchfit.runtime.errors import InputError
from switchfit.runtime.files import explain_read_errors

LONGEST_NAME = 255
"""Characters of a file's name at most, in most file systems."""

_TEXT_FORMAT = ("text", "read_text", "a table of text", ("topic",))
_NMEA_FORMAT = ("gps", "read_nmea", "an NMEA 0183 log", ("time", "topic"))
_BAG_FORMAT = ("ros", "read_bag", "a ROS bag", ("time",))
_PARQUET_FORMAT = ("parquet", "read_parquet", "a Parquet file", ("topic",))

_FORMATS: dict[str, tuple[str, str, str, tuple[str, ...]]] = {
    ".gpx": ("gps", "read_gpx", "a GPX track", ("time", "topic")),
    ".mat": ("matlab", "read_mat", "a .mat file", ()),
    ".nmea": _NMEA_FORMAT,
    ".nma": _NMEA_FORMAT,
    ".parquet": _PARQUET_FORMAT,
    ".pq": _PARQUET_FORMAT,
    **dict.fromkeys(BAGS, _BAG_FORMAT),
}
"""By the end of the name: module and reader, what it is, and the options that mean nothing for it."""

_SENTENCE = re.compile(rb"\s*\$[A-Z]{5},")


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
    >>> _ = Path("drive.csv").write_text("Zeit;Weg;\\nms;m;\\n0;0,00;\\n20;0,05;\\n40;0,10;\\n", encoding="latin-1")
    >>> log = sf.read_log("drive.csv", time_unit="s")
    >>> log.times, log["Weg"], log.units["Weg"]
    (array([0.  , 0.02, 0.04]), array([0.  , 0.05, 0.1 ]), 'm')
    >>> data = sf.Measurements(log.times, log[["Weg"]], sigma=0.01)
    >>> data.names
    ('Weg',)
    >>> Path("drive.csv").unlink()
    """
    path = objects.as_path(path, "path")
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
    options, origin = check_options(given), check_origin(given.origin)
    log = _read_format(path, options)
    # East and north are computed before the channels are picked, of which latitude and longitude are none any more.
    # Formats of positions always have them.
    wanted = any(name in FRAME_CHANNELS and name not in log for name in options.columns or ())
    if wanted or origin is not None or options.range_error is not None or log.has_positions:
        log = add_local_frame(log, origin, options.range_error)
    log = log if options.columns is None else log[list(options.columns)]
    # After the channels are picked: what is odd about others does not concern anybody. Before the unit is changed:
    # figures are those of the file.
    log = inspect_log(log, options.repair)
    return log if options.time_unit is None else convert_time_unit(log, options.time_unit)


def _read_format(path: Path, options: Options) -> Log:
    """Read a file of any format, which the end of its name tells, or how it begins."""
    ending = Path(path.name.lower().removesuffix(".gz")).suffix
    # By its name; a `.log` or a `.txt` may be NMEA, which its first line tells.
    form = _BAG_FORMAT if os.path.isfile(path / "metadata.yaml") else _FORMATS.get(ending)
    module, reader, what, lacks = form or (_NMEA_FORMAT if _is_nmea(path) else _TEXT_FORMAT)
    for name in lacks:
        value = getattr(options, name)
        if value is not None:
            raise InputError(f"{path} is {what}, for which {name} means nothing; leave out {name} = {shorten(value)}.")
    # Readers are imported here: ROS, MATLAB and GPS need libraries that most users have not.
    log: Log = getattr(importlib.import_module(f"switchfit.io.logs.{module}"), reader)(path, options)
    return log


def _is_nmea(path: Path) -> bool:
    """Return whether the first line of a file is a sentence of NMEA 0183."""
    if not os.path.isfile(path):
        return False
    with explain_read_errors(path), path.open("rb") as file:
        return bool(_SENTENCE.match(file.read(400)))
