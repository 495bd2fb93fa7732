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


def find_function(dispatcher: Any, result: object, refusal: str) -> Callable[..., Any]:
    """Return the function that is registered for a result, after importing the modules that register functions.

    For the default of a dispatcher, which is what a result gets as long as those modules are not imported.

    Parameters
    ----------
    dispatcher : function
        Made by `functools.singledispatch`.
    result : object
    refusal : str
        Message of the TypeError for a kind of result that no module has registered, with {} for its name.
    """
    for load in _loaders:
        load()
    function: Callable[..., Any] = dispatcher.dispatch(type(result))
    if function is dispatcher.dispatch(object):
        raise TypeError(refusal.format(type(result).__name__))
    return function


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
    function = find_function(validate_on, estimate, "no module of switchfit.strategy validates a {}.")
    return function(estimate, other, **settings)
