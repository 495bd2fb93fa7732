"""Results for people: text, tables and figures.

Results do not know this room. Its modules register how each kind of result is written and drawn
(`switchfit.runtime.presentation`). All of them are imported together, when a result is first written or drawn.
Imports `experiment_design` and the rooms before it.
"""

from switchfit.report import (  # noqa: F401
    certificate,
    directions,
    experiment_design,
    fit_report,
    fits_figures,
    fits_tables,
    frames,
    gallery,
    html,
    insertion_rates,
    issues,
    mode_endings,
    mode_figure,
    mode_search,
    model_comparison,
    online,
    prediction,
    problem,
    profiles,
    residuals,
    termination,
    validation,
    verdict,
)  # fmt: skip
