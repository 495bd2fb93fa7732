"""Hessians: what the SQP asks of full matrices and of arrows. Nothing else in it looks at their entries.

An arrow is the Hessian of many runs with unknowns of their own, and a few unknowns that they share. Two unknowns of
different runs never meet in one term of J, so that with the own unknowns of each run first

        ( H_1             G_1 )
    H = (      ...        ... )        H_e: blocks (k, k),  G_e: borders (k, s),  C: corner (s, s).
        (           H_R   G_R )
        ( G_1' ...  G_R'  C   )

All is done block by block, at a cost that is linear in the number R of runs: products, the Cholesky factorization (own
unknowns first, then the Schur complement ``C - sum_e G_e' H_e^-1 G_e`` of the shared ones), the quadratic programme,
and making H positive definite. Constraints join unknowns of one run at most, so that they keep this shape.

Runs with fewer than k own unknowns are padded with unknowns that are zero: ones on the diagonal, nothing beside it.

References
----------
.. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, sections 3.4 and 16.7.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from switchfit.optimize import algebra, qp
from switchfit.optimize.algebra import BoolArray, FloatArray, IntArray
from switchfit.optimize.qp import CholeskyFactor, Room


class Spectrum(NamedTuple):
    """The lowest end of the spectrum of a Hessian on the free directions.

    Attributes
    ----------
    smallest : float
        Smallest eigenvalue of the diagonally scaled Hessian; NaN without free directions, or without a Hessian. Of an
        arrow, infinite where all are above `algebra.EIGENVALUE_FLOOR`: how large they are is not needed then.
    lowest : array, shape (d,)
        Its direction, of unit length in theta.
    """

    smallest: float
    lowest: FloatArray


@dataclass(frozen=True, eq=False)
class Curvature:
    """Hessian on the free directions.

    Attributes
    ----------
    basis : array, shape (d, k)
        Orthonormal basis of these directions.
    find_spectrum : callable
        Computes the `Spectrum` when it is first read, which is not needed at an ordinary minimum.
    idle : array of bool, shape (d,), or None
        Coordinates left out as idle, beside those of the point.
    """

    basis: FloatArray
    find_spectrum: Callable[[], Spectrum]
    idle: BoolArray | None = None

    @cached_property
    def spectrum(self) -> Spectrum:
        """Smallest eigenvalue and its direction."""
        return self.find_spectrum()


class SymmetricMatrix:
    """A symmetric matrix H, (d, d), whose entries are held in some arrays: the `parts`.

    It is no abstract base class: `isinstance` of one, in each evaluation, takes a hundredth of a fit.
    """

    @property
    def parts(self) -> tuple[FloatArray, ...]:
        """The arrays."""
        raise NotImplementedError

    def with_parts(self, *parts: FloatArray) -> Self:
        """Return a matrix of the same shape with other entries."""
        raise NotImplementedError

    def pairs(self, vector: FloatArray) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """Return the entries of a vector (d,) for rows and columns of each part, to be broadcast."""
        raise NotImplementedError

    def change(self, vector: FloatArray, function: Callable[[FloatArray, FloatArray, FloatArray], FloatArray]) -> Self:
        """Return the matrix of ``function(H_ij, v_i, v_j)`` for a vector v (d,)."""
        pairs = zip(self.parts, self.pairs(vector), strict=True)
        return self.with_parts(*(function(part, a, b) for part, (a, b) in pairs))

    @property
    def finite(self) -> bool:
        """Whether all entries are."""
        return all(map(algebra.is_finite, self.parts))

    def absolute(self) -> Self:
        """Return the matrix of the absolute values of the entries."""
        return self.with_parts(*map(np.abs, self.parts))

    def scale(self, scaling: FloatArray) -> Self:
        """Return D⁻¹ H D⁻¹ for a diagonal D (d,)."""
        return self.change(scaling, lambda part, a, b: part / (a * b))

    def mask(self, labels: FloatArray) -> Self:
        """Return the matrix without the entries that join unknowns of different labels (d,)."""
        return self.change(labels, lambda part, a, b: part * (a == b))

    def mix_sides(self, minus: SymmetricMatrix, sides: FloatArray) -> Self:
        """Mix with `minus`: this one where two unknowns are on the right (sides 1), it on the left, else the mean."""
        pairs = zip(self.parts, minus.parts, self.pairs(sides), strict=True)
        return self.with_parts(*(algebra.mix_sides(right, left, a + b) for right, left, (a, b) in pairs))


def diagonal_scaling(matrix: Dense | Arrow, floor: FloatArray | float = 0.0) -> FloatArray:
    """Return a positive D, shape (d,), for which D⁻¹ H D⁻¹ has rows of largest entry about one.

    For a positive semi-definite H this is the root of the diagonal (Jacobi), so that everything computed in the
    scaled variables is the same whatever the units of the unknowns. Where off-diagonal entries are larger, as they
    may be in an indefinite H, a few rounds of symmetric equilibration follow.

    Parameters
    ----------
    matrix : Dense or Arrow
        H.
    floor : array, shape (d,), or 0
        Diagonal entries too small to matter, below which D² does not go.
    """
    size = matrix.absolute()
    scaling: FloatArray = algebra.jacobi_scaling(np.maximum(size.diagonal(), floor), size.largest_in_rows())
    # |H_ij| <= sqrt(H_ii H_jj) for a semi-definite H: Jacobi's scaling passes at once. Only an indefinite one goes on.
    for _ in range(algebra.EQUILIBRATIONS):
        largest = size.scale(scaling).largest_in_rows()
        if (largest <= algebra.EQUILIBRATED).all():
            break
        scaling = algebra.equilibrate(scaling, largest)
    return scaling


Change = Callable[[FloatArray], FloatArray]
"""Returns another matrix (d, d)."""

STIFFENINGS = (1.0, 1e2, 1e4, 1e6)
"""By how much directions across the constraints expected to be active are made stiffer, in turn."""


@dataclass(eq=False)  # frozen, one takes five times longer to make
class Dense(SymmetricMatrix):
    """A symmetric matrix held in full.

    Attributes
    ----------
    array : array, shape (d, d)
    """

    array: FloatArray

    @classmethod
    def of(cls, entries: ArrayLike, d: int) -> Dense:
        """Return the symmetric part of a matrix (d, d)."""
        array = np.asarray(entries, dtype=float).reshape(d, d)
        twice = array + array.T
        twice *= 0.5
        return cls(twice)

    @property
    def parts(self) -> tuple[FloatArray]:
        """The array."""
        return (self.array,)

    def with_parts(self, *parts: FloatArray) -> Dense:
        """Return a matrix with other entries."""
        return Dense(*parts)

    def pairs(self, vector: FloatArray) -> tuple[tuple[FloatArray, FloatArray]]:
        """Return the entries of a vector (d,) for rows and columns, to be broadcast."""
        return ((vector[:, None], vector),)

    def dense(self) -> FloatArray:
        """Return the matrix in full: (d, d)."""
        return self.array

    def diagonal(self) -> FloatArray:
        """Return its diagonal: (d,)."""
        return self.array.diagonal()

    def largest_in_rows(self) -> FloatArray:
        """Return the largest entry of each row, with its sign: (d,)."""
        return np.asarray(self.array.max(axis=1, initial=0.0))

    def dot(self, vector: FloatArray) -> FloatArray:
        """Return the product with a vector: (d,)."""
        return np.asarray(self.array.dot(vector))

    def keep(self, free: BoolArray) -> tuple[Dense, IntArray]:
        """Return the matrix of the free unknowns (d,) alone, and their places."""
        part = np.flatnonzero(free)
        return Dense(self.array[part[:, None], part]), part

    def convexify(
        self, normals: FloatArray, floor: FloatArray | float = 0.0, reach: FloatArray | None = None
    ) -> tuple[Dense, CholeskyFactor]:
        """Return a positive definite B that equals H wherever H can be kept, and its factorization; d > 0.

        A positive definite H is kept. Otherwise directions across the constraints expected to be active are made
        stiffer, which leaves Newton's step on their face unspoiled. If H is not positive definite on the face either,
        eigenvalues are replaced by their absolute values, or inside a trust region shifted. All of this is done in
        scaled variables.

        Parameters
        ----------
        normals : array, shape (k, d)
            Normals of the constraints expected to be active.
        floor : array, shape (d,), or 0
            See `diagonal_scaling`.
        reach : array, shape (d,), optional
            Half-widths of the trust region.

        References
        ----------
        .. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, sections 3.4 and 16.7.
        """
        # The usual case: a Cholesky factorization of the scaled H less the floor shows that H is definite.
        square = np.maximum(self.diagonal(), floor)
        if algebra.smallest(square) > 0.0:
            # A positive definite matrix needs no more than Jacobi's scaling.
            scaling = np.sqrt(square)
            scaled = self.array / (scaling[:, None] * scaling)
            factor = CholeskyFactor.of_scaled(scaled, scaling) if qp.has_curvature(scaled) else None
            if factor is not None:
                return self, factor
        make_definite: Change = make_absolute
        if reach is None:
            scaling = diagonal_scaling(self, floor)
            weight, rows = scaling[:, None] * scaling, normals / scaling
            if qp.has_curvature(self.array / weight):
                return self, CholeskyFactor.of(self.array)
        else:
            # In the metric of the region all unknowns that move by their reach are alike: a multiple of the identity is
            # added there.
            weight, rows = 1.0 / (reach[:, None] * reach), normals * reach
            make_definite = lambda matrix: qp.shift_to_positive(matrix)[0]  # noqa: E731
        convex = _convex_on_face(self.array / weight, rows, make_definite) * weight
        return Dense(convex), CholeskyFactor.of(convex)

    def solve(self, gradient: FloatArray, factor: CholeskyFactor, room: Room) -> tuple[FloatArray, FloatArray]:
        """Minimize ``gᵀd + ½ dᵀBd`` inside a room, B being this matrix; result as of `solve_programme`."""
        return qp.solve_programme(gradient, self.array, factor, room)

    def curvature(self, normals: FloatArray, held: BoolArray, flat: FloatArray) -> Curvature:
        """Return the unmodified curvature in the null space of normals (k, d), without the coordinates held (d,).

        Diagonal entries below `flat` (d,) count as zero.
        """
        free = np.flatnonzero(~held)
        normals = normals[:, free]
        basis = np.eye(len(held))
        # A basis in theta, for those who report it; the spectrum is found in scaled unknowns, when it is first read.
        if len(normals) or free.size < len(held):
            null = null_space(normals)
            basis = np.zeros((len(held), null.shape[1]))
            basis[free] = null
        return Curvature(basis, partial(_find_spectrum, self.array, flat, free, normals))


@dataclass(frozen=True, eq=False)
class ArrowLayout:
    """Where each unknown stands.

    Attributes
    ----------
    size : int
        d, the number of unknowns.
    own : (R, k) int array
        Positions of the own unknowns of each run; d, one past the last, where it has fewer than k.
    shared : (s,) int array
        Positions of all others.
    """

    size: int
    own: IntArray
    shared: IntArray

    @classmethod
    def of(cls, size: int, places: Sequence[IntArray]) -> ArrowLayout:
        """Return the layout of runs, each of which depends on the unknowns at the given places."""
        used = [np.unique(where[where >= 0]) for where in places]
        count = np.bincount(np.concatenate(used), minlength=size)
        alone = [where[count[where] == 1] for where in used]
        own = np.full((len(used), max(map(len, alone))), size, dtype=np.intp)
        for e, where in enumerate(alone):
            own[e, : len(where)] = where
        return cls(size, own, np.flatnonzero(count != 1))

    def slots(self, e: int, places: IntArray) -> IntArray:
        """Return the index of unknowns of run e in its own (k) and the shared (s) ones, one after the other."""
        order = np.concatenate([self.own[e], self.shared])
        return np.array([np.flatnonzero(order == place)[0] for place in places], dtype=np.intp)

    def split(self, vector: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the own (R, k), zero where padded, and shared (s,) entries of a vector (d,)."""
        return np.append(vector, 0.0)[self.own], vector[self.shared]

    def join(self, own: FloatArray, shared: FloatArray) -> FloatArray:
        """Return the vector (d,) with these own (R, k) and shared (s,) entries."""
        vector = np.zeros(self.size + 1)
        vector[self.own] = own
        vector[self.shared] = shared
        return vector[:-1]


@dataclass(frozen=True, eq=False)
class Arrow(SymmetricMatrix):
    """A symmetric matrix of the shape above.

    Attributes
    ----------
    layout : ArrowLayout
    blocks, borders, corner : (R, k, k), (R, k, s), (s, s) arrays
    """

    layout: ArrowLayout
    blocks: FloatArray
    borders: FloatArray
    corner: FloatArray

    @classmethod
    def of_runs(cls, layout: ArrowLayout, parts: FloatArray) -> Arrow:
        """Return the sum of symmetric matrices (R, k + s, k + s), one a run, in the order of `ArrowLayout.slots`."""
        k = layout.own.shape[1]
        stacked = 0.5 * (parts + np.swapaxes(parts, 1, 2))
        blocks = stacked[:, :k, :k].copy()
        # Ones where a run is padded: its block stays regular, and the unknown that is not there stays zero.
        padded = layout.own == layout.size
        blocks[:, np.arange(k), np.arange(k)] += padded
        return cls(layout, blocks, stacked[:, :k, k:], stacked[:, k:, k:].sum(0))

    @property
    def parts(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Blocks, borders and corner."""
        return self.blocks, self.borders, self.corner

    def with_parts(self, *parts: FloatArray) -> Arrow:
        """Return a matrix of the same shape with other entries."""
        return Arrow(self.layout, *parts)

    def pairs(self, vector: FloatArray) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """Return the entries of a vector (d,), 1 where padded, for rows and columns of each part, to be broadcast."""
        own, shared = np.append(vector, 1.0)[self.layout.own], vector[self.layout.shared]
        return (own[:, :, None], own[:, None, :]), (own[:, :, None], shared), (shared[:, None], shared)

    def dot(self, vector: FloatArray) -> FloatArray:
        """Return the product with a vector: (d,)."""
        own, shared = self.layout.split(vector)
        of_own = (self.blocks @ own[..., None])[..., 0] + self.borders @ shared
        return self.layout.join(of_own, np.einsum("eks,ek->s", self.borders, own) + self.corner @ shared)

    def diagonal(self) -> FloatArray:
        """(d,)."""
        return self.layout.join(np.diagonal(self.blocks, axis1=1, axis2=2), np.diagonal(self.corner))

    def largest_in_rows(self) -> FloatArray:
        """Return the largest entry of each row: (d,)."""
        own = np.maximum(self.blocks.max(2, initial=0.0), self.borders.max(2, initial=0.0))
        shared = np.maximum(self.borders.max((0, 1), initial=0.0), self.corner.max(1, initial=0.0))
        return self.layout.join(own, shared)

    def dense(self) -> FloatArray:
        """Return the matrix in full: (d, d)."""
        d, layout = self.layout.size, self.layout
        full = np.zeros((d + 1, d + 1))
        full[layout.own[:, :, None], layout.own[:, None, :]] = self.blocks
        full[layout.own[:, :, None], layout.shared] = self.borders
        full[layout.shared[:, None, None], layout.own] = np.moveaxis(self.borders, 2, 0)
        full[layout.shared[:, None], layout.shared] = self.corner
        return full[:d, :d]

    def plus_diagonal(self, value: float | FloatArray) -> Arrow:
        """Return H + value I, or H + diag(value) for a value (d,)."""
        k = self.blocks.shape[1]
        own, shared = self.layout.split(np.broadcast_to(value, self.layout.size))
        return replace(self, blocks=self.blocks + own[:, :, None] * np.eye(k), corner=self.corner + np.diag(shared))

    def held(self, free: BoolArray) -> Arrow:
        """Return the matrix with rows and columns of the identity for the unknowns that are not free."""
        kept = self.change(np.asarray(free, dtype=float), lambda part, a, b: part * a * b)
        return kept.plus_diagonal(np.where(free, 0.0, 1.0))

    def keep(self, free: BoolArray) -> tuple[Arrow, IntArray]:
        """Return the matrix with those unknowns decoupled that are not free (d,), and the places of all."""
        return self.held(free), np.arange(self.layout.size)

    def convexify(
        self, normals: FloatArray, floor: FloatArray, reach: FloatArray | None = None
    ) -> tuple[Arrow, ArrowFactor]:
        """Return a positive definite B of the same shape that equals H wherever H can be kept, and its factorization.

        As `Dense.convexify` does, outside of a trust region. Where H is not positive definite on the face of the
        constraints, eigenvalues of its blocks are replaced, and then those of the Schur complement of the shared
        unknowns.

        Parameters
        ----------
        normals : (r, d)
            Normals of the constraints expected to be active; each joins unknowns of one run, or shared ones.
        floor : (d,)
            See `diagonal_scaling`.
        reach : None
            There is no trust region, whose one radius would suit no run.
        """
        layout, scaling = self.layout, diagonal_scaling(self, floor)
        scaled = self.scale(scaling)
        # N'N, with the rows of the scaled unknowns.
        rows = algebra.unit_rows(normals / scaling)[0]
        own, shared = np.append(rows, np.zeros((len(rows), 1)), axis=1)[:, layout.own], rows[:, layout.shared]
        across = Arrow(
            layout, np.einsum("rek,rel->ekl", own, own), np.einsum("rek,rs->eks", own, shared), shared.T @ shared
        )
        for stiffness in (0.0, *STIFFENINGS) if len(normals) else (0.0,):
            pairs = zip(scaled.parts, across.parts, strict=True)
            stiff = scaled.with_parts(*(part + stiffness * other for part, other in pairs))
            if ArrowFactor.of(stiff.plus_diagonal(-algebra.EIGENVALUE_FLOOR)) is not None:
                convex = stiff.scale(1.0 / scaling) if stiffness else self
                break
        else:
            convex = _replace_eigenvalues(scaled).scale(1.0 / scaling)
        factor, ridge = ArrowFactor.of(convex), algebra.EIGENVALUE_FLOOR
        while factor is None:  # rounding, where a block is nearly singular
            convex, ridge = convex.plus_diagonal(ridge * scaling**2), 10.0 * ridge
            factor = ArrowFactor.of(convex)
        return convex, factor

    def solve(self, gradient: FloatArray, factor: ArrowFactor, room: Room) -> tuple[FloatArray, FloatArray]:
        """Minimize ``gᵀd + ½ dᵀBd`` inside a room, B being this matrix; result as of `solve_programme`.

        The programme is solved with the constraints that the step before has violated, until it violates no other:
        since it is strictly convex, that is the solution with all of them.
        """
        step = newton = qp.newton_step(gradient, self, factor)
        pull, size = np.zeros(len(room.lower)), np.sqrt((room.normals**2).sum(1))
        working = np.zeros(0, dtype=np.intp)
        # Thousands of rows for many runs, few of which matter: the working set only grows, so that the loop ends.
        while True:
            products = room.normals @ step
            # From the second round on rounding may violate a row.
            rounding = 1e-13 * size * np.max(np.abs(step), initial=0.0) if working.size else 0.0
            violated = (products < room.lower - rounding) | (products > room.upper + rounding)
            violated[working] = False
            if not violated.any():
                return room.press(step, pull), pull
            working = np.union1d(working, np.flatnonzero(violated))
            rows = room.normals[working]
            # The step is a combination of Newton's and of B⁻¹ C', C being the working set: as many unknowns as that
            # has.
            spanning = np.array([newton, *(factor.solve(row) for row in rows)]) * factor.scaling
            span = np.linalg.qr(spanning.T)[0] / factor.scaling[:, None]
            reduced = np.array([self.dot(direction) for direction in span.T]) @ span
            within = room.lower[working], room.upper[working]
            step, pull[working] = qp.solve_in_span(gradient, reduced, span, rows, *within)

    def curvature(self, normals: FloatArray, held: BoolArray, flat: FloatArray) -> Curvature:
        """Return the curvature in the null space of normals (k, d), as `Dense.curvature`.

        Block by block where each normal is that of a bound, to see that all eigenvalues are positive. All other cases
        are rare enough to be left to the algebra of full matrices.
        """
        # A normal with one entry is that of a bound: its null space is made of coordinates, and the arrow keeps its
        # shape there.
        rows, places = np.nonzero(normals)
        if len(rows) != len(normals) or not self.finite:
            return Dense(self.dense()).curvature(normals, held, flat)
        left_out = held.copy()
        left_out[places] = True

        def find_spectrum() -> Spectrum:
            # Scaled as in full: eigenvalues have no unit.
            kept = self.held(~left_out)
            scaled = kept.scale(diagonal_scaling(kept, flat))
            if left_out.all() or ArrowFactor.of(scaled.plus_diagonal(-algebra.EIGENVALUE_FLOOR)) is None:
                return Dense(self.dense()).curvature(normals, held, flat).spectrum
            return Spectrum(np.inf, np.zeros(len(held)))

        return Curvature(np.eye(len(held))[:, ~left_out], find_spectrum)


Hessian = Dense | Arrow


@dataclass(frozen=True, eq=False)
class ArrowFactor:
    """``B = D L Lᵀ D`` with own unknowns first: L_e of the blocks, ``W_e = L_e⁻¹ G_e``, and L_s of the complement.

    White vectors are the own ones of all runs, padding included, followed by the shared ones: (R k + s,).
    """

    layout: ArrowLayout
    scaling: FloatArray
    own: FloatArray  # (R, k, k)
    border: FloatArray  # (R, k, s)
    shared: FloatArray  # (s, s)

    @classmethod
    def of(cls, matrix: Arrow) -> ArrowFactor | None:
        """Return the factorization; None where the matrix is not positive definite."""
        variances = matrix.diagonal()
        if not np.all(variances > 0.0):
            return None
        scaling = np.sqrt(variances)
        scaled = matrix.scale(scaling)
        try:
            # H_e = L_e L_e', W_e = L_e^-1 G_e, and L_s L_s' = C - sum_e W_e' W_e: the Schur complement of the blocks.
            # The matrix is positive definite if and only if all of these exist.
            own = np.asarray(np.linalg.cholesky(scaled.blocks), float)
            border = np.asarray(np.linalg.solve(own, scaled.borders), float)
            shared = np.linalg.cholesky(scaled.corner - np.einsum("eks,ekt->st", border, border))
        except np.linalg.LinAlgError:
            return None
        return cls(matrix.layout, np.asarray(scaling, float), own, border, shared)

    @cached_property
    def _inverses(self) -> tuple[FloatArray, FloatArray]:
        """L_e⁻¹ and L_s⁻¹: each is used a few times, and NumPy has no triangular solve of many small systems."""
        return np.asarray(np.linalg.inv(self.own), float), np.asarray(np.linalg.inv(self.shared), float)

    def solve(self, vector: FloatArray) -> FloatArray:
        """Return B⁻¹ v."""
        of_own, of_shared = self._inverses
        # Forward substitution: y_e = L_e^-1 v_e, then L_s^-1 (v_s - sum_e W_e' y_e); backward: the shared ones first,
        # then L_e^-T (y_e - W_e x_s).
        own, shared = self.layout.split(vector / self.scaling)
        own = (of_own @ own[..., None])[..., 0]
        shared = of_shared.T @ (of_shared @ (shared - np.einsum("eks,ek->s", self.border, own)))
        own = (np.swapaxes(of_own, 1, 2) @ (own - self.border @ shared)[..., None])[..., 0]
        return self.layout.join(own, shared) / self.scaling


def _replace_eigenvalues(scaled: Arrow) -> Arrow:
    """Return the matrix with eigenvalues of its blocks, and of the Schur complement, that are not positive replaced."""
    values, vectors = np.linalg.eigh(scaled.blocks)
    # An eigenvalue that is replaced is made large enough for the shared unknowns not to lose their own curvature to it.
    # (v' G)^2 / lam is what an eigenvalue lam takes from the diagonal of the Schur complement, which is 1 at most after
    # scaling: with lam >= 2 sum_s (v' G_s)^2 one eigenvalue takes half of it at most.
    coupling = (np.swapaxes(vectors, 1, 2) @ scaled.borders) ** 2
    changed = np.maximum(algebra.positive_eigenvalues(values), 2.0 * coupling.sum(2))
    changed = np.where(values > algebra.EIGENVALUE_FLOOR, values, changed)
    # Blocks that are positive definite stay as they are, to the last bit.
    indefinite = values[:, 0] <= algebra.EIGENVALUE_FLOOR
    blocks = np.where(indefinite[:, None, None], _compose(changed, vectors), scaled.blocks)
    tie = np.einsum("eks,ekt->st", scaled.borders, np.linalg.solve(blocks, scaled.borders))
    # B has the borders of H: its Schur complement C - sum_e G_e' B_e^-1 G_e is convex with the tie added to the corner.
    corner = tie
    if corner.size:
        complement = Dense.of(scaled.corner - tie, len(tie))
        corner = complement.convexify(np.zeros((0, len(tie))))[0].array + tie
    return Arrow(scaled.layout, blocks, scaled.borders, 0.5 * (corner + corner.T))


def _find_spectrum(array: FloatArray, flat: FloatArray, free: IntArray, normals: FloatArray) -> Spectrum:
    """Return the eigenvalues of a matrix (d, d) in the null space of normals (k, f) of the free unknowns (f,)."""
    lowest = np.zeros(len(array))
    if not algebra.is_finite(array):
        return Spectrum(np.nan, lowest)
    block = array[np.ix_(free, free)]
    scaling = diagonal_scaling(Dense(block), flat[free])
    # With theta = D^-1 y the normals are N D^-1, and their null space is another one than that of N.
    null = null_space(normals / scaling)
    if null.size == 0:
        return Spectrum(np.nan, lowest)
    values, vectors = np.linalg.eigh(null.T @ (block / (scaling[:, None] * scaling)) @ null)
    lowest[free] = null @ vectors[:, 0] / scaling
    return Spectrum(float(values[0]), lowest / algebra.norm(lowest))


def null_space(normals: FloatArray) -> FloatArray:
    """Return an orthonormal basis of the null space of normals (k, d): shape (d, d - r)."""
    if normals.size == 0:
        return np.eye(normals.shape[1])
    _, sizes, right = np.linalg.svd(algebra.unit_rows(normals)[0])
    return np.asarray(right[np.count_nonzero(sizes > 1e-11) :].T)


def _convex_on_face(scaled: FloatArray, normals: FloatArray, make_definite: Change) -> FloatArray:
    """Return a positive definite matrix that differs from a scaled one across the normals alone if that is enough."""
    across = algebra.unit_rows(normals)[0]
    across = across.T @ across
    # H + sigma N'N is H on the face, and positive definite for a large sigma if and only if H is there ([1]_, 17.4).
    for stiffness in STIFFENINGS if len(normals) else ():
        stiff = scaled + stiffness * across
        if qp.has_curvature(stiff):
            return stiff
    return make_definite(scaled)


def make_absolute(matrix: FloatArray) -> FloatArray:
    """Return a symmetric matrix (d, d) with eigenvalues that are not positive replaced by absolute values."""
    values, vectors = np.linalg.eigh(matrix)
    return _compose(algebra.positive_eigenvalues(values), vectors)


def _compose(values: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return the symmetric matrices (..., d, d) with these eigenvalues and eigenvectors."""
    matrices = (vectors * values[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return np.asarray(0.5 * (matrices + np.swapaxes(matrices, -1, -2)))
