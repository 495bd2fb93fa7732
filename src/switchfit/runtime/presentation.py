"""Dispatch of results to the functions that write and draw them.

Results are data. Their ``__str__`` and ``plot`` call `format_text` and `draw_figure`, for which the modules of
`switchfit.report` register a function for each kind of result. The report thus depends on the results, and no result
depends on the report. Settings are the keyword arguments of the registered function.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import singledispatch
from typing import Any


@singledispatch
def format_text(result: Any, **settings: Any) -> str:
    """Return a result as plain text, of one or more lines, without a newline at the end."""
    raise _refuse(result, "writes", "format_text")


@singledispatch
def draw_figure(result: Any, **settings: Any) -> Any:
    """Return the figure of a result, a matplotlib Figure."""
    raise _refuse(result, "draws", "draw_figure")


@singledispatch
def format_page(result: Any, **settings: Any) -> str:
    """Return a result as one HTML page that needs no other file."""
    raise _refuse(result, "makes a page of", "format_page")


@singledispatch
def format_html(result: Any) -> str:
    """Return a result as a few lines of HTML, as a notebook shows it."""
    raise _refuse(result, "makes the HTML of", "format_html")


NAMED_IN_LINE = 6
"""Entries of a list that one line names."""


def format_line(result: Any, *parts: str) -> str:
    """Return a result as one line, for its ``repr``: the name of its class and the parts that are not empty.

    Parameters
    ----------
    result : object
    parts : str
    """
    return f"{type(result).__name__}({', '.join(part for part in parts if part)})"


def join_first(texts: Iterable[str], most: int = NAMED_IN_LINE) -> str:
    """Return texts with commas between them; of more than `most`, the first ones and how many there are besides.

    Parameters
    ----------
    texts : iterable of str
    most : int
    """
    given = list(texts)
    return ", ".join(given[:most]) + (f" and {len(given) - most} more" if len(given) > most else "")


def _refuse(result: Any, verb: str, dispatcher: str) -> TypeError:
    """Return the error for a kind of result that no module has registered."""
    kind = type(result).__name__
    return TypeError(f"no module of switchfit.report {verb} a {kind}; register one with {dispatcher}.register.")
