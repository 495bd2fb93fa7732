"""Mode sequences of many hypotheses, as arrays: which births may follow, and which hypotheses are kept.

A beam and an online estimator step from node to node in the same way: `Rules` list the births, `list_children` has
those that go on and then the births, the engine takes all of them to the next node, `select_lowest` chooses, and
`follow` keeps what was chosen. Nothing here knows a state, and of a cost only its value.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.strategy.library import Library

Integers = NDArray[np.int64]

MOST_PER_SEQUENCE = 3
"""Hypotheses with the same sequence that are kept, at most: without a limit, all would soon have the same."""

RESERVED_PART_OF_WIDTH = 0.5
"""Part of the width that is shared out among the numbers of switches; the best of all have the rest."""

SMALLEST_TIME_DIFFERENCE = float(np.finfo(float).smallest_subnormal)
"""Difference of two times of which one is later."""

HASH_MULTIPLIER = 1_000_003
"""Of the hash of sequences, which is exact for short sequences of few modes."""


class Rules(NamedTuple):
    """Which of K places may follow each other: the modes of a library, or the places in a given order of modes.

    Attributes
    ----------
    modes : (K,) int, mode at each place
    shortest : (K,), shortest time that its mode lasts
    first : (F,) int
    last : (K,) bool
    follows : (most + 1, K, K) bool
        Whether one may follow another after so many switches, and the sequence still end in one of `last`.
    between : (2, most) or None
        Times between which each switch may be born.
    """

    modes: Integers
    shortest: FloatArray
    first: Integers
    last: NDArray[np.bool_]
    follows: NDArray[np.bool_]
    between: FloatArray | None

    @classmethod
    def of(cls, library: Library, modes: Sequence[str]) -> Rules:
        """Return the rules of a library."""
        allowed = np.array([[a != b and library.allows(a, b) for b in modes] for a in modes])
        shortest = np.array([library.durations[mode] for mode in modes])
        # Row n: the modes from which one of `last` can be reached within n more switches. A hypothesis that cannot end
        # as it must any more would take room until the last stop.
        ends = np.logical_or.accumulate([[mode in after for mode in modes] for after in library.ends_after])
        begins = np.flatnonzero(np.isin(modes, library.first) & ends[-1])
        follows = np.zeros((len(ends), *allowed.shape), dtype=bool)
        # A birth after s switches leaves most - s - 1: `ends` from the last but one back. After `most` none follows.
        follows[:-1] = allowed & ends[-2::-1, None]
        return cls(np.arange(len(modes)), shortest, begins, ends[0], follows, None)

    @classmethod
    def of_order(cls, modes: Integers, shortest: FloatArray, between: FloatArray) -> Rules:
        """Return the rules of a given order of modes (N + 1,), each of which lasts at least some time."""
        count = len(modes)
        # From each place to the next one only. Places are not modes: a mode that occurs twice has two of them.
        follows = np.repeat(np.eye(count, k=1, dtype=bool)[None], count, axis=0)
        return cls(modes, shortest, np.zeros(1, dtype=np.int64), np.arange(count) == count - 1, follows, between)

    def list_births(self, kept: Sequences, t: float, end: float) -> tuple[Integers, Integers]:
        """Return the births at a time: positions of the parents (C,), and places of the children (C,)."""
        may_leave = t - kept.last >= self.least[kept.mode]
        if self.between is not None and self.between.size:
            # At the last place no switch is left: the index is clipped, and `follows` lets none through.
            earliest, latest = self.between[:, np.minimum(kept.switches, self.between.shape[1] - 1)]
            may_leave &= (earliest < t) & (t < latest)
        may_enter = t + self.shortest <= end
        K = len(self.modes)
        # One `take` from a flat table instead of two index arrays: this stands in the loop over all stops.
        follows = self.follows.reshape(-1, K).take(kept.switches * K + kept.mode, axis=0)
        parents, after = (follows & may_leave[:, None] & may_enter).nonzero()
        return parents, after

    @property
    def least(self) -> FloatArray:
        """How long a hypothesis stays in each place, (K,): its mode's shortest time, and more than an instant."""
        return np.maximum(self.shortest * (1 - 1e-9), SMALLEST_TIME_DIFFERENCE)


class Sequences(NamedTuple):
    """Sequences of B hypotheses.

    Attributes
    ----------
    mode : (B,) int, place of the mode that each is in
    switches : (B,) int
    last : (B,), time of its last birth, or t0
    code : (B,) int, equal for equal sequences
    modes : (B, S + 1) int
    times : (B, S), times of its births
    """

    mode: Integers
    switches: Integers
    last: FloatArray
    code: Integers
    modes: Integers
    times: FloatArray

    @classmethod
    def start(cls, first: Integers, births: int, t0: float) -> Sequences:
        """Return one hypothesis for each first mode."""
        B = len(first)
        modes = np.zeros((B, births + 1), dtype=np.int64)
        modes[:, 0] = first
        return cls(first, np.zeros(B, dtype=np.int64), np.full(B, t0), first + 1, modes, np.zeros((B, births)))

    @classmethod
    def of_places(cls, places: Integers, times: FloatArray, last: FloatArray) -> Sequences:
        """Return those of hypotheses in these places of a given order, with their births (B, S), and the last ones."""
        passed = np.arange(times.shape[1] + 1)
        return cls(places, places, last, places, np.where(passed <= places[:, None], passed, 0), times)

    def take(self, chosen: Integers | slice) -> Sequences:
        """Return some of them."""
        mode, switches, last, code, modes, times = self
        return Sequences(mode[chosen], switches[chosen], last[chosen], code[chosen], modes[chosen], times[chosen])

    def list_children(self, parents: Integers, after: Integers) -> Children:
        """Return all of them as they are, then births: positions of their parents (C,), and their modes (C,)."""
        parent = np.concatenate([np.arange(len(self.mode)), parents])
        # Equal sequences have equal codes: int64 wraps around for long ones, where two codes meet by chance at worst.
        born = self.code[parents] * HASH_MULTIPLIER + after + 1
        return Children(
            parent,
            np.concatenate([self.mode, after]),
            np.concatenate([self.switches, self.switches[parents] + 1]),
            np.concatenate([self.code, born]),
        )

    def follow(self, children: Children, chosen: Integers, t: float) -> Sequences:
        """Return the chosen ones of their children; births were at t."""
        parent, mode, switches = children.parent[chosen], children.mode[chosen], children.switches[chosen]
        modes, times, last = self.modes.take(parent, axis=0), self.times.take(parent, axis=0), self.last[parent]
        # Children are listed after all that go on (`list_children`), so that the position alone says which are births.
        born = (chosen >= len(self.mode)).nonzero()[0]
        slot = switches[born]
        modes[born, slot], times[born, slot - 1], last[born] = mode[born], t, t
        return Sequences(mode, switches, last, children.code[chosen], modes, times)


def encode(modes: Sequence[int]) -> int:
    """Return the code of a sequence of modes."""
    code = 0
    for mode in modes:
        # As int64 arrays wrap around, in Python's integers; the last line reads the 64 bits as a signed number.
        code = (code * HASH_MULTIPLIER + mode + 1) % 2**64
    return (code + 2**63) % 2**64 - 2**63


class Children(NamedTuple):
    """Children of hypotheses: position of the parent, place, number of switches and code of the sequence; (C,) each."""

    parent: Integers
    mode: Integers
    switches: Integers
    code: Integers


def select_lowest(
    value: FloatArray, code: Integers, switches: Integers, width: int, per_code: int = MOST_PER_SEQUENCE
) -> Integers:
    """Return the positions of the lowest values, at most `per_code` with the same code, in ascending order.

    A part of them is kept for each number of switches: where sigma is too small, or the model wrong, further switches
    pay everywhere, and hypotheses that have used up theirs would drive out all others.
    """
    order = value.argsort(kind="stable")
    # What could not be integrated, or may not end here (`Pass._follow`), is no candidate.
    order = order[np.isfinite(value[order])]
    # In the order of their values; the best of each number of switches first, then the others while there is room.
    most = int(np.maximum.reduce(switches, initial=0))
    first: list[int] = []  # places in this order
    others: list[int] = []
    codes = code[order].tolist()
    of_code, of_number = (
        dict.fromkeys(codes, per_code),
        [int(RESERVED_PART_OF_WIDTH * width / (1 + most))] * (1 + most),
    )  # left
    for place, (own, number) in enumerate(zip(codes, switches[order].tolist(), strict=True)):
        if of_code[own]:
            of_code[own] -= 1
            if of_number[number]:
                of_number[number] -= 1
                first.append(place)
            else:
                others.append(place)
    # Places in `order` are ranks: sorted they give ascending values, whether they were reserved or not.
    return order[sorted(first + others[: max(width - len(first), 0)])]
