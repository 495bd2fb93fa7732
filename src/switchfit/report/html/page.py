"""The page: what its template shows. Import this only where Jinja2 is installed."""

from __future__ import annotations

import base64
import io
from typing import Any

import jinja2
import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from switchfit.estimation.estimator import Estimate
from switchfit.estimation.saved import Provenance
from switchfit.report import text
from switchfit.report.plot import choose_runs, find_plane
from switchfit.report.sentences import list_reasons, write_reason, write_step
from switchfit.report.uncertainty import plot_diagnostics, tabulate_certificate, tabulate_diagnostics, write_direction
from switchfit.uncertainty.certificate import certify

MOST_DIAGNOSED = 2
"""Channels whose residuals have figures."""
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
    functions: list[Any] = [certify, list_reasons, write_reason, write_step]
    functions += [tabulate_certificate, tabulate_diagnostics, write_direction]
    environment.globals |= {function.__name__: function for function in functions}
    pictures = {"fit": _write_svg(estimate.plot())}
    for e in choose_runs(estimate):
        if any(find_plane(data.names, data.units) is not None for data in estimate.comparisons[e]):
            pictures[f"Path of {estimate.run_names[e]}"] = _write_svg(estimate.plot_plane(experiment=e))
    if estimate.residuals.channels:
        pictures["residuals"] = _write_svg(plot_diagnostics(estimate.residuals, MOST_DIAGNOSED))
    if any(record.optimality > 0 for record in estimate.history):
        pictures["convergence"] = _write_svg(estimate.plot_convergence())
    known = np.flatnonzero(np.isfinite(np.diag(estimate.correlation)))[:MOST_CORRELATED]
    content = {"estimate": estimate, "verdict": estimate.verdict, "origin": origin, "text": text, "pictures": pictures}
    content |= {"correlated": [estimate.theta_names[i] for i in known]}
    content |= {"correlation": estimate.correlation[np.ix_(known, known)]}
    return environment.get_template("report.html").render(content)


def _write_svg(figure: Figure) -> str:
    """Return a figure as SVG in the form in which a page has it."""
    drawn = io.BytesIO()
    with rc_context({"svg.fonttype": "none"}):
        figure.savefig(drawn, format="svg", transparent=True)
    return f"data:image/svg+xml;base64,{base64.b64encode(drawn.getvalue()).decode()}"
