"""What the models share: constants that are numbers or names of parameters, and checks of what is given."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from switchfit.problem.validation import as_finite, as_not_negative, as_positive, as_sequence, join_names

Constant = float | str
"""A number that stays, or the name of a parameter of the problem, which may be estimated."""
Constants = Mapping[str, Constant]
"""By their names in the model."""


def check_constants(
    *,
    positive: Mapping[str, Any],
    not_negative: Mapping[str, Any] | None = None,
    others: Mapping[str, Any] | None = None,
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
            check = as_positive if name in positive else as_not_negative if name in not_negative else as_finite
            found[name] = check(value, name)
    return found


def check_modes(modes: Any, known: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the modes that a system shall have.

    Parameters
    ----------
    modes : str or sequence of str
    known : str
        All modes of the model.

    Raises
    ------
    TypeError
        If `modes` is neither a name nor a sequence.
    ValueError
        For an unknown mode, one that is given twice, or an empty sequence.
    """
    form = f"a sequence of names out of {', '.join(known)}"
    names = (modes,) if isinstance(modes, str) else as_sequence(modes, "modes", form)
    valid = {name for name in names if isinstance(name, str)}.intersection(known)
    if not names or len(valid) < len(names):
        raise ValueError(f"modes must be different ones of {', '.join(known)}; got {join_names(names)}.")
    return names


def check_length(initial_state: Any, states: Sequence[str]) -> Any:
    """Return an initial state that has one entry for each state; a function of p is checked where it is called.

    Parameters
    ----------
    initial_state : (n,) array_like, or a function
    states : sequence of str
        Names of the states.

    Raises
    ------
    ValueError
        For another number of entries.
    """
    if not callable(initial_state) and not isinstance(initial_state, str) and np.ndim(initial_state) <= 1:
        count = np.size(initial_state)
        if count != len(states):
            raise ValueError(f"initial_state must have {len(states)} entries, {', '.join(states)}; got {count}.")
    return initial_state


def read_input(u: Any, channels: Sequence[str]) -> tuple[Any, ...]:
    """Return the channels of the input at one time.

    JAX clips an index that is too large instead of failing: too few channels would be taken for the last one.

    Parameters
    ----------
    u : (q,) array
    channels : sequence of str
        What they are, with units.

    Raises
    ------
    ValueError
        For another number of channels.
    """
    if np.shape(u) != (len(channels),):
        count = np.shape(u)[0] if np.ndim(u) == 1 else 1
        raise ValueError(
            f"the input of the Experiment must have {len(channels)} channels, {', '.join(channels)}; it has {count}."
        )
    return tuple(u[k] for k in range(len(channels)))


class Values:
    """The value of each constant: itself, or that of the parameter of its name, which is read when it is asked for.

    So a mode needs only the parameters that it reads.

    Parameters
    ----------
    constants : mapping of str to float or str
    p : mapping of str to array
        The parameters that a mode gets.
    """

    def __init__(self, constants: Constants, p: Mapping[str, Any]) -> None:
        self._constants, self._p = constants, p

    def __getitem__(self, name: str) -> Any:
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
