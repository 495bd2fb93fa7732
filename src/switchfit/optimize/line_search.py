"""The line search: the full step first, even across breakpoints, then inside the present smooth piece.

If the full step fails and crosses breakpoints, the programme is solved again inside the present smooth piece, where J
is smooth and backtracking must succeed.

References
----------
.. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, chapter 3.
.. [2] W. W. Hager, H. Zhang, A new conjugate gradient method with guaranteed descent and an efficient line search,
   SIAM J. Optim. 16 (2005) 170-192 (line searches below the rounding error of the cost).
.. [3] R. M. Chamberlain, M. J. D. Powell, C. Lemarechal, H. C. Pedersen, The watchdog technique for forcing convergence
   in algorithms for constrained optimization, Math. Program. Study 16 (1982) 1-17.
"""

from __future__ import annotations

from switchfit.optimize import box
from switchfit.optimize.algebra import (
    ARMIJO,
    ARMIJO_ACROSS,
    ARMIJO_DESCENT,
    NOISE,
    cost_allows,
    optimality_allows,
)
from switchfit.optimize.box import MANY_BREAKPOINTS, MAX_BACKTRACKS
from switchfit.optimize.direction import Direction, find_direction
from switchfit.optimize.feasibility import Trial, move
from switchfit.optimize.point import Oracle, Point
from switchfit.optimize.state import Accepted, State

#: Halvings of a step of the steepest descent, whose first length knows nothing of the curvature.
MAX_HALVINGS = 200
#: Iterations after which a step that fails in a trust region is followed by one more before the region shrinks.
PATIENCE = 15


def search(oracle: Oracle, state: State, direction: Direction) -> Accepted | None:
    """Return a step that decreases J: across breakpoints if that works, otherwise inside the present smooth piece."""
    problem, theta = oracle.problem, state.point.theta
    if problem.has_box:
        return _search_in_box(oracle, state, direction)
    if direction.descends:
        return _descend(oracle, state, direction)
    alpha = 1.0
    crossed = problem.breakpoints.count_crossed(theta, direction.step)
    # Across breakpoints the slope at theta says little: a larger part of the decrease is asked for, until few are
    # crossed.
    while crossed > 0:
        accepted = _attempt(oracle, state, direction, alpha, ARMIJO_ACROSS)
        if accepted is not None:
            return accepted
        alpha *= 0.5
        crossed = problem.breakpoints.count_crossed(theta, alpha * direction.step)
        if crossed < MANY_BREAKPOINTS:
            direction = find_direction(problem, state, problem.breakpoints.piece(theta, problem.constraints))
            break
    return _backtrack(oracle, state, direction)


def _search_in_box(oracle: Oracle, state: State, direction: Direction) -> Accepted | None:
    """Shrink the trust region until the step of the programme in it decreases J."""
    problem, point, whole = oracle.problem, state.point, direction.step
    noise, piece = NOISE * abs(point.cost), None
    for k in range(MAX_BACKTRACKS):
        crossed = problem.breakpoints.count_crossed(point.theta, direction.step)
        accepted = _attempt(oracle, state, direction, 1.0, ARMIJO_ACROSS if crossed else ARMIJO)
        if accepted is not None:
            decrease = point.cost - accepted.point.cost
            radius = box.next_radius(problem, direction, decrease, direction.reduction, noise)
            part = box.measure(problem, direction.step) / box.measure(problem, whole) if k else 1.0
            return Accepted(accepted.point, part, radius)
        # A narrow curved valley makes full steps fail again and again; only long minimizations are in one.
        corrected = _step_back(oracle, state, direction) if k == 0 and state.iteration >= PATIENCE else None
        if corrected is not None:
            return corrected
        if k > 5 and -direction.slope < 0.01 * noise:
            break
        direction, piece = box.shrink_region(problem, state, direction, piece)
    return _blind_step(oracle, state, direction)


def _step_back(oracle: Oracle, state: State, direction: Direction) -> Accepted | None:
    """Take one more step from where a step has failed: in a curved valley it leads back to the valley's floor ([3]_).

    The point of the failed step is evaluated once more, for the line search keeps none that it refuses.
    """
    problem, point = oracle.problem, state.point
    trial = oracle.point(move(problem, point.theta, direction.step, state.scale), state.scale)
    if trial is None:
        return None
    radius = min(direction.radius, box.measure(problem, direction.step))
    second = find_direction(problem, state._replace(point=trial, radius=radius))
    back = move(problem, trial.theta, second.step, state.scale)
    end = _judge(oracle, state, back, -direction.slope, ARMIJO_ACROSS)  # None where it leads back to the point itself
    return None if end is None else Accepted(end, 1.0, direction.radius)


def _backtrack(oracle: Oracle, state: State, direction: Direction) -> Accepted | None:
    """Backtrack from the full step by Armijo's rule ([1]_, algorithm 3.1)."""
    alpha = 1.0
    for k in range(MAX_BACKTRACKS):
        accepted = _attempt(oracle, state, direction, alpha, ARMIJO)
        if accepted is not None:
            return accepted
        alpha *= 0.5 if k < 5 else 0.25
        if k > 5 and alpha * -direction.slope < 0.01 * NOISE * abs(state.point.cost):
            break
    return _blind_step(oracle, state, direction)


def _descend(oracle: Oracle, state: State, direction: Direction) -> Accepted | None:
    """Halve the step of the steepest descent until Armijo's rule holds ([1]_, algorithm 3.1), inside the constraints.

    A large fraction of the predicted decrease keeps the steps across the narrow direction of a valley short of its
    other side. Derivatives need not jump at a breakpoint: the step ends there only where J is lowest there.
    """
    problem, theta = oracle.problem, state.point.theta
    alpha, longer = 1.0, direction
    for k in range(MAX_HALVINGS):
        accepted = _attempt(oracle, state, direction, 1.0, ARMIJO_DESCENT)
        if accepted is not None or (k > 5 and -direction.slope < 0.01 * NOISE * abs(state.point.cost)):
            break
        alpha *= 0.5
        longer, direction = direction, find_direction(problem, state._replace(metric=alpha * state.metric))
    crossed = 0 if longer is direction else problem.breakpoints.count_crossed(theta, longer.step)
    if accepted is None or 0 < crossed < MANY_BREAKPOINTS:
        piece = problem.breakpoints.piece(theta, problem.constraints)
        length = 1.0 if accepted is None else 2.0 * alpha
        nearer = find_direction(problem, state._replace(metric=length * state.metric), piece)
        stop = _attempt(oracle, state, nearer, 1.0, ARMIJO_ACROSS)
        if stop is not None and (accepted is None or stop.point.jumps):
            return Accepted(stop.point, alpha)
    return _blind_step(oracle, state, direction) if accepted is None else Accepted(accepted.point, alpha)


def _attempt(oracle: Oracle, state: State, direction: Direction, alpha: float, fraction: float) -> Accepted | None:
    """Return the point at step length alpha if it is acceptable."""
    theta = state.point.theta
    step = direction.step if alpha == 1.0 else alpha * direction.step
    there = move(oracle.problem, theta, step, state.scale)
    trial = None if there.is_at(theta) else _judge(oracle, state, there, -alpha * direction.slope, fraction)
    return None if trial is None else Accepted(trial, alpha)


def _judge(oracle: Oracle, state: State, there: Trial, decrease: float, fraction: float) -> Point | None:
    """Return the point at a trial if it is acceptable: if it achieves a fraction of the predicted linear decrease.

    Where the predicted decrease is below the rounding error of J, comparing costs says nothing ([2]_): then a
    smaller KKT residual counts, or a cost below every earlier one.
    """
    point, lowest = state.point, state.lowest_cost
    noise = NOISE * abs(point.cost)
    first = oracle.first(there)
    if first is None or not cost_allows(first.cost, point.cost, lowest, decrease, noise, fraction):
        return None
    trial = oracle.complete(there, first, state.scale)
    if trial is None:
        return None
    allowed = optimality_allows(trial.optimality, point.optimality, trial.cost, lowest, decrease, noise)
    return trial if allowed else None


def _blind_step(oracle: Oracle, state: State, direction: Direction) -> Accepted | None:
    """Take the full step on the word of the derivatives, where J is a small difference of large terms.

    The rounding error of such a J is that of the largest cost seen, not of J; the KKT residual has to halve.
    """
    noise = NOISE * state.cost_scale
    if direction.reduction > noise:
        return None
    there = move(oracle.problem, state.point.theta, direction.step, state.scale)
    if there.is_at(state.point.theta):
        return None
    trial = oracle.point(there, state.scale)
    if trial is None or trial.cost > state.lowest_cost + noise or trial.optimality > 0.5 * state.point.optimality:
        return None
    return Accepted(trial, 1.0, state.radius)
