"""Dispatch of a result's methods to functions of rooms that come after it.

`Estimate.validate` fits the transition times of another run with the strategies of `switchfit.strategy`, which itself
returns estimates. As with `switchfit.runtime.presentation`, the later room registers its function.
"""

from __future__ import annotations

from functools import singledispatch
from typing import Any


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
    raise TypeError(f"no module of switchfit.strategy validates a {type(estimate).__name__}.")
