"""The report of a fit as one HTML file that needs no network.

Templates are Jinja2's, figures are Bokeh's where sliders move them and matplotlib's elsewhere. Bokeh and Jinja2 come
with the extra ``report``. They and `page`, which builds the file, are imported when a page is made.
"""

from __future__ import annotations

from switchfit.io.provenance import Provenance
from switchfit.runtime.extras import import_library
from switchfit.runtime.presentation import format_page
from switchfit.uncertainty.judged_fit import JudgedFit


@format_page.register(JudgedFit)
def write_page(estimate: JudgedFit, *, provenance: Provenance | None = None) -> str:
    """Return the report of an estimate as one HTML page.

    Parameters
    ----------
    estimate : JudgedFit
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
