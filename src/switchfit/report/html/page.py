"""The page: what the templates show, and the JSON from which the page's script draws figures with Bokeh.

Import this only where Bokeh and Jinja2 are installed.
"""

from __future__ import annotations

import base64
import gzip
import io
import json
from collections.abc import Mapping, Sequence
from typing import Any

import jinja2
import numpy as np
from bokeh.resources import Resources
from matplotlib import rc_context
from matplotlib.figure import Figure

from switchfit.estimation.estimator import Estimate, Provenance
from switchfit.fit.result import Fit
from switchfit.problem.parameter import unit_suffix
from switchfit.report import text
from switchfit.report.formats import describe_clock, format_span, label_quantity, label_time
from switchfit.report.html.curves import (
    Columns,
    Curves,
    build_sliders,
    choose_points,
    collect_curves,
    drop_nan,
    list_places,
    list_spans,
    list_transitions,
)
from switchfit.report.plot import choose_mode_colours, find_plane
from switchfit.report.sentences import format_share, join_words, list_reasons, write_reason, write_step
from switchfit.report.uncertainty import plot_diagnostics, tabulate_certificate, tabulate_diagnostics, write_direction
from switchfit.uncertainty.certificate import certify
from switchfit.uncertainty.residuals import explain_worst, rank_runs
from switchfit.uncertainty.verdict import find_issues

MOST_RUNS = 12
"""Experiments whose figures are in a page, those that are explained worst."""
MOST_CHANNELS = 6
"""Channels of a run that are shown at first; the others are switched on."""
MOST_DIAGNOSED = 2
"""Channels whose residuals have figures."""
MARGIN = 0.01
"""Part of the horizon that is shown before and after it."""
MOST_SLIDERS = 24
"""Sliders of one run."""
MOST_CORRELATED = 60
"""Unknowns in the heat map, the first ones; the largest correlations of all are listed beside it."""


def build_page(estimate: Estimate, origin: Provenance) -> str:
    """Return the report of an estimate as one HTML page.

    Parameters
    ----------
    estimate : Estimate
    origin : Provenance
        What the fit was made from.
    """
    folder = jinja2.PackageLoader("switchfit.report.html", "templates")
    environment = jinja2.Environment(
        loader=folder, autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    functions: list[Any] = [certify, find_issues, format_span, join_words, list_reasons, unit_suffix]
    functions += [tabulate_certificate, tabulate_diagnostics, write_direction, write_reason, write_step]
    environment.globals |= {function.__name__: function for function in functions}
    runs, payload = _prepare_figures(estimate)
    payload["drawings"] = drawings = {}
    if estimate.residuals.channels:
        drawings["residuals-drawing"] = _compress_svg(plot_diagnostics(estimate.residuals, MOST_DIAGNOSED))
    if any(record.optimality > 0 for record in estimate.history):
        drawings["convergence-drawing"] = _compress_svg(estimate.plot_convergence())
    library = "".join(Resources(mode="inline", components=["bokeh", "bokeh-api"]).js_raw)
    known = np.flatnonzero(np.isfinite(np.diag(estimate.correlation)))[:MOST_CORRELATED]
    content = {"estimate": estimate, "verdict": estimate.verdict, "origin": origin, "runs": runs, "text": text}
    cut = any(len(list_places(estimate, e)) > MOST_SLIDERS for e in range(len(estimate.trajectories)))
    content |= {"sliders": payload["sliders"], "sliders_cut": cut, "drawings": drawings, "library": library}
    content |= {"correlated": [estimate.theta_names[i] for i in known]}
    content |= {"correlation": estimate.correlation[np.ix_(known, known)]}
    return environment.get_template("report.html").render(content, payload=_write_json(payload))


def _compress_svg(figure: Figure) -> str:
    """Return a figure as SVG, compressed and in base64: a tenth of its size."""
    figure.set_layout_engine(None)  # which draws everything twice more
    height = figure.get_figheight()
    figure.subplots_adjust(left=0.11, right=0.98, bottom=0.55 / height, top=1 - 0.4 / height)
    drawn = io.BytesIO()
    with rc_context({"svg.fonttype": "none"}):
        figure.savefig(drawn, format="svg", transparent=True)
    return base64.b64encode(gzip.compress(drawn.getvalue())).decode()


def _write_json(value: Any) -> str:
    """Return JSON that can stand inside a script element; arrays as their bytes in base64, with the type of numbers."""

    def pack(array: Any) -> dict[str, str]:
        return {"dtype": array.dtype.str, "data": base64.b64encode(array.tobytes()).decode()}

    written = json.dumps(value, allow_nan=False, separators=(",", ":"), default=pack)
    return written.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


# --- figures ----------------------------------------------------------------------------------------------------------


def _prepare_figures(estimate: Estimate) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return the runs that are shown, the one that is explained worst first, and the JSON of their figures."""
    order = rank_runs(estimate)[:MOST_RUNS]
    places = {e: list_places(estimate, e)[:MOST_SLIDERS] for e in order}
    points = choose_points(estimate, order, max((len(own) for own in places.values()), default=0))
    curves = {e: collect_curves(estimate, e, places[e], points) for e in order}
    colours = choose_mode_colours(estimate.trajectories, lines=True)
    sliders: list[dict[str, Any]] = []
    if estimate.problem is not None and np.isfinite(estimate.cost):
        movable = dict.fromkeys(place for e in order for place in places[e] if f"d{place}_0" in curves[e][0].curve)
        sliders = build_sliders(estimate, curves, list(movable))
    moved = [slider["place"] for slider in sliders]
    for slider in sliders:
        slider["runs"] = [number for number, e in enumerate(order) if slider["place"] in places[e]]
    derivatives = {"gradient": estimate.gradient[moved], "hessian": estimate.hessian[np.ix_(moved, moved)]}
    costs = {name: drop_nan(value) for name, value in {"cost": estimate.cost, **derivatives}.items()}
    payload = {"runs": [_prepare_run(estimate, e, curves[e], colours) for e in order], "sliders": sliders, **costs}
    return [_describe_run(estimate, e, curves[e], colours) for e in order], payload


def _prepare_run(fit: Fit, e: int, curves: Sequence[Curves], colours: Mapping[str, str]) -> dict[str, Any]:
    """Return what the page's script draws of a run: the columns of its sources, and what the curves are."""
    run = fit.trajectories[e]
    sources: dict[str, Columns] = {"modes": list_spans(fit, e, colours), "transitions": list_transitions(fit, e)}
    for c, own in enumerate(curves):
        sources |= {f"curve-{c}": own.curve} | ({f"samples-{c}": own.samples} if own.samples else {})
    first, last = float(run.times[0]), float(run.times[-1])
    margin = MARGIN * (last - first)
    drawn: list[dict[str, Any]] = []
    for part in curves:
        plane = find_plane(part.names, part.units) if part.samples else None
        labels = list(map(label_quantity, part.names, part.units))
        drawn.append({"kind": part.kind, "labels": labels, "plane": plane})
    # Bokeh escapes what is in columns, but no units in tips.
    unit = run.time_unit if run.time_unit.isalnum() and run.time_unit != "1" else ""
    times = {
        "label": label_time(run),
        "unit": unit,
        "clock": describe_clock(run),
        "range": [first - margin, last + margin],
    }
    return {"sources": sources, "curves": drawn, "times": times}


def _describe_run(fit: Fit, e: int, curves: Sequence[Curves], colours: Mapping[str, str]) -> dict[str, Any]:
    """Return what the template shows of a run; at first it shows some of the channels that are measured."""
    channels: list[tuple[str, str, bool]] = []
    for c, own in enumerate(curves):
        shown = own.kind != "states" or not fit.comparisons[e]
        for k, name in enumerate(own.names):
            first = shown and len(channels) < MOST_CHANNELS
            channels.append((f"{c}-{k}", name if shown else f"{name}, not measured", first))
    worst = explain_worst(fit, e)
    return {
        "name": fit.run_names[e] if len(fit.trajectories) > 1 else "",
        "explained": format_share(worst) if np.isfinite(worst) else "",
        "trajectory": fit.trajectories[e],
        "colours": colours,
        "channels": channels,
        "curves": curves,
    }
