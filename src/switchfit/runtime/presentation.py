"""Dispatch of results to functions of rooms that come after their own.

Results are data. How one is written or drawn is in a later room, which registers a function for each kind of result
(`functools.singledispatch`): their ``__str__`` and ``plot`` call `format_text` and `draw_figure`, for which the modules
of `switchfit.report` register functions. The report thus depends on the results, and no result depends on the report,
which is imported when a result is first written or drawn (`load_registering_rooms`). Settings are the keyword arguments
of the registered function.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import singledispatch
from typing import TYPE_CHECKING, Any

from switchfit.runtime import load_registering_rooms

NAMED_IN_LINE = 6
"""Entries of a list that one line names."""


if TYPE_CHECKING:
    from functools import _SingleDispatchCallable

    from matplotlib.axes import Axes as Axes
    from matplotlib.figure import Figure as Figure
    from typing_extensions import TypeVar

    Drawn = TypeVar("Drawn", bound=Axes | Figure, default=Figure)
    Returned = TypeVar("Returned")
else:
    Axes = Figure = Drawn = Any  # for annotations: to import matplotlib takes longer than half of switchfit
"""`Drawn` is what a plot returns: the axes that it is given, otherwise a new Figure."""


def call_registered(dispatcher: _SingleDispatchCallable[Returned], result: object, **settings: Any) -> Returned:
    """Call the function that is registered for a result, after importing the rooms that register them.

    For the default of a dispatcher, which is what a result gets as long as they are not imported.

    Parameters
    ----------
    dispatcher : function
        Made by `functools.singledispatch`.
    result : object
    settings
        Keyword arguments of the registered function.

    Raises
    ------
    TypeError
        For a kind of result that no module has registered.
    """
    load_registering_rooms()
    function, default = dispatcher.dispatch(type(result)), dispatcher.dispatch(object)
    if function is default:
        name = default.__name__
        raise TypeError(f"{name} has no function for a {type(result).__name__}: register one with {name}.register.")
    return function(result, **settings)


@singledispatch
def format_text(result: Any, **settings: Any) -> str:
    """Return a result as plain text, of one or more lines, without a newline at the end."""
    return call_registered(format_text, result, **settings)


@singledispatch
def draw_figure(result: Any, **settings: Any) -> Any:
    """Return the figure of a result, a matplotlib Figure."""
    return call_registered(draw_figure, result, **settings)


@singledispatch
def format_page(result: Any, **settings: Any) -> str:
    """Return a result as one HTML page that needs no other file."""
    return call_registered(format_page, result, **settings)


@singledispatch
def format_html(result: Any) -> str:
    """Return a result as a few lines of HTML, as a notebook shows it."""
    return call_registered(format_html, result)


class Printed:
    """A result whose text the report writes."""

    def __str__(self) -> str:
        return format_text(self)


class Displayed(Printed):
    """A result that has a form of its own in a notebook, too."""

    def _repr_html_(self) -> str:
        return format_html(self)


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
