"""The direction of an iteration, a convex quadratic programme in the step, and the trust region around the point.

Its matrix is the exact Hessian, made positive definite only in the subspace where it has to be (Newton), its blocks,
Gauss-Newton's matrix, or a multiple of the identity (steepest descent). By default the step stays inside a trust region
where the Hessian is not positive definite. It starts from the sides of the steepest descent, so that its step
descends wherever the optimality is positive.

The trust region: a box around the point, in which the quadratic model of the cost is trusted.

Far from the solution the Hessian is often indefinite. Where eigenvalues are replaced by their absolute values, a line
search along the step goes far in directions in which the model says nothing. Inside a trust region the Hessian is
shifted instead, in the metric of the region, until it is positive definite ([1]_, section 4.3), and no unknown moves
further than a radius times its `reach`. The radius follows from how well the model predicted the last step ([1]_,
algorithm 4.1). The region is a box, for then it adds nothing but bounds to the quadratic programme. As long as the
Hessian is positive definite and its steps succeed, there is no box.

References
----------
.. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, chapter 4.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from switchfit.optimize import algebra
from switchfit.optimize.algebra import BoolArray, FloatArray, IntArray
from switchfit.optimize.matrix import Dense, Hessian
from switchfit.optimize.point import MET
from switchfit.optimize.problem import Problem
from switchfit.optimize.qp import NONE, Equalities, Room, find_normal_step, is_definite, solve_composite
from switchfit.optimize.state import State

FIRST_RADIUS = 1.0
"""Radius of the first trust region."""

FIRST_CONSTRAINED_RADIUS = 5.0
"""The same where there are equality constraints, with which there always is one. The bed of poor starts is indifferent
to it between 5 and 40."""

Piece = tuple[FloatArray, FloatArray]
"""Bounds of the smooth piece around a point: (d,), (d,)."""

HALF = 0.5
"""Part of the violation of equality constraints that a step may leave while coordinates are held at kinks."""


NO_MULTIPLIERS: FloatArray = np.zeros(0)


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
    multipliers: FloatArray = NO_MULTIPLIERS
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
    constraints, point, d = problem.constraints, state.point, problem.constraints.size
    gradient, hessian = point.derivatives(sides)
    room, free = _room(problem, state, sides, piece)
    if problem.equalities:
        return _solve_constrained(problem, state, sides, room, free)
    # After a failed line search each unknown is taken by itself.
    labels = np.arange(d, dtype=float) if state.careful else problem.labels
    # Curvature of each unknown that counts as none.
    floor = algebra.curvature_floor(state.scale, state.cost_scale, point.largest_slopes)
    matrix, descends = hessian, _descends(problem, hessian, free)
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
    convex: Hessian
    factor: Any
    convex, factor = kept.convexify(pressed, floor, reach if problem.has_box else None)
    definite, radius = convex is kept, state.radius
    if problem.has_box and radius == np.inf and not definite:
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
    if point.kink is None and point.idle is None and constraints.all_movable:
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


def shrink_region(
    problem: Problem, state: State, direction: Direction, piece: Piece | None
) -> tuple[Direction, Piece | None]:
    """Return the direction after one that failed: in a smaller trust region, and the smooth piece that it keeps to.

    A step that failed across few breakpoints is tried in the present smooth piece before the region shrinks.
    """
    theta, radius = state.point.theta, direction.radius
    if piece is None and 0 < problem.breakpoints.count_crossed(theta, direction.step) < algebra.MANY_BREAKPOINTS:
        piece = problem.breakpoints.piece(theta, problem.constraints)
    else:
        radius = _shrink(problem) * measure_in_box(problem, direction.step)
    return find_direction(problem, state._replace(radius=radius), piece), piece
