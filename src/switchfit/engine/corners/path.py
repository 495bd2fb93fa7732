"""The path of a trajectory through corners: in which branches it runs, and when it crosses from one to the next."""

from __future__ import annotations

from typing import NamedTuple

from switchfit.arrays import FloatArray
from switchfit.problem.corners.branches import Sides


class BranchPath(NamedTuple):
    """Branches of a trajectory.

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
