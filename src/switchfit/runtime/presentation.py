"""Dispatch of results to the functions that write and draw them.

Results are data. Their ``__str__`` and ``plot`` call `format_text` and `draw_figure`, for which the modules of
`switchfit.report` register a function for each kind of result. The report thus depends on the results, and no result
depends on the report.
"""

from __future__ import annotations

from functools import singledispatch
from typing import Any


@singledispatch
def format_text(result: Any, **settings: Any) -> str:
    """Return a result as plain text, of one or more lines, without a newline at the end.

    Parameters
    ----------
    result : object
        Of a kind that a module of `switchfit.report` has registered.
    settings
        Keyword arguments of the registered function.
    """
    raise TypeError(
        f"no module of switchfit.report writes a {type(result).__name__}; register one with format_text.register."
    )


@singledispatch
def draw_figure(result: Any, **settings: Any) -> Any:
    """Return the figure of a result, a matplotlib Figure.

    Parameters
    ----------
    result : object
        Of a kind that a module of `switchfit.report` has registered.
    settings
        Keyword arguments of the registered function.
    """
    raise TypeError(
        f"no module of switchfit.report draws a {type(result).__name__}; register one with draw_figure.register."
    )


@singledispatch
def format_page(result: Any, **settings: Any) -> str:
    """Return a result as one HTML page that needs no other file.

    Parameters
    ----------
    result : object
        Of a kind that a module of `switchfit.report` has registered.
    settings
        What that kind of page can be given.
    """
    raise TypeError(f"no module of switchfit.report makes a page of a {type(result).__name__}; register one.")


@singledispatch
def format_html(result: Any) -> str:
    """Return a result as a few lines of HTML, as a notebook shows it.

    Parameters
    ----------
    result : object
        Of a kind that a module of `switchfit.report` has registered.
    """
    raise TypeError(f"no module of switchfit.report shows a {type(result).__name__} in a notebook; register one.")
