"""Many logs fitted one by one: which they are, and a table with a line for each."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from switchfit.estimation.estimator import Estimate
from switchfit.io.logs.files import find_logs, name_logs
from switchfit.io.problem_file import ProblemFile, load_problem
from switchfit.report.dates import list_dated
from switchfit.report.verdict import write_reason
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
    """Return a problem file with a log in it, or None and what is wrong.

    Parameters
    ----------
    problem, log : Path
    """
    try:
        return load_problem(problem, log), ""
    except (ValueError, OSError) as error:
        return None, str(error)


@dataclass
class ResultTable:
    """Results of fits to logs, in the order in which they were fitted."""

    rows: list[dict[str, str]] = field(default_factory=list)
    refused: int = 0
    failed: int = 0

    def __len__(self) -> int:
        return len(self.rows)

    def add(self, log: str, estimate: Estimate | None, error: str) -> None:
        """Add a log with its estimate, or with what is wrong with it.

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
        message = "" if estimate.status.successful else estimate.message
        if not message and not estimate.success:
            message = write_reason(estimate.verdict.reasons[0])
        row = {"log": log, "verdict": estimate.verdict.level, "status": estimate.status.name}
        row |= {"cost": repr(float(estimate.cost))}
        units, errors = estimate.theta_units, correct_errors(estimate)
        for name, unit, value, error_of in zip(estimate.theta_names, units, estimate.theta, errors, strict=True):
            shown = f"{name} ({unit})" if unit and unit != "1" else name
            row |= {shown: repr(float(value)), f"{shown} std. error": repr(float(error_of))}
        for name, value, run in zip(estimate.theta_names, estimate.theta, list_dated(estimate), strict=True):
            date = None if run is None or run.origin is None else run.origin.find_date(value, run.time_unit)
            row |= {} if date is None else {f"{name} (date)": date.isoformat()}
        self.rows.append({**row, "message": message})

    def describe_last(self) -> str:
        """Return the log that was added last in a line: its verdict and its numbers, or what is wrong."""
        row = self.rows[-1]
        if row["verdict"] == "refused":
            return f"{row['log']}: refused. {row['message']}"
        skipped = ("log", "verdict", "status", "cost", "message")
        numbers = [
            f"{name} = {float(value):.6g} +- {float(row[f'{name} std. error']):.2g}"
            for name, value in row.items()
            if name not in skipped and not name.endswith((" std. error", " (date)"))
        ]
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
        return f"{total} logs: {fitted} fitted, {self.failed} not, {self.refused} refused{left}"

    def write(self) -> str:
        """Return the table as CSV, with the columns that any of the logs has."""
        columns = list(dict.fromkeys(name for row in self.rows for name in row if name != "message"))
        text = io.StringIO()
        table = csv.DictWriter(text, [*columns, "message"], restval="", lineterminator="\r\n")
        table.writeheader()
        table.writerows(self.rows)
        return text.getvalue()
