"""The library of a search: which modes may occur, which may follow which, how long each lasts at least."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise


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
        Shortest time that each mode lasts, 0 where it may be any.
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

    def min_duration(self, mode: str) -> float:
        """Return the shortest time that a mode lasts, in the time unit of the experiments."""
        return self.durations.get(mode, 0.0)

    def admits(self, sequence: Sequence[str]) -> bool:
        """Return whether a mode sequence is one of the library, with at most `max_switches` switches."""
        if not 1 <= len(sequence) <= self.max_switches + 1:
            return False
        if sequence[0] not in self.first or sequence[-1] not in self.last:
            return False
        return all(self.allows(a, b) for a, b in pairwise(sequence))

    def list_sequences(self, switches: int) -> Iterator[tuple[str, ...]]:
        """Yield all sequences with that number of switches."""
        for mode in self.first:
            yield from self._continue((mode,), switches)

    def _continue(self, prefix: tuple[str, ...], switches: int) -> Iterator[tuple[str, ...]]:
        if prefix[-1] not in self.ends_after[switches]:
            return
        if switches == 0:
            yield prefix
            return
        for mode in self.successions[prefix[-1]]:
            yield from self._continue((*prefix, mode), switches - 1)

    @cached_property
    def ends_after(self) -> list[frozenset[str]]:
        """The modes from which a sequence can end after k more switches, for k = 0 ... max_switches."""
        found = [frozenset(self.last)]
        for _ in range(self.max_switches):
            found.append(frozenset(mode for mode in self.modes if found[-1] & set(self.successions[mode])))
        return found

    @cached_property
    def possible_switches(self) -> tuple[int, ...]:
        """The numbers of switches up to `max_switches` with which there is a sequence."""
        return tuple(k for k, modes in enumerate(self.ends_after) if modes & set(self.first))

    @property
    def trimmed(self) -> Library:
        """The same sequences, with a largest number of switches that one of them has: programs have room for it."""
        return replace(self, max_switches=max(self.possible_switches, default=0))
