"""The report of a fit as one HTML file that needs no network: Jinja2's templates, Bokeh's figures.

Both libraries come with the extra ``report``. They, and the modules of this package, are imported when a page is made,
not with switchfit: `page` puts the file together, `figures` draws, `curves`, `columns` and `sliders` prepare what is
drawn and what moves, `inputs` collects what is needed to run the fit again.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Mapping
from pathlib import Path

from switchfit.estimation.estimator import Estimate
from switchfit.report.wording import join_words
from switchfit.runtime.errors import MissingExtraError
from switchfit.runtime.presentation import format_page

LIBRARIES = ("bokeh", "jinja2")
"""What the extra ``report`` installs."""


@format_page.register(Estimate)
def write_page(
    estimate: Estimate, *, problem_file: Path | None = None, options: Mapping[str, object] | None = None
) -> str:
    """Return the report of an estimate as one HTML page.

    Parameters
    ----------
    estimate : Estimate
    problem_file : Path, optional
        Whose text is shown, with the hashes of the files that it names.
    options : mapping of str to object, optional
        What `estimate` was given.

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

    return build_page(estimate, problem_file, options)
