"""Parts of sentences: the figures and subjects of an issue as words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import join_first

ALLOWED = "Standard errors allow for the correlation of the residuals."
"""Below a table whose standard errors are corrected."""

LISTED_NAMES = 3
"""Names that a sentence lists; the data has all of them."""


def get_figure(issue: Issue, name: str) -> float:
    """Return a figure that is one number; NaN if the issue lacks it.

    Parameters
    ----------
    issue : Issue
    name : str
    """
    value = issue.figures.get(name, np.nan)
    # NaN, and no error: a sentence with a gap is better than no report.
    return np.nan if isinstance(value, tuple) else value


def list_figures(issue: Issue, name: str) -> tuple[float, ...]:
    """Return a figure that may be several numbers; nothing if the issue lacks it.

    Parameters
    ----------
    issue : Issue
    name : str
    """
    value = issue.figures.get(name, ())
    return value if isinstance(value, tuple) else (value,)


def list_each(issue: Issue, template: str, *names: str, first: int = 0) -> str:
    """Return subjects of an issue, each with its figures, such as "mu = 0.3, tau_1 = 2".

    Parameters
    ----------
    issue : Issue
    template : str
        With a field for the subject, and one for each figure.
    names : str
        Of the figures.
    first : int, optional
        Of the subjects.
    """
    each = zip(issue.subjects[first:], *(list_figures(issue, name) for name in names), strict=False)
    return join_first([template.format(*entries) for entries in each])


def join_words(words: Sequence[str]) -> str:
    """Return "a", "a and b", or "a, b and c"."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def capitalise(text: str) -> str:
    """Return a text with a capital letter at its beginning."""
    return text[:1].upper() + text[1:]


def join_subjects(issue: Issue) -> str:
    """Return the subjects of an issue with commas between them."""
    return ", ".join(issue.subjects)


def name_first(names: tuple[str, ...]) -> str:
    """Return the first names, and the number of the others."""
    return join_words(names or ("the unknowns",)) if len(names) <= LISTED_NAMES else join_first(names, LISTED_NAMES)
