"""Dispatch of results to the functions that write and draw them.

Results are data. Their ``__str__`` and ``plot`` call `format_text` and `draw_figure`, for which the modules of
`switchfit.report` register a function for each kind of result. The report thus depends on the results, and no result
depends on the report, which is imported when a result is first written or drawn. Settings are the keyword arguments of
the registered function.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import singledispatch
from typing import TYPE_CHECKING, Any

from switchfit.runtime.dispatch import call_registered

if TYPE_CHECKING:
    from matplotlib.axes import Axes as Axes
    from matplotlib.figure import Figure as Figure
else:
    Axes = Figure = Any  # for annotations: to import matplotlib takes longer than half of switchfit


@singledispatch
def format_text(result: Any, **settings: Any) -> str:
    """Return a result as plain text, of one or more lines, without a newline at the end."""
    text: str = call_registered(format_text, result, **settings)
    return text


@singledispatch
def draw_figure(result: Any, **settings: Any) -> Any:
    """Return the figure of a result, a matplotlib Figure."""
    return call_registered(draw_figure, result, **settings)


@singledispatch
def format_page(result: Any, **settings: Any) -> str:
    """Return a result as one HTML page that needs no other file."""
    text: str = call_registered(format_page, result, **settings)
    return text


@singledispatch
def format_html(result: Any) -> str:
    """Return a result as a few lines of HTML, as a notebook shows it."""
    text: str = call_registered(format_html, result)
    return text


class Printed:
    """A result whose text the report writes."""

    def __str__(self) -> str:
        return format_text(self)


class Displayed(Printed):
    """A result that has a form of its own in a notebook, too."""

    def _repr_html_(self) -> str:
        return format_html(self)


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


def format_count(number: int, one: str, many: str = "") -> str:
    """Return a number and a noun, such as "1 minimum" or "3 minima"; the plural ends in s unless given.

    Parameters
    ----------
    number : int
    one, many : str
    """
    return f"{number} {one if number == 1 else many or f'{one}s'}"


def join_first(texts: Iterable[str], most: int = NAMED_IN_LINE) -> str:
    """Return texts with commas between them; of more than `most`, the first ones and how many there are besides.

    Parameters
    ----------
    texts : iterable of str
    most : int
    """
    given = list(texts)
    return ", ".join(given[:most]) + (f" and {len(given) - most} more" if len(given) > most else "")
