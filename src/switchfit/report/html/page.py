"""The page: what the templates show, and the JSON that the page's script turns into figures.

Import this only where Bokeh and Jinja2 are installed.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from bokeh.embed import json_item
from bokeh.resources import Resources

from switchfit.estimation.estimator import Estimate
from switchfit.fit.result import Fit
from switchfit.problem.parameter import unit_suffix
from switchfit.report import text
from switchfit.report.dates import add_dates, describe_clock, format_span, list_dated
from switchfit.report.html.columns import FigureData, collect_diagnostics, collect_run
from switchfit.report.html.curves import Curves, choose_points, collect_curves, list_places
from switchfit.report.html.figures import describe_layout, draw_convergence, draw_diagnostics, draw_run, draw_slice
from switchfit.report.html.inputs import collect_inputs
from switchfit.report.html.sliders import Slider, build_sliders
from switchfit.report.numbers import format_unit
from switchfit.report.plot import choose_mode_colours
from switchfit.report.tables import Table
from switchfit.report.uncertainty import tabulate_certificate, tabulate_diagnostics, write_direction
from switchfit.report.verdict import format_share, write_reason, write_step
from switchfit.report.wording import join_words
from switchfit.uncertainty.certificate import certify
from switchfit.uncertainty.issues import find_issues
from switchfit.uncertainty.quality import explain_channel, explain_worst, rank_runs
from switchfit.uncertainty.residuals import diagnose

MOST_RUNS = 12
"""Experiments whose figures are in a page, those that are explained worst."""
MOST_CHANNELS = 6
"""Channels of a run that are shown at first; the others are switched on."""
MOST_DIAGNOSED = 8
"""Channels of a run whose residuals have figures."""
MOST_SLIDERS = 24
"""Sliders of one run."""
FIRST_ROWS = 40
"""Unknowns that are listed first: those at a bound or a kink, parameters, transition times; all are behind them."""
MOST_ROWS = 300
"""Rows of a table; what is left out is counted."""
MOST_CORRELATED = 60
"""Unknowns in the heat map."""
SMALL_GAP = 1e-3
"""Part of its range by which a curve is not seen to be off."""
MOST_PAIRS = 12
"""Correlations that are listed beside it."""


@dataclass(frozen=True)
class Run:
    """One experiment in a page.

    Attributes
    ----------
    number : int, from 0
        Its place in the page.
    e : int
        Its place in the fit.
    name, explained : str
    modes : tuple of (mode, colour, span)
    channels : tuple of (label, shown)
        What can be switched on and off.
    diagnosed : tuple of str
        Channels whose residuals have figures.
    notes : tuple of str
    """

    number: int
    e: int
    name: str
    explained: str
    modes: tuple[tuple[str, str, str], ...]
    channels: tuple[tuple[str, bool], ...]
    diagnosed: tuple[str, ...]
    notes: tuple[str, ...]


def build_page(estimate: Estimate, problem_file: Path | None, options: Mapping[str, object] | None) -> str:
    """Return the report of an estimate as one HTML page.

    Parameters
    ----------
    estimate : Estimate
    problem_file : Path or None
    options : mapping of str to object, or None
    """
    folder = jinja2.PackageLoader("switchfit.report.html", "templates")
    environment = jinja2.Environment(
        loader=folder, autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    runs, payload = _prepare_figures(estimate)
    library = "".join(Resources(mode="inline", components=["bokeh"]).js_raw)
    return environment.get_template("report.html").render(
        _collect_content(estimate),
        inputs=collect_inputs(estimate, problem_file, options),
        runs=runs,
        sliders=payload["sliders"],
        sliders_cut=any(len(list_places(estimate, run.e)) > MOST_SLIDERS for run in runs),
        payload=_write_json(payload),
        library=library,
    )


def _write_json(value: Any) -> str:
    """Return JSON that can stand inside a script element."""
    written = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return written.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


# --- sentences and tables ---------------------------------------------------------------------------------------------


def _collect_content(estimate: Estimate) -> dict[str, Any]:
    """Return what the template shows as text; the sentences are those of the report as text."""
    verdict, found, diagnostics = estimate.verdict, estimate.identifiability, diagnose(estimate)
    listed = text.select_unknowns(estimate, MOST_ROWS)
    everything, note = text.tabulate_unknowns(estimate, listed, ends=True)
    first = set(text.select_unknowns(estimate, FIRST_ROWS))
    rows = [row for i, row in zip(listed, everything.rows[1:], strict=True) if i in first]
    channels, shares = text.tabulate_channels(estimate)
    worst = [0, *(1 + k for k in np.argsort(shares, kind="stable").tolist())][: MOST_ROWS + 1]
    certificate = estimate.known_certificate or certify(estimate, None)
    pairs = [[f"{one}, {other}", f"{value:+.3f}"] for one, other, value in text.list_correlations(estimate)]
    tested, correlated = tabulate_diagnostics(diagnostics), _list_correlated(estimate)
    course = estimate.steps
    costs = [f"{step.cost:.8g}" if np.isfinite(step.cost) else "failed" for step in course]
    tried = [[s.strategy, cost, f"{s.evaluations}", f"{s.seconds:.2g}"] for s, cost in zip(course, costs, strict=True)]
    return {
        "level": verdict.level,
        "line": str(verdict),
        "reasons": [write_reason(reason) for reason in verdict.reasons],
        "steps": [write_step(step) for step in verdict.next_steps],
        "warnings": [add_dates(str(issue), estimate) for issue in find_issues(estimate)],
        "unknowns": everything._replace(rows=[everything.rows[0], *rows]),
        "all_unknowns": everything,
        "more_unknowns": len(estimate.theta) - len(listed),
        "unknowns_note": note,
        "fixed": Table(text.tabulate_fixed(estimate).rows[:MOST_ROWS], "<<<<"),
        "experiments": text.list_experiments(estimate, MOST_ROWS, full=True),
        "course": text.list_course(estimate, full=True),
        "quality": text.list_quality(estimate, full=True),
        "steps_tried": Table([["strategy", "lowest J after it", "evaluations", "seconds"], *tried], "<>>>"),
        "channels": Table([channels.rows[k] for k in worst], channels.alignment),
        "diagnostics": Table(tested.rows[: MOST_ROWS + 1], tested.alignment),
        "residual_issues": [str(issue) for issue in diagnostics.issues],
        "identifiability": str(found).split("\n  - ")[0].replace("\n", " "),
        "directions": [write_direction(found, direction) for direction in found.directions],
        "correlations": Table(pairs[:MOST_PAIRS], "<>"),
        "more_correlations": max(len(pairs) - MOST_PAIRS, 0),
        "certificate": _add_dates_to_table(tabulate_certificate(certificate), estimate),
        "certificate_passed": certificate.passed,
        "total_runs": len(estimate.trajectories),
        "has_model": estimate.problem is not None,
        "iterated": bool(estimate.history),
        "correlated": [estimate.theta_names[i] for i in correlated],
        "correlation": estimate.correlation[np.ix_(correlated, correlated)],
    }


def _add_dates_to_table(table: Table, fit: Fit) -> Table:
    return table._replace(rows=[[add_dates(cell, fit) for cell in row] for row in table.rows])


def _list_correlated(fit: Fit) -> list[int]:
    """Return the unknowns in the heat map: of too many those with the largest correlations."""
    if not np.isfinite(fit.standard_errors).any():
        return []
    known = np.flatnonzero(np.isfinite(np.diag(fit.correlation)))
    if len(known) < 2:
        return []
    strength = np.abs(np.nan_to_num(fit.correlation - np.eye(len(fit.theta))))[np.ix_(known, known)].max(axis=1)
    return sorted(known[np.argsort(-strength, kind="stable")[:MOST_CORRELATED]].tolist())


# --- figures ----------------------------------------------------------------------------------------------------------


def _prepare_figures(estimate: Estimate) -> tuple[list[Run], dict[str, Any]]:
    """Return the runs that are shown, the one that is explained worst first, and the JSON of all figures."""
    order = rank_runs(estimate)[:MOST_RUNS]
    places = {e: list_places(estimate, e)[:MOST_SLIDERS] for e in order}
    points = choose_points(estimate, order, max((len(own) for own in places.values()), default=0))
    curves = {e: collect_curves(estimate, e, places[e], points) for e in order}
    colours = choose_mode_colours(estimate.trajectories, lines=True)
    diagnostics = diagnose(estimate)
    runs: list[Run] = []
    drawn: dict[str, Any] = {}
    layouts: dict[Any, str] = {}
    figures: dict[str, Any] = {}
    groups: dict[str, list[str]] = {}
    for number, e in enumerate(order):
        tested = [channel for channel in diagnostics.channels if channel.experiment == e][:MOST_DIAGNOSED]
        runs.append(_describe_run(estimate, e, number, curves[e], colours, tuple(channel.name for channel in tested)))
        trajectory = estimate.trajectories[e]
        template = layouts.setdefault(describe_layout(curves[e], trajectory), f"run-{len(layouts)}")
        data = collect_run(template, estimate, e, curves[e], colours)
        if template not in drawn:
            drawn[template] = draw_run(curves[e], data, run=trajectory)
        own = {f"run-{number}": data}
        for c, channel in enumerate(tested):
            own |= {f"residuals-{number}-{c}-{k}": part for k, part in enumerate(collect_diagnostics(channel))}
        for part in own.values():
            if part.template not in drawn:
                drawn[part.template] = draw_diagnostics(part)
        groups[str(number)] = list(own)
        figures |= {name: part.to_json() for name, part in own.items()}
    always: dict[str, Any] = {}
    sliders: list[Slider] = []
    if estimate.problem is not None and np.isfinite(estimate.cost):
        movable = [place for place in dict.fromkeys(i for e in order for i in places[e]) if _moves(curves, place)]
        sliders = build_sliders(estimate, curves, movable)
        if sliders:
            always["slice"] = draw_slice()
    if estimate.history:
        always |= draw_convergence(estimate.history, estimate.tolerance)
    figures |= {name: FigureData(name).to_json() for name in always}
    moved = [slider.place for slider in sliders]
    return runs, {
        "templates": {name: json_item(part) for name, part in (drawn | always).items()},
        "figures": figures,
        "groups": groups,
        "always": list(always),
        "cost": _number(estimate.cost),
        "gradient": _numbers(estimate.gradient[moved]),
        "hessian": [_numbers(row) for row in estimate.hessian[np.ix_(moved, moved)]],
        "sliders": [_describe_slider(estimate, slider, order, places) for slider in sliders],
    }


def _moves(curves: Mapping[int, Sequence[Curves]], place: int) -> bool:
    """Return whether an unknown has derivatives in some curve."""
    return any(place in own.tangents for run in curves.values() for own in run)


def _describe_run(
    fit: Fit, e: int, number: int, curves: Sequence[Curves], colours: Mapping[str, str], diagnosed: tuple[str, ...]
) -> Run:
    trajectory, worst = fit.trajectories[e], explain_worst(fit, e)
    modes = [(mode, colours[mode], format_span(begin, end, trajectory)) for mode, begin, end in trajectory.mode_spans]
    labels = [
        (f"{name}, not measured" if own.kind == "states" and fit.comparisons[e] else name, own.kind == "states", own, k)
        for own in curves
        for k, name in enumerate(own.names)
    ]
    measured = bool(fit.comparisons[e])
    worst_first = np.argsort(
        [np.inf if state else explain_channel(fit.comparisons[e][curves.index(own)], k) for _, state, own, k in labels],
        kind="stable",
    )
    first = set(worst_first[:MOST_CHANNELS].tolist())
    shown = [k in first and not (state and measured) for k, (_, state, _, _) in enumerate(labels)]
    return Run(
        number=number,
        e=e,
        name=fit.run_names[e] if len(fit.trajectories) > 1 else "",
        explained=format_share(worst) if np.isfinite(worst) else "",
        modes=tuple(modes),
        channels=tuple((label, show) for (label, *_), show in zip(labels, shown, strict=True)),
        diagnosed=diagnosed,
        notes=tuple(_list_notes(fit, e, curves)),
    )


def _list_notes(fit: Fit, e: int, curves: Sequence[Curves]) -> Iterator[str]:
    """Yield what is not to be seen in the figures of a run: samples that are not drawn, sensors that are late."""
    unit = unit_suffix(fit.trajectories[e].time_unit)
    for own in curves:
        channels = join_words(list(own.names))
        if own.left_out:
            drawn = len(own.sample_times)
            yield f"Of {channels} {drawn} of {drawn + own.left_out} samples are drawn."
        late = own.times[0] - fit.trajectories[e].times[0]
        if late != 0:
            yield (
                f"{channels} is late by {late:.6g}{unit}: its curve stands at the times of the sensor, the modes and "
                "transitions at those of the model."
            )


def _describe_slider(
    estimate: Estimate, slider: Slider, order: Sequence[int], places: Mapping[int, Sequence[int]]
) -> dict[str, Any]:
    place = slider.place
    run = list_dated(estimate)[place]
    return {
        "place": place,
        "name": estimate.theta_names[place],
        "unit": format_unit(estimate.theta_units[place]),
        "theta": float(estimate.theta[place]),
        "clock": None if run is None else describe_clock(run),
        "runs": [number for number, e in enumerate(order) if place in places[e]],
        "values": _numbers(slider.values),
        "costs": _numbers(slider.costs),
        "gap": _format_gap(slider.gap),
    }


def _format_gap(gap: float) -> str:
    """Return how far the curves are off at the ends of a slider, as a sentence."""
    if not np.isfinite(gap):
        return "At its ends the model cannot be simulated."
    if gap < SMALL_GAP:
        return ""
    return f"At its ends the curves are off by {100 * gap:.2g} % of their range."


def _number(value: float) -> float | None:
    """Return a number for JSON, which has no NaN."""
    return float(value) if np.isfinite(value) else None


def _numbers(values: Any) -> list[float | None]:
    return [_number(value) for value in values]
