"""The page: what the templates show, and the JSON that the page's script turns into figures.

Import this only where Bokeh and Jinja2 are installed.
"""

from __future__ import annotations

import base64
import gzip
import io
import json
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import jinja2
import numpy as np
from bokeh.core.serialization import Serializer
from bokeh.embed import json_item
from bokeh.resources import Resources
from matplotlib import rc_context
from matplotlib.figure import Figure

from switchfit.estimation.estimator import Estimate
from switchfit.estimation.provenance import Provenance
from switchfit.fit.result import Fit
from switchfit.problem.parameter import unit_suffix
from switchfit.report import text
from switchfit.report.dates import add_dates, format_span
from switchfit.report.html.curves import (
    Curves,
    choose_points,
    collect_curves,
    list_places,
    list_spans,
    list_transitions,
)
from switchfit.report.html.figures import draw_run, draw_slice
from switchfit.report.html.sliders import build_sliders, drop_nan
from switchfit.report.plot import choose_mode_colours
from switchfit.report.sentences import join_words
from switchfit.report.tables import Table
from switchfit.report.uncertainty import plot_diagnostics, tabulate_certificate, tabulate_diagnostics, write_direction
from switchfit.report.verdict import format_share, list_reasons, write_reason, write_step
from switchfit.uncertainty.certificate import certify
from switchfit.uncertainty.issues import find_issues
from switchfit.uncertainty.quality import explain_channel, explain_worst, rank_runs

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
FIRST_ROWS = 40
"""Unknowns that are listed first: those at a bound or a kink, parameters, transition times; all are behind them."""
MOST_UNKNOWNS = 300
"""Unknowns that are listed, and experiments; those left out are counted. Other tables are cut off there too."""
MOST_CORRELATED = 60
"""Unknowns in the heat map."""
MOST_PAIRS = 12
"""Correlations that are listed beside it."""


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
    content = _collect_content(estimate)
    runs, payload = _prepare_figures(estimate)
    payload["drawings"] = drawings = {}
    if estimate.residuals.channels:
        drawings["residuals-drawing"] = _compress_svg(plot_diagnostics(estimate.residuals, MOST_DIAGNOSED))
    if content["iterated"]:
        drawings["convergence-drawing"] = _compress_svg(estimate.plot_convergence())
    library = "".join(Resources(mode="inline", components=["bokeh"]).js_raw)
    environment.globals |= {f.__name__: f for f in (list_reasons, write_reason, write_step, write_direction)}
    return environment.get_template("report.html").render(
        content,
        estimate=estimate,
        verdict=estimate.verdict,
        origin=origin,
        runs=runs,
        sliders=payload["sliders"],
        sliders_cut=any(len(list_places(estimate, e)) > MOST_SLIDERS for e in range(len(estimate.trajectories))),
        payload=_write_json(payload),
        library=library,
    )


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
    """Return JSON that can stand inside a script element."""
    written = json.dumps(value, allow_nan=False, separators=(",", ":"))
    return written.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


# --- sentences and tables ---------------------------------------------------------------------------------------------


def _collect_content(estimate: Estimate) -> dict[str, Any]:
    """Return what the template shows as text; the sentences are those of the report as text."""
    listed = text.select_unknowns(estimate, MOST_UNKNOWNS)
    everything, note = text.tabulate_unknowns(estimate, listed, ends=True)
    unknowns, _ = text.tabulate_unknowns(estimate, text.select_unknowns(estimate, FIRST_ROWS), ends=True)
    channels, shares = text.tabulate_channels(estimate)
    worst = [0, *(1 + k for k in np.argsort(shares, kind="stable").tolist())]
    certificate = tabulate_certificate(estimate.known_certificate or certify(estimate, None))
    pairs = [[f"{one}, {other}", f"{value:+.3f}"] for one, other, value in text.list_correlations(estimate)]
    correlated = _list_correlated(estimate)
    course = estimate.steps
    costs = [f"{step.cost:.8g}" if np.isfinite(step.cost) else "failed" for step in course]
    tried = [[s.strategy, cost, f"{s.evaluations}", f"{s.seconds:.2g}"] for s, cost in zip(course, costs, strict=True)]
    course_rows = text.list_course(estimate, full=True) + text.list_quality(estimate, full=True)
    return {
        "warnings": [add_dates(str(issue), estimate) for issue in find_issues(estimate)],
        "unknowns": unknowns,
        "all_unknowns": everything,
        "more_unknowns": len(estimate.theta) - len(listed),
        "unknowns_note": note,
        "fixed": text.tabulate_fixed(estimate),
        "course": text.list_experiments(estimate, MOST_UNKNOWNS, full=True) + course_rows,
        "steps_tried": Table([["strategy", "lowest J after it", "evaluations", "seconds"], *tried], "<>>>"),
        "channels": Table([channels.rows[k] for k in worst], channels.alignment),
        "diagnostics": tabulate_diagnostics(estimate.residuals),
        "correlations": Table(pairs[:MOST_PAIRS], "<>"),
        "more_correlations": max(len(pairs) - MOST_PAIRS, 0),
        "certificate": Table([[add_dates(cell, estimate) for cell in row] for row in certificate.rows], "<<"),
        "correlated": [estimate.theta_names[i] for i in correlated],
        "correlation": estimate.correlation[np.ix_(correlated, correlated)],
        "iterated": any(record.optimality > 0 for record in estimate.history),
    }


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


def _prepare_figures(estimate: Estimate) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Return the runs that are shown, the one that is explained worst first, and the JSON of their figures."""
    order = rank_runs(estimate)[:MOST_RUNS]
    places = {e: list_places(estimate, e)[:MOST_SLIDERS] for e in order}
    points = choose_points(estimate, order, max((len(own) for own in places.values()), default=0))
    curves = {e: collect_curves(estimate, e, places[e], points) for e in order}
    colours = choose_mode_colours(estimate.trajectories, lines=True)
    templates: dict[str, Any] = {}
    layouts: dict[Any, str] = {}
    figures = []
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
        margin = MARGIN * (last - first)
        figures.append(
            {
                "template": template,
                "sources": {name: Serializer(deferred=False).serialize(c).content for name, c in sources.items()},
                "ranges": {"times": {"start": first - margin, "end": last + margin}},
                "delays": {f"curve-{c}": part.delay for c, part in enumerate(own) if part.delay >= 0},
            }
        )
    sliders: list[dict[str, Any]] = []
    if estimate.problem is not None and np.isfinite(estimate.cost):
        movable = dict.fromkeys(place for e in order for place in places[e] if f"d{place}_0" in curves[e][0].curve)
        sliders = build_sliders(estimate, curves, list(movable))
        templates |= {"slice": json_item(draw_slice())} if sliders else {}
    moved = [slider["place"] for slider in sliders]
    for slider in sliders:
        slider["runs"] = [number for number, e in enumerate(order) if slider["place"] in places[e]]
    return [_describe_run(estimate, e, curves[e], colours) for e in order], {
        "templates": templates,
        "runs": figures,
        "cost": drop_nan(estimate.cost),
        "gradient": drop_nan(estimate.gradient[moved]),
        "hessian": drop_nan(estimate.hessian[np.ix_(moved, moved)]),
        "sliders": sliders,
    }


def _describe_run(fit: Fit, e: int, curves: Sequence[Curves], colours: Mapping[str, str]) -> dict[str, Any]:
    """Return what the template shows of a run; at first it shows the channels that are explained worst."""
    trajectory, comparisons, worst = fit.trajectories[e], fit.comparisons[e], explain_worst(fit, e)
    channels, shares = [], []
    for c, own in enumerate(curves):
        hidden = own.kind == "states" and bool(comparisons)
        for k, name in enumerate(own.names):
            channels.append((f"{c}-{k}", f"{name}, not measured" if hidden else name, not hidden))
            shares.append(np.inf if own.kind == "states" else explain_channel(comparisons[c], k))
    first = np.argsort(shares, kind="stable")[:MOST_CHANNELS]
    return {
        "name": fit.run_names[e] if len(fit.trajectories) > 1 else "",
        "explained": format_share(worst) if np.isfinite(worst) else "",
        "modes": [(mode, colours[mode], format_span(a, b, trajectory)) for mode, a, b in trajectory.mode_spans],
        "channels": [(name, label, can and k in first) for k, (name, label, can) in enumerate(channels)],
        "notes": list(_list_notes(fit, e, curves)),
    }


def _list_notes(fit: Fit, e: int, curves: Sequence[Curves]) -> Iterator[str]:
    """Yield what is not to be seen in the figures of a run: samples that are not drawn, sensors that are late."""
    unit = unit_suffix(fit.trajectories[e].time_unit)
    for own in curves:
        channels = join_words(list(own.names))
        if own.left_out:
            drawn = len(own.samples["t"])
            yield f"Of {channels} {drawn} of {drawn + own.left_out} samples are drawn."
        late = own.curve["t"][0] - fit.trajectories[e].times[0]
        if late != 0:
            yield (
                f"{channels} is late by {late:.6g}{unit}: its curve stands at the times of the sensor, the modes and "
                "transitions at those of the model."
            )
