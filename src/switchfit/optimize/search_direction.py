"""Search direction of an iteration: the solution of a convex quadratic programme in the step.

Its matrix is the exact Hessian, made positive definite only in the subspace where it has to be (Newton), its blocks,
Gauss-Newton's matrix, or a multiple of the identity (steepest descent). It starts from the sides of the steepest
descent, so that its step descends wherever the optimality is positive. With equality constraints the step is composed
of a normal and a tangential one (`composite_step`).

In a trust region the programme has a box around the point as additional bounds; `trust_region` says when there is one.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from switchfit.arrays import BoolArray, FloatArray, IntArray
from switchfit.optimize import algebra
from switchfit.optimize.arrow import Hessian
from switchfit.optimize.composite_step import find_normal_step, solve_composite
from switchfit.optimize.dense import Dense
from switchfit.optimize.equalities import Equalities
from switchfit.optimize.linear_constraints import NO_PLACES
from switchfit.optimize.minimization_problem import MinimizationProblem
from switchfit.optimize.point import MET
from switchfit.optimize.positive_definite import is_definite
from switchfit.optimize.qp import Room
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


class SearchDirection(NamedTuple):
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


def find_direction(problem: MinimizationProblem, state: State, piece: Piece | None = None) -> SearchDirection:
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


def _solve_on_sides(
    problem: MinimizationProblem, state: State, sides: IntArray, piece: Piece | None
) -> SearchDirection:
    """Solve the quadratic programme with kinks held or confined as `sides` say.

    Its matrix B is H made positive definite where it is not, inside the room and the trust region.
    """
    constraints, point, d = problem.constraints, state.point, len(problem.size)
    gradient, hessian = point.derivatives(sides)
    room, free = _room(problem, state, sides, piece)
    if problem.equalities:
        return _solve_constrained(problem, state, sides, room, free)
    # After a failed line search each unknown is taken by itself.
    # With the diagonal alone each unknown moves by its own curvature: a Hessian whose off-diagonal entries are wrong,
    # as beside a jump that is no breakpoint, couples nothing then.
    labels = np.arange(d, dtype=float) if state.careful else problem.labels
    # Curvature of each unknown that counts as none.
    floor = algebra.curvature_floor(state.scale, state.cost_scale, point.largest_slopes)
    matrix: Any = hessian  # a full matrix or an arrow, each of which solves with the factor that it has returned itself
    descends = _descends(problem, hessian, free)
    if descends:
        matrix, floor = Dense(np.eye(d) / state.metric), np.zeros(d)
    elif labels is not None:
        matrix = hessian.mask(labels)
    # Expected to be active: those with a multiplier at this point.
    pressed = constraints.normals[point.multipliers > 0.0 if point.active.size else slice(0)]
    kept, part, own, reach = matrix, NO_PLACES, gradient, problem.reach
    if free is not None:
        # All unknowns are fixed by their bounds, or held at kinks: a minimum, or one that the multipliers will release.
        if not free.any():
            return SearchDirection(np.zeros(d), 0.0, 0.0, False, state.radius, descends)
        # What is held is left out, or decoupled.
        kept, part = matrix.keep(free)
        own, pressed, floor = (gradient * free)[part], (pressed * free)[:, part], (floor * free)[part]
        room, reach = room.of(part, free), reach[part]
    convex, factor = kept.convexify(pressed, floor, reach if problem.hessian == "auto" else None)
    definite, radius = convex is kept, state.radius
    # As long as H is positive definite and its steps succeed, no box is in the way, and the fit of a good guess is
    # plain Newton. The first indefinite H brings the region about.
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
    return SearchDirection(step, slope, -(slope + 0.5 * curvature), regular, radius, descends)


def _solve_constrained(
    problem: MinimizationProblem, state: State, sides: IntArray, room: Room, free: BoolArray | None
) -> SearchDirection:
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
    return SearchDirection(step, slope, reduction, regular, radius, False, multipliers, equalities.predict(step))


def _room(
    problem: MinimizationProblem, state: State, sides: IntArray, piece: Piece | None
) -> tuple[Room, BoolArray | None]:
    """Return where the step may go, inside the constraints and the piece and to the given sides of kinks.

    The second result are the unknowns that may move at all, (d,) of bool; None if all may.
    """
    point, constraints = state.point, problem.constraints
    room = Room.around(constraints, point.slack)
    lower, upper = room.bounds
    # Rows that hold up to rounding hold exactly in the programme.
    if point.active.size:
        # A slack of an ulp would let the step go there, and the next one again: each iteration would end at the same
        # row.
        room.lower[point.active[point.active < constraints.b.size]] = 0.0
    if piece is not None:
        # A step of zero stays feasible, for whatever rounding has done to theta.
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


def _descends(problem: MinimizationProblem, hessian: Hessian, free: BoolArray | None) -> bool:
    """Return whether the step is one of steepest descent."""
    if problem.hessian != "descent-first":
        return not problem.uses_hessian
    # Held coordinates do not move: whether H is positive definite along them does not matter.
    kept = (hessian if free is None else hessian.keep(free)[0]).dense()
    return kept.size > 0 and not is_definite(kept)
