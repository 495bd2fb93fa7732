"""A fit of each of many logs: which logs, a line on each fit, and a table with a row for each."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from switchfit.cli.tables import list_columns, list_unknowns, write_rows
from switchfit.estimation.estimates import Estimate
from switchfit.io.logs.files import find_logs, name_files
from switchfit.report import numbers as numbers_module
from switchfit.report.frames import ERROR
from switchfit.report.verdict import write_reason
from switchfit.runtime.extras import import_library
from switchfit.uncertainty.quality import measure_quality

PARQUET = (".parquet", ".pq")
"""Endings of tables that are written as Parquet; all others are CSV."""


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
    # A log that two patterns match is fitted once.
    named = [log for path in paths for log in find_logs(Path(), str(path)) or [str(path)]]
    found = list(dict.fromkeys(named))
    return list(zip(name_files(found), map(Path, found), strict=True))


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
    message = "" if estimate.status.successful else estimate.message
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
        shown = numbers_module.label_quantity(unknown["unknown"], unknown["unit"])
        row |= {shown: unknown["value"], ERROR.format(shown): unknown["std_error"]}
    # Dates last, so that the columns of numbers are the same for logs with and without them.
    row |= {f"{unknown['unknown']} (date)": unknown["date"] for unknown in unknowns if unknown.get("date")}
    return {**row, "message": message}


def describe_row(row: Mapping[str, Any]) -> str:
    """Return the row of a log as one line of text: verdict and numbers, or the error.

    Parameters
    ----------
    row : mapping
    """
    numbers = []
    # An unknown is a column that has one for its standard error beside it.
    for name in (name for name in row if ERROR.format(name) in row):
        value, error, _ = numbers_module.format_rounded(row[name], row[ERROR.format(name)])
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
    # Rows differ: a log that was refused has no unknowns, and modes that collapse have none either.
    columns = sorted(list_columns(rows), key=lambda name: name == "message")  # which comes last
    if path.suffix.lower() not in PARQUET:
        return write_rows(rows, columns)
    # Whether it is installed was checked before the first fit.
    import pyarrow.parquet

    table, file = pyarrow.table({name: [row.get(name) for row in rows] for name in columns}), io.BytesIO()
    pyarrow.parquet.write_table(table, file)
    return file.getvalue()
