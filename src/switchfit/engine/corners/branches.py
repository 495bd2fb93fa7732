"""The branches of modes with corners: the path of a trajectory through them, the library of those that were met.

With the crossings of a path as transitions, whose times follow from the state by a guard, the discretized system is
smooth again: rows end at them. Programs are compiled for the library, which only grows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.problem.corners.branches import Sides, find_corners
from switchfit.problem.functions import Function
from switchfit.problem.structure import Structure

MOST_CROSSINGS, MOST_AT_GUESS = 48, 128
"""Largest number of crossings that are unknowns of a structure: the time of an evaluation grows with their square, and
programs take ten seconds to compile above the first number, which holds unless the trajectory of a guess has more."""

FEW_CORNERS = 2
"""Largest number of corners of a mode for which the ends of a branch are compiled with it, passed or not."""


class BranchPath(NamedTuple):
    """The path of a trajectory: in which branches it runs, and when it crosses from one to the next.

    Attributes
    ----------
    sides : for each segment the sides of its branches, one after the other
    ends : for each segment which end of a branch each crossing is; -1 at a known time, as where an input jumps
    times : (K,), of all crossings
    scales : (K,), the largest size so far of the function that is zero at each
    """

    sides: tuple[tuple[Sides, ...], ...]
    ends: tuple[tuple[int, ...], ...]
    times: FloatArray
    scales: FloatArray


class Branches:
    """The branches of the modes of a structure that trajectories have run in so far, as one library.

    Programs are compiled for the library, which only grows: a new branch compiles them anew.

    Attributes
    ----------
    corners : list of Corners, of each mode
    most : int
        Largest number of crossings of a path.
    """

    def __init__(self, structure: Structure) -> None:
        self.most = MOST_CROSSINGS
        self.corners = [find_corners(mode) for mode in structure.modes]
        self._modes: dict[tuple[int, Sides], None] = {}
        self._guards: dict[Function, None] = {}
        self._room = 2
        self._met: set[tuple[int, int, Sides]] = set()

    @property
    def count(self) -> int:
        """Number of branches in the library."""
        return len(self._modes)

    @property
    def version(self) -> str:
        """What changes as soon as a program of the library is of no use any more."""
        return f"{self.count} {[corners.margins for corners in self.corners]}"

    def add(self, structure: Structure, path: BranchPath) -> None:
        """Put the branches of a path into the library, with the ends that it passes; with all if they are few."""
        for mode, each, ends in zip(structure.mode_of_segment, path.sides, path.ends, strict=False):
            corners = self.corners[mode]
            for k, sides in enumerate(each):
                self._modes.setdefault((mode, sides))
                # A corner that no trajectory has passed at this theta may be passed at the next one: to compile its end
                # now costs less than to compile all anew, if corners are few.
                every = range(len(corners.list_ends(sides))) if corners.count <= FEW_CORNERS else ends[k : k + 1]
                self._guards |= {corners.end(sides, end): None for end in every if end >= 0}
        if len(path.times) > self._room:
            # Programs are compiled for a number of transitions: a few more crossings fit, as at another theta.
            # Powers of two up to 32, then multiples of 16: a program compiled for many more crossings than there are is
            # slower, for the time of an evaluation grows with their square.
            room = len(path.times) + 2
            self._room = 1 << (room - 1).bit_length() if room <= 32 else -(-room // 16) * 16

    def make_steep(self, mode: int, margins: Mapping[tuple[int, int], float]) -> None:
        """Make corners of a mode steep on a side, with their margins; programs of its branches are of no use."""
        corners = self.corners[mode]
        self.corners[mode] = find_corners(corners.function, tuple(sorted({**dict(corners.margins), **margins}.items())))
        self._modes.clear()
        self._guards.clear()

    def meet(self, mode: int, corner: int, sides: Sides) -> bool:
        """Record that a trajectory is at a corner of a branch; return whether none has been before."""
        is_first = (mode, corner, sides) not in self._met
        self._met.add((mode, corner, sides))
        return is_first

    def find(self, structure: Structure, mode: int, sides: Sides) -> int | None:
        """Return the place of a branch in the library; None if it is not in it."""
        return self._list(structure).index((mode, sides)) if (mode, sides) in self._modes else None

    def _list(self, structure: Structure) -> list[tuple[int, Sides]]:
        """Return all branches; the rest after a free tf is the last, where programs expect it."""
        return sorted(self._modes, key=lambda each: structure.is_rest(each[0]))

    def list_returns(self, structure: Structure) -> dict[int, Function]:
        """Return what `Corners.returns` does for the branches that slide, by their places in the library."""
        found = enumerate(self._list(structure))
        return {place: self.corners[mode].returns(sides) for place, (mode, sides) in found if 0 in sides}

    def get_structure(self, structure: Structure, path: BranchPath | None = None) -> Structure:
        """Return the structure in the library in which the crossings of a path are transitions.

        Without a path, the modes of its sequence are of no meaning: it is for the functions of the library alone.
        """
        known = self._list(structure)
        # For the functions alone, any branch serves as the mode of all segments.
        if path is None:
            path = BranchPath((known[0][1:],) * (structure.N + 1), ((),) * (structure.N + 1), np.zeros(0), np.zeros(0))
            structure = replace(structure, mode_of_segment=(known[0][0],) * (structure.N + 1))
        modes: list[int] = []
        found: list[tuple[Any, Any, Any]] = []  # guard, reset map and cost of each transition
        jumps = []
        for i, (mode, sides, ends) in enumerate(zip(structure.mode_of_segment, path.sides, path.ends, strict=True)):
            modes += [known.index((mode, each)) for each in sides]
            # A crossing is a transition between two branches of one mode: a guard if the state decides when, no reset
            # map, no cost.
            pairs = zip(sides, ends, strict=False)
            found += [(None if end < 0 else self.corners[mode].end(each, end), None, None) for each, end in pairs]
            if i < structure.N:
                # Transitions behind crossings have other numbers than in the experiment.
                jumps += [len(found)] if i in structure.jumps else []
                found.append((structure.guards[i], structure.reset_maps[i], structure.transition_costs[i]))
        guards = dict.fromkeys((*structure.guard_library, *self._guards))
        return replace(
            structure,
            modes=tuple(self.corners[mode].branch(sides) for mode, sides in known),
            mode_names=tuple(structure.mode_names[mode] for mode, _ in known),
            implicit=tuple(structure.implicit[mode] for mode, _ in known),
            mode_of_segment=tuple(modes),
            jumps=tuple(jumps),
            transitions=structure.transitions + self._room,
            guard_library=tuple(guards),
            guards=tuple(guard for guard, _, _ in found),
            reset_maps=tuple(reset_map for _, reset_map, _ in found),
            transition_costs=tuple(cost for _, _, cost in found),
            has_rough_hessian=structure.has_only_residuals and any(corners.margins for corners in self.corners),
        )


@lru_cache(maxsize=64)
def find_branches(library: Structure) -> Branches:
    """Return the branches of a library of modes: those that any of its experiments has run in."""
    return Branches(library)


def has_corners(structure: Structure) -> bool:
    """Return whether a mode of a structure has corners of the state."""
    return any(find_corners(mode).count for mode in structure.modes)
