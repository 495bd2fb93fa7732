"""Results as HTML: in a notebook, their text with a small figure below; the report of a fit as one file.

The file needs no network: templates of Jinja2, figures of Bokeh where sliders move them, of Matplotlib elsewhere. Both
libraries come with the extra ``report``. They, `page`, which puts the file together and draws what moves, and `curves`,
which prepares its numbers, are imported when a page is made, not with switchfit.
"""

from __future__ import annotations

from html import escape
from typing import Any

from switchfit.batch.fits import Fits
from switchfit.estimation.estimator import Estimate, Provenance
from switchfit.problem.problem import Problem
from switchfit.report import style
from switchfit.runtime.errors import import_library
from switchfit.runtime.presentation import Displayed, format_html, format_page, format_text
from switchfit.uncertainty.prediction import Prediction

DOTS = 64
"""Dots per inch of the figures in a notebook."""
LARGEST_FIGURE = 4
"""Experiments or outputs up to which a result shows its figure; with more of them it is no small one."""


@format_page.register(Estimate)
def write_page(estimate: Estimate, *, provenance: Provenance | None = None) -> str:
    """Return the report of an estimate as one HTML page.

    Parameters
    ----------
    estimate : Estimate
    provenance : Provenance, optional
        What the fit was made from; left out, what the estimate knows of it.

    Raises
    ------
    MissingExtraError
        If Bokeh or Jinja2 are not installed.
    """
    for library in ("bokeh", "jinja2"):
        import_library(library, "an HTML report", "'switchfit[report]'")
    from switchfit.report.html.page import build_page

    return build_page(estimate, estimate.describe_provenance(provenance) or Provenance())


@format_html.register(Problem)
@format_html.register(Prediction)
@format_html.register(Displayed)
def show_result(result: Any) -> str:
    """Return the text of a result, and its figure if it has a small one.

    Parameters
    ----------
    result : object
    """
    is_forecast = isinstance(result, Prediction)
    size = len(result.output_names if is_forecast else getattr(result, "trajectories", ()))
    is_empty = (is_forecast and not size) or (isinstance(result, Fits) and not len(result))
    image = ""
    if hasattr(result, "plot") and not is_empty and size <= LARGEST_FIGURE:
        source = style.embed_figure(result.plot(), dpi=DOTS)
        image = f'<img alt="the figure of the result" style="background: white" src="{source}">'
    text = repr(result) if is_forecast else format_text(result)
    return f"<div><pre>{escape(text)}</pre>{image}</div>"
