"""Reports of one fit for people: text, tables, figures, the HTML page; and what all reports are made of.

Modules here register how a result of the rooms below is written and drawn (`switchfit.runtime.presentation`); rooms
above do so for their own results, in modules beside these. All of them are imported together, when a result is first
written or drawn. Imports `io` and the rooms before it.
"""

from switchfit.report import (  # noqa: F401
    certificate,
    directions,
    fit_report,
    frames,
    gallery,
    html,
    issues,
    prediction,
    problem,
    profiles,
    residuals,
    termination,
    validation,
    verdict,
)  # fmt: skip
