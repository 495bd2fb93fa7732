"""`Log`: times, named channels with units, and what is odd about them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta
from typing import TYPE_CHECKING, Any, NamedTuple, overload

import numpy as np
from numpy.typing import DTypeLike, NDArray

from switchfit.arrays import FloatArray
from switchfit.problem.dates import Dates
from switchfit.problem.time_units import SECONDS_OF_UNIT
from switchfit.problem.validation.messages import join_names, shorten
from switchfit.runtime.errors import InputError
from switchfit.runtime.frames import Column, Frame, build_pandas
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import format_line, join_first

if TYPE_CHECKING:
    import pandas


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
        length = 1e6 * SECONDS_OF_UNIT[self.time_unit or "s"]
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
        return datetime(1970, 1, 1, tzinfo=UTC) + timedelta(
            seconds=self.offset * SECONDS_OF_UNIT[self.time_unit or "s"]
        )

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
    def __getitem__(self, name: str | Sequence[str]) -> FloatArray | Log:
        if isinstance(name, str):
            return self.values[self.find_channel(name)]
        if isinstance(name, Sequence):
            # A name in the header may be a label; the channels of the new log have their own names.
            names = [self.find_channel(entry) for entry in name]
            return replace(
                self,
                values={own: self.values[own] for own in names},
                units={own: self.units.get(own, "") for own in names},
                labels={label: own for label, own in self.labels.items() if own in names},
            )
        raise TypeError(f'A log is indexed by a name or a list of names, as in log["x"]; got {shorten(name)}.')

    def __array__(self, dtype: DTypeLike | None = None, copy: bool | None = None) -> NDArray[Any]:
        """All channels as a (K, q) array."""
        # NumPy calls this wherever a log is given in place of an array, as in Measurements(log.times, log[[...]]).
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

    def to_pandas(self) -> pandas.DataFrame:
        """Return a pandas DataFrame with the times as its index, and the units in ``attrs["units"]``.

        See Also
        --------
        read_log

        Examples
        --------
        >>> from pathlib import Path
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
