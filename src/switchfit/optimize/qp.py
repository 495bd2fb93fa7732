"""Linear constraints, convex quadratic programmes and the algebra the SQP needs around them.

Every quadratic programme here is strictly convex with a feasible zero step,

    minimise  gᵀd + ½ dᵀBd   subject to   C d >= c,   c <= 0,

and is solved in stages. Newton's step −B⁻¹g, if it is feasible, is the solution. Otherwise:

1. *whitening*: with B = D L Lᵀ D (D the root of the diagonal) and e = Lᵀ D d it becomes a least-distance problem,
   minimise ½‖e + q‖² subject to G e >= c, with unit rows of G and ‖q‖ = 1, so that nothing has a scale any more;
2. *identification*: the least-distance problem is a nonnegative least-squares problem (Lawson & Hanson, chapter 23);
3. *polish*: on the active set so found the solution follows from one QR factorisation and one step of refinement.

If the second stage fails or its active set is not optimal, a primal active-set method started at d = 0 takes over.

References
----------
.. [1] C. L. Lawson, R. J. Hanson, Solving Least Squares Problems, SIAM 1995, chapter 23.
.. [2] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, chapters 3, 12 and 16.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import qr
from scipy.linalg.lapack import dgeqp3, dpotrf, dpotrs, dtrtrs
from scipy.optimize import lsq_linear, nnls

FloatArray = NDArray[np.float64]

EPS = float(np.finfo(np.float64).eps)
#: Eigenvalues of the diagonally scaled Hessian below this count as zero.
EIGENVALUE_FLOOR = 1e-10
#: What such an eigenvalue is replaced by in the quadratic programme: small, but steps along it stay within reason.
EIGENVALUE_REPLACEMENT = 1e-4
#: Feasibility and sign tolerance of the whitened problem, whose quantities are all of order one.
_WHITE_TOLERANCE = 1e-12


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

    Raises
    ------
    ValueError
        If shapes disagree, a number is NaN, a lower bound exceeds its upper bound, or names are missing.
    """

    A: FloatArray
    b: FloatArray
    lower: FloatArray
    upper: FloatArray
    names: tuple[object, ...]

    def __post_init__(self) -> None:
        lower = np.atleast_1d(np.asarray(self.lower, dtype=float))
        d = lower.size
        A = np.asarray(self.A, dtype=float)
        fields = {
            "A": A.reshape(0, d) if A.size == 0 else A,
            "b": np.asarray(self.b, dtype=float).reshape(-1),
            "lower": lower,
            "upper": np.atleast_1d(np.asarray(self.upper, dtype=float)),
            "names": tuple(self.names),
        }
        for key, value in fields.items():
            object.__setattr__(self, key, value)
        self._validate()

    def _validate(self) -> None:
        m, d = self.b.size, self.lower.size
        if self.A.shape != (m, d) or self.lower.shape != (d,) or self.upper.shape != (d,):
            shapes = f"A {self.A.shape}, b {self.b.shape}, lower {self.lower.shape}, upper {self.upper.shape}"
            raise ValueError(f"shapes of the constraints disagree: {shapes}; expected (m, d), (m,), (d,), (d,)")
        if len(self.names) != m + 2 * d:
            raise ValueError(
                f"got {len(self.names)} names for {m} rows and 2 x {d} bounds; give one for each of the {m + 2 * d}: "
                "rows, then lower bounds, then upper bounds"
            )
        if not (np.isfinite(self.A).all() and np.isfinite(self.b).all()):
            raise ValueError("A and b of the constraints must be finite; leave out rows that do not constrain")
        wrong = np.flatnonzero(~(self.lower <= self.upper))
        if wrong.size:
            i = int(wrong[0])
            raise ValueError(
                f"lower bound {self.lower[i]} is not below upper bound {self.upper[i]} "
                f"({self.names[m + i]!r}, {self.names[m + d + i]!r})"
            )

    @classmethod
    def box(cls, lower: ArrayLike, upper: ArrayLike, *, unknowns: Sequence[str] | None = None) -> LinearConstraints:
        """Bounds alone, named after the unknowns (``theta[i]`` if these have no names)."""
        low = np.atleast_1d(np.asarray(lower, dtype=float))
        labels = [f"theta[{i}]" for i in range(low.size)] if unknowns is None else list(unknowns)
        names = [f"{label} at lower bound" for label in labels] + [f"{label} at upper bound" for label in labels]
        return cls(np.zeros((0, low.size)), np.zeros(0), low, np.asarray(upper, dtype=float), tuple(names))

    @property
    def size(self) -> int:
        """Number of unknowns, d."""
        return self.lower.size

    @cached_property
    def movable(self) -> NDArray[np.bool_]:
        """Which unknowns their bounds leave any room, shape (d,)."""
        return np.asarray(self.lower < self.upper)

    @cached_property
    def normals(self) -> FloatArray:
        """Inward normals of rows, lower and upper bounds, shape (m + 2 d, d)."""
        identity = np.eye(self.size)
        return np.vstack([self.A, identity, -identity])

    def exact_rows(self, index: NDArray[np.intp]) -> list[tuple[int, int, float]]:
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

    def rows(self, index: NDArray[np.intp]) -> FloatArray:
        """The normals at the given places, shape (k, d)."""
        m, d = self.b.size, self.size
        chosen = np.zeros((index.size, d))
        if index.size == 0:
            return chosen
        in_A = index < m
        chosen[in_A] = self.A[index[in_A]]
        bounds = np.flatnonzero(~in_A)
        place = index[bounds] - m
        chosen[bounds, place % d] = np.where(place < d, 1.0, -1.0)
        return chosen

    @property
    def row_norms(self) -> FloatArray:
        """Lengths of the normals, shape (m + 2 d,)."""
        return np.concatenate([np.linalg.norm(self.A, axis=1), np.ones(2 * self.size)])

    def slopes(self, step: FloatArray) -> FloatArray:
        """Products of the normals with a step, shape (m + 2 d,)."""
        return np.concatenate([self.A @ step, step, -step])

    def slack(self, theta: FloatArray) -> FloatArray:
        """How far theta is inside each constraint, shape (m + 2 d,); negative where violated."""
        return np.concatenate([self.A @ theta - self.b, theta - self.lower, self.upper - theta])

    def rounding(self, scale: FloatArray) -> FloatArray:
        """Size of the rounding error of `slack` at unknowns of size `scale`, shape (m + 2 d,)."""
        rows = 16 * EPS * (np.abs(self.b) + np.abs(self.A) @ scale)
        return np.concatenate([rows, np.zeros(2 * self.size)])


def nearest_feasible(constraints: LinearConstraints, theta: FloatArray) -> FloatArray:
    """The feasible point nearest to theta (d,), up to rounding.

    ``min ||s||²`` subject to ``N s >= -slack`` is a nonnegative least-squares problem ([1]_, chapter 23, section 4).
    """
    slack = constraints.slack(theta)
    if np.all(slack >= 0.0):
        return theta
    kept = np.isfinite(slack)
    normals = constraints.normals[kept]
    size = float(np.max(-slack))
    right = np.append(np.zeros(theta.size), 1.0)
    found = nnls(np.vstack([normals.T, -slack[kept] / size]), right)[0]
    residual = np.append(normals.T @ found, -slack[kept] @ found / size) - right
    if not residual[-1] < 0.0:
        raise ValueError("no point satisfies all the constraints")
    return np.asarray(np.clip(theta - size * residual[:-1] / residual[-1], constraints.lower, constraints.upper))


@dataclass(frozen=True, eq=False)
class QPSolution:
    """Step d, shape (d,), and multipliers, shape (k,), of a quadratic programme with ``B d + g = Cᵀ multipliers``."""

    step: FloatArray
    multipliers: FloatArray


def solve_qp(gradient: FloatArray, matrix: FloatArray, normals: FloatArray, offsets: FloatArray) -> QPSolution:
    """Minimise ``gᵀd + ½ dᵀBd`` subject to ``C d >= c`` with B positive definite and d = 0 feasible.

    Parameters
    ----------
    gradient : array, shape (d,)
        g.
    matrix : array, shape (d, d)
        B, symmetric positive definite.
    normals : array, shape (k, d)
        Rows of C.
    offsets : array, shape (k,)
        c, not positive; minus infinity where a row does not constrain.

    Returns
    -------
    QPSolution
        The step and its nonnegative multipliers, which satisfy ``B d + g = Cᵀ multipliers``.

    Raises
    ------
    ValueError
        If B is not positive definite or c is positive somewhere.
    """
    offsets = np.asarray(offsets, dtype=float)
    if (offsets > 0.0).any():
        raise ValueError(f"the zero step violates row {int(np.argmax(offsets))} by {offsets.max()}; c must be <= 0")
    multipliers = np.zeros(offsets.size)
    if gradient.size == 0 or not np.any(gradient):
        return QPSolution(np.zeros(gradient.size), multipliers)
    factor = _Factor.of(matrix)
    step = -factor.solve(gradient)
    step -= factor.solve(gradient + matrix @ step)
    if (normals @ step >= offsets).all():
        return QPSolution(step, multipliers)
    return QPSolution(*solve_whitened(gradient, matrix, factor, normals, offsets))


class Factor(Protocol):
    """A factorisation B = D L Lᵀ D, of a matrix whatever its shape."""

    def whiten(self, vectors: FloatArray) -> FloatArray:
        """L⁻¹ D⁻¹ v for a vector or each of the rows v."""
        ...

    def unwhiten(self, vector: FloatArray) -> FloatArray:
        """D⁻¹ L⁻ᵀ v."""
        ...


class Matrix(Protocol):
    """What can be multiplied with a vector."""

    def __matmul__(self, vector: FloatArray, /) -> Any: ...


def solve_whitened(
    gradient: FloatArray, matrix: Matrix, factor: Factor, normals: FloatArray, offsets: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Step and multipliers of a quadratic programme whose matrix has been factorised, in white variables.

    Parameters
    ----------
    gradient, matrix, normals, offsets : as of `solve_qp`
    factor : Factor
        Of the matrix.
    """
    multipliers = np.zeros(offsets.size)
    white = _whiten(gradient, factor, normals, offsets)
    e, white_multipliers = _least_distance(white.target, white.rows, white.offsets)
    e, white_multipliers = _refine(white, e, white_multipliers, gradient, matrix)
    multipliers[white.kept] = white_multipliers * white.length / white.norms
    return white.unwhiten(e), multipliers


@dataclass(frozen=True, eq=False)
class _Factor:
    """The factorisation B = D L Lᵀ D, with the root of B's diagonal for D."""

    diagonal: FloatArray
    lower: FloatArray

    @classmethod
    def of(cls, matrix: FloatArray) -> _Factor:
        variances = matrix.diagonal()
        if np.all(variances > 0.0):
            diagonal = np.sqrt(variances)
            lower, failed = dpotrf(matrix / (diagonal[:, None] * diagonal), lower=1)
            if not failed:
                return cls(diagonal, lower)
        raise ValueError("the matrix of the quadratic programme is not positive definite; convexify it first")

    def solve(self, vector: FloatArray) -> FloatArray:
        """B⁻¹ v."""
        return np.asarray(dpotrs(self.lower, vector / self.diagonal, lower=1)[0] / self.diagonal)

    def whiten(self, vectors: FloatArray) -> FloatArray:
        """L⁻¹ D⁻¹ v for each of the rows v."""
        return _solve_triangular(self.lower, (vectors / self.diagonal).T, lower=1).T

    def unwhiten(self, vector: FloatArray) -> FloatArray:
        """D⁻¹ L⁻ᵀ v."""
        return _solve_triangular(self.lower, vector, lower=1, trans=1) / self.diagonal


def _solve_triangular(matrix: FloatArray, right: FloatArray, lower: int = 0, trans: int = 0) -> FloatArray:
    """LAPACK's solution; `scipy.linalg.solve_triangular` takes ten times longer on a small system."""
    solution, singular = dtrtrs(matrix, right, lower=lower, trans=trans)
    return np.full_like(right, np.nan) if singular else np.asarray(solution)


@dataclass(frozen=True, eq=False)
class _White:
    """The whitened problem: minimise ½‖e + target‖² subject to rows e >= offsets; d = length D⁻¹ L⁻ᵀ e."""

    factor: Factor
    length: float  # norm of L⁻¹ D⁻¹ g
    target: FloatArray  # q, of norm 1
    kept: NDArray[np.intp]  # which constraints can be active at all
    norms: FloatArray  # length of their whitened normals
    rows: FloatArray  # G
    offsets: FloatArray

    def unwhiten(self, e: FloatArray) -> FloatArray:
        return self.length * self.factor.unwhiten(e)


def _whiten(gradient: FloatArray, factor: Factor, normals: FloatArray, offsets: FloatArray) -> _White:
    target = factor.whiten(gradient)
    length = float(np.linalg.norm(target))
    target = target / length
    rows = factor.whiten(normals)
    norms = np.linalg.norm(rows, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        unit = rows / norms[:, None]
        scaled = offsets / (length * norms)
        # d = 0 is feasible, so ‖e + q‖ <= ‖q‖ = 1: a row that this ball does not reach can be forgotten.
        reached = (norms > 0.0) & (scaled + unit @ target >= -1.0 - 1e-9)
    kept = np.flatnonzero(reached)
    return _White(factor, length, target, kept, norms[kept], unit[kept], scaled[kept])


def _least_distance(target: FloatArray, rows: FloatArray, offsets: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Minimise ½‖e + q‖² subject to G e >= c: e, shape (d,), and multipliers, shape (k,)."""
    if offsets.size == 0:
        return -target, np.zeros(0)
    raw = _lawson_hanson(target, rows, offsets)
    if raw is not None:
        polished = _polish(target, rows, offsets, np.flatnonzero(raw > 0.0))
        if polished is not None:
            return polished
    working = _primal_active_set(target, rows, offsets)
    if working is not None:
        polished = _polish(target, rows, offsets, working)
        if polished is not None:
            return polished
    return _feasible_fraction(target, rows, offsets, np.zeros(offsets.size) if raw is None else raw)


def _lawson_hanson(target: FloatArray, rows: FloatArray, offsets: FloatArray) -> FloatArray | None:
    """Multipliers by the equivalent nonnegative least-squares problem ([1]_, chapter 23, algorithm LDP)."""
    stacked = np.vstack([rows.T, offsets + rows @ target])
    goal = np.zeros(target.size + 1)
    goal[-1] = 1.0
    try:
        u, _ = nnls(stacked, goal, maxiter=10 * offsets.size + 30)
    except RuntimeError:
        return None
    return np.asarray(u / (1.0 - stacked[-1] @ u))


def _equality_solution(target: FloatArray, rows: FloatArray, offsets: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Minimise ½‖e + q‖² subject to G e = c for independent rows, by e = Q R⁻ᵀ c − (I − QQᵀ) q."""
    if offsets.size == 0:
        return -target, np.zeros(0)
    Q, R = np.linalg.qr(rows.T)
    inside = _solve_triangular(R, offsets, trans=1)
    along = Q.T @ target
    multipliers = _solve_triangular(R, inside + along)
    return Q @ (inside + along) - target, multipliers


def _independent(rows: FloatArray, working: NDArray[np.intp]) -> NDArray[np.intp]:
    """A maximal linearly independent part of the working set (unit rows)."""
    if working.size <= 1:
        return working
    R, order, *_ = dgeqp3(rows[working].T)
    rank = int(np.sum(np.abs(R.diagonal()) > 1e-11))
    return np.sort(working[order[:rank] - 1])


def _polish(
    target: FloatArray, rows: FloatArray, offsets: FloatArray, working: NDArray[np.intp]
) -> tuple[FloatArray, FloatArray] | None:
    """Solution on the working set if it is primal and dual feasible, otherwise None."""
    working = _independent(rows, working)
    e, active_multipliers = _equality_solution(target, rows[working], offsets[working])
    size = max(1.0, float(np.max(np.abs(active_multipliers), initial=0.0)))
    infeasible = np.any(rows @ e < offsets - _WHITE_TOLERANCE)
    if infeasible or np.any(active_multipliers < -_WHITE_TOLERANCE * size) or not np.isfinite(e).all():
        return None
    multipliers = np.zeros(offsets.size)
    multipliers[working] = np.maximum(active_multipliers, 0.0)
    return e, multipliers


def _primal_active_set(target: FloatArray, rows: FloatArray, offsets: FloatArray) -> NDArray[np.intp] | None:
    """Optimal working set by the primal active-set method ([2]_, algorithm 16.3) with Bland's rule against cycling."""
    e = np.zeros(target.size)
    working: list[int] = []
    for _ in range(50 + 20 * offsets.size):
        chosen = np.array(working, dtype=np.intp)
        # p lies in the null space of the working rows, which hold with equality at e.
        p, multipliers = _equality_solution(e + target, rows[chosen], np.zeros(chosen.size))
        if np.linalg.norm(p) <= 1e-13:
            wrong = np.flatnonzero(multipliers < -1e-13 * max(1.0, float(np.max(np.abs(multipliers), initial=0.0))))
            if wrong.size == 0:
                return chosen
            working.remove(int(chosen[wrong].min()))
            continue
        slope = rows @ p
        approaching = slope < -1e-14
        approaching[chosen] = False
        lengths = np.full(offsets.size, np.inf)
        gap = np.maximum(rows @ e - offsets, 0.0)
        lengths[approaching] = gap[approaching] / -slope[approaching]
        length = min(1.0, float(lengths.min()))
        e = e + length * p
        if length < 1.0:
            working.append(int(np.flatnonzero(lengths <= length)[0]))
    return None


def _feasible_fraction(
    target: FloatArray, rows: FloatArray, offsets: FloatArray, multipliers: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Last resort: the unpolished solution, shortened until feasible, which is still a descent step."""
    e = rows.T @ multipliers - target
    if e @ target >= 0.0:
        e = np.zeros_like(target)
    slope = rows @ e
    outside = slope < offsets
    fraction = float(np.min(offsets[outside] / slope[outside], initial=1.0))
    return max(fraction, 0.0) * e, multipliers


def _refine(
    white: _White, e: FloatArray, multipliers: FloatArray, gradient: FloatArray, matrix: Matrix
) -> tuple[FloatArray, FloatArray]:
    """One step of iterative refinement: the residual is computed with B itself, not with its factor."""
    working = np.flatnonzero(multipliers > 0.0)
    if working.size > e.size:
        return e, multipliers
    rows = white.rows[working]
    # C_iᵀ mu_i = length D L G_iᵀ lam_i, so the constraints' part of the residual is exact in white variables.
    residual = white.factor.whiten(gradient + matrix @ white.unwhiten(e)) / white.length - rows.T @ multipliers[working]
    gap = white.offsets[working] - rows @ e
    correction, change = _equality_solution(residual, rows, gap)
    # Rows that depend on one another, as the last resort may leave them, give no small one.
    small = np.linalg.norm(correction) <= 1e-4 * np.linalg.norm(e) + 1e-12
    if not small or np.any(multipliers[working] + change < 0.0):
        return e, multipliers
    refined = multipliers.copy()
    refined[working] += change
    return e + correction, refined


def diagonal_scaling(hessian: FloatArray, floor: FloatArray | None = None) -> FloatArray:
    """Positive D, shape (d,), for which D⁻¹ H D⁻¹ has rows of largest entry about one.

    For a positive semi-definite H this is the root of the diagonal (Jacobi), so that everything computed in the
    scaled variables is the same whatever the units of the unknowns. Where off-diagonal entries are larger, as they
    may be in an indefinite H, a few rounds of symmetric equilibration follow.

    Parameters
    ----------
    hessian : array, shape (d, d)
        H, symmetric.
    floor : array, shape (d,), optional
        Diagonal entries too small to matter, below which D² does not go.
    """
    size = np.abs(hessian)
    square = size.diagonal().copy()
    if floor is not None:
        square = np.maximum(square, floor)
    empty = square <= 0.0
    if empty.any():
        square[empty] = size.max(axis=1, initial=0.0)[empty]
        square[square <= 0.0] = 1.0
    scaling = np.sqrt(square)
    for _ in range(20):
        largest = (size / (scaling[:, None] * scaling)).max(axis=1, initial=0.0)
        if (largest <= 1.0 + 1e-9).all():
            break
        scaling = scaling * np.sqrt(np.maximum(largest, 1.0))
    return scaling


def split_space(normals: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Orthonormal bases of the null space, shape (d, d - r), and of the row space, shape (d, r), of the normals."""
    d = normals.shape[1]
    if normals.shape[0] == 0:
        return np.eye(d), np.zeros((d, 0))
    lengths = np.linalg.norm(normals, axis=1)
    rows = normals[lengths > 0.0] / lengths[lengths > 0.0, None]
    if rows.shape[0] == 0:
        return np.eye(d), np.zeros((d, 0))
    Q, R, _ = qr(rows.T, mode="full", pivoting=True)
    rank = int(np.sum(np.abs(np.diag(R)) > 1e-11))
    return Q[:, rank:], Q[:, :rank]


def convexify(hessian: FloatArray, normals: FloatArray, floor: FloatArray | None = None) -> FloatArray:
    """Positive definite B that equals H wherever H can be kept.

    In scaled variables, with Z the directions free of the (presumably) active constraints and Y their normals: a
    positive definite H is kept; otherwise ZᵀHZ is kept if it is positive definite, which leaves Newton's step on the
    face unspoiled, and only the Schur complement on Y has its eigenvalues replaced by their absolute values. If
    ZᵀHZ is not positive definite either, its eigenvalues are treated in the same way.

    Parameters
    ----------
    hessian : array, shape (d, d)
        H, symmetric.
    normals : array, shape (k, d)
        Normals of the constraints expected to be active.
    floor : array, shape (d,), optional
        See `diagonal_scaling`.

    References
    ----------
    .. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, sections 3.4 and 16.7.
    """
    if hessian.size == 0:
        return hessian
    scaling = diagonal_scaling(hessian, floor)
    weight = scaling[:, None] * scaling
    scaled = hessian / weight
    if not dpotrf(scaled - EIGENVALUE_FLOOR * np.eye(scaled.shape[0]))[1]:
        return hessian
    free, blocked = split_space(normals / scaling)
    if blocked.shape[1] == 0 or free.shape[1] == 0:
        return _absolute(scaled) * weight
    top = _absolute(free.T @ scaled @ free)
    cross = free.T @ scaled @ blocked
    tie = cross.T @ np.linalg.solve(top, cross)
    bottom = _absolute(blocked.T @ scaled @ blocked - tie) + tie
    basis = np.hstack([free, blocked])
    convex = basis @ np.block([[top, cross], [cross.T, bottom]]) @ basis.T
    values = np.linalg.eigvalsh(convex)
    # A nearly singular Z'HZ makes the tie huge, and the smallest eigenvalue rounding.
    if values[0] < max(0.1 * EIGENVALUE_FLOOR, 64 * EPS * values[-1]):
        return _absolute(scaled) * weight
    return 0.5 * (convex + convex.T) * weight


def _absolute(matrix: FloatArray) -> FloatArray:
    """The matrix with eigenvalues that are not positive replaced by absolute values; itself if there are none."""
    symmetric = 0.5 * (matrix + matrix.T)
    values, vectors = np.linalg.eigh(symmetric)
    if values.size == 0 or values[0] > EIGENVALUE_FLOOR:
        return symmetric
    changed = np.where(values > EIGENVALUE_FLOOR, values, np.maximum(np.abs(values), EIGENVALUE_REPLACEMENT))
    convex = (vectors * changed) @ vectors.T
    return np.asarray(0.5 * (convex + convex.T))


def kkt_residual(low: FloatArray, high: FloatArray, normals: FloatArray) -> tuple[float, FloatArray]:
    """Distance of the gradient from the cone of the active constraints, and the multipliers that attain it.

    min over lam >= 0 and low <= g <= high of ‖g − Nᵀ lam‖₂, where low = high except at coordinates held at a kink.

    Parameters
    ----------
    low, high : array, shape (d,)
        The interval of one-sided derivatives.
    normals : array, shape (k, d)
        Inward normals N of the active constraints.

    Returns
    -------
    residual : float
    multipliers : array, shape (k,)
    """
    if normals.shape[0] == 0:
        return float(np.linalg.norm(low if low is high else np.clip(0.0, low, high))), np.zeros(0)
    size = float(max(np.max(np.abs(low), initial=0.0), np.max(np.abs(high), initial=0.0)))
    if size == 0.0:
        return 0.0, np.zeros(normals.shape[0])
    wide = np.flatnonzero(high > low)
    lengths = np.linalg.norm(normals, axis=1)
    lengths = np.where(lengths > 0.0, lengths, 1.0)
    unit = normals / lengths[:, None]
    if wide.size == 0:
        multipliers = _cone_projection(unit, low / size)
        shift = np.zeros(0)
    else:
        multipliers, shift = _box_projection(unit, low / size, (high - low)[wide] / size, wide)
    gradient = low / size
    gradient[wide] += shift
    residual = size * float(np.linalg.norm(gradient - unit.T @ multipliers))
    return residual, size * multipliers / lengths


def _cone_projection(unit: FloatArray, gradient: FloatArray) -> FloatArray:
    """Argument of min over lam >= 0 of ‖g − Nᵀ lam‖.

    SciPy's nnls is fast, but from version 1.15 on its answer may be wrong for dependent rows, and its residual with it
    (https://github.com/scipy/scipy/issues/25389), so that the answer is checked.
    """
    if gradient.size == 0:
        return np.zeros(unit.shape[0])
    try:
        multipliers = np.asarray(nnls(unit.T, gradient, maxiter=10 * unit.shape[0] + 30)[0])
    except RuntimeError:
        multipliers = np.full(unit.shape[0], np.nan)
    pull = unit @ (gradient - unit.T @ multipliers)
    wrong = np.where(multipliers > 0.0, np.abs(pull), pull)
    if np.all(wrong <= 1e-12 * (1.0 + np.max(multipliers))):
        return multipliers
    return np.asarray(lsq_linear(unit.T, gradient, bounds=(0.0, np.inf), method="bvls").x)


def _box_projection(
    unit: FloatArray, low: FloatArray, width: FloatArray, wide: NDArray[np.intp]
) -> tuple[FloatArray, FloatArray]:
    """Arguments of min over lam >= 0, 0 <= s <= width of ‖low + s − Nᵀ lam‖: lam and s.

    With s inside its interval a coordinate puts no condition on lam, at an end of it an ordinary one: nonnegative
    least squares with the coordinates so labelled, until the labels agree with the solution. Should they cycle, a
    general (less accurate) solver has its say too.
    """
    label = np.zeros(wide.size)  # −1 and +1: at the lower and upper end
    candidates = []
    for _ in range(3 * wide.size + 5):
        target = low.copy()
        target[wide] += np.where(label > 0, width, 0.0)
        fitted = np.ones(low.size, dtype=bool)
        fitted[wide] = label != 0.0
        multipliers = _cone_projection(unit[:, fitted], target[fitted])
        above = (unit.T @ multipliers - low)[wide]
        shifts = np.clip(above, 0.0, width)
        candidates.append((multipliers, shifts))
        relabelled = np.where(above > width, 1.0, np.where(above < 0.0, -1.0, 0.0))
        if np.array_equal(relabelled, label):
            return multipliers, shifts
        label = relabelled
    candidates.append(_bounded_least_squares(unit, low, width, wide))
    return min(candidates, key=lambda pair: _distance(unit, low, wide, *pair))


def _distance(
    unit: FloatArray, low: FloatArray, wide: NDArray[np.intp], multipliers: FloatArray, shifts: FloatArray
) -> float:
    """‖low + s − Nᵀ lam‖."""
    difference = low - unit.T @ multipliers
    difference[wide] += shifts
    return float(np.linalg.norm(difference))


def _bounded_least_squares(
    unit: FloatArray, low: FloatArray, width: FloatArray, wide: NDArray[np.intp]
) -> tuple[FloatArray, FloatArray]:
    """The problem of `_box_projection` by a general solver."""
    k, d = unit.shape
    columns = np.zeros((d, wide.size))
    columns[wide, np.arange(wide.size)] = -1.0
    upper = np.concatenate([np.full(k, np.inf), width])
    solution = lsq_linear(np.hstack([unit.T, columns]), low, bounds=(np.zeros(k + wide.size), upper), method="bvls").x
    return np.maximum(solution[:k], 0.0), np.clip(solution[k:], 0.0, width)
