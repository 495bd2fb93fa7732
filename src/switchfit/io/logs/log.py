"""`Log`: times, named channels with units, and what is odd about them; made from columns of which one has the times."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from typing import Any, NamedTuple, overload

import numpy as np
from numpy.typing import NDArray

from switchfit.io.logs import refuse_without_times
from switchfit.problem.dates import SECONDS, TIME_UNITS, Dates
from switchfit.problem.validation import join_names, shorten
from switchfit.runtime.errors import InputError, Issue
from switchfit.runtime.frames import Column, Frame, build_pandas
from switchfit.runtime.presentation import format_line, join_first

EPOCH_SECONDS = (9.4e8, 2.6e9)
"""Between which numbers seconds since 1970 lie: the years 1999 to 2052."""

_PREFIXED = (
    "m", "s", "g", "rad", "Hz", "N", "Nm", "Pa", "V", "A", "W", "J", "K", "T", "G", "F", "H", "C", "Ohm", "Ω", "bar",
    "l", "L", "px",
)  # fmt: skip
_PLAIN = (
    "1", "-", "%", "°", "deg", "degree", "degrees", "grad", "rad", "°C", "degC", "°F", "°/s", "min", "h", "d", "rpm",
    "ticks", "tick", "counts", "count", "pix", "pixel", "pixels", "ft", "in", "mi", "kn", "kt", "kts", "knots", "mph",
    "kph", "psi", "rev", "bit", "bool", "fps", "sec", "msec", "usec", "nsec", "mol", "lx", "dB", "mps", "kmh",
)  # fmt: skip
_FACTOR = re.compile(
    rf"(?:{'|'.join(re.escape(u) for u in sorted(_PLAIN, key=len, reverse=True))}"
    rf"|[nuµμmckMG]?(?:{'|'.join(re.escape(u) for u in sorted(_PREFIXED, key=len, reverse=True))}))"
    r"(?:\^?-?\d|\*\*-?\d|[²³⁻¹]+)?"
)
_SUFFIX = re.compile(r"[^_]_(ns|us|ms|s|sec|min|rad|deg|m|mm|cm|km|Hz|rpm|mps|Nm)$")


def is_unit(text: str) -> bool:
    """Return whether a text is a unit, such as ``m/s^2``, ``°C``, ``ticks`` or ``[rad/s]``."""
    inner = strip_brackets(text)
    if not inner:
        return False
    factors = re.split(r"[/*·. ]", inner)
    return all(_FACTOR.fullmatch(factor) for factor in factors)


def strip_brackets(text: str) -> str:
    """Return a text without the brackets around it."""
    text = text.strip()
    return text[1:-1].strip() if text[:1] + text[-1:] in ("[]", "()", "{}", "<>") else text


def split_unit(name: str) -> tuple[str, str]:
    """Return the name and the unit in a text such as ``"x [m]"``, ``"x (m)"`` or ``"x_m"``.

    A suffix stays in the name; the unit is empty where there is none.
    """
    match = re.fullmatch(r"(.*\S)\s*(\[[^\[\]]{1,12}\]|\([^()]{1,12}\))", name)
    if match and (is_unit(match[2]) or match[2][0] == "["):
        return match[1], strip_brackets(match[2])
    suffix = _SUFFIX.search(name)
    return name, suffix[1] if suffix else ""


def normalize_time_unit(text: str) -> str:
    """Return the key of `SECONDS` that a text stands for, or the text itself if it is no unit of time."""
    return TIME_UNITS.get(strip_brackets(text).lower(), text)


FloatArray = NDArray[np.float64]


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


class Event(NamedTuple):
    """Something that a log says in words.

    Attributes
    ----------
    time : float
        In the log's unit of time.
    channel : str
        The column or topic.
    text : str
    """

    time: float
    channel: str
    text: str


@dataclass(frozen=True, eq=False)
class Log:
    """What `read_log` found in a file; index it with names for values.

    ``log["x"]`` is a (K,) array. ``log[["x", "y"]]`` is a `Log` of these channels, which is taken wherever an array
    is, and keeps names and units: ``sf.Measurements(log.times, log[["x", "y"]])``.

    Attributes
    ----------
    times : (K,) array
        In `time_unit`, in the order of the file unless a repair was asked for.
    values : mapping of str to (K,) array
        The samples of each channel; NaN is a missing one.
    units : mapping of str to str
        The unit of each channel, "" where the file states none.
    time_unit : str
        "ns", "us", "ms", "s", "min", "h" or "d"; "" where the file states none.
    source : str
        The file.
    issues : tuple of Issue
        What is odd about the log, with the line of the file; print one for its sentence.
    events : tuple of Event
        Columns of text, as (time, channel, text) wherever the text changes.
    offset : float
        What was subtracted from the file's times, where these are dates or count from 1970; otherwise 0.
    origin : (latitude, longitude, altitude) or None
        Of the channels east, north and up, in degrees and metres.
    labels : mapping of str to str
        Other names in the header, and the channel that each of them means.
    rows : (K,) array of int
        Number of each sample's line in the file.
    place : str
        What `rows` counts: "line", "row", "message" or "point".
    time_name : str
        The column with the times.
    has_positions : bool
        Whether latitude and longitude are those of a format of positions, to which east and north are added.
    time_zone : str
        Zone of the file's dates, such as "UTC" or "+02:00"; "" where it states none.
    has_dates : bool
        Whether the file has dates that are written as such, not stamps of a recorder or numbers since 1970.

    See Also
    --------
    read_log, Measurements

    Examples
    --------
    >>> from pathlib import Path
    >>> import switchfit as sf
    >>> _ = Path("drive.csv").write_text("t [ms];x [m];mode\\n0;1.5;push\\n20;1.6;push\\n40;1.8;brake\\n")
    >>> log = sf.read_log("drive.csv")
    >>> log.channels, log["x"], log.time_unit
    (('x',), array([1.5, 1.6, 1.8]), 'ms')
    >>> log.events[-1]
    Event(time=40.0, channel='mode', text='brake')
    >>> Path("drive.csv").unlink()
    """

    times: FloatArray
    values: Mapping[str, FloatArray]
    units: Mapping[str, str]
    time_unit: str
    source: str
    issues: tuple[Issue, ...] = ()
    events: tuple[Event, ...] = ()
    offset: float = 0.0
    origin: tuple[float, float, float] | None = None
    labels: Mapping[str, str] = field(default_factory=dict)
    rows: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    place: str = "row"
    time_name: str = "t"
    has_positions: bool = False
    time_zone: str = "UTC"
    has_dates: bool = False

    @property
    def dates(self) -> Dates | None:
        """The times as dates, for `Measurements`, `Input` and `Experiment`; None where the file has no dates.

        They have the time zone that the file states, or none.
        """
        if not self.offset:
            return None
        length = 1e6 * SECONDS[self.time_unit or "s"]
        micros = round(self.offset * length) + np.rint(self.times * length).astype(np.int64)
        return Dates(micros.astype("datetime64[us]"), self.time_zone)

    def __repr__(self) -> str:
        return format_line(self, self.source, join_first(self.values), f"{len(self.times)} times")

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels, in the order of the file."""
        return tuple(self.values)

    columns = channels
    """By the name that tables of other libraries have for it."""

    @property
    def attrs(self) -> dict[str, Any]:
        """The units, where tables of other libraries have them."""
        return {"units": dict(self.units)}

    @property
    def start(self) -> datetime | None:
        """Date and time of ``times == 0``, dates without a zone taken for UTC; None where the file has no dates."""
        if not self.offset:
            return None
        return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=self.offset * SECONDS[self.time_unit or "s"])

    def __len__(self) -> int:
        """Number of samples, K."""
        return len(self.times)

    def __contains__(self, name: object) -> bool:
        return name in self.values or name in self.labels

    def __iter__(self) -> Iterator[str]:
        return iter(self.values)

    @overload
    def __getitem__(self, name: str) -> FloatArray: ...
    @overload
    def __getitem__(self, name: list[str] | tuple[str, ...]) -> Log: ...
    def __getitem__(self, name: Any) -> Any:
        if isinstance(name, str):
            return self.values[self.find_channel(name)]
        if isinstance(name, Sequence):
            names = [self.find_channel(entry) for entry in name]
            return replace(
                self,
                values={own: self.values[own] for own in names},
                units={own: self.units.get(own, "") for own in names},
                labels={label: own for label, own in self.labels.items() if own in names},
            )
        raise TypeError(f'A log is indexed by a name or a list of names, as in log["x"]; got {shorten(name)}.')

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        """All channels as a (K, q) array."""
        columns = [np.asarray(values, dtype=dtype) for values in self.values.values()]
        return np.stack(columns, axis=1) if columns else np.zeros((len(self), 0))

    def find_channel(self, name: str) -> str:
        """Return the channel that a name in the header means.

        Raises
        ------
        InputError
            If there is none, with the names that there are.

        See Also
        --------
        Log

        Examples
        --------
        >>> from pathlib import Path
        >>> import switchfit as sf
        >>> _ = Path("drive.csv").write_text("Time;Position along X\\ns;m\\nt;x\\n0;1.5\\n1;1.6\\n")
        >>> sf.read_log("drive.csv").find_channel("Position along X")
        'x'
        >>> Path("drive.csv").unlink()
        """
        if name in self.values:
            return name
        if name in self.labels:
            return self.labels[name]
        raise InputError(f"{self.source} has no column {shorten(name)}; its columns are {join_names(self.values)}.")

    def to_pandas(self) -> Any:
        """Return a pandas DataFrame with the times as its index, and the units in ``attrs["units"]``.

        See Also
        --------
        read_log

        Examples
        --------
        >>> from pathlib import Path
        >>> import switchfit as sf
        >>> _ = Path("drive.csv").write_text("t [s],x [m]\\n0,1.5\\n1,1.6\\n")
        >>> table = sf.read_log("drive.csv").to_pandas()
        >>> table["x"].tolist(), table.index.name, table.attrs["units"]
        ([1.5, 1.6], 't (s)', {'x': 'm'})
        >>> Path("drive.csv").unlink()
        """
        index = Column(f"{self.time_name} ({self.time_unit})" if self.time_unit else self.time_name, self.times)
        columns = [Column(name, values, self.units.get(name, "")) for name, values in self.values.items()]
        return build_pandas(Frame((index,), tuple(columns)))

    def __str__(self) -> str:
        """Return source, span, channels, origin and issues as text."""
        unit = f" {self.time_unit}" if self.time_unit else ""
        span = f", {self.times[0]:.6g} to {self.times[-1]:.6g}{unit}" if len(self) else ""
        start = f" from {self.start:%Y-%m-%d %H:%M:%S}{' UTC' if self.time_zone else ''}" if self.start else ""
        names = [f"{name} ({self.units[name]})" if self.units.get(name) else name for name in self.values]
        lines = [f"{self.source}: {len(self)} samples{span}{start}", f"  channels: {', '.join(names) or 'none'}"]
        if self.origin:
            latitude, longitude, altitude = self.origin
            lines.append(f"  origin: latitude {latitude:.8f}, longitude {longitude:.8f}, altitude {altitude:.2f} m")
        if self.events:
            lines.append(f"  events: {len(self.events)}")
        return "\n".join([*lines, *(f"  {issue}" for issue in self.issues)])


# --- from columns to a log --------------------------------------------------------------------------------------------

_NAMES = (
    re.compile(
        r"_*(t|times?|timestamps?|stamp|zeit|utc|clock|date_?time|secs?|seconds|millis|micros|elapsed.*|.*[ _]elapsed)"
    ),
    re.compile(
        r"_*(t_(rel|abs|[num]?s|sec|min|h)|(time|timestamp|stamp|zeit)[ _.\-/].*|.*[ _./](time|timestamp|stamp))"
    ),
    re.compile(r"date|datum|days?|hours?|hrs|minutes|mins"),
)
"""Names of columns of times: those of the first kind before those of the second."""

TEMPERATURE = "T"
"""Rather the name of a temperature; of times only if no other column has such a name, as with MATLAB's ``[T, Y]``."""


def find_time_name(names: Iterable[str], channels: Collection[str] = ()) -> str | None:
    """Return the name that is most clearly one of times; None if there is none.

    Parameters
    ----------
    names : iterable of str
    channels : collection of str
        Names that are known to be those of measured values.
    """
    given = list(names)
    for kind in _NAMES:
        for name in given:
            if kind.fullmatch(name.strip().lower()) and name.strip() != TEMPERATURE:
                return name
    return next((name for name in given if name.strip() == TEMPERATURE and name not in channels), None)


def _find_epoch_unit(time: float) -> str | None:
    """Return the unit in which a number is a time since 1970, None if it is too small for one."""
    low, high = EPOCH_SECONDS
    return next((unit for unit in ("s", "ms", "us", "ns") if low <= time * SECONDS[unit] < high), None)


def _are_uptimes(times: FloatArray) -> bool:
    """Return whether times that could be seconds since 1970 are rather microseconds since a start: whole, far apart."""
    steps = np.diff(times)
    if len(steps) == 0 or _find_epoch_unit(float(times[0])) != "s":
        return False
    step = float(np.median(steps))
    return bool(np.all(times == np.rint(times)) and step >= 1000 and step % 60 != 0)


def build_log(
    source: str,
    columns: Mapping[str, Any],
    units: Mapping[str, str],
    options: Options,
    zones: Mapping[str, str] | None = None,
) -> Log:
    """Return a log from columns, one of which has the times.

    Parameters
    ----------
    source : str
    columns : mapping of str to (K,) array
        Of numbers, or of ``datetime64`` where they are dates.
    units : mapping of str to str
        Those that are stated; others may stand in the names.
    options : Options
    zones : mapping of str to str, optional
        Time zones of columns of dates, which are in UTC then.

    Raises
    ------
    InputError
        If there is no such column.
    """
    time = find_time_name(list(columns)) if options.time is None else options.time
    if time is None:
        refuse_without_times(source, columns)
    if time not in columns:
        raise InputError(f"{source} has no column {shorten(time)}; its columns are {join_names(columns)}.")
    stated = {name: units.get(name, "") or split_unit(name)[1] for name in columns}
    if columns[time].dtype.kind not in "biufMm":
        raise InputError(
            f"{source}: column {time!r} has neither numbers nor dates. Name the one with the times: time = ..."
        )
    times, time_unit, offset = _convert_times(columns[time], time, stated[time], options.keep_epoch)
    values = {
        name: np.asarray(column, dtype=np.float64)
        for name, column in columns.items()
        if name != time and column.dtype.kind in "biuf"
    }
    labels = {name: split_unit(name)[0] for name in values}
    return Log(
        times=times,
        values=values,
        units={name: stated[name] for name in values},
        time_unit=time_unit,
        source=source,
        offset=offset,
        labels={short: name for name, short in labels.items() if short not in values},
        rows=np.arange(1, len(times) + 1),
        time_name=time,
        time_zone=(zones or {}).get(time, "") if columns[time].dtype.kind == "M" else "UTC",
        has_dates=columns[time].dtype.kind == "M",
    )


def _convert_times(column: Any, name: str, unit: str, keep_epoch: bool) -> tuple[FloatArray, str, float]:
    """Return times, their unit, and what was subtracted from them: the first one, if they count from 1970.

    Integers are subtracted as such; doubles would round them. With `keep_epoch` numbers are left as they are.
    """
    second = np.timedelta64(1, "s")
    if column.dtype.kind == "M":
        first = column[~np.isnat(column)][0]
        micros = first.astype("datetime64[us]").astype(np.int64)
        return (column - first) / second, "s", float(micros) / 1e6
    if column.dtype.kind == "m":
        return column / second, "s", 0.0
    numbers = np.asarray(column, dtype=np.float64)
    unit = normalize_time_unit(unit)
    if unit not in SECONDS:  # it may be a word in the name, such as in seconds_elapsed or millis
        words = re.split(r"[ _.\-/]", name.lower())
        unit = next((TIME_UNITS[word] for word in words if len(word) > 3 and word in TIME_UNITS), "")
    finite = numbers[np.isfinite(numbers)]
    epoch = _find_epoch_unit(float(finite[0])) if len(finite) else None
    if epoch is None or (unit and unit != epoch) or (not unit and _are_uptimes(finite)):
        return numbers, unit, 0.0
    if keep_epoch:
        return numbers, epoch, 0.0
    if column.dtype.kind in "iu":
        return (column.astype(np.int64) - int(column[0])).astype(np.float64), epoch, float(column[0])
    return numbers - finite[0], epoch, float(finite[0])
