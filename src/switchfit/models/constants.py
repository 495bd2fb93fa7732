"""Physical constants of a model: each is a number, or the name of a parameter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

Constant = float | str
"""A number that stays, or the name of a parameter of the problem, which may be estimated."""


def check_constants(given: Mapping[str, Any], *, positive: tuple[str, ...] = ()) -> dict[str, Constant]:
    """Return constants as floats and names.

    Parameters
    ----------
    given : mapping of str to float or str
        The value of each argument.
    positive : tuple of str
        Arguments that must be positive where they are numbers.

    Raises
    ------
    TypeError
        If a value is neither a number nor a string.
    ValueError
        If a number is not finite, or not positive where it must be, or a name is no identifier.
    """
    found: dict[str, Constant] = {}
    for name, value in given.items():
        if isinstance(value, str):
            if not value.isidentifier():
                raise ValueError(f"{name} must be a number or the name of a parameter; got the name {value!r}.")
            found[name] = value
            continue
        if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
            raise TypeError(
                f"{name} must be a number, or the name of a parameter to be fixed or estimated in the Problem; got "
                f"{type(value).__name__}."
            )
        if not np.isfinite(value):
            raise ValueError(f"{name} must be finite; got {value}.")
        if name in positive and not value > 0:
            raise ValueError(f"{name} must be positive; got {value}.")
        found[name] = float(value)
    return found


def read_constants(constants: Mapping[str, Constant], p: Mapping[str, Any]) -> dict[str, Any]:
    """Return the value of each constant: itself, or that of the parameter of its name.

    Parameters
    ----------
    constants : mapping of str to float or str
    p : mapping of str to array
        The parameters that a mode gets.
    """
    return {name: p[value] if isinstance(value, str) else value for name, value in constants.items()}


def is_absent(value: Constant) -> bool:
    """Return whether a term is left out of the model: its constant is the number zero.

    Parameters
    ----------
    value : float or str
    """
    return not isinstance(value, str) and value == 0.0
