"""Linear inequalities and bounds, strictly convex quadratic programmes, and steps with equality constraints.

Every quadratic programme here is strictly convex with a feasible zero step,

    minimize  gᵀd + ½ dᵀBd   subject to   C d >= c,   c <= 0,

and is solved in stages. Newton's step −B⁻¹g, if it is feasible, is the solution. Otherwise, with B = D L Lᵀ D (D the
root of the diagonal) and e = Lᵀ D d, it becomes a least-distance problem,

    minimize  ½‖e + q‖²   subject to   G e >= c,   ‖q‖ = 1,

in which nothing has a scale any more, and which a dual active-set method ([1]_, daqp) solves.

With equality constraints c(theta) = 0 a step leads towards them and along them. The programme

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
.. [1] D. Arnström, A. Bemporad, D. Axehill, A dual active-set solver for embedded quadratic programming using recursive
   LDLᵀ updates, IEEE Trans. Autom. Control 67 (2022) 4362-4369.
.. [2] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, chapters 15 and 18.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import daqp
import numpy as np

from switchfit.optimize import algebra, lapack
from switchfit.optimize.algebra import BoolArray, FloatArray, IntArray

NONE = np.zeros(0, dtype=np.intp)
"""No places."""


@dataclass(frozen=True, eq=False)
class LinearConstraints:
    """Linear inequalities and bounds, ``A theta >= b`` and ``lower <= theta <= upper``, each with a name.

    Parameters
    ----------
    A : array, shape (m, d)
        Rows of the inequalities; m may be zero.
    b : array, shape (m,)
        Their right-hand sides.
    lower, upper : array, shape (d,)
        Bounds; infinite where there is none.
    names : sequence, length m + 2 d
        What to call each row, then each lower bound, then each upper bound: text, or anything that prints as such.
    """

    A: FloatArray
    b: FloatArray
    lower: FloatArray
    upper: FloatArray
    names: tuple[object, ...]

    @cached_property
    def movable(self) -> BoolArray:
        """Which unknowns their bounds leave any room, shape (d,)."""
        return np.asarray(self.lower < self.upper)

    @cached_property
    def normals(self) -> FloatArray:
        """Inward normals of rows, lower and upper bounds, shape (m + 2 d, d)."""
        identity = np.eye(self.lower.size)
        return np.vstack([self.A, identity, -identity])

    def exact_rows(self, index: IntArray) -> list[tuple[int, int, float]]:
        """Of the given rows of A those that can hold with equality in floating point.

        ``(i, -1, value)`` for a row that holds where theta_i is the value; ``(i, j, 0.0)`` for ``theta_i >= theta_j``.
        """
        return [self._exact[k] for k in index.tolist() if k in self._exact]

    @cached_property
    def _exact(self) -> dict[int, tuple[int, int, float]]:
        found = {}
        for k, (row, bound) in enumerate(zip(self.A, self.b.tolist(), strict=True)):
            places = np.flatnonzero(row)
            if np.any(np.abs(row[places]) != 1.0):
                continue
            if places.size == 1:
                found[k] = (int(places[0]), -1, bound * float(row[places[0]]))
            elif places.size == 2 and bound == 0.0 and row[places].sum() == 0.0:
                found[k] = (int(np.argmax(row)), int(np.argmin(row)), 0.0)
        return found

    def slack(self, theta: FloatArray) -> FloatArray:
        """Return how far theta is inside each constraint, shape (m + 2 d,); negative where violated."""
        return np.asarray(algebra.slack(self, theta))

    def violation(self, theta: FloatArray) -> float:
        """Return the largest violation of a row; 0 if all hold."""
        return float(np.max(self.b - self.A @ theta, initial=0.0))

    @cached_property
    def sizes(self) -> tuple[FloatArray, FloatArray]:
        """Absolute values of A, shape (m, d), and b, shape (m,)."""
        return np.abs(self.A), np.abs(self.b)

    @cached_property
    def _largest_sizes(self) -> tuple[float, float]:
        """Largest sum of the absolute values of a row of A, and largest absolute value of b."""
        A, b = self.sizes
        return float(np.max(A.sum(1), initial=0.0)), float(np.max(b, initial=0.0))

    def are_far(self, slack: FloatArray, size: float) -> bool:
        """Return whether none of the constraints holds with equality, nor nearly, as at most points.

        Parameters
        ----------
        slack : array, shape (m + 2 d,)
            Of a theta.
        size : float
            Of the largest unknown; rounding is a part of it.
        """
        A, b = self._largest_sizes
        return algebra.smallest(slack) > 32 * algebra.EPS * (b + max(A, 1.0) * size)

    def active(self, slack: FloatArray, size: FloatArray) -> IntArray:
        """Return the places, ascending, of the constraints that hold with equality up to rounding.

        Parameters
        ----------
        slack : array, shape (m + 2 d,)
            Of a theta.
        size : array, shape (d,)
            Of the unknowns; rounding is a part of it.
        """
        return np.asarray(algebra.is_active(slack, size, *self.sizes).nonzero()[0])


TOLERANCES = 1e-12, 1e-10, 1e-8, 1e-6
"""By which daqp may violate a row of length one, in turn: rows that are nearly parallel need more than others."""

PARALLEL = 1e-14
"""Square of the sine of the angle from which on daqp takes rows for independent, in the metric of the matrix.

A matrix of the condition 1e12 brings rows to within 1e-6 of one another.
"""

SHORT = 0.01
"""Part of Newton's step, in the metric of the matrix, below which a step is refined: it has the other's rounding."""

OUTSIDE = 1e-8
"""Part of a step by which it may leave the room. The tolerance of daqp is one in the metric of the matrix: a million
times as much along directions in which that is nearly flat."""

SOLVED, EQUALITY = 1, 5
"""What daqp calls a programme that it has solved, and a row that holds with equality."""


def find_least_distance(
    target: FloatArray, rows: FloatArray, lower: FloatArray, upper: FloatArray, equal: BoolArray | None = None
) -> tuple[FloatArray, FloatArray] | None:
    """Minimize ½‖e + q‖² subject to ``lower <= G e <= upper``: e and what the rows exert; None if infeasible.

    Tolerances are absolute: rows are to be of the length one, and all quantities of the order 1.

    Parameters
    ----------
    target : array, shape (n,)
        q.
    rows : array, shape (k, n)
        G.
    lower, upper : arrays, shape (k,)
    equal : array of bool, shape (k,), optional
        Which of these hold with equality.

    Returns
    -------
    e, pull : arrays, shape (n,), (k,)
        ``e + q = Gᵀ pull``, positive where a lower bound presses and negative where an upper one does.
    """
    sense = np.zeros(lower.size, dtype=np.int32) if equal is None else np.where(equal, EQUALITY, 0).astype(np.int32)
    identity = np.eye(target.size)
    for tolerance in TOLERANCES:
        e, _, flag, found = daqp.solve(
            identity, target, rows, upper, lower, sense, primal_tol=tolerance, sing_tol=PARALLEL
        )
        if flag == SOLVED:
            return e, -found["lam"]
    return None


def nearest_feasible(constraints: LinearConstraints, theta: FloatArray, size: FloatArray | float = 1.0) -> FloatArray:
    """Return the feasible point nearest to theta (d,), up to rounding, each unknown being measured by its size (d,)."""
    if np.all(constraints.slack(theta) >= 0.0):
        return theta
    # In units of the sizes, and of the largest violation: min ||s||^2 subject to lower <= N s <= upper.
    rows, lengths = algebra.unit_rows(constraints.A * size)
    lower = np.concatenate([(constraints.lower - theta) / size, (constraints.b - constraints.A @ theta) / lengths])
    upper = np.concatenate([(constraints.upper - theta) / size, np.full(len(rows), np.inf)])
    violation = max(algebra.largest(lower), -algebra.smallest(upper))
    normals = np.concatenate([np.eye(theta.size), rows])
    found = find_least_distance(np.zeros(theta.size), normals, lower / violation, upper / violation)
    if found is None:
        raise ValueError("no point satisfies all the constraints")
    return np.asarray(np.clip(theta + violation * size * found[0], constraints.lower, constraints.upper))


class Room(NamedTuple):
    """Where a step d may go: ``lower <= N d <= upper``; d = 0 may.

    Attributes
    ----------
    normals : array, shape (m + d, d)
        Rows, and the identity.
    lower, upper : arrays, shape (m + d,)
    """

    normals: FloatArray
    lower: FloatArray
    upper: FloatArray

    @classmethod
    def around(cls, constraints: LinearConstraints, slack: FloatArray) -> Room:
        """Return the room around a feasible point with the given slack (m + 2 d,)."""
        m, d = constraints.A.shape
        slack = np.maximum(slack, 0.0)
        upper = np.concatenate([np.full(m, np.inf), slack[m + d :]])
        return cls(constraints.normals[: m + d], -slack[: m + d], upper)

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds of the step: (d,), (d,)."""
        d = self.normals.shape[1]
        return self.lower[-d:], self.upper[-d:]

    def holds(self, step: FloatArray) -> bool:
        """Return whether a step (d,) is inside."""
        products = self.normals.dot(step)
        return np.count_nonzero((self.lower <= products) & (products <= self.upper)) == products.size

    def narrow(self, reach: FloatArray) -> Room:
        """Return the part of the room in which no unknown moves by more than its `reach` (d,)."""
        narrowed = Room(self.normals, self.lower.copy(), self.upper.copy())
        lower, upper = narrowed.bounds
        np.maximum(lower, -reach, out=lower)
        np.minimum(upper, reach, out=upper)
        return narrowed

    def of(self, part: IntArray, free: BoolArray | None = None) -> Room:
        """Return the room of some of the unknowns, the others being held; what is not free (d,) is too."""
        m = len(self.normals) - self.normals.shape[1]
        kept = np.concatenate([np.arange(m), m + part])
        normals = self.normals[kept][:, part]
        return Room(normals if free is None else normals * free[part], self.lower[kept], self.upper[kept])

    def press(self, step: FloatArray, pull: FloatArray) -> FloatArray:
        """Return a step (d,) exactly on each of its bounds that pulls (m + d,): kinks depend on it."""
        (lower, upper), own = self.bounds, pull[-step.size :]
        return np.minimum(np.maximum(np.where(own > 0.0, lower, np.where(own < 0.0, upper, step)), lower), upper)

    def move_inside(self, step: FloatArray) -> FloatArray:
        """Return the step (d,) inside that is nearest to one: itself, unless it leaves by more than `OUTSIDE`."""
        products, size = self.normals.dot(step), algebra.largest(np.abs(step))
        if max(algebra.largest(self.lower - products), algebra.largest(products - self.upper)) <= OUTSIDE * size:
            return step
        rows, lengths = algebra.unit_rows(self.normals)
        low, high = (self.lower - products) / (size * lengths), (self.upper - products) / (size * lengths)
        found = find_least_distance(np.zeros(step.size), rows, low, high)
        return np.zeros(step.size) if found is None else np.clip(step + size * found[0], *self.bounds)


def newton_step(gradient: FloatArray, matrix: Any, factor: Any) -> FloatArray:
    """Return −B⁻¹g (d,), refined once: the residual is computed with B itself, not with its factor."""
    step = -factor.solve(gradient)
    step -= factor.solve(gradient + matrix.dot(step))
    return step


def solve_programme(
    gradient: FloatArray, matrix: FloatArray, factor: CholeskyFactor, room: Room
) -> tuple[FloatArray, FloatArray]:
    """Minimize ``gᵀd + ½ dᵀBd`` inside a room.

    Returns
    -------
    step, pull : arrays, shape (d,), (m + d,)
        ``B d + g = Nᵀ pull``, positive where a lower bound presses and negative where an upper one does.
    """
    newton = newton_step(gradient, matrix, factor)
    if room.holds(newton):
        return newton, np.zeros(len(room.lower))
    # In white variables, d = length D⁻¹ L⁻ᵀ e, nothing has a scale any more.
    target = factor.whiten(gradient)
    length = algebra.norm(target)
    rows, lengths = algebra.unit_rows(factor.whiten(room.normals))
    lower, upper = room.lower / (length * lengths), room.upper / (length * lengths)
    found = find_least_distance(target / length, rows, lower, upper)
    if found is None:  # the zero step is feasible; a search along it ends at once
        return np.zeros(gradient.size), np.zeros(lower.size)
    e, pull = found
    if algebra.norm(e) < SHORT:
        # One step of refinement, with a residual that is computed with B itself: the same programme for the error, with
        # what is active now.
        active = pull != 0.0
        missing = np.where(pull > 0.0, lower, upper) - rows.dot(e)
        residual = factor.whiten(gradient + matrix.dot(length * factor.unwhiten(e))) / length - rows.T.dot(pull)
        lower, upper = np.where(active, missing, -np.inf), np.where(active, missing, np.inf)
        refined = find_least_distance(residual, rows, lower, upper, active)
        if refined is not None:
            e, pull = e + refined[0], np.where(active, pull + refined[1], 0.0)
    pull = length * pull / lengths
    return room.move_inside(room.press(length * factor.unwhiten(e), pull)), pull


def solve_in_span(
    gradient: FloatArray, matrix: FloatArray, span: FloatArray, rows: FloatArray, lower: FloatArray, upper: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Minimize the programme of the steps ``d = S w`` with the matrix ``Sᵀ B S`` and ``lower <= rows d <= upper``.

    The result is that of `solve_programme`: the step (d,), and what the rows exert.
    """
    wide = np.full(len(matrix), np.inf)
    normals = np.concatenate([rows.dot(span), np.eye(wide.size)])
    inside = Room(normals, np.append(lower, -wide), np.append(upper, wide))
    found, pull = solve_programme(span.T.dot(gradient), matrix, CholeskyFactor.of(matrix), inside)
    return span.dot(found), pull[: len(rows)]


class CholeskyFactor(NamedTuple):
    """The factorization B = D L Lᵀ D of a full matrix.

    Attributes
    ----------
    diagonal : array, shape (d,)
        D: the root of B's diagonal, or larger where its entries count as none.
    lower : array, shape (d, d)
        L, zero above its diagonal.
    """

    diagonal: FloatArray
    lower: FloatArray

    @classmethod
    def of(cls, matrix: FloatArray) -> CholeskyFactor:
        """Return the factorization of a matrix (d, d); ValueError if it is not positive definite."""
        variances = matrix.diagonal()
        if algebra.smallest(variances) > 0.0:
            diagonal = np.sqrt(variances)
            found = cls.of_scaled(matrix / (diagonal[:, None] * diagonal), diagonal)
            if found is not None:
                return found
        raise ValueError("the matrix of the quadratic programme is not positive definite; convexify it first")

    @classmethod
    def of_scaled(cls, scaled: FloatArray, diagonal: FloatArray) -> CholeskyFactor | None:
        """Return the factorization of D S D (d, d) from S and D; None if S is not positive definite."""
        lower, failed = lapack.dpotrf(scaled, lower=1)
        return None if failed else cls(diagonal, lower)

    def solve(self, vector: FloatArray) -> FloatArray:
        """Return B⁻¹ v."""
        return np.asarray(lapack.dpotrs(self.lower, vector / self.diagonal, lower=1)[0] / self.diagonal)

    def whiten(self, vectors: FloatArray) -> FloatArray:
        """Return L⁻¹ D⁻¹ v for a vector or each of the rows v."""
        return np.asarray(lapack.dtrtrs(self.lower, (vectors / self.diagonal).T, lower=1)[0]).T

    def unwhiten(self, vector: FloatArray) -> FloatArray:
        """Return D⁻¹ L⁻ᵀ v."""
        return np.asarray(lapack.dtrtrs(self.lower, vector, lower=1, trans=1)[0] / self.diagonal)


def is_definite(matrix: FloatArray) -> bool:
    """Return whether a symmetric matrix (d, d) has a Cholesky factorization."""
    return not lapack.dpotrf(matrix, lower=1)[1]


def add_to_diagonal(matrix: FloatArray, amount: float) -> FloatArray:
    """Return the matrix with an amount added to each entry of its diagonal."""
    changed = matrix.copy()
    changed.reshape(-1)[:: len(matrix) + 1] += amount
    return changed


def has_curvature(scaled: FloatArray) -> bool:
    """Return whether all eigenvalues of a scaled matrix are above `algebra.EIGENVALUE_FLOOR`."""
    return is_definite(add_to_diagonal(scaled, -algebra.EIGENVALUE_FLOOR))


RAISED = 2.0
"""Multiple of the smallest eigenvalue by which an indefinite matrix is shifted inside a trust region."""


def shift_to_positive(matrix: FloatArray, least: float = 0.0) -> tuple[FloatArray, bool]:
    """Return the matrix with all eigenvalues raised until the smallest is positive, or `least`, and whether it was."""
    symmetric = 0.5 * (matrix + matrix.T)
    if not matrix.size:
        return symmetric, True
    values = lapack.dsyev(symmetric, compute_v=0)[0]
    lowest, highest = float(values[0]), float(values[-1])
    margin = max(algebra.EIGENVALUE_FLOOR * max(abs(lowest), abs(highest)), least)
    if lowest > margin:
        return symmetric, True
    margin = margin or algebra.EIGENVALUE_REPLACEMENT  # without any curvature nothing says how large it is
    return add_to_diagonal(symmetric, margin - RAISED * min(lowest, 0.0)), False


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

    def predict(self, step: FloatArray) -> float:
        """Return ‖c + A d‖₂ for a step d (d,)."""
        return algebra.norm(self.values + self.jacobian.dot(step))


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
        """Return the lam (k,) that minimizes ‖force + Aᵀ lam‖₂ ([2]_, section 18.3), the shortest of them."""
        return -np.asarray(self.left.dot(self.right.T.dot(force) / self.sizes))


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
    rows = Rows.of(scaled.jacobian)
    # v, within NORMAL_PART of the region; then t in the null space of A, from the slope g + H v of the model at its
    # end.
    step = _find_normal_step(scaled, rows, room, NORMAL_PART * radius)
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
