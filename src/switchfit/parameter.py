"""`Parameter`, an unknown of any kind: of the model, a transition time, or an entry of an initial state."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, eq=False)
class Parameter:
    """One unknown, scalar or array: its initial guess and what is known about it.

    Parameters
    ----------
    value : float or array_like
        Initial guess, or the value itself where `fixed`.
    lower, upper : float or array_like, optional
        Bounds; broadcast to the shape of `value`.
    unit : str, optional
        For the report.
    fixed : bool, optional
        A fixed parameter is not estimated.

    Raises
    ------
    ValueError
        If a value is not finite, bounds cross, or the guess lies outside them.
    """

    value: Any
    lower: Any = -np.inf
    upper: Any = np.inf
    unit: str = ""
    fixed: bool = False

    def __post_init__(self) -> None:
        try:
            value = np.array(self.value, dtype=np.float64)
            lower = np.broadcast_to(np.asarray(self.lower, dtype=np.float64), value.shape).copy()
            upper = np.broadcast_to(np.asarray(self.upper, dtype=np.float64), value.shape).copy()
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"Parameter needs numbers: value {self.value!r}, lower {self.lower!r}, upper {self.upper!r}; {error}."
            ) from error
        if value.size == 0:
            raise ValueError("Parameter value must have one entry or more; got none.")
        if not np.all(np.isfinite(value)):
            raise ValueError(f"Parameter value must be finite; got {self.value!r}.")
        if not np.all(lower <= upper):
            raise ValueError(f"Parameter bounds must satisfy lower <= upper; got [{self.lower}, {self.upper}].")
        if not (np.all(lower <= value) and np.all(value <= upper)):
            raise ValueError(f"Parameter value {self.value} lies outside its bounds [{self.lower}, {self.upper}].")
        for name, array in (("value", value), ("lower", lower), ("upper", upper)):
            object.__setattr__(self, name, array)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the parameter, () for a scalar."""
        return tuple(self.value.shape)


def as_parameter(value: Any, what: str) -> Parameter:
    """`value` itself if it is a `Parameter`, otherwise a free one without bounds; errors call it `what`."""
    if isinstance(value, Parameter):
        return value
    try:
        return Parameter(value)
    except ValueError as error:
        raise ValueError(f"{what} must be a number, an array or an sf.Parameter: {error}") from error
