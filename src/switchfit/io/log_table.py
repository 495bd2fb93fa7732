"""Fit many logs one by one: find and load them, and write a table with a row for each, as CSV or Parquet."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from switchfit.estimation.estimator import Estimate
from switchfit.io.logs.files import find_logs, name_files
from switchfit.io.logs.libraries import import_library
from switchfit.io.result_tables import list_columns, list_unknowns, name_column, write_rows
from switchfit.report.dates import add_dates
from switchfit.report.frames import ERROR
from switchfit.report.numbers import format_rounded
from switchfit.report.verdict import write_reason
from switchfit.runtime.presentation import format_count
from switchfit.uncertainty.quality import measure_quality


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
    found: list[str] = []
    for path in paths:
        logs = find_logs(Path(), str(path))
        found += [str(path)] if logs is None else logs
    found = list(dict.fromkeys(found))
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
        import_library("pyarrow.parquet", "parquet", str(path), "or give the table a name that ends in .csv")


@dataclass
class ResultTable:
    """Results of fits to logs, in the order in which they were fitted.

    Attributes
    ----------
    rows : list of dict
        Of each log its columns; a column that does not apply to it is left out.
    unknowns : dict of str to str
        Names of the columns of the unknowns of all logs, with the unit in parentheses, and their units.
    refused, failed : int
    """

    rows: list[dict[str, Any]] = field(default_factory=list)
    unknowns: dict[str, str] = field(default_factory=dict)
    refused: int = 0
    failed: int = 0

    def __len__(self) -> int:
        return len(self.rows)

    def add(self, log: str, estimate: Estimate | None, error: str) -> None:
        """Add a row for a log: its estimate, or the error that kept it from being fitted.

        Parameters
        ----------
        log : str
        estimate : Estimate or None
        error : str
        """
        if estimate is None:
            self.refused += 1
            self.rows.append({"log": log, "verdict": "refused", "message": error})
            return
        self.failed += not estimate.success
        message = "" if estimate.status.successful else add_dates(estimate.message, estimate)
        if not message and not estimate.success:
            message = write_reason(estimate.verdict.reasons[0])
        quality = measure_quality(estimate)
        trajectory = estimate.trajectories[0]
        row: dict[str, Any] = {
            "log": log,
            "verdict": estimate.verdict.level,
            "status": estimate.status.name,
            "cost": float(estimate.cost),
            "values": estimate.samples,
            "chi2": float(quality.chi_square),
            "degrees of freedom": quality.freedom,
            "explained": float(quality.explained),
            "t0": float(trajectory.times[0]),
            "tf": float(trajectory.times[-1]),
            "time unit": trajectory.time_unit,
            "iterations": estimate.iterations,
            "seconds": float(estimate.seconds),
        }
        unknowns = list_unknowns(estimate)
        for unknown in unknowns:
            shown = name_column(unknown["name"], unknown["unit"])
            self.unknowns[shown] = unknown["unit"]
            row |= {shown: float(unknown["value"]), ERROR.format(shown): float(unknown["standard_error"])}
        row |= {f"{unknown['name']} (date)": unknown["date"] for unknown in unknowns if unknown.get("date")}
        self.rows.append({**row, "message": message})

    def describe_last(self) -> str:
        """Return the last row as one line of text: verdict and numbers, or the error."""
        row = self.rows[-1]
        if row["verdict"] == "refused":
            return f"{row['log']}: refused. {row['message']}"
        numbers = []
        for name in (name for name in self.unknowns if name in row):
            value, error, _ = format_rounded(row[name], row[ERROR.format(name)])
            numbers.append(f"{name} = {value} {error}".rstrip())
        message = f". {row['message']}" if row["message"] else ""
        return f"{row['log']}: {row['verdict']}. {', '.join(numbers)}{message}"

    def summarize(self, total: int) -> str:
        """Return how many logs were fitted, in a line.

        Parameters
        ----------
        total : int
            Logs that were to be fitted.
        """
        left = f"; {total - len(self)} were not begun" if total > len(self) else ""
        fitted = len(self) - self.refused - self.failed
        return f"{format_count(total, 'log')}: {fitted} fitted, {self.failed} not, {self.refused} refused{left}"

    def write(self, path: Path) -> str | bytes:
        """Return the content of the table's file, with the columns that any of the logs has.

        Parameters
        ----------
        path : Path
            Its ending says whether it is Parquet or CSV.
        """
        columns = sorted(list_columns(self.rows), key=lambda name: name == "message")  # which comes last
        return self._write_parquet(columns) if path.suffix.lower() in PARQUET else write_rows(self.rows, columns)

    def _write_parquet(self, columns: Sequence[str]) -> bytes:
        """Return Parquet; an empty cell is null, and the fields of unknowns have their units as metadata."""
        import pyarrow
        import pyarrow.parquet

        arrays, fields = [], []
        for name in columns:
            array = pyarrow.array([row.get(name) for row in self.rows])
            unit = self.unknowns.get(name.removesuffix(ERROR.format("")), "")
            arrays.append(array)
            fields.append(pyarrow.field(name, array.type, metadata={"unit": unit} if unit else None))
        file = io.BytesIO()
        pyarrow.parquet.write_table(pyarrow.table(arrays, schema=pyarrow.schema(fields)), file)
        return file.getvalue()
