"""Fit many logs one by one: find and load them, and write a table with a row for each, as CSV or Parquet."""

from __future__ import annotations

import csv
import importlib
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from switchfit.estimation.estimator import Estimate
from switchfit.io.logs.files import find_logs, name_logs
from switchfit.io.problem_file import ProblemFile, load_problem
from switchfit.report.dates import add_dates, list_dated
from switchfit.report.numbers import format_rounded
from switchfit.report.verdict import write_reason
from switchfit.runtime.errors import InputError
from switchfit.runtime.presentation import format_count
from switchfit.uncertainty.quality import measure_quality
from switchfit.uncertainty.residuals import correct_errors


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
    return list(zip(name_logs(found), map(Path, found), strict=True))


def load_log(problem: Path, log: Path) -> tuple[ProblemFile | None, str]:
    """Return a problem file with the data of a log; None and an error message if it cannot be loaded.

    Parameters
    ----------
    problem, log : Path
    """
    try:
        return load_problem(problem, log), ""
    except (ValueError, OSError) as error:
        return None, str(error)


PARQUET = (".parquet", ".pq")
"""Endings of tables that are written as Parquet; all others are CSV."""

ERROR = "{} std. error"
"""Name of the column beside that of an unknown."""


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
        try:
            importlib.import_module("pyarrow.parquet")
        except ImportError as error:
            raise InputError(
                f"{path} is written with pyarrow, which cannot be imported ({error}): pip install "
                "'switchfit[parquet]', or give the table a name that ends in .csv."
            ) from error


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
        units, errors = estimate.theta_units, correct_errors(estimate)
        for name, unit, value, error_of in zip(estimate.theta_names, units, estimate.theta, errors, strict=True):
            shown = f"{name} ({unit})" if unit and unit != "1" else name
            self.unknowns[shown] = unit
            row |= {shown: float(value), ERROR.format(shown): float(error_of)}
        for name, value, run in zip(estimate.theta_names, estimate.theta, list_dated(estimate), strict=True):
            date = None if run is None or run.origin is None else run.origin.find_date(value, run.time_unit)
            row |= {} if date is None else {f"{name} (date)": date.isoformat()}
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
        columns = list(dict.fromkeys(name for row in self.rows for name in row if name != "message"))
        columns.append("message")
        return self._write_parquet(columns) if path.suffix.lower() in PARQUET else self._write_csv(columns)

    def _write_csv(self, columns: Sequence[str]) -> str:
        """Return CSV; numbers have the digits that it takes to read the same ones, and NaN is an empty cell."""
        text = io.StringIO()
        table = csv.DictWriter(text, columns, restval="", lineterminator="\r\n")
        table.writeheader()
        for row in self.rows:
            table.writerow({name: "" if isinstance(x, float) and np.isnan(x) else x for name, x in row.items()})
        return text.getvalue()

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
