"""The step of an iteration with equality constraints c(theta) = 0: towards them, and along them.

The quadratic programme with linearized constraints

    minimize  gᵀd + ½ dᵀHd   subject to   c + A d = 0,   N d >= offsets,   |d_i| <= radius reach_i

need not have a feasible point: the linearizations may contradict one another, the inequalities or the trust region. The
composite step of Byrd and Omojokun ([1]_, section 18.5, algorithm 18.4) asks of c + A d what can be had:

1. the *normal step* v minimizes ‖c + A v‖₂ within a part of the trust region and the inequalities;
2. the *tangential step* t minimizes the model within ``A t = 0``, the rest of the trust region and the inequalities.

With an orthonormal basis Z of the null space of A the second is a programme in w, t = Z w, of which w = 0 is a feasible
point, as `solve_qp` needs it; only ZᵀHZ has to be positive definite, and is shifted where it is not. Both are solved in
units of `reach`.

References
----------
.. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, chapters 15 and 18.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from switchfit.optimize import lapack
from switchfit.optimize.algebra import FloatArray, IntArray, largest, norm
from switchfit.optimize.matrix import factorize_rows, shift_to_positive, solve_in_bounds
from switchfit.optimize.qp import CholeskyFactor, newton_step, satisfies, solve_whitened

NORMAL_PART = 0.95
"""Part of the trust region in which the normal step has to stay; the rest is left for the tangential step."""

DEPENDENT = 1e-10
"""Rows of a Jacobian whose part across the others is below this part of the largest row depend on them."""

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
    """The factorization Aᵀ P = Q R of a Jacobian A (k, d), which may have dependent rows.

    Attributes
    ----------
    jacobian : array, shape (k, d)
    orthogonal : array, shape (d, d)
        Q.
    triangular : array, shape (d, k)
        R is its upper triangle; below it is what the factorization has left.
    order : array, shape (k,)
        P.
    rank : int
        Number of independent rows.
    """

    jacobian: FloatArray
    orthogonal: FloatArray
    triangular: FloatArray
    order: IntArray
    rank: int

    @classmethod
    def of(cls, jacobian: FloatArray) -> Rows:
        """Factorize a Jacobian (k, d), k > 0."""
        orthogonal, triangular, order = factorize_rows(jacobian)
        sizes = [abs(size) for size in triangular.diagonal().tolist()]
        least = DEPENDENT * sizes[0]
        return cls(jacobian, orthogonal, triangular, order, sum([size > least for size in sizes]))

    @property
    def null(self) -> FloatArray:
        """Orthonormal basis of the null space of A: (d, d - rank)."""
        return self.orthogonal[:, self.rank :]

    @property
    def _regular(self) -> FloatArray | None:
        k = len(self.order)
        return self.triangular[:k] if self.rank == k else None

    def solve(self, values: FloatArray) -> FloatArray:
        """Return the shortest v (d,) that minimizes ‖values + A v‖₂."""
        regular = self._regular
        if regular is None:
            return -np.asarray(np.linalg.lstsq(self.jacobian, values, rcond=DEPENDENT)[0])
        # A' P = Q R, so that A v = -c is R' (Q'v) = -P'c: the solution in the range of Q is the shortest.
        inside = lapack.dtrtrs(regular, values[self.order], trans=1)[0]
        return -np.asarray(self.orthogonal[:, : self.rank].dot(inside))

    def multipliers(self, force: FloatArray) -> FloatArray:
        """Return the lam (k,) that minimizes ‖force + Aᵀ lam‖₂ ([1]_, section 18.3), the shortest of them."""
        regular = self._regular
        if regular is None:
            return -np.asarray(np.linalg.lstsq(self.jacobian.T, force, rcond=DEPENDENT)[0])
        found = np.empty(len(self.order))
        found[self.order] = -lapack.dtrtrs(regular, self.orthogonal[:, : self.rank].T.dot(force))[0]
        return found


class Composite(NamedTuple):
    """A composite step.

    Attributes
    ----------
    step : array, shape (d,)
    inequalities : array, shape (m,)
        Multipliers of the inequalities; the trust region's are left out.
    multipliers : array, shape (k,)
        Of the equality constraints: ``g + H d + Aᵀ lam = Nᵀ inequalities``, as nearly as that can be had.
    definite : bool
        Whether H was positive definite as it is along the constraints.
    """

    step: FloatArray
    inequalities: FloatArray
    multipliers: FloatArray
    definite: bool


class Region(NamedTuple):
    """What does not change from point to point: the trust region at radius 1, and inequalities N in its units.

    Attributes
    ----------
    reach : array, shape (d,)
        Half-widths of the trust region.
    weight : array, shape (d, d)
        Their products, which take a Hessian to these units.
    normals : array, shape (m, d)
        N times `reach`.
    extents : array, shape (m,)
        How far the region extends along each of them.
    """

    reach: FloatArray
    weight: FloatArray
    normals: FloatArray
    extents: FloatArray

    @classmethod
    def of(cls, normals: FloatArray, reach: FloatArray) -> Region:
        """Return the region of inequalities N (m, d) and half-widths (d,)."""
        scaled = normals * reach
        return cls(reach, reach[:, None] * reach, scaled, np.abs(scaled).sum(1))


def solve_composite(
    gradient: FloatArray,
    hessian: FloatArray,
    equalities: Equalities,
    region: Region,
    offsets: FloatArray,
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
    region : Region
    offsets : array, shape (m,)
        ``N d >= offsets``, offsets not positive.
    radius : float
        No unknown moves by more than ``radius * reach``.
    """
    if not gradient.size:
        return Composite(gradient, np.zeros(len(offsets)), np.zeros(len(equalities.values)), True)
    reach = region.reach
    # Units of `reach`: the trust region is the cube |d_i| <= radius, and unlike unknowns have comparable lengths.
    slope, bending = gradient * reach, hessian * region.weight
    scaled = Equalities(equalities.values, equalities.jacobian * reach)
    rows = Rows.of(scaled.jacobian)
    # A row of the inequalities that the whole trust region satisfies is left out.
    kept = (region.extents * radius > -offsets).nonzero()[0]
    within, room = region.normals[kept], offsets[kept]
    # v, within NORMAL_PART of the region; then t in the null space of A, from the slope g + H v of the model at its
    # end.
    step = _find_normal_step(scaled, rows, within, room, NORMAL_PART * radius)
    pressing, definite, force = None, True, slope + bending.dot(step)
    if rows.rank < step.size:
        least = FLAT * largest(np.abs(slope)) + TINY
        along, pressing, definite = _find_tangential_step(force, bending, rows.null, least, step, within, room, radius)
        step = step + along
        force = slope + bending.dot(step)
    inequalities = np.zeros(len(offsets))
    # Multipliers come in the order: inequalities, lower faces of the cube, upper faces. What all of these exert is
    # taken off before the rest is balanced by lam: g + H d - N' mu + A' lam = 0 in the least-squares sense.
    if pressing is not None:
        count, d = len(room), step.size
        force -= within.T.dot(pressing[:count]) + pressing[count : count + d] - pressing[count + d :]
        inequalities[kept] = pressing[:count]
    return Composite(step * reach, inequalities, rows.multipliers(force), definite)


def _find_tangential_step(
    slope: FloatArray,
    bending: FloatArray,
    null: FloatArray,
    least: float,
    normal: FloatArray,
    within: FloatArray,
    room: FloatArray,
    radius: float,
) -> tuple[FloatArray, FloatArray | None, bool]:
    """Return the tangential step (d,), and the multipliers of the inequalities and the trust region, (m + 2 d,).

    These are None where none of them presses. The third result is `Composite.definite`. Everything is in units in which
    the trust region is a cube; `slope` is that of the model at the end of the normal step, `null` a basis of the null
    space, `least` the least curvature.
    """
    # The programme in w, t = Z w: matrix Z'H Z, slope Z'(g + H v), with w = 0 feasible because v is.
    (matrix, definite), slope = shift_to_positive(null.T.dot(bending).dot(null), least), null.T.dot(slope)
    factor = CholeskyFactor.of(matrix)
    newton = newton_step(slope, matrix, factor)
    step = null.dot(newton)
    left = np.minimum(room - within.dot(normal), 0.0)
    if largest(np.abs(normal + step)) <= radius and satisfies(within, step, left):
        return step, None, definite
    # N Z w >= offsets - N v, and -radius <= v + Z w <= radius.
    inside = np.concatenate([within.dot(null), null, -null])
    left = np.concatenate([left, -radius - normal, normal - radius])
    found, multipliers = solve_whitened(slope, matrix, factor, inside, np.minimum(left, 0.0))
    return null.dot(found), multipliers, definite


def find_normal_step(equalities: Equalities, region: Region, offsets: FloatArray, radius: float) -> FloatArray:
    """Return the v (d,) that minimizes ‖c + A v‖₂ in a trust region; arguments as of `solve_composite`."""
    scaled = Equalities(equalities.values, equalities.jacobian * region.reach)
    kept = (offsets > -np.inf).nonzero()[0]
    rows = Rows.of(scaled.jacobian)
    return _find_normal_step(scaled, rows, region.normals[kept], offsets[kept], radius) * region.reach


def _find_normal_step(
    equalities: Equalities, rows: Rows, normals: FloatArray, offsets: FloatArray, radius: float
) -> FloatArray:
    """Return the v of `find_normal_step` in units in which the trust region is a cube."""
    shortest = rows.solve(equalities.values)
    if largest(np.abs(shortest)) <= radius and satisfies(normals, shortest, offsets):
        return shortest
    A, d = equalities.jacobian, shortest.size
    # The minimum of ||c + A v||^2 / 2 in the region: A'A is singular wherever constraints are fewer than unknowns.
    matrix = A.T.dot(A)
    matrix.reshape(-1)[:: d + 1] += RIDGE * max(float(matrix.trace()) / d, TINY)
    slope = A.T.dot(equalities.values)
    inside, left = normals, np.minimum(offsets, 0.0)
    if radius < np.inf:
        left = np.concatenate([left, np.full(2 * d, -radius)])
        # Where the rows cut off the nearest step in the cube, more than the cube presses: of 340 such programmes of the
        # pendulum that bounds alone were to solve, 2 have been.
        if satisfies(normals, np.minimum(np.maximum(shortest, -radius), radius), offsets):
            found = solve_in_bounds(slope, matrix, shortest, normals, left)
            if found is not None:
                return found[0]
        identity = np.eye(d)
        inside = np.concatenate([normals, identity, -identity])
    return solve_whitened(slope, matrix, CholeskyFactor.of(matrix), inside, left)[0]
