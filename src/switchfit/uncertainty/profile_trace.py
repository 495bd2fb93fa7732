"""The points of a profile likelihood: fits with one unknown held, outwards in equal steps of zeta.

zeta is nearly linear in the unknown, so that its crossing of the quantile is found in a few more fits than the march
has made. Where the next point lies, and where the other unknowns begin there, follows from the derivatives at the point
before (`switchfit.uncertainty.elimination`); then the others are fitted, with the unknown's lower and upper bound set
to its value. Where the slopes of two points far apart show another minimum between them, it is looked for; where the
cost falls outwards, the lower branch is followed back inwards. All fits use the compiled program of the original one,
on its meshes with halved cells, which follow.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.problem.problem import Problem

SideEnding = Literal["crossed", "limit", "flat", "failed", "stopped"]

STEPS_TO_THRESHOLD = 5
"""Points between the estimate and the crossing of the threshold, on each side."""

MARCHED_BEYOND_THRESHOLD = 1.15
"""The march continues until zeta is this many times the threshold ..."""

LOOK_AHEAD = 3
"""... and then adds this many points for a second region, each twice as far out as the one before; twice as many while
the cost falls outwards."""

MOST_POINTS_OF_SIDE = 60
"""Largest number of points on one side."""

LONGEST_GROWTH = 2.5
"""Largest ratio of a step to the one before."""

FLAT_UP_TO_SIZES = 1e2
"""A side is flat if the threshold is not crossed up to this many times the unknown's size or its standard error."""

HALVINGS_OF_STEP = 8
"""Largest number of times that a step is reduced because a fit fails or zeta rises too much."""

ITERATIONS_OF_PROFILE_FIT = 100
"""Largest number of iterations of one fit along the profile."""

CREEPING = 1e-3
"""Fall of J in the second half of them, as a part of that in one unit of zeta, below which the fit has ended too."""


def limit_unknowns(problem: Problem) -> tuple[FloatArray, FloatArray]:
    """Return the lower and the upper bounds of all unknowns, (d,) and (d,), with room for all times before and after.

    Parameters
    ----------
    problem : Problem
    """
    unknowns = problem.unknowns
    low, high = unknowns.lowest.copy(), unknowns.upper.copy()
    for experiment, where in zip(problem.experiments, unknowns.times, strict=True):
        free, times = where >= 0, experiment.initial_times
        gaps = np.array([problem.durations[mode] for mode in experiment.mode_sequence])  # before each time
        latest = np.inf if experiment.has_free_tf else experiment.end - gaps[-1]
        # A fixed time limits its neighbours like a bound; index -1 of its place reads a value that is not taken.
        first, last = np.where(free, [low[where], high[where]], times)
        # Without the gaps before them, times are in order.
        ahead = np.cumsum(gaps)[: len(where)]
        earlier = np.maximum.accumulate(np.maximum(first - ahead, experiment.t0)) + ahead
        later = np.minimum.accumulate(np.minimum(last - ahead, latest - ahead[-1:])[::-1])[::-1] + ahead
        own = where[free]
        low[own], high[own] = np.maximum(first, earlier)[free], np.minimum(last, later)[free]
    return low, high


@dataclass(frozen=True, eq=False)
class ProfilePoint:
    """One fit with the unknown held at `value`; slope and curvature of the profile, and how the others follow (d,)."""

    value: float
    cost: float
    slope: float
    curvature: float
    theta: FloatArray
    follow: FloatArray
    converged: bool

    def predict(self, value: float) -> tuple[FloatArray, float]:
        """Return all unknowns, and the cost, near by."""
        step = value - self.value
        cost = self.cost + step * (self.slope + 0.5 * step * self.curvature)
        return self.theta + np.nan_to_num(step * self.follow), cost
