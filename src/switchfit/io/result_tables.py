"""Tables of all runs and all unknowns of a fit as CSV, however many."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence

import numpy as np

from switchfit.estimation.estimator import Estimate
from switchfit.fit.result import Fit
from switchfit.optimize.arrow import ArrowLayout
from switchfit.problem.problem import Problem
from switchfit.report.dates import format_iso, list_dated
from switchfit.report.frames import list_holds
from switchfit.uncertainty.quality import ChannelQuality, measure_quality
from switchfit.uncertainty.residuals import correct_errors, correct_intervals
from switchfit.uncertainty.verdict import CLEARLY_OFF, UNLIKELY


def write_unknowns(fit: Fit) -> str:
    """Return a CSV table with a line for each unknown: value, standard error, interval, first guess, what holds it.

    Standard errors and intervals are those of the report, which allow for correlated residuals; the naive standard
    errors stand beside them.

    Parameters
    ----------
    fit : Fit
    """
    header = [
        "name",
        "unit",
        "value",
        "std. error",
        "naive",
        "low 95 %",
        "high 95 %",
        "first guess",
        "transition",
        "held",
    ]
    dated = list_dated(fit)
    any_dated = any(run is not None for run in dated)
    header += ["date", "date low 95 %", "date high 95 %"] if any_dated else []
    joins = {transition.index: f"{transition.before} -> {transition.after}" for transition in fit.transitions}
    errors, naive, intervals = correct_errors(fit), fit.standard_errors, correct_intervals(fit)
    rows = []
    for i, name in enumerate(fit.theta_names):
        numbers = [fit.theta[i], errors[i], naive[i], *intervals[i], fit.initial_theta[i]]
        held = "; ".join(list_holds(fit, name))
        run = dated[i]
        shown = [] if not any_dated else [fit.theta[i], *intervals[i]]
        dates = ["" if run is None else format_iso(time, run) for time in shown]
        rows.append([name, fit.theta_units[i], *map(_format_number, numbers), joins.get(i, ""), held, *dates])
    return _write(header, rows)


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
    names = list(_name_own_unknowns(problem, estimate))
    columns = list(dict.fromkeys(column for own in names for column in own))
    header = ["run", "modes", "t0", "tf", "time unit", "values", "chi2", "explained", "flags"]
    any_dated = any(trajectory.origin is not None for trajectory in estimate.trajectories)
    header += ["origin"] if any_dated else []
    header += [part for column in columns for part in (column, f"{column} std. error")]
    rows = []
    for e, (own, trajectory) in enumerate(zip(names, estimate.trajectories, strict=True)):
        here = [channel for channel in quality.channels if channel.experiment == e]
        row = [
            estimate.run_names[e],
            " -> ".join(mode for mode, _, _ in trajectory.mode_spans),
            _format_number(trajectory.times[0]),
            _format_number(trajectory.times[-1]),
            trajectory.time_unit,
            str(sum(channel.count for channel in here)),
            _format_number(sum(channel.chi_square for channel in here) if here else np.nan),
            _format_number(min((c.explained for c in here if np.isfinite(c.explained)), default=np.nan)),
            "; ".join(_list_flags(estimate, e, here, own, len(quality.channels))),
        ]
        row += ["" if trajectory.origin is None else trajectory.origin.date] if any_dated else []
        for column in columns:
            place = own.get(column)
            row += ["", ""] if place is None else [_format_number(estimate.theta[place]), _format_number(errors[place])]
        rows.append(row)
    return _write(header, rows)


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
    for channel in channels:
        if channel.probability < UNLIKELY / tested and channel.chi_square > (1 + CLEARLY_OFF) * channel.count:
            yield f"chi2 of {channel.label} too large"
        if channel.correlated:
            yield f"residuals of {channel.label} correlated"
    for constraint in fit.active:
        if constraint.position is not None and constraint.run == fit.run_names[e]:
            state = "collapsed" if constraint.kind == "collapsed" else "at its minimum duration"
            yield f"mode {constraint.mode} {state}"
    for column, i in own.items():
        for hold in list_holds(fit, fit.theta_names[i]):
            yield f"{column} {hold}"


def _format_number(value: float) -> str:
    """Return a number with all its digits; an empty cell for NaN."""
    return "" if np.isnan(value) else repr(float(value))


def _write(header: list[str], rows: list[list[str]]) -> str:
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\r\n")
    table.writerow(header)
    table.writerows(rows)
    return text.getvalue()


TABLES = {"runs": write_runs, "unknowns": write_unknowns}
"""Tables of a fit by the names of their files."""
