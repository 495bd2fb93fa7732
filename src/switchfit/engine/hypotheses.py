"""Hypotheses on the mode sequence of one experiment, as the engine takes and returns them."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray

Column = IntEnum("Column", "PARENT BEFORE AFTER SLOT RESET_MAP TRANSITION_COST GUARD", start=0)
"""Columns of the table that makes children of hypotheses: (C, 7) of int64.

PARENT : position of the parent
BEFORE, AFTER : mode of the parent and of the child
SLOT : which transition happens at the first node, from 0, a birth; -1 if none does
RESET_MAP, TRANSITION_COST, GUARD : place of its functions in the library, -1 for none
"""


class Hypotheses(NamedTuple):
    """Hypotheses on the mode sequence of one experiment, at one time; D = births at most + M unknowns.

    Their costs are linearised: ``J + g'd + d'H d / 2`` for a change d of the birth times and of p from the point of
    linearisation.

    Attributes
    ----------
    scores : (B,), the lowest cost for any d; NaN where a hypothesis has failed
    costs : (B,), J of the samples so far
    gradients, matrices : (B, D), (B, D, D): g and the Gauss-Newton matrix H
    moved : (B, D), how far the point of linearisation is from the births on the grid and from the first p
    states, tangents : (B, n), (B, n, D)
    records : (B, size)
        Memory of the engine, with all of the above in it and what it needs to go on; empty where none can.
    """

    scores: FloatArray
    costs: FloatArray
    gradients: FloatArray
    matrices: FloatArray
    moved: FloatArray
    states: FloatArray
    tangents: FloatArray
    records: FloatArray = np.zeros((0, 0))

    def take(self, chosen: NDArray[np.int64]) -> Hypotheses:
        """Return some of them, with which no engine can go on."""
        return Hypotheses(*(values[chosen] for values in self[:-1]))


class HypothesisTolerances(NamedTuple):
    """Tolerances of the propagation of hypotheses.

    Attributes
    ----------
    relative : error of a step, relative to the state
    smallest : size of a state at which the relative and the absolute error are equal
    guard : information of a guard on the time of its transition, in units of J
    """

    relative: float
    smallest: float
    guard: float


class HypothesisLimits(NamedTuple):
    """Bounds of `Hypotheses.moved`, (D,) each, and how far it may move at once, (D,)."""

    low: FloatArray
    high: FloatArray
    most: FloatArray
