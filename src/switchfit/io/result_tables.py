"""Tables of all runs and all unknowns of a fit as CSV, however many."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from switchfit.estimation.estimator import Estimate
from switchfit.fit.result import Fit
from switchfit.optimize.arrow import ArrowLayout
from switchfit.problem.problem import Problem
from switchfit.report.dates import format_iso, list_dated
from switchfit.report.frames import ERROR, list_holds
from switchfit.uncertainty.answers import UNLIKELY
from switchfit.uncertainty.quality import ChannelQuality, measure_quality
from switchfit.uncertainty.residuals import correct_errors, correct_intervals


def write_unknowns(fit: Fit) -> str:
    """Return a CSV table with a line for each unknown: value, standard error, interval, first guess, what holds it.

    Standard errors and intervals are those of the report, which allow for correlated residuals; the naive standard
    errors stand beside them.

    Parameters
    ----------
    fit : Fit
    """
    joins = {transition.index: f"{transition.before} -> {transition.after}" for transition in fit.transitions}
    errors, naive, intervals = correct_errors(fit), fit.standard_errors, correct_intervals(fit)
    rows = []
    for i, (name, run) in enumerate(zip(fit.theta_names, list_dated(fit), strict=True)):
        low, high = intervals[i]
        row = {
            "name": name,
            "unit": fit.theta_units[i],
            "value": fit.theta[i],
            "std. error": errors[i],
            "naive": naive[i],
            "low 95 %": low,
            "high 95 %": high,
            "first guess": fit.initial_theta[i],
            "transition": joins.get(i, ""),
            "held": "; ".join(list_holds(fit, name)),
        }
        if run is not None:
            times = {"date": fit.theta[i], "date low 95 %": low, "date high 95 %": high}
            row |= {column: format_iso(time, run) for column, time in times.items()}
        rows.append(row)
    return write_rows(rows)


def write_runs(estimate: Estimate) -> str:
    """Return a CSV table with a line for each run: modes, data, how well it fits, its own unknowns and their errors.

    An unknown is called as the model calls it, so that those of all runs share a column.

    Parameters
    ----------
    estimate : Estimate
        With its problem.
    """
    problem = estimate.evaluator_at_solution().problem
    errors, quality = correct_errors(estimate), measure_quality(estimate)
    any_dated = any(trajectory.origin is not None for trajectory in estimate.trajectories)
    rows = []
    for e, own in enumerate(_name_own_unknowns(problem, estimate)):
        trajectory = estimate.trajectories[e]
        here = [channel for channel in quality.channels if channel.experiment == e]
        row = {
            "run": estimate.run_names[e],
            "modes": " -> ".join(mode for mode, _, _ in trajectory.mode_spans),
            "t0": trajectory.times[0],
            "tf": trajectory.times[-1],
            "time unit": trajectory.time_unit,
            "values": sum(channel.count for channel in here),
            "chi2": sum(channel.chi_square for channel in here) if here else np.nan,
            "explained": min((c.explained for c in here if np.isfinite(c.explained)), default=np.nan),
            "flags": "; ".join(_list_flags(estimate, e, here, own, len(quality.channels))),
        }
        if any_dated:
            row["origin"] = "" if trajectory.origin is None else trajectory.origin.date
        for column, place in own.items():
            row |= {column: estimate.theta[place], ERROR.format(column): errors[place]}
        rows.append(row)
    return write_rows(rows)


def _name_own_unknowns(problem: Problem, fit: Fit) -> Iterator[dict[str, int]]:
    """Yield where in theta the unknowns of each run alone stand, by the model's names, transition times first."""
    unknowns, ends = problem.unknowns, fit.final_places
    layout = ArrowLayout.of(len(fit.theta), problem.places)
    spans = {i: name for name, span in unknowns.parameters.items() for i in range(span.start, span.stop)}
    for e, experiment in enumerate(problem.experiments):
        times = {int(place): f"tau_{k + 1}" for k, place in enumerate(fit.transition_places[e])} | {ends[e]: "tf"}
        inside = {experiment.parameter_map.get(name, name): name for name, _, _ in problem.structures[e].parameters}
        found = {}
        for i in (int(place) for place in layout.own[e] if place < layout.size):
            name = fit.theta_names[i]
            if i in times:
                column = times[i]
            elif i in spans:
                column = name.replace(spans[i], inside.get(spans[i], spans[i]), 1)
            else:
                column = name.removeprefix(f"{fit.run_names[e]}.")
            unit = fit.theta_units[i]
            found[f"{column} ({unit})" if unit and unit != "1" else column] = i
        yield found


def _list_flags(
    fit: Fit, e: int, channels: Sequence[ChannelQuality], own: dict[str, int], tested: int
) -> Iterator[str]:
    """Yield the flags of a run; the false alarms of chi-square are shared among all channels `tested`."""
    words = {"model": "residuals of {} correlated", "outliers": "outliers in {}", "sigma": "chi2 of {} too large"}
    for channel in channels:
        failed = [name for name, probability in channel.tests.items() if probability * tested < UNLIKELY]
        yield from (words[name].format(channel.label) for name in failed)
    for constraint in fit.active:
        if constraint.position is not None and constraint.run == fit.run_names[e]:
            state = "collapsed" if constraint.kind == "collapsed" else "at its minimum duration"
            yield f"mode {constraint.mode} {state}"
    for column, i in own.items():
        for hold in list_holds(fit, fit.theta_names[i]):
            yield f"{column} {hold}"


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
