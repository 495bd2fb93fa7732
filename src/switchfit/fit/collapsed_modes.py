"""Unknowns that collapsed modes leave idle: modes of zero duration, whose two transition times are equal.

If a collapsed mode lies between two intervals of the same mode, as B in (A, B, A), the cost does not depend on its
position: to the integration error, J is constant as its two transition times move together. Nor does the cost depend on
a parameter that acts in collapsed modes alone. Such unknowns are *idle*: no data determine them, and the curvature of J
along them is that of the integration error, of either sign.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.fit.hidden_switches import list_changes
from switchfit.meshes.evaluator import Evaluator
from switchfit.optimize.algebra import EPS
from switchfit.problem.experiment import Experiment
from switchfit.problem.problem import Problem
from switchfit.problem.reads import find_unread
from switchfit.problem.system import HybridSystem

TESTED_CHANGES = (0.1, -0.1)
"""Relative changes of a parameter to test its effect; if it is 0, relative to the range between its bounds."""

LEAST_EFFECT_ON_COST = 1e-12
"""Relative change of the cost that may be rounding: a parameter that changes it by less has no effect."""

ROUNDING_OF_TIMES = 32 * EPS
"""Rounding error of the difference of two times, as a part of their size."""


def idle_unknowns(evaluator: Evaluator, theta: FloatArray, parameters: bool) -> NDArray[np.bool_]:
    """Return which unknowns may be fixed, as J does not depend on them while collapsed modes remain collapsed: (d,).

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
    parameters : bool
        Whether to test parameters too, with a few evaluations of J for each. Of transition times that coincide, only
        the first is returned, which leaves the others free to move away from it.
    """
    problem = evaluator.problem
    idle = np.zeros(len(theta), dtype=bool)
    ends = zip(problem.experiments, problem.ends_of_modes(theta), strict=True)
    # Equal times differ by rounding of the clock, which is large where times are dates.
    collapsed = [times[1:] - times[:-1] <= ROUNDING_OF_TIMES * run.clock for run, times in ends]
    if not any(map(np.any, collapsed)):  # the usual case: tested at every step
        return idle
    for run, where, own in zip(problem.experiments, problem.unknowns.times, collapsed, strict=True):
        for first, after in np.flatnonzero(np.diff(own, prepend=False, append=False)).reshape(-1, 2).tolist():
            # The transitions around the collapsed modes: moved together, between equal modes, they change nothing.
            group = where[max(first - 1, 0) : after]
            if first > 0 and after < len(own) and np.all(group >= 0) and _may_move(problem.system, run, first, after):
                idle[group[0]] = True
    if parameters:
        base = evaluator.cost(theta)
        for i in _list_parameters(problem):
            # Two changes, to both sides: the derivative may be zero at theta and the cost not constant.
            moved = map(evaluator.cost, list_changes(problem, theta, i, TESTED_CHANGES))
            idle[i] = all(abs(cost - base) <= LEAST_EFFECT_ON_COST * abs(base) for cost in moved)
    return idle


def _may_move(system: HybridSystem, run: Experiment, first: int, after: int) -> bool:
    """Return whether collapsed modes, from the first to the one before `after`, may move together without effect.

    The modes before and after them are the same, and no reset map, guard or jump lies in between.
    """
    modes = run.mode_sequence[first - 1 : after + 1]
    acts = any(pair in system.reset_maps or pair in system.guards for pair in pairwise(modes))
    jumps = np.isin(run.passed_by_jumps, range(first, after))
    return modes[0] == modes[-1] and not acts and not jumps.any()


def _list_parameters(problem: Problem) -> list[int]:
    """Return the indices in theta of the parameters that a function reads which acts."""
    spans = problem.unknowns.parameters.values()
    without = {name for names in find_unread(problem) for name in names}
    return [i for span in spans for i in range(span.start, span.stop) if problem.theta_names[i] not in without]
