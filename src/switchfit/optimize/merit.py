"""Merit function of equality constraints, ``J + mu ‖c‖₂``: its penalty, and the second-order correction.

The penalty mu is raised to where the model of the merit function decreases by a part of what the penalty itself makes
of the step ([1]_, (18.36)); it never falls. A step that fails because the constraints bend is corrected: the
*second-order correction* is the shortest step that meets the constraints as they are at its end ([1]_, section 15.6).
Without it the merit function refuses full steps near the solution (Maratos). If that fails too, the trust region
shrinks. Constraints whose violation no longer falls are stuck: the minimization ends as infeasible.

References
----------
.. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, chapters 15 and 18.
"""

from __future__ import annotations

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.optimize.composite_step import find_normal_step
from switchfit.optimize.feasibility import Trial, move
from switchfit.optimize.oracle import Oracle
from switchfit.optimize.point import MET, Point, Sample
from switchfit.optimize.qp import Room
from switchfit.optimize.search_direction import FIRST_CONSTRAINED_RADIUS, SearchDirection
from switchfit.optimize.state import State

#: Part of the decrease of ``mu ‖c‖`` that the decrease of the model has to be, rho of [1]_, (18.36).
SHARE = 0.1

#: Factor by which the penalty is raised beyond what is needed, so that the next step does not raise it again.
PENALTY_INCREASE = 1.1

#: Iterations in which the violation has to change by a tenth: with 6 to 40 of them as many fits end right.
STAGNANT = 10

#: Part of the violation that a step has to leave, by the linearized constraints, for constraints to count as stuck.
FALL = 0.9


def measure_merit(sample: Sample, state: State) -> float:
    """Return the merit function, which is J where there are no equality constraints."""
    return sample.cost + state.penalty * sample.violation


def raise_penalty(penalty: float, point: Point, direction: SearchDirection) -> float:
    """Return the penalty for which a step of the model decreases the merit function by enough ([1]_, (18.36))."""
    # mu >= rise / ((1 - rho) (||c|| - ||c + A d||)): a composite step need not meet the linearization, so that its gain
    # stands where [1] has ||c||.
    gain = point.violation - direction.left
    # The model without its curvature where that is negative, sigma of [1].
    rise = max(-direction.reduction, direction.slope)
    # No penalty makes a step descend that gains nothing of the violation; where J falls by itself, none is needed.
    if gain <= 1e-14 * point.violation or rise <= 0.0:
        return penalty
    needed = rise / ((1.0 - SHARE) * gain)
    return penalty if penalty >= needed else PENALTY_INCREASE * needed


def is_stuck(oracle: Oracle, state: State) -> bool:
    """Return whether constraints are not met, their violation has stagnated, and no step would reduce it by much.

    Along curved constraints the violation may stagnate while J falls, or while the trust region, having been small,
    grows again: a step as long as the first trust region then still leads to where they are met.
    """
    point, problem = state.point, oracle.problem
    if point.violation <= MET or state.stagnant < STAGNANT:
        return False
    equalities = point.equalities(point.reported_sides)
    room = Room.around(problem.constraints, point.slack)
    radius = max(state.radius, FIRST_CONSTRAINED_RADIUS)
    # Not even the linearized constraints leave a way down: a local minimum of the violation.
    normal = find_normal_step(equalities, room, problem.reach, radius)
    return equalities.predict(normal) > FALL * point.violation


def correct(oracle: Oracle, trial: Trial, sample: Sample, scale: FloatArray) -> Trial | None:
    """Return the trial moved by the second-order correction: the shortest step to where the constraints there lead."""
    problem = oracle.problem
    room = Room.around(problem.constraints, trial.slack)
    step = find_normal_step(sample.equalities, room, problem.reach, np.inf)
    moved = move(problem, trial.theta, step, scale)
    return None if moved.is_at(trial.theta) else moved
