"""Tables of all runs and all unknowns of a fit as CSV, however many.

Fit many logs one by one: find and load them, and write a table with a row for each, as CSV or Parquet.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from switchfit.estimation.estimator import Estimate
from switchfit.fit.result import Fit
from switchfit.fit.trajectory import Trajectory
from switchfit.io.logs import find_logs, name_files
from switchfit.report.formats import add_dates, format_rounded, label_quantity
from switchfit.report.frames import ERROR
from switchfit.report.sentences import write_reason
from switchfit.runtime.errors import import_library
from switchfit.runtime.frames import describe_frame
from switchfit.uncertainty.answers import UNLIKELY
from switchfit.uncertainty.residuals import ChannelQuality, measure_quality


def list_unknowns(estimate: Estimate) -> list[dict[str, Any]]:
    """Return a row for each unknown, with the columns of `Estimate.to_pandas`.

    Parameters
    ----------
    estimate : Estimate
    """
    frame = describe_frame(estimate)
    columns = (*frame.index, *(each for each in frame.variables if each.dimensions == (frame.rows,)))
    return zip_rows({each.name: each.values.tolist() for each in columns})


def zip_rows(columns: Mapping[str, Iterable[Any]]) -> list[dict[str, Any]]:
    """Return the rows of a table, each a dict, from its columns.

    Parameters
    ----------
    columns : mapping of str to iterable
        All of one length.
    """
    return [dict(zip(columns, entries, strict=True)) for entries in zip(*columns.values(), strict=True)]


def write_unknowns(estimate: Estimate) -> str:
    """Return a CSV table with a line for each unknown, with the columns of `Estimate.to_pandas`.

    Parameters
    ----------
    estimate : Estimate
    """
    return write_rows(list_unknowns(estimate))


def write_runs(estimate: Estimate) -> str:
    """Return a CSV table with a line for each run: modes, data, how well it fits, and what is wrong with it.

    Parameters
    ----------
    estimate : Estimate
    """
    quality = measure_quality(estimate)
    any_dated = any(trajectory.origin is not None for trajectory in estimate.trajectories)
    rows = []
    for e, (name, trajectory) in enumerate(zip(estimate.run_names, estimate.trajectories, strict=True)):
        here = [channel for channel in quality.channels if channel.experiment == e]
        row = {
            "run": name,
            "modes": " -> ".join(mode for mode, _, _ in trajectory.mode_spans),
            "t0": trajectory.times[0],
            "tf": trajectory.times[-1],
            "time unit": trajectory.time_unit,
            "values": sum(channel.count for channel in here),
            "chi2": sum(channel.chi_square for channel in here) if here else np.nan,
            "explained": min((c.explained for c in here if np.isfinite(c.explained)), default=np.nan),
            "flags": "; ".join(_list_flags(estimate, name, here, len(quality.channels))),
        }
        if any_dated:
            row["origin"] = "" if trajectory.origin is None else trajectory.origin.date
        rows.append(row)
    return write_rows(rows)


def write_trajectories(names: Sequence[str], runs: Sequence[Trajectory]) -> str:
    """Return trajectories as CSV: a row for each node or time, with the run, the mode and the states.

    Parameters
    ----------
    names : sequence of str
    runs : sequence of Trajectory

    Raises
    ------
    ValueError
        If they have times in different units.
    """
    units = {run.time_unit for run in runs}
    if len(units) > 1:
        raise ValueError(
            f"the experiments have times in different units ({', '.join(sorted(units))}), and one column of the "
            "CSV file would mix them: give each its own problem file."
        )
    (unit,) = units
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\r\n")
    dated = any(run.origin is not None for run in runs)
    columns = ["t" if unit == "s" else f"t ({unit})", *(["date"] if dated else [])]
    table.writerow(["experiment", *columns, "mode", *runs[0].state_names])
    for name, run in zip(names, runs, strict=True):
        dates = [""] * len(run.times) if run.dates is None else [date.isoformat() for date in run.dates]
        for t, date, mode, x in zip(run.times.tolist(), dates, run.modes, run.states.tolist(), strict=True):
            table.writerow([name, t, *([date] if dated else []), mode, *x])
    return text.getvalue()


def _list_flags(fit: Fit, run: str, channels: Sequence[ChannelQuality], tested: int) -> Iterator[str]:
    """Yield the flags of a run; the false alarms of chi-square are shared among all channels `tested`."""
    words = {"model": "residuals of {} correlated", "outliers": "outliers in {}", "sigma": "chi2 of {} too large"}
    for channel in channels:
        failed = [name for name, probability in channel.tests.items() if probability * tested < UNLIKELY]
        yield from (words[name].format(channel.label) for name in failed)
    for constraint in fit.active:
        if constraint.position is not None and constraint.run == run:
            state = "collapsed" if constraint.kind == "collapsed" else "at its minimum duration"
            yield f"mode {constraint.mode} {state}"


def write_rows(rows: Sequence[Mapping[str, Any]], columns: Iterable[str] = ()) -> str:
    """Return CSV; numbers have the digits that it takes to read the same ones, and NaN is an empty cell.

    Parameters
    ----------
    rows : sequence of mapping
        Of each row its cells by columns, an empty one where a column is left out.
    columns : iterable of str, optional
        Left out, those of all rows as they come.
    """
    text = io.StringIO()
    table = csv.DictWriter(text, list(columns) or list_columns(rows), restval="", lineterminator="\r\n")
    table.writeheader()
    for row in rows:
        table.writerow({name: "" if isinstance(cell, float) and np.isnan(cell) else cell for name, cell in row.items()})
    return text.getvalue()


def list_columns(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the columns that any row has.

    Parameters
    ----------
    rows : sequence of mapping
    """
    return list(dict.fromkeys(name for row in rows for name in row))


TABLES = {"runs": write_runs, "unknowns": write_unknowns}
"""Tables of a fit by the names of their files."""


def list_logs(paths: Sequence[Path]) -> list[tuple[str, Path]]:
    """Return (name, path) of all logs that paths, patterns and folders stand for.

    Parameters
    ----------
    paths : sequence of Path

    Raises
    ------
    InputError
        If a pattern matches nothing.
    """
    named = [log for path in paths for log in find_logs(Path(), str(path)) or [str(path)]]
    found = list(dict.fromkeys(named))
    return list(zip(name_files(found), map(Path, found), strict=True))


PARQUET = (".parquet", ".pq")
"""Endings of tables that are written as Parquet; all others are CSV."""


def check_table(path: Path) -> None:
    """Raise for a table that cannot be written, before any log is fitted.

    Parameters
    ----------
    path : Path

    Raises
    ------
    InputError
        If it is to be Parquet, and pyarrow is not installed.
    """
    if path.suffix.lower() in PARQUET:
        import_library(
            "pyarrow.parquet", str(path), "'switchfit[parquet]'", ", or give the table a name that ends in .csv"
        )


def describe_fit(log: str, estimate: Estimate | None, error: str) -> dict[str, Any]:
    """Return the row of a log: its estimate, or the error that kept it from being fitted.

    A column that does not apply to it is left out. The message is empty for a fit that is good or doubtful.

    Parameters
    ----------
    log : str
    estimate : Estimate or None
    error : str
    """
    if estimate is None:
        return {"log": log, "verdict": "refused", "message": error}
    message = "" if estimate.status.successful else add_dates(estimate.message, estimate)
    if not message and not estimate.success:
        message = write_reason(estimate.verdict.reasons[0])
    quality, trajectory = measure_quality(estimate), estimate.trajectories[0]
    row: dict[str, Any] = {
        "log": log,
        "verdict": estimate.verdict.level,
        "status": estimate.status.name,
        "cost": float(estimate.cost),
        "values": estimate.samples,
        "chi2": float(quality.chi_square),
        "degrees of freedom": estimate.freedom,
        "explained": float(quality.explained),
        "t0": float(trajectory.times[0]),
        "tf": float(trajectory.times[-1]),
        "time unit": trajectory.time_unit,
        "iterations": estimate.iterations,
        "seconds": float(estimate.seconds),
    }
    unknowns = list_unknowns(estimate)
    for unknown in unknowns:
        shown = label_quantity(unknown["unknown"], unknown["unit"])
        row |= {shown: unknown["value"], ERROR.format(shown): unknown["std_error"]}
    row |= {f"{unknown['unknown']} (date)": unknown["date"] for unknown in unknowns if unknown.get("date")}
    return {**row, "message": message}


def describe_row(row: Mapping[str, Any]) -> str:
    """Return the row of a log as one line of text: verdict and numbers, or the error.

    Parameters
    ----------
    row : mapping
    """
    numbers = []
    for name in (name for name in row if ERROR.format(name) in row):
        value, error, _ = format_rounded(row[name], row[ERROR.format(name)])
        numbers.append(f"{name} = {value} {error}".rstrip())
    return ". ".join(filter(None, [f"{row['log']}: {row['verdict']}", ", ".join(numbers), row["message"]]))


def write_logs(rows: Sequence[Mapping[str, Any]], path: Path) -> str | bytes:
    """Return the content of the table of logs, with the columns that any of them has.

    Parameters
    ----------
    rows : sequence of mapping
    path : Path
        Its ending says whether it is Parquet or CSV.
    """
    columns = sorted(list_columns(rows), key=lambda name: name == "message")  # which comes last
    if path.suffix.lower() not in PARQUET:
        return write_rows(rows, columns)
    import pyarrow.parquet

    def find_unit(column: str) -> str:  # of an unknown, which has it in parentheses
        name = column.removesuffix(ERROR.format(""))
        return name[:-1].rpartition(" (")[2] if ERROR.format(name) in columns and name.endswith(")") else ""

    table, file = pyarrow.table({name: [row.get(name) for row in rows] for name in columns}), io.BytesIO()
    units = map(find_unit, columns)
    fields = [f.with_metadata({"unit": unit} if unit else {}) for f, unit in zip(table.schema, units, strict=True)]
    pyarrow.parquet.write_table(table.cast(pyarrow.schema(fields)), file)
    return file.getvalue()
