"""The report of a fit as one HTML file that needs no network: Jinja2's templates, figures of Bokeh and Matplotlib.

Both libraries come with the extra ``report``. They, and the modules of this package, are imported when a page is made,
not with switchfit: `page` puts the file together and draws what sliders move, `curves` prepares its
numbers. What does not move are the figures of Matplotlib.
"""

from __future__ import annotations

import importlib.util

from switchfit.estimation.estimator import Estimate, Provenance, describe_python_problem
from switchfit.report.sentences import join_words
from switchfit.runtime.errors import MissingExtraError
from switchfit.runtime.presentation import format_page

LIBRARIES = ("bokeh", "jinja2")
"""What the extra ``report`` installs."""


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
    missing = [name for name in LIBRARIES if importlib.util.find_spec(name) is None]
    if missing:
        raise MissingExtraError(
            f"an HTML report needs {join_words(missing)}, not installed here: pip install 'switchfit[report]'"
        )
    from switchfit.report.html.page import build_page

    return build_page(estimate, estimate.describe_provenance(provenance) or describe_python_problem(estimate))
