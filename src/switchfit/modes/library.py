"""The library of a search from the arguments of `find_modes`, checked."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from switchfit.problem.problem import Problem
from switchfit.problem.unknowns import get_min_duration
from switchfit.problem.validation import as_count, as_name, as_names, as_number, join_names, shorten
from switchfit.strategy.library import Library


def build_library(
    problem: Problem,
    library: Any = None,
    *,
    first: Any = None,
    last: Any = None,
    successions: Any = None,
    min_duration: Any = None,
    max_switches: Any = 8,
) -> Library:
    """Return the library of a search from the arguments of `find_modes`, checked.

    Parameters
    ----------
    problem : Problem
    library : sequence of str, optional
    first, last : str or sequence of str, optional
    successions : mapping of str to sequence of str, optional
    min_duration : float or mapping of str to float, optional
    max_switches : int

    Raises
    ------
    ValueError
        For names that the system lacks, successions from a mode that is not in the library, a `last` that cannot be
        reached from any `first`, or a negative duration.
    TypeError
        If an argument is of the wrong type.
    """
    most = as_count(max_switches, "max_switches")
    names = _choose_modes(library, "library", tuple(problem.system.modes), "system")
    begins, ends = _choose_modes(first, "first", names), _choose_modes(last, "last", names)
    followers = _check_successions(successions, names)
    durations = _check_durations(problem, min_duration, names)
    found = Library(names, begins, ends, followers, durations, most)
    if not replace(found, max_switches=len(names)).possible_switches:  # however many switches there may be
        raise ValueError(
            f"no mode of last ({join_names(ends)}) can be reached from first ({join_names(begins)}) by the "
            "successions: add the missing successions, or change first or last."
        )
    return found


def _require_known(names: Sequence[str], what: str, known: Sequence[str], owner: str = "library") -> None:
    unknown = next((name for name in names if name not in known), None)
    if unknown is not None:
        raise ValueError(f"{what} names the mode {shorten(unknown)}; the {owner} has the modes {join_names(known)}.")


def _choose_modes(given: Any, what: str, names: tuple[str, ...], owner: str = "library") -> tuple[str, ...]:
    """Return the given modes among some names, in their order; all if they are left out."""
    if given is None:
        return names
    chosen = (as_name(given, what),) if isinstance(given, str) else as_names(given, what, "a mode or a list of modes")
    if not chosen:
        raise ValueError(f"{what} is empty: name at least one mode, or leave it out for all modes of the {owner}.")
    _require_known(chosen, what, names, owner)
    return tuple(name for name in names if name in chosen)


def _check_successions(given: Any, names: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """Return the modes that may follow each mode; a mode that a mapping leaves out has none."""
    if given is None:
        return {name: tuple(other for other in names if other != name) for name in names}
    if not isinstance(given, Mapping):
        raise TypeError(
            "successions must be a dict of mode -> the modes that may follow it, such as "
            f"{{'flight': ('slide',), 'slide': ('stick',)}}; got {shorten(given)}."
        )
    _require_known(list(given), "successions", names)
    found: dict[str, tuple[str, ...]] = dict.fromkeys(names, ())
    for name, after in given.items():
        what = f"successions of {shorten(name)}"
        listed = (after,) if isinstance(after, str) else as_names(after, what, "a sequence of names of modes")
        _require_known(listed, what, names)
        if name in listed:
            raise ValueError(f"{what} names the mode itself: a switch leads to another mode. Leave it out.")
        found[name] = tuple(other for other in names if other in listed)
    return found


def _check_durations(problem: Problem, given: Any, names: tuple[str, ...]) -> dict[str, float]:
    if given is None:
        return {name: get_min_duration(problem.min_duration, name) for name in names}
    if not isinstance(given, Mapping):
        return dict.fromkeys(names, _as_duration(given, "min_duration"))
    _require_known(list(given), "min_duration", names)
    own = {name: _as_duration(value, f"min_duration of {shorten(name)}") for name, value in given.items()}
    return {name: own.get(name, get_min_duration(problem.min_duration, name)) for name in names}


def _as_duration(value: Any, what: str) -> float:
    found = as_number(value, what)
    if not (np.isfinite(found) and found >= 0):
        raise ValueError(f"{what} must be zero or positive; got {found}.")
    return found


def check_room(problem: Problem, library: Library) -> None:
    """Warn if the shortest durations leave no room for the largest number of switches.

    Parameters
    ----------
    problem : Problem
    library : Library
    """
    shortest = min(library.durations.values())
    for run in problem.experiments:
        length = run.end - run.t0
        if shortest > 0 and (library.max_switches + 1) * shortest > length:
            fits = max(int(np.ceil(length / shortest)) - 2, 0)
            warnings.warn(
                f"max_switches is {library.max_switches}, but modes that last {shortest:g} or longer leave room for "
                f"{fits} switches in a horizon of {length:g}. Lower max_switches or min_duration.",
                stacklevel=3,
            )
            return
