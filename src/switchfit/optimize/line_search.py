"""Line search: how far to go along a search direction, and when a trial point is accepted.

The full step is tried first, even across breakpoints. If it fails and crosses breakpoints, the programme is solved
again inside the present smooth piece, where J is smooth and backtracking must succeed. In a trust region the region
shrinks in place of the step. In a narrow curved valley one more step from the refused point may lead back to the floor
of the valley ([3]_). With equality constraints the merit function is compared in place of J.

References
----------
.. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, chapters 3 and 4.
.. [2] W. W. Hager, H. Zhang, A new conjugate gradient method with guaranteed descent and an efficient line search,
   SIAM J. Optim. 16 (2005) 170-192 (line searches below the rounding error of the cost).
.. [3] R. M. Chamberlain, M. J. D. Powell, C. Lemarechal, H. C. Pedersen, The watchdog technique for forcing convergence
   in algorithms for constrained optimization, Math. Program. Study 16 (1982) 1-17.
"""

from __future__ import annotations

import math

from switchfit.optimize import algebra
from switchfit.optimize.composite_step import TINY
from switchfit.optimize.feasibility import Trial, move
from switchfit.optimize.merit import correct, measure_merit, raise_penalty
from switchfit.optimize.oracle import Oracle
from switchfit.optimize.point import Point, Sample
from switchfit.optimize.search_direction import SearchDirection, find_direction
from switchfit.optimize.state import Accepted, State
from switchfit.optimize.trust_region import get_shrink_factor, measure_in_box, next_radius

MAX_BACKTRACKS = 60

#: Halvings of a step of the steepest descent, whose first length knows nothing of the curvature.
MAX_HALVINGS = 200

#: Iterations after which a step that fails in a trust region is followed by one more before the region shrinks.
ITERATIONS_BEFORE_STEP_BACK = 15

#: Jumps of a derivative larger than this part of the largest derivative are not integration errors.
LARGE_JUMP = 1e-6

#: Radius of the trust region below which violated constraints count as stuck.
SMALLEST_RADIUS = 1e-10


def search(oracle: Oracle, state: State, direction: SearchDirection) -> Accepted | None:
    """Return a step that decreases J: across breakpoints if that works, otherwise inside the present smooth piece.

    With equality constraints, one that decreases the merit function.
    """
    problem, theta = oracle.problem, state.point.theta
    if problem.has_region:
        return _search_in_region(oracle, state, direction)
    if direction.descends:
        return _descend(oracle, state, direction)
    # The full step goes across breakpoints: on the way to a minimum that is far away it passes hundreds of samples,
    # whose kinks are small beside the curvature of the whole. Piece by piece a fit would take an iteration a sample.
    alpha, crossing, k = 1.0, problem.breakpoints.count_crossed(theta, direction.step) > 0, 0
    while k < MAX_BACKTRACKS and not _is_hopeless(state, direction, k, alpha):
        # Across breakpoints the slope at theta says little: a larger part of the decrease is asked for, until few are
        # crossed.
        accepted = _attempt(oracle, state, direction, alpha, algebra.ARMIJO_ACROSS if crossing else algebra.ARMIJO)
        if accepted is not None:
            return accepted
        if crossing:
            alpha *= 0.5
            if problem.breakpoints.count_crossed(theta, alpha * direction.step) < algebra.MANY_BREAKPOINTS:
                direction = find_direction(problem, state, problem.breakpoints.piece(theta, problem.constraints))
                alpha, crossing = 1.0, False
        else:
            # Armijo's rule ([1]_, algorithm 3.1).
            alpha, k = alpha * (0.5 if k < 5 else 0.25), k + 1
    return None


def _search_in_region(oracle: Oracle, state: State, direction: SearchDirection) -> Accepted | None:
    """Shrink the trust region until the step of the programme in it is accepted."""
    problem, point, whole, piece = oracle.problem, state.point, direction.step, None
    constrained = bool(problem.equalities)
    for k in range(MAX_BACKTRACKS):
        crossed = problem.breakpoints.count_crossed(point.theta, direction.step)
        state = state._replace(penalty=raise_penalty(state.penalty, point, direction))
        fraction = algebra.ARMIJO_ACROSS if crossed else algebra.ARMIJO
        accepted = _attempt(oracle, state, direction, 1.0, fraction, correcting=constrained and k == 0)
        # A narrow curved valley makes full steps fail again and again; only long minimizations are in one.
        if accepted is None and k == 0 and state.iteration >= ITERATIONS_BEFORE_STEP_BACK and not constrained:
            accepted = _step_back(oracle, state, direction)
        length = measure_in_box(problem, direction.step)
        if accepted is not None:
            return accepted if k == 0 else accepted._replace(step_length=length / measure_in_box(problem, whole))
        if length < SMALLEST_RADIUS if constrained else _is_hopeless(state, direction, k + 1):
            return None
        radius = direction.radius
        # A step that failed across few breakpoints is tried in the present smooth piece before the region shrinks.
        if piece is None and 0 < crossed < algebra.MANY_BREAKPOINTS:
            piece = problem.breakpoints.piece(point.theta, problem.constraints)
        else:
            radius = get_shrink_factor(problem) * length
        direction = find_direction(problem, state._replace(radius=radius), piece)
    return None


def _is_hopeless(state: State, direction: SearchDirection, k: int, alpha: float = 1.0) -> bool:
    """Return whether the slope promises a decrease that J cannot show, after k steps that failed."""
    return k > 6 and alpha * -direction.slope < 0.01 * algebra.COST_NOISE * abs(state.point.cost)


def _step_back(oracle: Oracle, state: State, direction: SearchDirection) -> Accepted | None:
    """Take one more step from where a step has failed: in a curved valley it leads back to the valley's floor ([3]_).

    The point of the failed step is evaluated once more, for the line search keeps none that it refuses.
    """
    problem, point = oracle.problem, state.point
    trial = oracle.point(move(problem, point.theta, direction.step, state.scale), state.scale)
    if trial is None:
        return None
    radius = min(direction.radius, measure_in_box(problem, direction.step))
    second = find_direction(problem, state._replace(point=trial, radius=radius))
    back = move(problem, trial.theta, second.step, state.scale)
    # None where it leads back to the point itself.
    end = _judge(oracle, state, direction, back, oracle.first(back), 1.0, algebra.ARMIJO_ACROSS)
    return None if end is None else end._replace(radius=direction.radius)


def _descend(oracle: Oracle, state: State, direction: SearchDirection) -> Accepted | None:
    """Halve the step of the steepest descent until Armijo's rule holds ([1]_, algorithm 3.1), inside the constraints.

    A large fraction of the predicted decrease keeps the steps across the narrow direction of a valley short of its
    other side. Derivatives need not jump at a breakpoint: the step ends there only where J is lowest there.
    """
    problem, theta = oracle.problem, state.point.theta
    alpha, longer = 1.0, direction
    for k in range(MAX_HALVINGS):
        accepted = _attempt(oracle, state, direction, 1.0, algebra.ARMIJO_DESCENT)
        if accepted is not None or _is_hopeless(state, direction, k + 1):
            break
        alpha *= 0.5
        longer, direction = direction, find_direction(problem, state._replace(metric=alpha * state.metric))
    # The last step that failed, of twice the length, may have ended beyond a breakpoint at which J is lowest.
    crossed = 0 if longer is direction else problem.breakpoints.count_crossed(theta, longer.step)
    if accepted is None or 0 < crossed < algebra.MANY_BREAKPOINTS:
        piece = problem.breakpoints.piece(theta, problem.constraints)
        length = 1.0 if accepted is None else 2.0 * alpha
        nearer = find_direction(problem, state._replace(metric=length * state.metric), piece)
        stop = _attempt(oracle, state, nearer, 1.0, algebra.ARMIJO_ACROSS)
        if stop is not None:
            jumps = stop.point.find_jumps(LARGE_JUMP * stop.point.largest_derivative)
            if accepted is None or jumps.any():
                return Accepted(stop.point, alpha)
    return None if accepted is None else Accepted(accepted.point, alpha)


def _attempt(
    oracle: Oracle, state: State, direction: SearchDirection, alpha: float, fraction: float, correcting: bool = False
) -> Accepted | None:
    """Return the point at step length alpha if it is acceptable, or after a second-order correction."""
    problem, theta = oracle.problem, state.point.theta
    # A trial is evaluated with the multipliers of its step, so that its Hessian is that of the Lagrangian there.
    oracle.multipliers = direction.multipliers
    there = move(problem, theta, direction.step if alpha == 1.0 else alpha * direction.step, state.scale)
    first = None if there.is_at(theta) else oracle.first(there)
    found = _judge(oracle, state, direction, there, first, alpha, fraction)
    # The constraints bend: a full step along their tangent leaves them by the square of its length, and the merit
    # function refuses it however near the solution is (Maratos). From there, the shortest step back.
    if first is None or found is not None or not correcting:
        return found
    moved = correct(oracle, there, first, state.scale)
    # What is longer than the step that it is to correct corrects nothing.
    length = measure_in_box(problem, there.theta - theta)
    if moved is None or not measure_in_box(problem, moved.theta - there.theta) < length:
        return None
    return _judge(oracle, state, direction, moved, oracle.first(moved), alpha, fraction)


def _judge(
    oracle: Oracle,
    state: State,
    direction: SearchDirection,
    there: Trial,
    first: Sample | None,
    alpha: float,
    part: float,
) -> Accepted | None:
    """Return the point of a trial that decreases the merit function by a part of what is predicted.

    Where the predicted decrease is below the rounding error, comparing costs says nothing ([2]_): then the residuals of
    the optimality conditions have to fall, or a cost is below every earlier one.
    """
    if first is None:
        return None
    point, penalty, constrained = state.point, state.penalty, bool(oracle.problem.equalities)
    # Noise: J is compared to a part of itself only. Steps below it are judged by the residuals, and may not rise above
    # the lowest J so far by more than it: else J could creep up by rounding, iteration by iteration.
    merit, before = measure_merit(first, state), measure_merit(point.plus, state)
    noise = algebra.COST_NOISE * (abs(point.cost) + penalty * point.violation)
    # Of the model of the merit function: q(0) - q(d) + mu (||c|| - ||c + A d||), positive by the choice of mu.
    reduction = direction.reduction + penalty * (point.violation - direction.left)
    predicted, lowest = (reduction, before) if constrained else (-alpha * direction.slope, state.lowest_cost)
    if not algebra.cost_allows(merit, before, lowest, predicted, noise, part):
        return None
    trial = oracle.complete(there, first, state.scale)
    if trial is None:
        return None
    lowest = -math.inf if constrained else lowest  # of a merit function whose penalty changes there is no lowest one
    if not algebra.optimality_allows(_residual(state, trial), _residual(state, point), merit, lowest, predicted, noise):
        return None
    radius = next_radius(oracle.problem, direction, before - merit, reduction, noise)
    return Accepted(trial, alpha, radius, penalty)


def _residual(state: State, point: Point) -> float:
    """Return how far a point is from the optimality conditions: relative optimality and violation."""
    return point.optimality / max(state.gradient_scale, TINY) + point.violation
