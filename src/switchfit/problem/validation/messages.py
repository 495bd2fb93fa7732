"""Values, names and units as short text for messages."""

from __future__ import annotations

import reprlib
from collections.abc import Iterable
from typing import Any

import numpy as np

from switchfit.runtime.presentation import join_first

LONGEST_SHOWN_VALUE = 120
"""Largest number of characters of a value that a message shows."""

MOST_LISTED = 10
"""Largest number of names that a message lists."""


_SHORT = reprlib.Repr()
"""Representations of bounded length, computed in bounded time."""

_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxset = _SHORT.maxfrozenset = _SHORT.maxdeque = _SHORT.maxdict = 6
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother = 4, 60, 60


def unit_suffix(unit: str) -> str:
    """Return what follows a number in this unit, such as " min"; nothing for "" and for "1", a pure number."""
    return "" if unit in ("", "1") else f" {unit}"


def shorten(value: object) -> str:
    """Return any value as text for a message: at most `LONGEST_SHOWN_VALUE` characters."""
    array: Any = value  # maybe, and of any library
    try:
        is_small = hasattr(array, "tolist") and np.size(array) <= 8
        text = " ".join(_SHORT.repr(array.tolist() if is_small else value).split())
    except Exception:  # a faulty __repr__
        text = f"an object of type {type(value).__name__}"
    return text if len(text) <= LONGEST_SHOWN_VALUE else f"{text[: LONGEST_SHOWN_VALUE - 3]}..."


def join_names(names: Iterable[object]) -> str:
    """Return names with commas between them, the first ten if there are more; 'none' for no names."""
    return join_first((f"{name!s:.40}" for name in names), MOST_LISTED) or "none"
