"""The step with equality constraints c(theta) = 0: a normal step towards them, and a tangential step along them.

The quadratic programme with linearized constraints

    minimize  gᵀd + ½ dᵀHd   subject to   c + A d = 0,   N d >= offsets,   |d_i| <= radius reach_i

need not have a feasible point: the linearizations may contradict one another, the inequalities or the trust region. The
composite step of Byrd and Omojokun ([1]_, section 18.5, algorithm 18.4) asks of c + A d what can be had:

1. the *normal step* v minimizes ‖c + A v‖₂ within a part of the trust region and the inequalities;
2. the *tangential step* t minimizes the model within ``A t = 0``, the rest of the trust region and the inequalities.

With an orthonormal basis Z of the null space of A the second is a programme in w, t = Z w, of which w = 0 is a feasible
point, as `solve_programme` needs it; only ZᵀHZ has to be positive definite, and is shifted where it is not. Both are
solved in units of `reach`.

References
----------
.. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, chapters 15 and 18.
"""

from __future__ import annotations

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.optimize import algebra
from switchfit.optimize.equalities import Equalities, JacobianSVD
from switchfit.optimize.positive_definite import CholeskyFactor, shift_to_positive
from switchfit.optimize.qp import Room, solve_in_span, solve_programme

NORMAL_PART = 0.95
"""Part of the trust region in which the normal step has to stay; the rest is left for the tangential step."""

FLAT = 1e-8
"""Curvature that counts as none, as a part of the largest slope: where J is linear, the trust region ends the step."""

TINY = float(np.finfo(float).tiny)

NORMAL_STEP_RIDGE = 1e-12
"""Part of the mean curvature of ½‖c + A v‖² that is added to all directions, to make the shortest of all v the
solution."""


def solve_composite(
    gradient: FloatArray, hessian: FloatArray, equalities: Equalities, room: Room, reach: FloatArray, radius: float
) -> tuple[FloatArray, FloatArray, bool]:
    """Find the composite step.

    Parameters
    ----------
    gradient : array, shape (d,)
        Of J.
    hessian : array, shape (d, d)
        Of the Lagrangian ``J + lam . c``.
    equalities : Equalities
    room : Room
        The inequalities.
    reach : array, shape (d,)
    radius : float
        No unknown moves by more than ``radius * reach``.

    Returns
    -------
    step : array, shape (d,)
    multipliers : array, shape (k,)
        Of the equality constraints: ``g + H d + Aᵀ lam`` is what the inequalities exert, as nearly as that can be had.
    definite : bool
        Whether H was positive definite as it is along the constraints.
    """
    d = gradient.size
    if not d:
        return gradient, np.zeros(len(equalities.values)), True
    # Units of `reach`: the trust region is the cube |d_i| <= radius, and unlike unknowns have comparable lengths.
    slope, bending = gradient * reach, hessian * (reach[:, None] * reach)
    scaled, room = Equalities(equalities.values, equalities.jacobian * reach), _scale_room(room, reach)
    rows = JacobianSVD.of(scaled.jacobian)
    # v, within NORMAL_PART of the region; then t in the null space of A, from the slope g + H v of the model at its
    # end.
    step = _find_normal_step(scaled, rows, room, NORMAL_PART * radius)
    # As many independent constraints as unknowns: the normal step is the whole step, Newton's for c = 0.
    pull, definite, force = np.zeros(len(room.lower)), True, slope + bending.dot(step)
    if rows.null.size:
        # The programme in w, t = Z w: matrix Z'H Z, slope Z'(g + H v), with w = 0 feasible because v is.
        least = FLAT * algebra.largest(np.abs(slope)) + TINY
        matrix, definite = shift_to_positive(rows.null.T.dot(bending).dot(rows.null), least)
        cube = room.narrow(np.full(d, radius))
        products = cube.normals.dot(step)
        lower, upper = np.minimum(cube.lower - products, 0.0), np.maximum(cube.upper - products, 0.0)
        tangential, pull = solve_in_span(force, matrix, rows.null, cube.normals, lower, upper)
        step = cube.press(step + tangential, pull)
        force = slope + bending.dot(step)
    # What the inequalities exert is taken off before the rest is balanced by lam: g + H d - N' mu + A' lam = 0 in the
    # least-squares sense.
    multipliers = rows.multipliers(force - room.normals.T.dot(pull))
    return step * reach, multipliers, definite


def _scale_room(room: Room, reach: FloatArray) -> Room:
    """Return a room in units of `reach` (d,)."""
    unit = np.concatenate([np.ones(len(room.normals) - reach.size), reach])
    return Room(room.normals * (reach / unit[:, None]), room.lower / unit, room.upper / unit)


def find_normal_step(equalities: Equalities, room: Room, reach: FloatArray, radius: float) -> FloatArray:
    """Return the v (d,) that minimizes ‖c + A v‖₂ in a trust region; arguments as of `solve_composite`."""
    scaled = Equalities(equalities.values, equalities.jacobian * reach)
    return _find_normal_step(scaled, JacobianSVD.of(scaled.jacobian), _scale_room(room, reach), radius) * reach


def _find_normal_step(equalities: Equalities, rows: JacobianSVD, room: Room, radius: float) -> FloatArray:
    """Return the v of `find_normal_step` in units in which the trust region is a cube."""
    shortest, d = rows.solve(equalities.values), equalities.jacobian.shape[1]
    cube = room.narrow(np.full(d, radius))
    # The usual case near the solution. Rows of A that depend on one another are no obstacle: the decomposition leaves
    # out what they repeat, and where they contradict each other the shortest least-squares solution is taken.
    if cube.holds(shortest):
        return shortest
    # The minimum of ||c + A v||^2 / 2 in the region: A'A is singular wherever constraints are fewer than unknowns.
    A = equalities.jacobian
    matrix = A.T.dot(A)
    matrix.reshape(-1)[:: d + 1] += NORMAL_STEP_RIDGE * max(float(matrix.trace()) / d, TINY)
    return solve_programme(A.T.dot(equalities.values), matrix, CholeskyFactor.of(matrix), cube)[0]
