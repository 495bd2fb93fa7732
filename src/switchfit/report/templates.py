"""Templates of sentences on issues: their fields are subjects by number, figures by name, and words.

A template is a string for `str.format`, or a function of the issue where a string is not enough. `write_sentence` looks
a field up among the words, then among the figures of the issue.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from string import Formatter
from typing import Any

import numpy as np

from switchfit.report.shares import format_share, write_worst_explained
from switchfit.report.wording import (
    LISTED_NAMES,
    capitalise,
    get_figure,
    join_subjects,
    join_words,
    list_each,
    list_figures,
    name_first,
)
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import format_count

# --- templates --------------------------------------------------------------------------------------------------------

Sentence = str | Callable[[Issue], str]
"""A template, whose fields are subjects by their number, words, and figures by their name; or a function."""

_REPAIRS = {
    "log: unsorted times": ("repair='sort' sorts by time", "sorted"),
    "log: clock jump": (
        "if these are two recordings, split the file there; else repair='sort' sorts by time",
        "sorted",
    ),
    "log: repeated time": ("repair='drop-duplicates' keeps the first sample of each", "the first sample is kept"),
    "log: wrapped angle": ("repair='unwrap:{2}' makes it continuous", "unwrapped"),
}
"""What repairs it, and what to say once that is done."""

DEFINITION_EXAMPLES = {
    "sqrt": "its argument positive, as jnp.sqrt(jnp.maximum(x, 1e-9))",
    "log": "its argument positive, as jnp.log(jnp.maximum(x, 1e-9))",
    "pow": "its base positive, as jnp.maximum(x, 1e-9) ** p",
    "jnp.linalg.norm": "it from 0, as jnp.sqrt(jnp.sum(x**2) + 1e-12)",
    "div": "its denominator away from 0, as a / jnp.maximum(x, 1e-9)",
}
"""What to keep from where an operation is not defined, or has no derivative."""

_DELAYED = " J has a kink where a transition meets a late sample's moment: fix the delay at its estimate to see."
"""Behind why a line search failed if a delay is estimated."""


def write_sentence(sentence: Sentence, issue: Issue) -> str:
    """Return the sentence on an issue.

    Parameters
    ----------
    sentence : str or callable
    issue : Issue
    """
    if callable(sentence):
        return sentence(issue)
    # Only the fields that the template has are looked up: a word may need figures that other issues lack.
    names = [name for _, name, *_ in Formatter().parse(sentence) if name and not name.isdigit()]
    fields = {name: _WORDS[name](issue) if name in _WORDS else get_figure(issue, name) for name in names}
    return sentence.format(*issue.subjects, **fields)


# --- logs -------------------------------------------------------------------------------------------------------------


def _locate(issue: Issue) -> str:
    """Return the file and the line, with how many more lines there are of the kind."""
    source, place = issue.subjects[:2]
    count = get_figure(issue, "count")
    more = f" (and {count - 1:.0f} more)" if count > 1 else ""
    return f"{source}, {place} {get_figure(issue, 'line'):.0f}{more}"


def _add_unit(issue: Issue, name: str) -> str:
    unit = issue.subjects[2]
    return f"{get_figure(issue, name):.6g} {unit}".rstrip()


def _write_repair(issue: Issue) -> str:
    remedy, repaired = _REPAIRS[issue.kind]
    return repaired if get_figure(issue, "repaired") == 1.0 else remedy.format(*issue.subjects)


def _write_jump(issue: Issue) -> str:
    """Return where the cost jumps, as the beginning of a sentence; empty where that is not known."""
    template = "The cost jumps from {before:.8g} to {after:.8g} where {0} passes {at:.8g}: "
    return write_sentence(template, issue) if np.isfinite(get_figure(issue, "at")) else ""


def write_undefined(issue: Issue) -> str:
    """Return which function has no finite value or derivative, and where, as a part of a sentence.

    Parameters
    ----------
    issue : Issue
    """
    role, operation, line, run = issue.subjects
    x = [float(f"{value:.6g}") for value in list_figures(issue, "x")]
    t = f"t = {get_figure(issue, 't'):.6g}, " if "t" in issue.figures else ""
    # The value is fine where only the derivative is not, as of sqrt at 0.
    lacks = "derivatives" if get_figure(issue, "valued") else "value"
    function = f"{role}{f' of {run}' if run else ''} has no finite {lacks}{f' at {t}x = {x}' if x else ''}"
    # Order 0 is the function itself, 1 and 2 are its derivatives, which are needed for gradient and Hessian.
    which = ("", "the derivative of ", "the second derivative of ")[int(get_figure(issue, "order"))]
    return f"{function}: {which}{operation}{f' at {line}' if line else ''} is not finite"


def suggest_definition(operation: str) -> str:
    """Return what to do about an operation that is not defined, or has no derivative, somewhere.

    Parameters
    ----------
    operation : str
        Its name in JAX.
    """
    example = DEFINITION_EXAMPLES.get(operation, "its argument away from there, as by jnp.where")
    return f"keep {example}, or make what happens there a mode of its own"


def write_agreement(tried: int, better: int, agreeing: int, *, few: bool = False) -> str:
    """Return how many of the other starts found the lowest J, as a part of a sentence.

    Parameters
    ----------
    tried, better, agreeing : int
        As in `Fit.starts`.
    few : bool
        Whether so few starts agree that the minimum is doubtful.
    """
    if better > 0:
        return f"{better} of {tried} other starts are better"
    count = "none" if not agreeing else f"only {agreeing}" if few else str(agreeing)
    return f"the lowest J was found from {count} of {tried} other starts"


def describe_starts(issue: Issue) -> str:
    """Return how many starts were tried, and how many ended at this J or lower."""
    tried, better, agreeing = (int(get_figure(issue, name)) for name in ("tried", "better", "agreeing"))
    return write_agreement(tried, better, agreeing, few=issue.kind == "few starts agree")


def _count_fits(issue: Issue) -> str:
    """Return the number of fits that a reason is about."""
    return f"{get_figure(issue, 'count'):.0f} of {format_count(int(get_figure(issue, 'fits')), 'fit')}"


def _name_least(issue: Issue) -> str:
    """Return which fit explains least, and how much; empty where that is not known."""
    share = get_figure(issue, "worst")
    return f" (fit {issue.subjects[0]} explains {format_share(share)} of the variance)" if np.isfinite(share) else ""


_WORDS: Mapping[str, Callable[[Issue], Any]] = {
    "where": _locate,
    "repair": _write_repair,
    **{name: partial(_add_unit, name=name) for name in ("time", "step", "typical")},
    "names": join_subjects,
    "of names": lambda issue: f" of {join_words(issue.subjects)}" if issue.subjects else "",
    "correlated": lambda issue: list_each(issue, "{} ({:.2f})", "correlation"),
    "jump": _write_jump,
    "places": lambda issue: list_each(issue, "{} = {:.8g}", "at"),
    "kind": lambda issue: issue.kind,
    "orders": lambda issue: ", ".join(f"{order:.2f}" for order in list_figures(issue, "orders")),
    "undefined": lambda issue: capitalise(write_undefined(issue)),
    "definition": lambda issue: capitalise(suggest_definition(issue.subjects[1])),
    "delay": lambda issue: _DELAYED if get_figure(issue, "delayed") == 1.0 else "",
    "first names": lambda issue: name_first(issue.subjects),
    "mode": lambda issue: " of ".join((f"mode {issue.subjects[0]!r}", *filter(None, issue.subjects[1:2]))),
    "explanation of the worst": write_worst_explained,
    "agreement": describe_starts,
    "fits": _count_fits,
    "least": _name_least,
    "per cent": lambda issue: 100 * get_figure(issue, "share"),
    "level in per cent": lambda issue: 100 * get_figure(issue, "level"),
    "rivals": lambda issue: list_each(issue, "{} may be {:.6g} as well, where J is {:.2g} higher", "at", "rise"),
    "times at jumps": lambda issue: list_each(issue, "{} at {:.8g}", "at"),
    "where it failed": lambda issue: list_each(issue, "{} = {:.6g}", "at", first=2),
    "statuses": lambda issue: ", ".join(issue.subjects[:LISTED_NAMES]),
}
"""What a field of a sentence stands for that is neither a subject nor a figure."""
