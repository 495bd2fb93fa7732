"""Where the functions, transitions and unknowns of an experiment are in the program of its library."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import ArrayModule, BoolArray, FloatArray, IntArray, Traced
from switchfit.discretization.model import AT_TRANSITIONS
from switchfit.engine.native.sizes import Sizes
from switchfit.problem.structure import Structure


def places_in_library(structure: Structure) -> dict[str, NDArray[np.int64]]:
    """Return the index in the library of the mode of each segment, and of the functions of each transition.

    Transitions without a function of a kind have -1. If there are jumps at known times, "jumps" is 1 for these. Idle
    segments, which the sequence does not need, have its last mode and no functions. Each array ends with an unused -1,
    so that it is never empty.
    """
    # A program of the library has room for more transitions than the sequence: those left over are at tf.
    library, idle = structure.library, structure.transitions - structure.N

    def find(own: Sequence[Any], available: Sequence[Any]) -> list[int]:
        return [-1 if f is None else available.index(f) for f in own] + [-1] * idle

    modes = list(structure.mode_of_segment)
    found = {"modes": modes + modes[-1:] * idle, "resets": find(structure.reset_maps, library.reset_maps)}
    for kind in AT_TRANSITIONS:
        found[kind] = find(getattr(structure, kind), getattr(library, kind))
    if structure.jumps:
        found["jumps"] = [int(i in structure.jumps) for i in range(structure.N)] + [0] * idle
    return {name: np.array([*which, -1], dtype=np.int64) for name, which in found.items()}


def find_directions(sizes: Sizes, are_jumps: Traced, xp: ArrayModule) -> tuple[Traced, Traced, Traced]:
    """Return the derivatives of the times in the unknowns of a program, and where an experiment finds its derivatives.

    Times of jumps are known: they are no unknowns of the program.

    Parameters
    ----------
    sizes : Sizes
    are_jumps : int array, of length N of the experiment
        1 for each transition that is a jump. May be traced.
    xp : module
        NumPy or jax.numpy.

    Returns
    -------
    units : (N + 1, width), N that of the program
        Row i + 1 is the derivative of time i: a unit vector, 0 for a jump. Row 0 is 0.
    places, there : int array, bool array
        For each time and parameter of the experiment its position among the unknowns of the program, and whether it is
        one.
    """
    N = are_jumps.shape[0]
    # Unknowns of the program are numbered by the transitions that are no jumps: `order` is the place of each among
    # them.
    free = xp.concatenate([1 - are_jumps, np.ones(sizes.N - N, dtype=np.int64)])
    order = xp.maximum(xp.cumsum(free) - 1, 0)
    units = xp.where((order[:, None] == np.arange(sizes.width)[None]) & (free[:, None] == 1), 1.0, 0.0)
    places = xp.concatenate([order[:N], sizes.T + np.arange(sizes.M)])
    there = xp.concatenate([free[:N] == 1, np.ones(sizes.M, dtype=bool)])
    return xp.concatenate([np.zeros((1, sizes.width)), units]), places, there


@lru_cache(maxsize=64)
def find_own_directions(sizes: Sizes, N: int, jumps: tuple[int, ...]) -> tuple[FloatArray, IntArray, BoolArray]:
    """Return what `find_directions` does for N transitions with these jumps, shared by all meshes."""
    return find_directions(sizes, np.isin(np.arange(N), jumps).astype(np.int64), np)
