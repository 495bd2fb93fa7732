"""`read_log`: the reader of a file's format, then the local frame, the checks and the repairs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from switchfit.io.logs.log import Log
from switchfit.io.logs.quality import check_repairs, inspect_log
from switchfit.io.logs.text import read_text
from switchfit.io.logs.units import SECONDS
from switchfit.problem.validation import as_choice, as_names, as_path


@dataclass(frozen=True)
class Options:
    """What the reader of a format is told.

    Attributes
    ----------
    columns : sequence of str, optional
    time : str, optional
    keep_epoch, drop_broken : bool
    """

    columns: Sequence[str] | None = None
    time: str | None = None
    keep_epoch: bool = False
    drop_broken: bool = False


def read_log(
    path: str | Path,
    *,
    columns: Sequence[str] | None = None,
    time: str | None = None,
    time_unit: str | None = None,
    repair: str | Sequence[str] = (),
) -> Log:
    """Read a log: a table of text in any dialect.

    Parameters
    ----------
    path : str or Path
        The file, which gzip may have compressed.
    columns : sequence of str, optional
        Names of the channels that are wanted; left out, all that are numbers.
    time : str, optional
        The column with the times; left out, the one that is called so.
    time_unit : {"ns", "us", "ms", "s", "min", "h", "d"}, optional
        Convert the times to this unit. Times of a file that states no unit are taken to be in it.
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
        For anything wrong with the file, with its name and the line.

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
    return read_source(
        as_path(path, "path"), columns=columns, time=time, time_unit=time_unit, repair=repair, keep_epoch=False
    )


def read_source(
    path: Path,
    *,
    columns: Sequence[str] | None,
    time: str | None,
    time_unit: str | None,
    repair: str | Sequence[str],
    keep_epoch: bool,
) -> Log:
    """Read a log as `read_log` does.

    Parameters
    ----------
    path, columns, time, time_unit, repair
        As of `read_log`.
    keep_epoch : bool
        Leave numbers that count from 1970 as they are.
    """
    repairs = check_repairs(repair)
    if columns is not None:
        columns = as_names((columns,) if isinstance(columns, str) else columns, "columns", "a sequence of strings")
    if time_unit is not None:
        as_choice(time_unit, "time_unit", tuple(SECONDS))
    options = Options(columns, time, keep_epoch, "drop-broken-lines" in repairs)
    log = inspect_log(_choose_reader(path)(path, options), repairs)
    return log if time_unit is None else convert_times(log, time_unit)


def convert_times(log: Log, unit: str) -> Log:
    """Return the log with its times in another unit; times without a unit are taken to be in it.

    Parameters
    ----------
    log : Log
    unit : str
        A key of `SECONDS`.
    """
    if log.time_unit in ("", unit):
        return replace(log, time_unit=unit)
    factor = SECONDS[log.time_unit] / SECONDS[unit]
    if factor < 1:  # a division is exact where a product is not: 40 ms are 0.04 s
        inverse = SECONDS[unit] / SECONDS[log.time_unit]
        inverse = round(inverse) if abs(inverse - round(inverse)) < 1e-6 else inverse
        return _scale_times(log, unit, lambda t: t / inverse)
    return _scale_times(log, unit, lambda t: t * factor)


def _scale_times(log: Log, unit: str, scale: Callable[..., float]) -> Log:
    events = tuple(event._replace(time=scale(event.time)) for event in log.events)
    return replace(log, times=scale(log.times), offset=scale(log.offset), time_unit=unit, events=events)  # type: ignore[arg-type]


def _choose_reader(path: Path) -> Callable[[Path, Options], Log]:
    """Return the reader of a file by its first bytes and the end of its name."""
    return _read_text


def _read_text(path: Path, options: Options) -> Log:
    return read_text(
        path,
        columns=options.columns,
        time=options.time,
        keep_epoch=options.keep_epoch,
        drop_broken=options.drop_broken,
    )
