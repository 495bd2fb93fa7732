"""The merit function of equality constraints, ``J + mu ‖c‖₂``, and the search for a step that decreases it.

The penalty mu is raised to where the model of the merit function decreases by a part of what the penalty itself makes
of the step ([1]_, (18.36)); it never falls. A step that fails because the constraints bend is corrected: the
*second-order correction* is the shortest step that meets the constraints as they are at its end ([1]_, section 15.6).
Without it the merit function refuses full steps near the solution (Maratos). If that fails too, the trust region
shrinks.

References
----------
.. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, chapters 15 and 18.
"""

from __future__ import annotations

import numpy as np

from switchfit.optimize import box
from switchfit.optimize.algebra import ARMIJO, ARMIJO_ACROSS, NOISE, FloatArray
from switchfit.optimize.box import MAX_BACKTRACKS
from switchfit.optimize.composite import find_normal_step
from switchfit.optimize.direction import FIRST_CONSTRAINED_RADIUS, Direction
from switchfit.optimize.feasibility import Trial, move
from switchfit.optimize.point import MET, Oracle, Point, Sample
from switchfit.optimize.state import Accepted, State

#: Part of the decrease of ``mu ‖c‖`` that the decrease of the model has to be, rho of [1]_, (18.36).
SHARE = 0.1
#: Factor by which the penalty is raised beyond what is needed, so that the next step does not raise it again.
RAISED = 1.1
#: Radius of the trust region below which violated constraints count as stuck.
SMALLEST_RADIUS = 1e-10
#: Factor by which the trust region shrinks after a step that failed.
SHRINK = 0.5
#: Iterations in which the violation has to change by a tenth: with 6 to 40 of them as many fits end right.
STAGNANT = 10
#: Part of the violation that a step has to leave, by the linearized constraints, for constraints to count as stuck.
FALL = 0.9


def search_merit(oracle: Oracle, state: State, direction: Direction) -> Accepted | None:
    """Shrink the trust region until a composite step decreases the merit function."""
    problem, point, penalty = oracle.problem, state.point, state.penalty
    whole, piece = box.measure(problem, direction.step), None
    for k in range(MAX_BACKTRACKS):
        crossed = problem.breakpoints.count_crossed(point.theta, direction.step)
        penalty = raise_penalty(penalty, point, direction)
        length = box.measure(problem, direction.step) if k else whole
        # Of the model of the merit function: q(0) - q(d) + mu (||c|| - ||c + A d||), positive by the choice of mu.
        reduction = direction.reduction + penalty * (point.violation - direction.left)
        # The trial is evaluated with the multipliers of this step, so that its Hessian is that of the Lagrangian there.
        if direction.multipliers is not None:
            oracle.multipliers = direction.multipliers
        trial = move(problem, point.theta, direction.step, state.scale)
        if trial.is_at(point.theta):
            return None
        fraction = ARMIJO_ACROSS if crossed else ARMIJO
        accepted = _accept(oracle, state, trial, penalty, reduction, fraction, k == 0)
        if accepted is not None:
            there, decrease = accepted
            radius = box.next_radius(problem, direction, decrease, reduction, _noise(state, penalty), SHRINK)
            return Accepted(there, length / whole if k else 1.0, radius, penalty)
        if length < SMALLEST_RADIUS:
            break
        direction, piece = box.shrink_region(problem, state, direction, piece, SHRINK)
    return None


def raise_penalty(penalty: float, point: Point, direction: Direction) -> float:
    """Return the penalty for which a step of the model decreases the merit function by enough ([1]_, (18.36))."""
    # mu >= rise / ((1 - rho) (||c|| - ||c + A d||)): a composite step need not meet the linearization, so that its gain
    # stands where [1] has ||c||.
    gain = point.violation - direction.left
    # The model without its curvature where that is negative, sigma of [1].
    rise = max(-direction.reduction, direction.slope)
    if gain <= 1e-14 * point.violation or rise <= 0.0:
        return penalty
    needed = rise / ((1.0 - SHARE) * gain)
    return penalty if penalty >= needed else RAISED * needed


def is_stuck(oracle: Oracle, state: State) -> bool:
    """Return whether constraints are not met, their violation has stagnated, and no step would reduce it by much.

    Along curved constraints the violation may stagnate while J falls, or while the trust region, having been small,
    grows again: a step as long as the first trust region then still leads to where they are met.
    """
    point, problem = state.point, oracle.problem
    if point.violation <= MET or state.stagnant < STAGNANT:
        return False
    equalities = point.equalities(point.reported_sides)
    room = -np.maximum(point.slack, 0.0)
    radius = max(state.radius, FIRST_CONSTRAINED_RADIUS)
    # Not even the linearized constraints leave a way down: a local minimum of the violation.
    normal = find_normal_step(equalities, problem.region, room, radius)
    return equalities.predict(normal) > FALL * point.violation


def correct(oracle: Oracle, trial: Trial, sample: Sample, scale: FloatArray, radius: float) -> Trial | None:
    """Return the trial moved by the second-order correction: the shortest step to where the constraints there lead."""
    problem = oracle.problem
    if sample.equalities is None:
        return None
    room = -np.maximum(trial.slack, 0.0)
    step = find_normal_step(sample.equalities, problem.region, room, radius)
    moved = move(problem, trial.theta, step, scale)
    return None if moved.is_at(trial.theta) else moved


def _accept(
    oracle: Oracle, state: State, trial: Trial, penalty: float, reduction: float, fraction: float, corrects: bool
) -> tuple[Point, float] | None:
    """Return the point of a trial that decreases the merit function, after a correction if need be, and by how much."""
    first = oracle.first(trial)
    if first is None:
        return None
    found = _judge(oracle, state, trial, first, penalty, reduction, fraction)
    if found is not None or not corrects:
        return found
    problem = oracle.problem
    moved = correct(oracle, trial, first, state.scale, np.inf)
    # What is longer than the step that it is to correct corrects nothing.
    length = box.measure(problem, trial.theta - state.point.theta)
    if moved is None or not box.measure(problem, moved.theta - trial.theta) < length:
        return None
    first = oracle.first(moved)
    if first is None:
        return None
    return _judge(oracle, state, moved, first, penalty, reduction, fraction)


def _judge(
    oracle: Oracle, state: State, trial: Trial, first: Sample, penalty: float, reduction: float, fraction: float
) -> tuple[Point, float] | None:
    """Return the point of a trial that decreases the merit function by a fraction of what is predicted, and how much.

    Where the predicted decrease is below the rounding error of the merit function, the residuals of the optimality
    conditions have to fall.
    """
    point, noise = state.point, _noise(state, penalty)
    decrease = point.cost + penalty * point.violation - first.cost - penalty * first.violation
    below_noise = reduction <= noise
    if not (decrease >= -noise if below_noise else decrease >= fraction * reduction):
        return None
    there = oracle.complete(trial, first, state.scale)
    if there is None or (below_noise and not _residual(state, there) < _residual(state, point)):
        return None
    return there, decrease


def _residual(state: State, point: Point) -> float:
    """Return how far a point is from the optimality conditions: relative optimality and violation."""
    return point.optimality / max(state.gradient_scale, np.finfo(float).tiny) + point.violation


def _noise(state: State, penalty: float) -> float:
    """Return the rounding error of the merit function."""
    return NOISE * (abs(state.point.cost) + penalty * state.point.violation)
