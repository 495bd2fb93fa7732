"""Results as tables in CSV files: a row for each unknown, for each run, or for whatever is given."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from switchfit.estimation.estimates import Estimate
from switchfit.report.selection import SCREEN
from switchfit.runtime.frames import describe_frame
from switchfit.uncertainty.quality import measure_quality


def list_unknowns(estimate: Estimate) -> list[dict[str, Any]]:
    """Return a row for each unknown, with the columns of `Estimate.to_pandas`.

    Parameters
    ----------
    estimate : Estimate
    """
    frame = describe_frame(estimate)
    return zip_rows({each.name: each.values.tolist() for each in (*frame.index, *frame.columns)})


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
            # Of the channel that is explained worst, as in the report: a mean would hide it.
            "explained": min((c.explained for c in here if np.isfinite(c.explained)), default=np.nan),
        }
        if trajectory.origin is not None:
            row["origin"] = trajectory.origin.date
        rows.append(row)
    return write_rows(rows)


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
    # CRLF, as RFC 4180 has it: spreadsheets on Windows need it, others take it.
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


def list_tables(estimate: Estimate) -> dict[str, str]:
    """Return the tables that a screen of the report has no room for, as CSV, by the names of their files.

    Parameters
    ----------
    estimate : Estimate
    """
    # Only what the report leaves out: a fit of one run has no tables.
    runs = {"runs": write_runs(estimate)} if len(estimate.run_names) > SCREEN["experiments"] else {}
    return runs | ({"unknowns": write_unknowns(estimate)} if len(estimate.theta) > SCREEN["unknowns"] else {})
