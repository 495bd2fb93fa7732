"""Branches of modes with corners: where a trajectory crosses a corner, and the structure in which it is a transition.

A path says in which branches (`switchfit.problem.corners`) a trajectory runs, segment by segment, and when it crosses
from one to the next. With these crossings as transitions, whose times follow from the state by a guard, the discretized
system is smooth again: rows end at them. `switchfit.engine.split` eliminates their times.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import jax
import numpy as np

from switchfit.engine.native.trace import Unsupported, trace_scalars
from switchfit.problem.corners import Sides, find_corners
from switchfit.problem.data import FloatArray
from switchfit.problem.functions import Function, use_float64
from switchfit.problem.structure import Structure

MOST_CROSSINGS = 48
"""Largest number of crossings that are unknowns of a structure: the time of an evaluation grows with their square."""

FEW_CORNERS = 2
"""Largest number of corners of a mode for which the ends of a branch are compiled with it, passed or not."""

MOST_FOUND = 500
"""Largest number of steps in a branch without machine code; then it is compiled."""


class NumpyFunction:
    """A function of a mode's arguments as NumPy evaluates it, from the graph of its scalars; by JAX if it has none."""

    def __init__(self, function: Function) -> None:
        call = lambda *given: jax.core.eval_jaxpr(function.jaxpr, function.consts, *given)  # noqa: E731
        self._template = self._call = None
        with use_float64():
            try:
                self._template = trace_scalars(call, *(a.shape for a in function.structs))
            except Unsupported:
                axes = (0,) * (2 + function.takes_input) + (None,) * len(function.parameters)
                self._call = jax.jit(jax.vmap(call, in_axes=axes))

    def __call__(self, t: Any, x: FloatArray, given: Sequence[FloatArray], count: int) -> FloatArray:
        """Return the values at times () or (L,) and states (n,) or (L, n), with the input and the parameters.

        The input is the first of those `given` if the function `count`s one, (size,) or (L, size).
        """
        if self._template is not None:
            moving = [np.asarray(a).T for a in given[:count]]
            return self._template.evaluate([t], x.T, *moving, *(np.ravel(a) for a in given[count:]))[0]
        times = np.atleast_1d(t)
        moving = [np.reshape(a, (len(times), -1)) for a in given[:count]]
        with use_float64():
            found = np.asarray(self._call(times, np.atleast_2d(x), *moving, *given[count:])[0])  # type: ignore[misc]
        return found if np.ndim(t) else found[0]


@lru_cache(maxsize=1024)
def trace_for_numpy(function: Function) -> NumpyFunction:
    """Return a function as NumPy evaluates it, traced once."""
    return NumpyFunction(function)


@dataclass(frozen=True)
class Path:
    """Branches of a trajectory.

    Attributes
    ----------
    sides : for each segment the sides of its branches, one after the other
    ends : for each segment which end of a branch each crossing is; -1 at a known time, as where an input jumps
    times : (K,), of all crossings
    """

    sides: tuple[tuple[Sides, ...], ...]
    ends: tuple[tuple[int, ...], ...]
    times: FloatArray

    @property
    def sequence(self) -> Any:
        """What a program depends on."""
        return self.sides, self.ends


class Branches:
    """The branches of the modes of a structure that trajectories have run in so far, as one library.

    Programs are compiled for the library, which only grows: a new branch compiles them anew.

    Attributes
    ----------
    corners : list of Corners, of each mode
    """

    def __init__(self, structure: Structure) -> None:
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

    def add(self, structure: Structure, path: Path) -> None:
        """Put the branches of a path into the library, with the ends that it passes; with all if they are few."""
        for mode, each, ends in zip(structure.mode_of_segment, path.sides, path.ends, strict=False):
            corners = self.corners[mode]
            for k, sides in enumerate(each):
                self._modes.setdefault((mode, sides))
                every = range(len(corners.list_ends(sides))) if corners.count <= FEW_CORNERS else ends[k : k + 1]
                self._guards |= {corners.end(sides, end): None for end in every if end >= 0}
        if len(path.times) > self._room:
            # A power of two: programs are compiled for a number of transitions, and a few more crossings fit.
            self._room = 1 << (len(path.times) + 1).bit_length()  # and some more at another theta

    def make_steep(self, mode: int, margins: Mapping[tuple[int, int], float]) -> None:
        """Make corners of a mode steep on a side, with their margins; programs of its branches are of no use."""
        corners = self.corners[mode]
        self.corners[mode] = find_corners(corners.function, tuple(sorted({**dict(corners.margins), **margins}.items())))
        self._modes.clear()
        self._guards.clear()

    def is_unknown(self, mode: int, corner: int, sides: Sides) -> bool:
        """Return whether no trajectory has been at a corner of a branch before."""
        is_unknown = (mode, corner, sides) not in self._met
        self._met.add((mode, corner, sides))
        return is_unknown

    def find(self, structure: Structure, mode: int, sides: Sides) -> int | None:
        """Return the place of a branch in the library; None if it is not in it."""
        return self._list(structure).index((mode, sides)) if (mode, sides) in self._modes else None

    def _list(self, structure: Structure) -> list[tuple[int, Sides]]:
        """Return all branches; the rest after a free tf is the last, where programs expect it."""
        return sorted(self._modes, key=lambda each: structure.is_rest(each[0]))

    def get_structure(self, structure: Structure, path: Path | None = None) -> Structure:
        """Return the structure in the library in which the crossings of a path are transitions.

        Without a path, the modes of its sequence are of no meaning: it is for the functions of the library alone.
        """
        known = self._list(structure)
        # For the functions alone, any branch serves as the mode of all segments.
        if path is None:
            path = Path((known[0][1:],) * (structure.N + 1), ((),) * (structure.N + 1), np.zeros(0))
            structure = replace(structure, mode_of_segment=(known[0][0],) * (structure.N + 1))
        modes: list[int] = []
        at: dict[str, list[Any]] = {name: [] for name in ("reset_maps", "guards", "transition_costs")}
        jumps = []
        for i, (mode, sides, ends) in enumerate(zip(structure.mode_of_segment, path.sides, path.ends, strict=True)):
            modes += [known.index((mode, each)) for each in sides]
            # A crossing is a transition between two branches of one mode: a guard if the state decides when, no reset
            # map, no cost.
            for each, end in zip(sides, ends, strict=False):
                at["guards"].append(None if end < 0 else self.corners[mode].end(each, end))
                at["reset_maps"].append(None)
                at["transition_costs"].append(None)
            if i < structure.N:
                # Transitions behind crossings have other numbers than in the experiment.
                jumps += [len(at["guards"])] if i in structure.jumps else []
                for name, functions in at.items():
                    functions.append(getattr(structure, name)[i])
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
            reset_maps=tuple(at["reset_maps"]),
            guards=tuple(at["guards"]),
            transition_costs=tuple(at["transition_costs"]),
        )


@lru_cache(maxsize=64)
def find_branches(library: Structure) -> Branches:
    """Return the branches of a library of modes: those that any of its experiments has run in."""
    return Branches(library)


def has_corners(structure: Structure) -> bool:
    """Return whether a mode of a structure has corners of the state."""
    return any(find_corners(mode).count for mode in structure.modes)
