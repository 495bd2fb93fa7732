"""The report of a fit as text: the verdict first, then its sections, on one screen or in full."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from switchfit.report import tables
from switchfit.report.directions import write_direction
from switchfit.report.fit_summary import format_rows, list_course, list_experiments, list_quality, tabulate_channels
from switchfit.report.selection import SCREEN
from switchfit.report.tables import format_table, wrap_text
from switchfit.report.unknowns import SMALL_CORRELATION, format_unknowns, tabulate_correlations, tabulate_fixed
from switchfit.runtime.presentation import format_count, format_text
from switchfit.uncertainty.identification import WEAK
from switchfit.uncertainty.issues import find_issues
from switchfit.uncertainty.judged_fit import JudgedFit

_COVERED = {
    "a mode collapsed": {"idle times", "idle parameters"},
    "idle": {"idle times", "idle parameters"},
    "at bounds": {"lower bound", "upper bound"},
    "not determined": {"no errors: not positive definite"},
    "not converged": {"no errors: not positive definite"},
    "unexplained": {"sigma too small", "correlated residuals"},
    "model suspected": {"sigma too small", "correlated residuals"},
    "outliers suspected": {"sigma too small"},
    "sigma suspected": {"sigma too small"},
    "integration error": {"large integration error"},
}
"""Other kinds of warnings whose content is in a reason of the verdict, by the kind of that reason."""


@format_text.register(JudgedFit)
def write_estimate(estimate: JudgedFit, *, full: bool = False) -> str:
    """Return the report: the verdict, the problem, the course of the fit, its quality, the unknowns, the warnings.

    Parameters
    ----------
    estimate : JudgedFit
        The failures of its certificate count in the verdict if it is known.
    full : bool
        All experiments, channels, unknowns, correlations, directions and warnings; otherwise as much as fits on one
        screen.

    Returns
    -------
    str
        Several lines without a newline at the end; the verdict first.
    """
    # One layout with two sets of limits: nothing is left out of the full report.
    limits = dict.fromkeys(SCREEN, sys.maxsize) if full else SCREEN
    course = [*list_experiments(estimate, limits["experiments"]), *list_course(estimate)]
    channels = format_table(*tabulate_channels(estimate), most=limits["channels"], where=", of which more is explained")
    correlations = format_table(*tabulate_correlations(estimate), most=limits["others"])
    sections = {
        "Fit": format_rows(course),
        "Quality of the fit": [*format_rows(list_quality(estimate)), *([""] if channels else []), *channels],
        "Unknowns": format_unknowns(estimate, limits["unknowns"]),
        "Held fixed": format_table(*tabulate_fixed(estimate), most=limits["fixed"]),
        f"Correlations above {SMALL_CORRELATION:g}": correlations,
        "Determined worst by the data": _describe_weak(estimate, limits["directions"]),
        "Warnings": _list_sentences(_list_warnings(estimate), limits["others"], "warning"),
    }
    written = [[title, *lines] for title, lines in sections.items() if lines]
    shown = tables.join_sections(wrap_text(str(estimate.verdict)), *written)
    return shown if full else f"{shown}\n\nMore: estimate.report(full=True), switchfit fit --full."


def _describe_weak(estimate: JudgedFit, most: int) -> list[str]:
    """Return the combinations of unknowns that the data hardly determine, as lines."""
    found = estimate.identifiability
    # Without convergence the curvature is not that of a minimum, and what it says of directions means little.
    weak = [d for d in found.directions if d.eigenvalue < WEAK] if estimate.status.successful else []
    return _list_sentences([write_direction(found, direction) for direction in weak], most, "direction")


def _list_sentences(sentences: Sequence[str], most: int, what: str) -> list[str]:
    """Return the first sentences as lines, and how many more there are of what they are about."""
    lines = [line for sentence in sentences[:most] for line in wrap_text(sentence, "  - ", "    ")]
    more = len(sentences) - len(sentences[:most])
    return lines + ([f"  and {format_count(more, what)} more"] if more else [])


def _list_warnings(estimate: JudgedFit) -> list[str]:
    """Return the warnings that the verdict does not cover, as sentences."""
    reasons = {reason.kind for reason in estimate.verdict.reasons}
    # Of two sentences on one thing, the verdict's is enough: it says what to do.
    covered = reasons.union(*(_COVERED.get(kind, set()) for kind in reasons))
    return [str(issue) for issue in find_issues(estimate) if issue.kind not in covered]
