"""The step of an iteration: its direction, how far to go along it, and why a search found nothing lower.

The direction is the solution of a convex quadratic programme. Its matrix is the exact Hessian, made positive definite
only in the subspace where it has to be (Newton), its blocks, Gauss-Newton's matrix, or a multiple of the identity
(steepest descent). It starts from the sides of the steepest descent, so that its step descends wherever the optimality
is positive.

The trust region: a box around the point, in which the quadratic model of the cost is trusted. Far from the solution the
Hessian is often indefinite. Where eigenvalues are replaced by their absolute values, a line search along the step goes
far in directions in which the model says nothing. Inside a trust region the Hessian is shifted instead, in the metric
of the region, until it is positive definite ([1]_, section 4.3), and no unknown moves further than a radius times its
`reach`. The radius follows from how well the model predicted the last step ([1]_, algorithm 4.1). The region is a box,
for then it adds nothing but bounds to the quadratic programme. As long as the Hessian is positive definite and its
steps succeed, there is no box.

If the full step fails and crosses breakpoints, the programme is solved again inside the present smooth piece, where J
is smooth and backtracking must succeed.

The merit function of equality constraints is ``J + mu ‖c‖₂``. The penalty mu is raised to where the model of the merit
function decreases by a part of what the penalty itself makes of the step ([1]_, (18.36)); it never falls. A step that
fails because the constraints bend is corrected: the *second-order correction* is the shortest step that meets the
constraints as they are at its end ([1]_, section 15.6). Without it the merit function refuses full steps near the
solution (Maratos). If that fails too, the trust region shrinks.

References
----------
.. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, chapters 3, 4, 15 and 18.
.. [2] W. W. Hager, H. Zhang, A new conjugate gradient method with guaranteed descent and an efficient line search,
   SIAM J. Optim. 16 (2005) 170-192 (line searches below the rounding error of the cost).
.. [3] J. J. More, S. M. Wild, Estimating computational noise, SIAM J. Sci. Comput. 33 (2011) 1292-1314.
.. [4] R. M. Chamberlain, M. J. D. Powell, C. Lemarechal, H. C. Pedersen, The watchdog technique for forcing convergence
   in algorithms for constrained optimization, Math. Program. Study 16 (1982) 1-17.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from switchfit.optimize import algebra
from switchfit.optimize.algebra import BoolArray, FloatArray, IntArray
from switchfit.optimize.matrix import Dense, Hessian
from switchfit.optimize.problem import Problem, Trial, move
from switchfit.optimize.qp import NONE, TINY, Equalities, Room, find_normal_step, is_definite, solve_composite
from switchfit.optimize.state import MET, Accepted, Finding, Oracle, Point, Sample, State
from switchfit.optimize.threads import one_thread

FIRST_RADIUS = 1.0
"""Radius of the first trust region."""

FIRST_CONSTRAINED_RADIUS = 5.0
"""The same where there are equality constraints, with which there always is one. The bed of poor starts is indifferent
to it between 5 and 40."""

Piece = tuple[FloatArray, FloatArray]
"""Bounds of the smooth piece around a point: (d,), (d,)."""

HALF = 0.5
"""Part of the violation of equality constraints that a step may leave while coordinates are held at kinks."""


class Direction(NamedTuple):
    """Step d (d,) of the quadratic programme with its slope gᵀd and its predicted reduction −(gᵀd + ½dᵀBd).

    `regular`: no constraint is active, no coordinate is held or at a kink, and H is positive definite. `radius` is that
    of the trust region that it was found in. With equality constraints, `multipliers` are theirs, (k,), and `left` is
    what their linearization leaves of their violation.
    """

    step: FloatArray
    slope: float
    reduction: float
    regular: bool
    radius: float = np.inf
    descends: bool = False
    multipliers: FloatArray = np.zeros(0)
    left: float = 0.0


def find_direction(problem: Problem, state: State, piece: Piece | None = None) -> Direction:
    """Return the step of the quadratic programme, with coordinates on a kink held or confined to the downhill side.

    Parameters
    ----------
    problem : Problem
    state : State
    piece : pair of arrays, shape (d,), optional
        Bounds to keep to, narrower than those of the problem.
    """
    point, sides = state.point, state.point.downhill
    found = _solve_on_sides(problem, state, sides, piece)
    if point.kink is None or found.left <= max(HALF * point.violation, MET):
        return found
    # The equality constraints cannot be met while these coordinates are held, or kept to one side: they are released to
    # where the normal step takes them.
    room, _ = _room(problem, state, np.where(point.kink, 0, sides), piece)
    normal = find_normal_step(point.equalities(sides), room, problem.reach, np.inf)
    return _solve_on_sides(problem, state, np.where(point.kink, np.where(normal > 0.0, 1, -1), sides), piece)


def _solve_on_sides(problem: Problem, state: State, sides: IntArray, piece: Piece | None) -> Direction:
    """Solve the quadratic programme with kinks held or confined as `sides` say.

    Its matrix B is H made positive definite where it is not, inside the room and the trust region.
    """
    constraints, point, d = problem.constraints, state.point, len(problem.size)
    gradient, hessian = point.derivatives(sides)
    room, free = _room(problem, state, sides, piece)
    if problem.equalities:
        return _solve_constrained(problem, state, sides, room, free)
    # After a failed line search each unknown is taken by itself.
    labels = np.arange(d, dtype=float) if state.careful else problem.labels
    # Curvature of each unknown that counts as none.
    floor = algebra.curvature_floor(state.scale, state.cost_scale, point.largest_slopes)
    matrix: Any = hessian
    descends = _descends(problem, hessian, free)
    if descends:
        matrix, floor = Dense(np.eye(d) / state.metric), np.zeros(d)
    elif labels is not None:
        matrix = hessian.mask(labels)
    # Expected to be active: those with a multiplier at this point.
    pressed = constraints.normals[point.multipliers > 0.0 if point.active.size else slice(0)]
    kept, part, own, reach = matrix, NONE, gradient, problem.reach
    if free is not None:
        if not free.any():
            return Direction(np.zeros(d), 0.0, 0.0, False, state.radius, descends)
        # What is held is left out, or decoupled.
        kept, part = matrix.keep(free)
        own, pressed, floor = (gradient * free)[part], (pressed * free)[:, part], (floor * free)[part]
        room, reach = room.of(part, free), reach[part]
    convex, factor = kept.convexify(pressed, floor, reach if problem.hessian == "auto" else None)
    definite, radius = convex is kept, state.radius
    if problem.hessian == "auto" and radius == np.inf and not definite:
        radius = FIRST_RADIUS
    if radius < np.inf:
        room = room.narrow(radius * reach)
    step, _ = convex.solve(own, factor, room)
    curvature = float(step.dot(convex.dot(step)))
    if free is not None:
        moved, step = step, np.zeros(d)
        step[part] = moved
    slope = float(gradient.dot(step))
    regular = definite and matrix is hessian and free is None and point.is_interior
    return Direction(step, slope, -(slope + 0.5 * curvature), regular, radius, descends)


def _solve_constrained(
    problem: Problem, state: State, sides: IntArray, room: Room, free: BoolArray | None
) -> Direction:
    """Do the work of `_solve_on_sides` where there are equality constraints."""
    equalities, (gradient, hessian) = state.point.equalities(sides), state.point.derivatives(sides)
    radius = FIRST_CONSTRAINED_RADIUS if state.radius == np.inf else state.radius
    full = np.diag(np.abs(hessian.diagonal())) if state.careful else hessian.dense()
    part = np.arange(gradient.size) if free is None else np.flatnonzero(free)
    own = Equalities(equalities.values, equalities.jacobian[:, part])
    step, (block, reach) = np.zeros(gradient.size), (full[np.ix_(part, part)], problem.reach[part])
    step[part], multipliers, definite = solve_composite(gradient[part], block, own, room.of(part), reach, radius)
    slope = float(gradient.dot(step))
    reduction = -(slope + 0.5 * float(step.dot(full.dot(step))))
    regular = definite and free is None and state.point.is_interior and not state.careful
    return Direction(step, slope, reduction, regular, radius, False, multipliers, equalities.predict(step))


def _room(problem: Problem, state: State, sides: IntArray, piece: Piece | None) -> tuple[Room, BoolArray | None]:
    """Return where the step may go, inside the constraints and the piece and to the given sides of kinks.

    The second result are the unknowns that may move at all, (d,) of bool; None if all may.
    """
    point, constraints = state.point, problem.constraints
    room = Room.around(constraints, point.slack)
    lower, upper = room.bounds
    # Rows that hold up to rounding hold exactly in the programme.
    if point.active.size:
        room.lower[point.active[point.active < constraints.b.size]] = 0.0
    if piece is not None:
        lower[:] = np.minimum(piece[0] - point.theta, 0.0)
        upper[:] = np.maximum(piece[1] - point.theta, 0.0)
    if point.kink is None and point.idle is None and constraints.movable.all():
        return room, None
    free = constraints.movable if point.idle is None else constraints.movable & ~point.idle
    if point.kink is not None:
        lower[point.kink & (sides > 0)] = 0.0
        upper[point.kink & (sides < 0)] = 0.0
        free = ~(point.kink & (sides == 0)) & free
    return room, None if free.all() else free


def _descends(problem: Problem, hessian: Hessian, free: BoolArray | None) -> bool:
    """Return whether the step is one of steepest descent."""
    if problem.hessian != "descent-first":
        return not problem.uses_hessian
    kept = (hessian if free is None else hessian.keep(free)[0]).dense()
    return kept.size > 0 and not is_definite(kept)


#: Factors by which the radius falls after a step that the model misjudged, and grows after one that it judged well.
SHRINK, GROW = 0.25, 2.0
#: The first of them where there are equality constraints.
CONSTRAINED_SHRINK = 0.5
#: Ratios of the actual to the predicted reduction below and above which it does so.
POOR, GOOD = 0.25, 0.75
MAX_BACKTRACKS = 60


def measure_in_box(problem: Problem, step: FloatArray) -> float:
    """Return the radius of the smallest box that holds a step (d,)."""
    return algebra.largest(np.abs(step) / problem.reach)


def _shrink(problem: Problem) -> float:
    return CONSTRAINED_SHRINK if problem.equalities else SHRINK


def next_radius(problem: Problem, direction: Direction, decrease: float, predicted: float, noise: float) -> float:
    """Return the radius that follows an accepted step, from the actual and the predicted decrease and their error."""
    radius = direction.radius
    if predicted <= noise or not problem.has_region:
        return radius
    ratio = decrease / predicted
    if ratio < POOR:
        return min(radius, _shrink(problem) * measure_in_box(problem, direction.step))
    grows = ratio > GOOD and radius < math.inf and measure_in_box(problem, direction.step) > 0.9 * radius
    return GROW * radius if grows else radius


#: Halvings of a step of the steepest descent, whose first length knows nothing of the curvature.
MAX_HALVINGS = 200
#: Iterations after which a step that fails in a trust region is followed by one more before the region shrinks.
PATIENCE = 15
#: Jumps of a derivative larger than this part of the largest derivative are not integration errors.
LARGE_JUMP = 1e-6


def search(oracle: Oracle, state: State, direction: Direction) -> Accepted | None:
    """Return a step that decreases J: across breakpoints if that works, otherwise inside the present smooth piece.

    With equality constraints, one that decreases the merit function.
    """
    problem, theta = oracle.problem, state.point.theta
    if problem.has_region:
        return _search_in_region(oracle, state, direction)
    if direction.descends:
        return _descend(oracle, state, direction)
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


def _search_in_region(oracle: Oracle, state: State, direction: Direction) -> Accepted | None:
    """Shrink the trust region until the step of the programme in it is accepted."""
    problem, point, whole, piece = oracle.problem, state.point, direction.step, None
    constrained = bool(problem.equalities)
    for k in range(MAX_BACKTRACKS):
        crossed = problem.breakpoints.count_crossed(point.theta, direction.step)
        state = state._replace(penalty=raise_penalty(state.penalty, point, direction))
        fraction = algebra.ARMIJO_ACROSS if crossed else algebra.ARMIJO
        accepted = _attempt(oracle, state, direction, 1.0, fraction, correcting=constrained and k == 0)
        # A narrow curved valley makes full steps fail again and again; only long minimizations are in one.
        if accepted is None and k == 0 and state.iteration >= PATIENCE and not constrained:
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
            radius = _shrink(problem) * length
        direction = find_direction(problem, state._replace(radius=radius), piece)
    return None


def _is_hopeless(state: State, direction: Direction, k: int, alpha: float = 1.0) -> bool:
    """Return whether the slope promises a decrease that J cannot show, after k steps that failed."""
    return k > 6 and alpha * -direction.slope < 0.01 * algebra.NOISE * abs(state.point.cost)


def _step_back(oracle: Oracle, state: State, direction: Direction) -> Accepted | None:
    """Take one more step from where a step has failed: in a curved valley it leads back to the valley's floor ([4]_).

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


def _descend(oracle: Oracle, state: State, direction: Direction) -> Accepted | None:
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
    oracle: Oracle, state: State, direction: Direction, alpha: float, fraction: float, correcting: bool = False
) -> Accepted | None:
    """Return the point at step length alpha if it is acceptable, or after a second-order correction."""
    problem, theta = oracle.problem, state.point.theta
    # A trial is evaluated with the multipliers of its step, so that its Hessian is that of the Lagrangian there.
    oracle.multipliers = direction.multipliers
    there = move(problem, theta, direction.step if alpha == 1.0 else alpha * direction.step, state.scale)
    first = None if there.is_at(theta) else oracle.first(there)
    found = _judge(oracle, state, direction, there, first, alpha, fraction)
    if first is None or found is not None or not correcting:
        return found
    moved = correct(oracle, there, first, state.scale)
    # What is longer than the step that it is to correct corrects nothing.
    length = measure_in_box(problem, there.theta - theta)
    if moved is None or not measure_in_box(problem, moved.theta - there.theta) < length:
        return None
    return _judge(oracle, state, direction, moved, oracle.first(moved), alpha, fraction)


def measure_merit(sample: Sample, state: State) -> float:
    """Return the merit function, which is J where there are no equality constraints."""
    return sample.cost + state.penalty * sample.violation


def _judge(
    oracle: Oracle, state: State, direction: Direction, there: Trial, first: Sample | None, alpha: float, part: float
) -> Accepted | None:
    """Return the point of a trial that decreases the merit function by a part of what is predicted.

    Where the predicted decrease is below the rounding error, comparing costs says nothing ([2]_): then the residuals of
    the optimality conditions have to fall, or a cost is below every earlier one.
    """
    if first is None:
        return None
    point, penalty, constrained = state.point, state.penalty, bool(oracle.problem.equalities)
    merit, before = measure_merit(first, state), measure_merit(point.plus, state)
    noise = algebra.NOISE * (abs(point.cost) + penalty * point.violation)
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


#: Part of the decrease of ``mu ‖c‖`` that the decrease of the model has to be, rho of [1]_, (18.36).
SHARE = 0.1
#: Factor by which the penalty is raised beyond what is needed, so that the next step does not raise it again.
RAISED = 1.1
#: Radius of the trust region below which violated constraints count as stuck.
SMALLEST_RADIUS = 1e-10
#: Iterations in which the violation has to change by a tenth: with 6 to 40 of them as many fits end right.
STAGNANT = 10
#: Part of the violation that a step has to leave, by the linearized constraints, for constraints to count as stuck.
FALL = 0.9


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


def is_below_rounding(oracle: Oracle, state: State, direction: Direction) -> bool:
    """Return whether the decrease that a step still promises is below the rounding error of J.

    This error is a part of J or, where J is a small difference of large terms, as at a perfect fit, more. The largest J
    seen is a bound on it, which says little where the start was far away: between the two the error is measured, as
    standard deviation along the step. Differences of the fourth order of a smooth J at equal distances vanish, those of
    its error do not ([3]_). A jump or a kink makes them large too; it is on one side of the point, so that the smaller
    of both sides counts.
    """
    smallest, largest = 10 * algebra.NOISE * abs(state.point.cost), 10 * algebra.NOISE * state.cost_scale
    if not smallest < direction.reduction <= largest:
        return direction.reduction <= smallest
    found, step = [np.inf], direction.step
    for side in (1.0, -1.0):
        trials = [move(oracle.problem, state.point.theta, side * k / 8 * step, state.scale) for k in range(9)]
        samples = [sample for trial in trials if (sample := oracle.first(trial)) is not None]
        if len(samples) == 9:
            values = [sample.lagrangian(state.point.forces)[0] for sample in samples]
            found.append(math.sqrt(float(np.mean(np.diff(values, 4) ** 2)) / 70))  # 70 = 8! / (4!)²
    return direction.reduction <= 10 * min(found)


class _Place(NamedTuple):
    """J, its slope and its gradient (d,) at a fraction of a step; cost and slope are infinite where not finite."""

    fraction: float
    theta: FloatArray
    cost: float
    slope: float
    gradient: FloatArray

    def excess(self, before: _Place) -> float:
        """Return by how much J rises from a place before this one more than its slopes at both say."""
        return self.cost - before.cost - 0.5 * (self.fraction - before.fraction) * (before.slope + self.slope)


class _Line(NamedTuple):
    """J along a step (d,), and its rounding error; with equality constraints, the Lagrangian."""

    oracle: Oracle
    state: State
    step: FloatArray
    noise: float

    def see(self, fraction: float) -> _Place:
        """Evaluate J at a fraction of the step; at its begin J is known, on the sides of kinks to which it leads."""
        point = self.state.point
        theta = point.theta + fraction * self.step
        sample = self.oracle.sample(theta, 1) if fraction else point.plus
        if sample is None:
            return _Place(fraction, theta, np.inf, np.inf, self.step)
        cost, gradient = sample.lagrangian(point.forces)
        if not fraction:
            gradient = algebra.mix_sides(gradient, point.minus.lagrangian(point.forces)[1], self.step)
        return _Place(fraction, theta, cost, float(gradient @ self.step), gradient)

    def jumps(self, low: _Place, high: _Place) -> bool:
        """Return whether J rises between two places by more than its slopes explain."""
        return high.cost < np.inf and abs(high.excess(low)) > 10 * self.noise

    def bends(self, low: _Place, high: _Place) -> bool:
        """Return whether the slope of J rises between two places by more than a part of what it was at the begin."""
        return high.slope - low.slope > DISAGREES * max(abs(self.see(0.0).slope), abs(low.slope))


#: Part of its distance, and of the step, within which a jump or a kink is located.
LOCATED, SHORTEST = 2.0**-40, 2.0**-60
#: Fractions of the step over which differences of J are taken.
LENGTHS = 10.0 ** -np.arange(1, 6)
#: A slope is wrong where differences of J contradict it by more than this part of it, beyond their own error.
DISAGREES = 0.1
#: Number of unknowns that are named at most.
NAMED = 4


@one_thread()
def explain_failure(oracle: Oracle, state: State, direction: Direction) -> Finding:
    """Find out why no fraction of a step decreases J although its slope is negative."""
    step, noise = direction.step, algebra.NOISE * max(abs(state.point.cost), 0.01 * state.cost_scale)
    line = _Line(oracle, state, step, noise)
    begin = line.see(0.0)
    if not begin.slope < 0.0:
        return Finding("rounding", {"noise": noise})
    low, high = _locate_rise(line)
    if line.jumps(low, high):
        return Finding("jump", {"before": low.cost, "after": high.cost}, _who_jumps(line, low, high))
    # After the jump: differences across one contradict a slope that is right between jumps.
    measured = _contradict_slope(line)
    if measured is not None:
        return Finding("wrong slope", {"before": begin.slope, "after": measured})
    if high.cost == np.inf:
        return Finding("not finite", {}, _list_places(np.flatnonzero(step), high))
    if line.bends(low, high):
        change = np.abs((high.gradient - low.gradient) * step)
        bent = np.flatnonzero(change > 0.1 * change.max())[:NAMED]
        return Finding("kink", {"before": low.slope, "after": high.slope}, _list_places(bent, high))
    lost = begin.cost - low.cost <= noise and -0.5 * low.fraction * begin.slope <= noise
    return Finding("rounding", {"noise": noise}) if lost else Finding("valley", {})


def _list_places(coordinates: IntArray, place: _Place) -> tuple[tuple[int, float], ...]:
    return tuple((i, float(place.theta[i])) for i in coordinates.tolist())


def _locate_rise(line: _Line) -> tuple[_Place, _Place]:
    """Return a place at which J falls, and the next one at which it has risen; the begin twice if it nowhere rises.

    They are as near to each other as makes no difference where J jumps or bends between them, or is not finite from
    there on; where it is smooth, their slopes are nearly equal.
    """
    low = high = begin = line.see(0.0)
    # From the shortest length, a power of 1/64, from which on J is larger.
    for k in range(10):
        there = line.see(64.0**-k)
        if there.cost <= low.cost + line.noise:
            break
        high = there
    while high.fraction - low.fraction > max(LOCATED * high.fraction, SHORTEST):
        if high.cost < np.inf and not line.jumps(low, high) and not line.bends(low, high):
            break
        middle = line.see(0.5 * (low.fraction + high.fraction))
        rises = middle.cost > begin.cost + line.noise or middle.slope >= 0.0
        low, high = (low, middle) if rises else (middle, high)
    return low, high


def _who_jumps(line: _Line, low: _Place, high: _Place) -> tuple[tuple[int, float], ...]:
    """Find the coordinate whose change across a jump of J makes it jump alone, and its value there.

    Up to four coordinates that the step moves, where none of them does so alone.
    """
    moving = np.flatnonzero(line.step)
    for i in moving[low.theta[moving] != high.theta[moving]].tolist():
        moved = np.where(np.arange(line.step.size) == i, high.theta, low.theta)
        sample = line.oracle.sample(moved, 1)
        cost = low.cost if sample is None else sample.lagrangian(line.state.point.forces)[0]
        if abs(cost - low.cost) > 0.5 * abs(high.cost - low.cost):
            return ((i, float(high.theta[i])),)
    return _list_places(moving[:NAMED], high)


def _contradict_slope(line: _Line) -> float | None:
    """Return what differences of J say in place of its slope at the begin, if they contradict it; None if not.

    They have to contradict the slopes farther on as well: at a kink within the shortest difference they do not.
    """
    begin, values, errors, farther = line.see(0.0), [], [], []
    # J is smooth, if it is what it is said to be, up to the next breakpoint or bound.
    low, high = line.oracle.problem.breakpoints.piece(begin.theta, line.oracle.problem.constraints)
    moving = np.flatnonzero(line.step)
    parts = (np.where(line.step > 0.0, high, low) - begin.theta)[moving] / line.step[moving]
    smooth = np.min(parts, where=parts > 0.0, initial=1.0)
    for length in LENGTHS * smooth:
        half, full = line.see(0.5 * length), line.see(length)
        if max(half.cost, full.cost) < np.inf:
            values.append((4 * half.cost - 3 * begin.cost - full.cost) / length)
            errors.append(8 * line.noise / length)
            farther.append(abs(full.excess(half)) / (0.5 * length))
    if len(values) < 2:
        return None
    spread = np.abs(np.diff(values)) + np.array(errors[1:])
    best = int(np.argmin(spread)) + 1
    error = 2 * spread[best - 1] + DISAGREES * max(abs(begin.slope), abs(values[best]))
    return values[best] if min(abs(values[best] - begin.slope), farther[best]) > error else None
