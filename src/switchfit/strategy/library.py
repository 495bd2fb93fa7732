"""The library of a search: which modes may occur, which may follow which, how long each lasts at least."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

from switchfit.problem.consistency import check_durations
from switchfit.problem.problem import Problem
from switchfit.problem.validation.arrays import as_count
from switchfit.problem.validation.messages import join_names, shorten
from switchfit.problem.validation.names import as_name, as_names, require_known


@dataclass(frozen=True)
class Library:
    """The mode sequences among which a search chooses.

    Attributes
    ----------
    modes : tuple of str
        Names of the modes that may occur, in the order of the system.
    first, last : tuple of str
        Modes with which a sequence may begin and end.
    successions : mapping of str to tuple of str
        The modes that may follow each mode.
    durations : mapping of str to float
        Shortest time that each mode lasts, in the time unit of the experiments; 0 where it may be any.
    max_switches : int
        Largest number of switches of a sequence.
    """

    modes: tuple[str, ...]
    first: tuple[str, ...]
    last: tuple[str, ...]
    successions: Mapping[str, tuple[str, ...]]
    durations: Mapping[str, float]
    max_switches: int

    def allows(self, before: str, after: str) -> bool:
        """Return whether one mode may follow another."""
        return after in self.successions.get(before, ())

    def admits(self, sequence: Sequence[str]) -> bool:
        """Return whether a mode sequence is one of the library, with at most `max_switches` switches."""
        if not 1 <= len(sequence) <= self.max_switches + 1:
            return False
        if sequence[0] not in self.first or sequence[-1] not in self.last:
            return False
        return all(self.allows(a, b) for a, b in pairwise(sequence))

    def list_sequences(self, switches: int, before: str | None = None) -> Iterator[tuple[str, ...]]:
        """Yield all sequences with that number of switches, from the beginning or after a mode."""
        for mode in self.first if before is None else self.successions[before]:
            if mode in self.ends_after[switches]:
                rest = self.list_sequences(switches - 1, mode) if switches else iter([()])
                yield from ((mode, *modes) for modes in rest)

    @cached_property
    def ends_after(self) -> list[frozenset[str]]:
        """The modes from which a sequence can end after k more switches, for k = 0 ... max_switches."""
        found = [frozenset(self.last)]
        for _ in range(self.max_switches):
            # Backwards from the last modes: those with a follower from which k - 1 switches lead to the end.
            found.append(frozenset(mode for mode in self.modes if found[-1] & set(self.successions[mode])))
        return found

    @cached_property
    def possible_switches(self) -> tuple[int, ...]:
        """The numbers of switches up to `max_switches` with which there is a sequence."""
        return tuple(k for k, modes in enumerate(self.ends_after) if modes & set(self.first))


def build_library(
    problem: Problem,
    library: str | Iterable[str] | None = None,
    *,
    first: str | Iterable[str] | None = None,
    last: str | Iterable[str] | None = None,
    successions: Mapping[str, str | Sequence[str]] | None = None,
    min_duration: float | Mapping[str, float] | None = None,
    max_switches: int = 8,
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
    names = _choose_modes(library, "library", tuple(problem.system.modes))
    begins, ends = _choose_modes(first, "first", names), _choose_modes(last, "last", names)
    followers = _check_successions(successions, names)
    found = Library(names, begins, ends, followers, _read_durations(problem, min_duration, names), most)
    # A shortest way visits no mode twice: with as many switches as modes, every `last` that can be reached at all is.
    if not replace(found, max_switches=len(names)).possible_switches:  # however many switches there may be
        raise ValueError(
            f"no mode of last ({join_names(ends)}) can be reached from first ({join_names(begins)}) by the "
            "successions: add the missing successions, or change first or last."
        )
    return found


def _choose_modes(given: object, what: str, names: tuple[str, ...]) -> tuple[str, ...]:
    """Return the given modes among some names, in their order; all if they are left out."""
    if given is None:
        return names
    chosen = (as_name(given, what),) if isinstance(given, str) else as_names(given, what, "a mode or a list of modes")
    if not chosen:
        raise ValueError(f"{what} is empty: name at least one mode, or leave it out for all modes.")
    require_known(chosen, what, names)
    return tuple(name for name in names if name in chosen)


def _check_successions(given: object, names: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """Return the modes that may follow each mode; a mode that a mapping leaves out has none."""
    if given is None:
        return {name: tuple(other for other in names if other != name) for name in names}
    if not isinstance(given, Mapping):
        raise TypeError(
            "successions must be a dict of mode -> the modes that may follow it, such as "
            f"{{'flight': ('slide',), 'slide': ('stick',)}}; got {shorten(given)}."
        )
    require_known(given, "successions", names)
    found: dict[str, tuple[str, ...]] = dict.fromkeys(names, ())
    for name, after in given.items():
        what = f"successions of {shorten(name)}"
        listed = (after,) if isinstance(after, str) else as_names(after, what, "a sequence of names of modes")
        require_known(listed, what, names)
        if name in listed:
            raise ValueError(f"{what} names the mode itself: a switch leads to another mode. Leave it out.")
        found[name] = tuple(other for other in names if other in listed)
    return found


def _read_durations(problem: Problem, given: object, names: tuple[str, ...]) -> dict[str, float]:
    """Return the shortest duration of each mode; that of the problem where it is left out."""
    found = {name: problem.durations[name] for name in names}
    if given is not None:
        asked = check_durations(given, problem.system)
        found |= {name: asked.get(name, found[name]) if isinstance(asked, dict) else asked for name in names}
    return found
