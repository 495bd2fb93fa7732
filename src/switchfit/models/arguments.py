"""Checks of what users give to the models: modes, the length of the initial state, and channels of the input."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from switchfit.arrays import Converted, Traced
from switchfit.problem.validation.messages import join_names
from switchfit.problem.validation.names import as_sequence


def check_modes(modes: object, known: Iterable[str]) -> tuple[str, ...]:
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
    valid = [name for name in names if isinstance(name, str) and name in set(known)]
    if not names or len(set(valid)) < len(names):
        raise ValueError(f"modes must be different ones of {', '.join(known)}; got {join_names(names)}.")
    return tuple(valid)


def check_length(initial_state: Converted, states: Sequence[str]) -> Converted:
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
    # Anything else is refused by `HybridSystem`, with its own message.
    if not callable(initial_state) and not isinstance(initial_state, str) and np.ndim(initial_state) <= 1:
        count = np.size(initial_state)
        if count != len(states):
            raise ValueError(f"initial_state must have {len(states)} entries, {', '.join(states)}; got {count}.")
    return initial_state


def read_input(u: Traced, channels: Sequence[str]) -> tuple[Traced, ...]:
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
