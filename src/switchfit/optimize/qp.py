"""Linear inequalities and bounds, and strictly convex quadratic programmes.

Every quadratic programme here is strictly convex with a feasible zero step,

    minimize  gᵀd + ½ dᵀBd   subject to   C d >= c,   c <= 0,

and is solved in stages. Newton's step −B⁻¹g, if it is feasible, is the solution. Otherwise:

1. *whitening*: with B = D L Lᵀ D (D the root of the diagonal) and e = Lᵀ D d it becomes a least-distance problem,
   minimize ½‖e + q‖² subject to G e >= c, with unit rows of G and ‖q‖ = 1, so that nothing has a scale any more;
2. *identification*: the least-distance problem is a nonnegative least-squares problem (Lawson & Hanson, chapter 23);
3. *polish*: on the active set so found the solution follows from one QR factorization and one step of refinement.

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
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from switchfit.optimize import algebra, lapack
from switchfit.optimize.algebra import EPS, BoolArray, FloatArray, IntArray, is_finite, norm, smallest
from switchfit.optimize.threads import one_thread

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
        m = self.b.size
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
        """Return the bounds alone, named after the unknowns (``theta[i]`` if these have no names)."""
        low = np.atleast_1d(np.asarray(lower, dtype=float))
        labels = [f"theta[{i}]" for i in range(low.size)] if unknowns is None else list(unknowns)
        names = [f"{label} at lower bound" for label in labels] + [f"{label} at upper bound" for label in labels]
        return cls(np.zeros((0, low.size)), np.zeros(0), low, np.asarray(upper, dtype=float), tuple(names))

    @property
    def size(self) -> int:
        """Number of unknowns, d."""
        return self.lower.size

    @cached_property
    def movable(self) -> BoolArray:
        """Which unknowns their bounds leave any room, shape (d,)."""
        return np.asarray(self.lower < self.upper)

    @cached_property
    def all_movable(self) -> bool:
        """Whether no unknown is held by its bounds."""
        return bool(self.movable.all())

    @cached_property
    def normals(self) -> FloatArray:
        """Inward normals of rows, lower and upper bounds, shape (m + 2 d, d)."""
        identity = np.eye(self.size)
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

    def rows(self, index: IntArray) -> FloatArray:
        """Return the normals at the given places, shape (k, d)."""
        return self.normals[index]

    @cached_property
    def row_norms(self) -> FloatArray:
        """Lengths of the normals, shape (m + 2 d,)."""
        return np.concatenate([np.linalg.norm(self.A, axis=1), np.ones(2 * self.size)])

    def slopes(self, step: FloatArray) -> FloatArray:
        """Return the products of the normals with a step, shape (m + 2 d,)."""
        return np.concatenate([self.A @ step, step, -step])

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
        return smallest(slack) > 32 * EPS * (b + max(A, 1.0) * size)

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


#: Feasibility and sign tolerance of the whitened problem, whose quantities are all of order one.
_WHITE_TOLERANCE = 1e-12


def nearest_feasible(constraints: LinearConstraints, theta: FloatArray) -> FloatArray:
    """Return the feasible point nearest to theta (d,), up to rounding.

    ``min ||s||²`` subject to ``N s >= -slack`` is a nonnegative least-squares problem ([1]_, chapter 23, section 4).
    """
    slack = constraints.slack(theta)
    if np.all(slack >= 0.0):
        return theta
    from scipy.optimize import nnls  # here, since importing it takes longer than most fits, which do not need it

    # Least distance by nonnegative least squares: with E = (N'; -slack') and r = E u - e_{d+1} at the best u >= 0,
    #     s = -r_{1..d} / r_{d+1},
    # and r = 0 if and only if the constraints contradict one another. `size` takes the unit of the slack away.
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


@one_thread()
def solve_qp(gradient: FloatArray, matrix: FloatArray, normals: FloatArray, offsets: FloatArray) -> QPSolution:
    """Minimize ``gᵀd + ½ dᵀBd`` subject to ``C d >= c`` with B positive definite and d = 0 feasible.

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
    if not np.count_nonzero(gradient):
        return QPSolution(np.zeros(gradient.size), multipliers)
    factor = CholeskyFactor.of(matrix)
    step = newton_step(gradient, matrix, factor)
    # The unconstrained minimum, if it is feasible, is the solution: the usual case, for which nothing is whitened.
    if satisfies(normals, step, offsets):
        return QPSolution(step, multipliers)
    return QPSolution(*solve_whitened(gradient, matrix, factor, normals, offsets))


def satisfies(normals: FloatArray, step: FloatArray, offsets: FloatArray) -> bool:
    """Return whether a step (d,) satisfies ``C d >= c``."""
    return np.count_nonzero(normals.dot(step) >= offsets) == offsets.size


def newton_step(gradient: FloatArray, matrix: Any, factor: Any) -> FloatArray:
    """Return −B⁻¹g (d,), refined once: the residual is computed with B itself, not with its factor."""
    step = -factor.solve(gradient)
    step -= factor.solve(gradient + matrix.dot(step))
    return step


def solve_whitened(
    gradient: FloatArray, matrix: Any, factor: Any, normals: FloatArray, offsets: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the step and multipliers of a quadratic programme whose matrix has been factorized, in white variables.

    Parameters
    ----------
    gradient, matrix, normals, offsets : as of `solve_qp`
    factor : CholeskyFactor or ArrowFactor
        Of the matrix.
    """
    # With d = length D^-1 L^-T e the objective is length^2 (||e + q||^2 / 2 + const), q = L^-1 D^-1 g / length.
    target = factor.whiten(gradient)
    length = norm(target)  # d = length D⁻¹ L⁻ᵀ e
    target = target / length
    rows = factor.whiten(normals)
    norms = np.sqrt((rows * rows).sum(1))
    # d = 0 is feasible, so ‖e + q‖ <= ‖q‖ = 1: a row that this ball does not reach can be forgotten, and one of zeros.
    reached = offsets + length * rows.dot(target) >= (-1.0 - 1e-9) * length * norms
    kept = (reached & (norms > 0.0)).nonzero()[0]
    norms = norms[kept]
    rows, bounds = rows[kept] / norms[:, None], offsets[kept] / (length * norms)
    e, white_multipliers = _least_distance(target, rows, bounds)
    # C_iᵀ mu_i = length D L G_iᵀ lam_i, so the constraints' part of the residual is exact in white variables.
    residual = factor.whiten(gradient + matrix @ (length * factor.unwhiten(e))) / length
    e, white_multipliers = _refine(residual, rows, bounds, e, white_multipliers)
    multipliers = np.zeros(offsets.size)
    multipliers[kept] = white_multipliers * length / norms
    return length * factor.unwhiten(e), multipliers


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
        if smallest(variances) > 0.0:
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
        """Return L⁻¹ D⁻¹ v for each of the rows v."""
        return _solve_triangular(self.lower, (vectors / self.diagonal).T, lower=1).T

    def unwhiten(self, vector: FloatArray) -> FloatArray:
        """Return D⁻¹ L⁻ᵀ v."""
        return _solve_triangular(self.lower, vector, lower=1, trans=1) / self.diagonal


def is_definite(matrix: FloatArray) -> bool:
    """Return whether a symmetric matrix (d, d) has a Cholesky factorization."""
    return not lapack.dpotrf(matrix, lower=1)[1]


def _solve_triangular(matrix: FloatArray, right: FloatArray, lower: int = 0, trans: int = 0) -> FloatArray:
    """Return LAPACK's solution; `scipy.linalg.solve_triangular` takes ten times longer on a small system."""
    solution, singular = lapack.dtrtrs(matrix, right, lower=lower, trans=trans)
    return np.full_like(right, np.nan) if singular else np.asarray(solution)


def _least_distance(target: FloatArray, rows: FloatArray, offsets: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Minimize ½‖e + q‖² subject to G e >= c: e, shape (d,), and multipliers, shape (k,).

    The last resort, e = 0, is feasible; a search along it ends at once.
    """
    if offsets.size == 0:
        return -target, np.zeros(0)
    for find_active in (_lawson_hanson, _primal_active_set):
        working = find_active(target, rows, offsets)
        polished = None if working is None else _polish(target, rows, offsets, working)
        if polished is not None:
            return polished
    return np.zeros(target.size), np.zeros(offsets.size)


def _lawson_hanson(target: FloatArray, rows: FloatArray, offsets: FloatArray) -> IntArray | None:
    """Find the active set by the equivalent nonnegative least-squares problem ([1]_, chapter 23, algorithm LDP)."""
    from scipy.optimize import nnls

    # In z = e + q: minimize ||z|| subject to G z >= c + G q. The rows with u > 0 are the active ones.
    stacked = np.empty((target.size + 1, offsets.size))
    stacked[:-1], stacked[-1] = rows.T, offsets + rows.dot(target)
    goal = np.zeros(target.size + 1)
    goal[-1] = 1.0
    try:
        u, _ = nnls(stacked, goal, maxiter=10 * offsets.size + 30)
    except RuntimeError:
        return None
    return np.asarray((u > 0.0).nonzero()[0])


def _equality_solution(target: FloatArray, rows: FloatArray, offsets: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Minimize ½‖e + q‖² subject to G e = c for independent rows, by e = Q R⁻ᵀ c − (I − QQᵀ) q."""
    if offsets.size == 0:
        return -target, np.zeros(0)
    packed, tau, _, _ = lapack.dgeqrf(rows.T)  # `np.linalg.qr` takes five times longer on a small matrix
    Q, R = lapack.dorgqr(packed, tau)[0], packed[: offsets.size]
    # G' = Q R: e + q = G' lam lies in the range of Q, so that e = Q along - q with R' Q'e = c, and R lam = along.
    along = _solve_triangular(R, offsets, trans=1) + Q.T.dot(target)
    return Q.dot(along) - target, _solve_triangular(R, along)


def _select_independent(rows: FloatArray, working: IntArray) -> IntArray:
    """Return a maximal linearly independent part of the working set (unit rows)."""
    if working.size <= 1:
        return working
    R, order, *_ = lapack.dgeqp3(rows[working].T)
    rank = np.count_nonzero(np.abs(R.diagonal()) > 1e-11)
    return np.sort(working[order[:rank] - 1])


def _polish(
    target: FloatArray, rows: FloatArray, offsets: FloatArray, working: IntArray
) -> tuple[FloatArray, FloatArray] | None:
    """Return the solution on the working set if it is primal and dual feasible, otherwise None."""
    # The stages before are asked for the active set alone: one QR factorization on that set gives the numbers, or shows
    # that the set was wrong.
    working = _select_independent(rows, working)
    e, active_multipliers = _equality_solution(target, rows[working], offsets[working])
    size = max(1.0, float(np.max(np.abs(active_multipliers), initial=0.0)))
    wrong = np.count_nonzero(active_multipliers < -_WHITE_TOLERANCE * size)
    if wrong or not satisfies(rows, e, offsets - _WHITE_TOLERANCE) or not is_finite(e):
        return None
    multipliers = np.zeros(offsets.size)
    multipliers[working] = np.maximum(active_multipliers, 0.0)
    return e, multipliers


def _primal_active_set(target: FloatArray, rows: FloatArray, offsets: FloatArray) -> IntArray | None:
    """Find the optimal working set by the primal active-set method ([2]_, algorithm 16.3), with Bland's rule."""
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
        # As far along p as the first row that it approaches allows; of several, the lowest one joins (Bland: no
        # cycles).
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


def _refine(
    residual: FloatArray, rows: FloatArray, offsets: FloatArray, e: FloatArray, multipliers: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Do one step of iterative refinement: the residual is computed with B itself, not with its factor."""
    working = (multipliers > 0.0).nonzero()[0]
    active = rows[working]
    residual = residual - active.T.dot(multipliers[working])
    # The same programme for the error: residual for gradient, and what the active rows still miss for offsets.
    correction, change = _equality_solution(residual, active, offsets[working] - active.dot(e))
    changed = multipliers[working] + change
    if not norm(correction) <= 1e-4 * norm(e) + 1e-12 or np.count_nonzero(changed < 0.0):
        return e, multipliers
    refined = multipliers.copy()
    refined[working] = changed
    return e + correction, refined
