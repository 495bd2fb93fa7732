"""Dispatch of a result to functions of rooms that come after its own.

Results are data. How one is written or drawn, and how an estimate is validated with another run, is in later rooms,
which register a function for each kind of result (`functools.singledispatch`). These rooms are imported at the first
call that needs them.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import singledispatch
from typing import Any

_loaders: list[Callable[[], object]] = []


def register_later(load: Callable[[], object]) -> None:
    """Have `load` called before a kind of result is refused: it imports the modules that register functions.

    Parameters
    ----------
    load : callable
    """
    _loaders.append(load)


def call_registered(dispatcher: Any, result: object, **settings: Any) -> Any:
    """Call the function that is registered for a result, after importing the modules that register functions.

    For the default of a dispatcher, which is what a result gets as long as those modules are not imported.

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
    for load in _loaders:
        load()
    function = dispatcher.dispatch(type(result))
    if function is dispatcher.dispatch(object):
        name = dispatcher.__name__
        raise TypeError(f"{name} has no function for a {type(result).__name__}: register one with {name}.register.")
    return function(result, **settings)


@singledispatch
def validate_on(estimate: Any, other: Any, **settings: Any) -> Any:
    """Return the validation of an estimate on another run.

    Parameters
    ----------
    estimate : object
        Of a kind that `switchfit.strategy.validation` has registered.
    other : object
    settings
        Keyword arguments of the registered function.
    """
    return call_registered(validate_on, estimate, other=other, **settings)
