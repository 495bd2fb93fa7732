"""Sentences about issues as templates: text with fields for names and numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from string import Formatter
from typing import Any

import numpy as np

from switchfit.runtime.issue import Issue

Sentence = str | Callable[[Issue], str]
"""A template, whose fields are subjects by their number, words, and figures by their name; or a function."""
Words = Mapping[str, Callable[[Issue], Any]]
"""What a field stands for that is neither a subject nor a figure."""


class _Fields(dict[str, Any]):
    """Look up the fields of a template: first among the words, then among the figures of the issue."""

    def __init__(self, issue: Issue, words: Words) -> None:
        self.issue, self.words = issue, words

    def __getitem__(self, name: str) -> Any:
        return self.words[name](self.issue) if name in self.words else get_figure(self.issue, name)


def write_sentence(sentence: Sentence, issue: Issue, words: Words) -> str:
    """Return the sentence on an issue.

    Parameters
    ----------
    sentence : str or callable
    issue : Issue
    words : mapping of str to callable
    """
    if callable(sentence):
        return sentence(issue)
    return Formatter().vformat(sentence, issue.subjects, _Fields(issue, words))


def get_figure(issue: Issue, name: str) -> float:
    """Return a figure that is one number; NaN if the issue lacks it.

    Parameters
    ----------
    issue : Issue
    name : str
    """
    value = issue.figures.get(name, np.nan)
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


def write_places(names: Sequence[str], values: Sequence[float], digits: int = 8) -> str:
    """Return values of unknowns, such as "mu = 0.3, tau_1 = 2".

    Parameters
    ----------
    names : sequence of str
    values : sequence of float
    digits : int, optional
    """
    return ", ".join(f"{name} = {value:.{digits}g}" for name, value in zip(names, values, strict=False))


def join_words(words: Sequence[str]) -> str:
    """Return "a", "a and b", or "a, b and c"."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def capitalise(text: str) -> str:
    """Return a text with a capital letter at its beginning."""
    return text[:1].upper() + text[1:]
