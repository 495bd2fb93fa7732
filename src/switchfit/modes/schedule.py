"""Schedules: a mode sequence and its transition times, in a horizon from t0 to tf, and operations on them.

All functions are pure, and return schedules that their library admits.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterator
from functools import cache
from itertools import combinations
from typing import NamedTuple

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.strategy.beam_grid import keep_apart
from switchfit.strategy.library import Library

CELLS = 12
"""Cells of the grid between whose times modes are put in."""


class Schedule(NamedTuple):
    """Which mode is active when.

    Attributes
    ----------
    sequence : tuple of str, N + 1 modes
    times : (N,) array
        Transition times, ascending; equal ones stand for a mode of no duration.
    t0, tf : float
        The horizon.
    """

    sequence: tuple[str, ...]
    times: FloatArray
    t0: float
    tf: float

    @property
    def switches(self) -> int:
        """Number of transitions, N."""
        return len(self.sequence) - 1

    @property
    def knots(self) -> FloatArray:
        """Where each mode begins and the last one ends: (N + 2,)."""
        return np.concatenate([[self.t0], self.times, [self.tf]])

    @property
    def durations(self) -> FloatArray:
        """How long each mode lasts: (N + 1,)."""
        return np.diff(self.knots)

    def replace(self, sequence: tuple[str, ...], times: FloatArray) -> Schedule:
        """Return another schedule in the same horizon."""
        return Schedule(sequence, np.asarray(times, dtype=float), self.t0, self.tf)


def merge_neighbours(schedule: Schedule) -> Schedule:
    """Return the schedule without transitions from a mode to itself."""
    # Transition i leads from mode i to mode i + 1.
    keep = [i for i in range(schedule.switches) if schedule.sequence[i] != schedule.sequence[i + 1]]
    sequence = (schedule.sequence[0], *(schedule.sequence[i + 1] for i in keep))
    return schedule.replace(sequence, schedule.times[keep])


def remove_segments(schedule: Schedule, i: int, count: int = 1) -> Schedule:
    """Return the schedule without so many modes from mode i on (from 0): their neighbours meet in the middle, equal
    ones become one.
    """
    knots, j = schedule.knots, i + count
    # Without the first mode or the last there is no neighbour to meet: the other one takes all.
    inside = [0.5 * (knots[i] + knots[j])] if i > 0 and j <= schedule.switches else []
    left = np.concatenate([schedule.times[: max(i - 1, 0)], inside, schedule.times[j:]])
    return merge_neighbours(schedule.replace((*schedule.sequence[:i], *schedule.sequence[j:]), left))


def collapse(schedule: Schedule, library: Library, shortest: float) -> Schedule:
    """Return the schedule without modes that last at most `shortest`, those first that last the least.

    A mode stays where the library does not admit the sequence without it.
    """
    schedule = merge_neighbours(schedule)
    durations = schedule.durations
    # One at a time, shortest first: its neighbours become longer, and may then stay.
    for i in np.argsort(durations, kind="stable").tolist() if schedule.switches else []:
        without = remove_segments(schedule, i)
        if durations[i] <= shortest and library.admits(without.sequence):
            return collapse(without, library, shortest)
    return schedule


def splice(schedule: Schedule, mode: str, begin: float, end: float) -> Schedule:
    """Return the schedule, whose modes have durations, with a mode active from `begin` to `end`, two times inside the
    horizon, whatever was active there.
    """
    names, starts = schedule.sequence, [schedule.t0, *schedule.times.tolist()]
    # Lists and bisect in place of arrays: `list_insertions` splices for every pair of times of a grid and every mode.
    i = bisect_left(starts, begin)  # modes that begin before
    j = bisect_right(starts, end) - 1 if end < schedule.tf else len(names)  # the mode that is active after
    # Where a neighbour has the same mode already, the pulse lengthens it and there is no transition.
    opens, closes = not i or names[i - 1] != mode, j < len(names) and names[j] != mode
    sequence = (*names[:i], *[mode] * opens, *names[j if closes else j + 1 :])
    # Beginnings of all modes, of which the first is t0 and no transition.
    times = [*starts[:i], *[begin] * opens, *[end] * closes, *starts[j + 1 :]][1:]
    return schedule.replace(sequence, np.array(times))


def drop_empty(schedule: Schedule) -> Schedule:
    """Return the schedule without modes of no duration."""
    # Each mode that lasts begins at its own knot; equal neighbours of one that went become one.
    there = np.flatnonzero(schedule.durations > 0).tolist()
    sequence = tuple(schedule.sequence[i] for i in there)
    return merge_neighbours(schedule.replace(sequence, schedule.knots[there[1:]]))


def list_removals(schedule: Schedule, library: Library) -> Iterator[Schedule]:
    """Yield the schedules without one of the modes, then those without two in a row neither of which may go alone."""
    alone = [remove_segments(schedule, i) for i in range(schedule.switches + 1)] if schedule.switches else []
    admitted = [library.admits(without.sequence) for without in alone]
    yield from (without for without, is_admitted in zip(alone, admitted, strict=True) if is_admitted)
    for i in range(schedule.switches):
        # Where A, B, C, A is the only succession, neither B nor C may go alone, but both together may.
        if schedule.switches > 1 and not (admitted[i] or admitted[i + 1]):
            without = remove_segments(schedule, i, 2)
            if library.admits(without.sequence):
                yield without


def list_substitutions(schedule: Schedule, library: Library) -> Iterator[Schedule]:
    """Yield the schedules with another mode in the place of one."""
    for i, name in enumerate(schedule.sequence):
        for other in library.modes:
            if other != name:
                sequence = (*schedule.sequence[:i], other, *schedule.sequence[i + 1 :])
                changed = merge_neighbours(schedule.replace(sequence, schedule.times))
                if library.admits(changed.sequence):
                    yield changed


def list_insertions(schedule: Schedule, library: Library, cells: int = CELLS) -> Iterator[Schedule]:
    """Yield the schedules with a mode active between two times, whatever was active there.

    Parameters
    ----------
    schedule : Schedule
    library : Library
    cells : int
        The times are those of a grid with so many cells, and those of the schedule.
    """
    grid = np.linspace(schedule.t0, schedule.tf, cells + 1)
    times = np.unique(np.concatenate([grid, schedule.times])).tolist()
    # `admits` is asked for the same sequences again and again: they are few, the pairs of times many.
    whole, close, admits = drop_empty(schedule), 1e-12 * (schedule.tf - schedule.t0), cache(library.admits)
    for begin, end in combinations(times, 2):
        for mode in library.modes:
            changed = splice(whole, mode, begin, end)
            # A mode put where it is active already gives the schedule back.
            is_other = changed.sequence != schedule.sequence or np.any(np.abs(changed.times - schedule.times) > close)
            if is_other and admits(changed.sequence):
                yield changed


def spread(schedule: Schedule, library: Library, room: float = 1e-9) -> Schedule | None:
    """Return the schedule with times moved so that each mode lasts as long as it must; None if there is no room.

    Parameters
    ----------
    schedule : Schedule
    library : Library
    room : float
        Shortest duration, as a part of the horizon, also where modes may have none.
    """
    length = schedule.tf - schedule.t0
    # A little more than must be: rounding of the sum of durations shall not make a feasible start infeasible.
    least = np.array([library.durations[mode] for mode in schedule.sequence]) * (1 + 1e-9) + room * length
    if least.sum() >= length:
        return None
    return schedule.replace(schedule.sequence, keep_apart(schedule.times, least, schedule.t0, schedule.tf))


def keep_off(schedule: Schedule, jump_times: FloatArray, room: float = 1e-6) -> Schedule:
    """Return the schedule with transition times a little later that are at the time of a jump.

    Parameters
    ----------
    schedule : Schedule
    jump_times : (K,) array
    room : float
        How much later, as a part of the horizon.
    """
    later = np.where(np.isin(schedule.times, jump_times), room * (schedule.tf - schedule.t0), 0.0)
    return schedule.replace(schedule.sequence, schedule.times + later)


def space_evenly(sequence: tuple[str, ...], t0: float, tf: float, library: Library) -> Schedule | None:
    """Return the schedule whose modes last equally long beyond what they must; None if there is no room."""
    least = np.array([library.durations[mode] for mode in sequence])
    rest = (tf - t0) - least.sum()
    if rest <= 0:
        return None
    durations = least + rest / len(sequence)
    return Schedule(sequence, t0 + np.cumsum(durations)[:-1], t0, tf)
