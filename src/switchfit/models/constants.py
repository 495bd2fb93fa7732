"""Constants of the models: numbers that stay, or names of parameters that may be estimated."""

from __future__ import annotations

from collections.abc import Mapping

from switchfit.arrays import Traced
from switchfit.problem.validation.arrays import as_finite, as_not_negative, as_positive

Constant = float | str
"""A number that stays, or the name of a parameter of the problem, which may be estimated."""

Constants = Mapping[str, Constant]
"""By their names in the model."""


def check_constants(
    *,
    positive: Mapping[str, object],
    not_negative: Mapping[str, object] | None = None,
    others: Mapping[str, object] | None = None,
) -> dict[str, Constant]:
    """Return constants as floats and names.

    Parameters
    ----------
    positive, not_negative, others : mapping of str to float or str
        The value of each argument: those that must be positive where they are numbers, those that must be 0 or more,
        and those that may have either sign.

    Raises
    ------
    TypeError
        If a value is neither a number nor a string.
    ValueError
        If a number is not finite, or not positive where it must be, or a name is no identifier.
    """
    found: dict[str, Constant] = {}
    not_negative = not_negative or {}
    for name, value in {**positive, **not_negative, **(others or {})}.items():
        if isinstance(value, str):
            if not value.isidentifier():
                raise ValueError(f"{name} must be a number or the name of a parameter; got the name {value!r}.")
            found[name] = value
        else:
            # Only numbers have a sign: that of a parameter is for its bounds to say.
            check = as_positive if name in positive else as_not_negative if name in not_negative else as_finite
            found[name] = check(value, name)
    return found


class Values:
    """The value of each constant: itself, or that of the parameter of its name, which is read when it is asked for.

    So a mode needs only the parameters that it reads.

    Parameters
    ----------
    constants : mapping of str to float or str
    p : mapping of str to array
        The parameters that a mode gets.
    """

    def __init__(self, constants: Constants, p: Mapping[str, Traced]) -> None:
        self._constants, self._p = constants, p

    def __getitem__(self, name: str) -> Traced:
        """Return the value of a constant."""
        value = self._constants[name]
        return self._p[value] if isinstance(value, str) else value


def is_absent(value: Constant) -> bool:
    """Return whether a term is left out of the model: its constant is the number zero.

    Parameters
    ----------
    value : float or str
    """
    return not isinstance(value, str) and value == 0.0
