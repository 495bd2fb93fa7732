"""The step of an iteration with equality constraints c(theta) = 0: towards them, and along them.

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

from typing import NamedTuple

import numpy as np

from switchfit.optimize.algebra import FloatArray, largest, norm
from switchfit.optimize.matrix import shift_to_positive
from switchfit.optimize.qp import CholeskyFactor, Room, solve_programme

NORMAL_PART = 0.95
"""Part of the trust region in which the normal step has to stay; the rest is left for the tangential step."""

DEPENDENT = 1e-10
"""Rows of a Jacobian are dependent where a singular value is below this part of the largest one."""

FLAT = 1e-8
"""Curvature that counts as none, as a part of the largest slope: where J is linear, the trust region ends the step."""

TINY = float(np.finfo(float).tiny)

RIDGE = 1e-12
"""Part of the mean curvature of ½‖c + A v‖² that is added to all directions, to make the shortest of all v the
solution."""


class Equalities(NamedTuple):
    """Equality constraints at a point: values c, (k,), and Jacobian A, (k, d)."""

    values: FloatArray
    jacobian: FloatArray

    @property
    def violation(self) -> float:
        """‖c‖₂."""
        return norm(self.values)

    def predict(self, step: FloatArray) -> float:
        """Return ‖c + A d‖₂ for a step d (d,)."""
        return norm(self.values + self.jacobian.dot(step))


class Rows(NamedTuple):
    """The singular value decomposition A = U S Vᵀ of a Jacobian A (k, d), which may have dependent rows.

    Attributes
    ----------
    left, sizes, right : arrays, shape (k, r), (r,), (d, r)
        U, the diagonal of S, and V, for the r singular values that count.
    null : array, shape (d, d - r)
        Orthonormal basis of the null space of A.
    """

    left: FloatArray
    sizes: FloatArray
    right: FloatArray
    null: FloatArray

    @classmethod
    def of(cls, jacobian: FloatArray) -> Rows:
        """Decompose a Jacobian (k, d), k > 0."""
        left, sizes, right = np.linalg.svd(jacobian)
        rank = np.count_nonzero(sizes > DEPENDENT * sizes[0])
        return cls(left[:, :rank], sizes[:rank], right[:rank].T, right[rank:].T)

    def solve(self, values: FloatArray) -> FloatArray:
        """Return the shortest v (d,) that minimizes ‖values + A v‖₂."""
        return -np.asarray(self.right.dot(self.left.T.dot(values) / self.sizes))

    def multipliers(self, force: FloatArray) -> FloatArray:
        """Return the lam (k,) that minimizes ‖force + Aᵀ lam‖₂ ([1]_, section 18.3), the shortest of them."""
        return -np.asarray(self.left.dot(self.right.T.dot(force) / self.sizes))


class Composite(NamedTuple):
    """A composite step.

    Attributes
    ----------
    step : array, shape (d,)
    multipliers : array, shape (k,)
        Of the equality constraints: ``g + H d + Aᵀ lam`` is what the inequalities exert, as nearly as that can be had.
    definite : bool
        Whether H was positive definite as it is along the constraints.
    """

    step: FloatArray
    multipliers: FloatArray
    definite: bool


def solve_composite(
    gradient: FloatArray,
    hessian: FloatArray,
    equalities: Equalities,
    room: Room,
    reach: FloatArray,
    radius: float,
) -> Composite:
    """Return the composite step.

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
    """
    d = gradient.size
    if not d:
        return Composite(gradient, np.zeros(len(equalities.values)), True)
    # Units of `reach`: the trust region is the cube |d_i| <= radius, and unlike unknowns have comparable lengths.
    slope, bending = gradient * reach, hessian * (reach[:, None] * reach)
    scaled, room = Equalities(equalities.values, equalities.jacobian * reach), _scale_room(room, reach)
    rows = Rows.of(scaled.jacobian)
    # v, within NORMAL_PART of the region; then t in the null space of A, from the slope g + H v of the model at its
    # end.
    step = _find_normal_step(scaled, rows, room, NORMAL_PART * radius)
    pull, definite, force = np.zeros(len(room.lower)), True, slope + bending.dot(step)
    if rows.null.size:
        least = FLAT * largest(np.abs(slope)) + TINY
        cube = room.narrow(np.full(d, radius))
        step, pull, definite = _add_tangential_step(force, bending, rows.null, least, step, cube)
        force = slope + bending.dot(step)
    # What the inequalities exert is taken off before the rest is balanced by lam: g + H d - N' mu + A' lam = 0 in the
    # least-squares sense.
    multipliers = rows.multipliers(force - room.normals.T.dot(pull))
    return Composite(step * reach, multipliers, definite)


def _scale_room(room: Room, reach: FloatArray) -> Room:
    """Return a room in units of `reach` (d,)."""
    unit = np.concatenate([np.ones(len(room.normals) - reach.size), reach])
    return Room(room.normals * (reach / unit[:, None]), room.lower / unit, room.upper / unit)


def _add_tangential_step(
    slope: FloatArray, bending: FloatArray, null: FloatArray, least: float, normal: FloatArray, cube: Room
) -> tuple[FloatArray, FloatArray, bool]:
    """Return the sum of normal and tangential step (d,), and what presses as of `solve_programme`, (m + d,).

    The third result is `Composite.definite`. Everything is in units in which the trust region is a cube; `slope` is
    that of the model at the end of the normal step, `null` a basis of the null space, `least` the least curvature.
    """
    # The programme in w, t = Z w: matrix Z'H Z, slope Z'(g + H v), with w = 0 feasible because v is.
    (matrix, definite), slope = shift_to_positive(null.T.dot(bending).dot(null), least), null.T.dot(slope)
    # What bounds v + Z w bounds w by rows alone.
    products, free = cube.normals.dot(normal), np.full(slope.size, np.inf)
    lower = np.concatenate([np.minimum(cube.lower - products, 0.0), -free])
    upper = np.concatenate([np.maximum(cube.upper - products, 0.0), free])
    inside = Room(np.concatenate([cube.normals.dot(null), np.eye(slope.size)]), lower, upper)
    found, pull = solve_programme(slope, matrix, CholeskyFactor.of(matrix), inside)
    pull = pull[: -slope.size]
    return cube.press(normal + null.dot(found), pull), pull, definite


def find_normal_step(equalities: Equalities, room: Room, reach: FloatArray, radius: float) -> FloatArray:
    """Return the v (d,) that minimizes ‖c + A v‖₂ in a trust region; arguments as of `solve_composite`."""
    scaled = Equalities(equalities.values, equalities.jacobian * reach)
    return _find_normal_step(scaled, Rows.of(scaled.jacobian), _scale_room(room, reach), radius) * reach


def _find_normal_step(equalities: Equalities, rows: Rows, room: Room, radius: float) -> FloatArray:
    """Return the v of `find_normal_step` in units in which the trust region is a cube."""
    shortest, d = rows.solve(equalities.values), equalities.jacobian.shape[1]
    cube = room.narrow(np.full(d, radius))
    if cube.holds(shortest):
        return shortest
    # The minimum of ||c + A v||^2 / 2 in the region: A'A is singular wherever constraints are fewer than unknowns.
    A = equalities.jacobian
    matrix = A.T.dot(A)
    matrix.reshape(-1)[:: d + 1] += RIDGE * max(float(matrix.trace()) / d, TINY)
    return solve_programme(A.T.dot(equalities.values), matrix, CholeskyFactor.of(matrix), cube)[0]
