"""The page of a fit: what the templates show, and the JSON that the page's script turns into figures.

Import this only where Bokeh and Jinja2 are installed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import jinja2
import numpy as np
from bokeh.core.serialization import Serializer
from bokeh.embed import json_item
from bokeh.resources import Resources

from switchfit.arrays import FloatArray
from switchfit.fit.result import Fit
from switchfit.io.provenance import Provenance
from switchfit.problem.validation.messages import unit_suffix
from switchfit.report.certificate import tabulate_certificate
from switchfit.report.directions import write_direction
from switchfit.report.fit_summary import list_course, list_experiments, list_quality, tabulate_channels
from switchfit.report.html import notebook
from switchfit.report.html.bokeh_figures import draw_run, draw_slice
from switchfit.report.html.curves import (
    Curves,
    choose_points,
    collect_curves,
    list_places,
    list_spans,
    list_transitions,
)
from switchfit.report.html.sliders import build_sliders, drop_nan
from switchfit.report.panels import choose_mode_colours
from switchfit.report.residuals import plot_diagnostics, tabulate_diagnostics
from switchfit.report.shares import format_share
from switchfit.report.times import format_span
from switchfit.report.unknowns import select_unknowns_of_fit, tabulate_correlations, tabulate_fixed, tabulate_unknowns
from switchfit.report.verdict import list_reasons, write_reason, write_step
from switchfit.report.wording import join_words
from switchfit.uncertainty.certificate import certify
from switchfit.uncertainty.explained_variance import explain_worst, rank_runs
from switchfit.uncertainty.issues import find_issues
from switchfit.uncertainty.judged_fit import JudgedFit

MOST_RUNS_IN_PAGE = 12
"""Experiments whose figures are in a page, those that are explained worst."""

MOST_CHANNELS_AT_FIRST = 6
"""Channels of a run that are shown at first; the others are switched on."""

HORIZON_MARGIN = 0.01
"""Part of the horizon that is shown before and after it."""

MOST_SLIDERS = 24
"""Sliders of one run."""

MOST_CORRELATED = 60
"""Unknowns in the heat map, the first ones; the largest correlations of all are listed beside it."""


def build_page(estimate: JudgedFit, origin: Provenance) -> str:
    """Return the report of an estimate as one HTML page.

    Parameters
    ----------
    estimate : JudgedFit
    origin : Provenance
        What the fit was made from.
    """
    folder = jinja2.PackageLoader("switchfit.report.html", "templates")
    environment = jinja2.Environment(
        loader=folder, autoescape=True, trim_blocks=True, lstrip_blocks=True, undefined=jinja2.StrictUndefined
    )
    # NaN is no JSON, and a browser would refuse all of it: what is not finite was replaced before.
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    functions = (
        certify, find_issues, format_span, join_words, list_course, list_experiments, list_quality, list_reasons,
        notebook.embed_figure, plot_diagnostics, select_unknowns_of_fit, tabulate_certificate, tabulate_channels,
        tabulate_correlations, tabulate_diagnostics, tabulate_fixed, tabulate_unknowns, unit_suffix, write_direction,
        write_reason, write_step,
    )  # fmt: skip
    # Templates call these by their names. StrictUndefined makes a misspelt one an error, not a gap in the page.
    environment.globals |= {function.__name__: function for function in functions}
    runs, payload = _prepare_figures(estimate)
    library = "".join(Resources(mode="inline", components=["bokeh"]).js_raw)
    # Unknowns that are held have no correlation.
    known = np.flatnonzero(np.isfinite(np.diag(estimate.correlation)))[:MOST_CORRELATED]
    content = {"estimate": estimate, "verdict": estimate.verdict, "origin": origin, "runs": runs}
    cut = any(len(list_places(estimate, e)) > MOST_SLIDERS for e in range(len(estimate.trajectories)))
    content |= {"payload": payload, "sliders": payload["sliders"], "sliders_cut": cut, "library": library}
    content |= {"correlated": [estimate.theta_names[i] for i in known]}
    content |= {"correlation": estimate.correlation[np.ix_(known, known)]}
    return environment.get_template("report.html").render(content)


def _prepare_figures(estimate: JudgedFit) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return the runs that are shown, the one that is explained worst first, and the JSON of their figures."""
    # The worst explained first: of many runs, those are in the page that deserve a look.
    order = rank_runs(estimate)[:MOST_RUNS_IN_PAGE]
    places = {e: list_places(estimate, e)[:MOST_SLIDERS] for e in order}
    points = choose_points(estimate, order, max((len(own) for own in places.values()), default=0))
    curves = {e: collect_curves(estimate, e, places[e], points) for e in order}
    colours = choose_mode_colours(estimate.trajectories, lines=True)
    templates: dict[str, Any] = {}
    layouts: dict[Any, str] = {}
    figures: list[dict[str, Any]] = []
    for e in order:
        run, own = estimate.trajectories[e], curves[e]
        sources = {"modes": list_spans(estimate, e, colours), "transitions": list_transitions(estimate, e)}
        for c, part in enumerate(own):
            sources |= {f"curve-{c}": part.curve} | ({f"samples-{c}": part.samples} if part.samples else {})
        # What two runs have to share to be shown by the same drawing, which takes Bokeh a tenth of a second, while its
        # numbers take a thousandth; tangents are not drawn.
        drawn = ((c.names, c.units, c.kind, *(key for key in (*c.curve, *c.samples) if key[0] != "d")) for c in own)
        template = layouts.setdefault((run.time_unit, run.origin, *drawn), f"run-{len(layouts)}")
        if template not in templates:
            templates[template] = json_item(draw_run(own, sources, run=run))
        first, last = float(run.times[0]), float(run.times[-1])
        # So that transitions at the very ends are not on the frame.
        margin = HORIZON_MARGIN * (last - first)
        written = {name: Serializer(deferred=False).serialize(columns).content for name, columns in sources.items()}
        ranges = {"times": {"start": first - margin, "end": last + margin}}
        figures.append({"template": template, "sources": written, "ranges": ranges})
    # Unknowns with derivatives in some curve, in the order of the runs; without a cost there is nothing to compare.
    movable = dict.fromkeys(place for e in order for place in places[e] if f"d{place}_0" in curves[e][0].curve)
    sliders = build_sliders(estimate, curves, list(movable) if np.isfinite(estimate.cost) else [])
    templates |= {"slice": json_item(draw_slice())} if sliders else {}
    moved = [slider["place"] for slider in sliders]
    for slider in sliders:
        slider["runs"] = [number for number, e in enumerate(order) if slider["place"] in places[e]]
    derivatives = {"gradient": estimate.gradient[moved], "hessian": estimate.hessian[np.ix_(moved, moved)]}
    values: dict[str, float | FloatArray] = {"cost": estimate.cost, **derivatives}
    costs = {name: drop_nan(value) for name, value in values.items()}
    payload = {"templates": templates, "runs": figures, "sliders": sliders, **costs}
    return [_describe_run(estimate, e, curves[e], colours) for e in order], payload


def _describe_run(fit: Fit, e: int, curves: Sequence[Curves], colours: Mapping[str, str]) -> dict[str, Any]:
    """Return what the template shows of a run; at first it shows some of the channels that are measured."""
    channels: list[tuple[str, str, bool]] = []
    for c, own in enumerate(curves):
        shown = own.kind != "states" or not fit.comparisons[e]
        for k, name in enumerate(own.names):
            first = shown and len(channels) < MOST_CHANNELS_AT_FIRST
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
