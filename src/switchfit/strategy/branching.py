"""The mode sequences of many hypotheses, as arrays: which births may follow, and which hypotheses are kept."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.problem.data import FloatArray
from switchfit.strategy.library import Library

Integers = NDArray[np.int64]

PER_SEQUENCE = 3
"""Hypotheses with the same sequence that are kept, at most: without a limit, all would soon have the same."""

RESERVED = 0.5
"""Part of the width that is shared out among the numbers of switches; the best of all have the rest."""

MULTIPLIER = 1_000_003
"""Of the hash of sequences, which is exact for short sequences of few modes."""


class Rules(NamedTuple):
    """Which of K places may follow each other: the modes of a library, or the places in a given order of modes.

    Attributes
    ----------
    modes : (K,) int, mode at each place
    allowed : (most + 1, K, K) bool
        Whether, after so many switches, one place may follow another, so that a sequence can end in one of `last`.
    shortest : (K,), shortest time that its mode lasts
    first : (F,) int
    last : (K,) bool
    earliest, latest : (most + 1,)
        Times between which each switch may be born; after the last there is none.
    """

    modes: Integers
    allowed: NDArray[np.bool_]
    shortest: FloatArray
    first: Integers
    last: NDArray[np.bool_]
    earliest: FloatArray
    latest: FloatArray

    @classmethod
    def of(cls, library: Library, modes: Sequence[str]) -> Rules:
        """Return the rules of a library."""
        follows = np.array([[a != b and library.allows(a, b) for b in modes] for a in modes])
        shortest = np.array([library.min_duration(mode) for mode in modes])
        ends = np.logical_or.accumulate([[mode in after for mode in modes] for after in library.ends_after])
        begins = np.flatnonzero(np.isin(modes, library.first) & ends[-1])
        allowed = follows & np.insert(ends[-2::-1], len(ends) - 1, False, axis=0)[:, None]
        free = np.full(len(ends), np.inf)
        return cls(np.arange(len(modes)), allowed, shortest, begins, ends[0], -free, free)

    @classmethod
    def of_order(cls, modes: Integers, shortest: FloatArray, earliest: FloatArray, latest: FloatArray) -> Rules:
        """Return the rules of a given order of modes (N + 1,), each of which lasts at least some time."""
        place = np.arange(len(modes))
        # After k switches a sequence is at place k.
        allowed = (place[:, None, None] == place[:, None]) & np.eye(len(modes), k=1, dtype=bool)
        first, last = np.zeros(1, dtype=np.int64), place == len(modes) - 1
        return cls(modes, allowed, shortest, first, last, np.append(earliest, np.inf), np.append(latest, -np.inf))

    def list_births(self, kept: Sequences, t: float, end: float) -> tuple[Integers, Integers]:
        """Return the births at a time: positions of the parents (C,), and places of the children (C,)."""
        # A place may be left once its mode has lasted long enough, and not in the instant of its birth.
        since, is_open = t - kept.last, (self.earliest < t) & (t < self.latest)
        may_leave = (since >= self.shortest[kept.mode] * (1 - 1e-9)) & (since > 0) & is_open[kept.switches]
        may_follow = self.allowed[kept.switches, kept.mode] & (t + self.shortest <= end)
        parents, after = (may_follow & may_leave[:, None]).nonzero()
        return parents, after


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

    def take(self, chosen: Integers) -> Sequences:
        """Return some of them."""
        mode, switches, last, code, modes, times = self
        return Sequences(mode[chosen], switches[chosen], last[chosen], code[chosen], modes[chosen], times[chosen])

    def branch(self, parents: Integers, after: Integers, t: float) -> tuple[Integers, Sequences]:
        """Return all of them as they are, then births at a time of the places `after` (C,): positions of their parents
        among these, and the sequences.
        """
        B = len(self.mode)
        parent = np.concatenate([np.arange(B), parents])
        mode, switches, last, code, modes, times = children = self.take(parent)
        born, slot = np.arange(B, len(parent)), switches[B:]
        mode[B:], last[B:] = after, t
        times[born, slot] = t
        slot += 1
        modes[born, slot] = after
        # Equal sequences have equal codes: int64 wraps around for long ones, where two codes meet by chance at worst.
        code[B:] = code[B:] * MULTIPLIER + after + 1
        return parent, children


def select_lowest(
    value: FloatArray, code: Integers, switches: Integers, width: int, per_code: int = PER_SEQUENCE
) -> Integers:
    """Return the positions of the lowest values, at most `per_code` with the same code, in ascending order.

    A part of them is kept for each number of switches: where sigma is too small, or the model wrong, further switches
    pay everywhere, and hypotheses that have used up theirs would drive out all others.
    """
    order = np.argsort(value, kind="stable")
    order = order[np.isfinite(value[order])]
    order = order[_list_first(code[order].tolist(), per_code)]
    if len(order) <= width:
        return order
    # The best of each number of switches first, then the others while there is room.
    first = _list_first(switches[order].tolist(), int(RESERVED * width / (1 + switches.max())))
    others = np.delete(np.arange(len(order)), first)
    return order[np.sort(np.append(first, others[: max(width - len(first), 0)]))]


def _list_first(keys: list[int], most: int) -> NDArray[np.intp]:
    """Return the places of the first keys, at most so many that are equal."""
    counts: dict[int, int] = {}  # a Counter takes several times longer
    found = []
    for place, key in enumerate(keys):
        count = counts.get(key, 0)
        if count < most:
            counts[key] = count + 1
            found.append(place)
    return np.array(found, dtype=np.intp)
