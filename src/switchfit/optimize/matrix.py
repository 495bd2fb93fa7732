"""Hessians: what full matrices and arrows (`switchfit.optimize.arrow`) share in the SQP, and full matrices.

Nothing else in the SQP looks at the entries of a Hessian.

References
----------
.. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, sections 3.4 and 16.7.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from switchfit.optimize import lapack
from switchfit.optimize.algebra import (
    EIGENVALUE_FLOOR,
    EIGENVALUE_REPLACEMENT,
    EQUILIBRATED,
    EQUILIBRATIONS,
    BoolArray,
    FloatArray,
    IntArray,
    equilibrate,
    is_finite,
    jacobi_scaling,
    mix_sides,
    norm,
    positive_eigenvalues,
    smallest,
    unit_rows,
)
from switchfit.optimize.qp import CholeskyFactor, Room, is_definite, solve_programme


class Spectrum(NamedTuple):
    """Eigenvalues of a Hessian on the free directions.

    Attributes
    ----------
    eigenvalues : array, shape (k,)
        Ascending, of the diagonally scaled Hessian; of an arrow the smallest alone. NaN where there is no Hessian.
    lowest : array, shape (d,)
        The direction of the smallest scaled eigenvalue, of unit length in theta.
    """

    eigenvalues: FloatArray
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
        """Eigenvalues and the lowest direction."""
        return self.find_spectrum()

    @property
    def smallest(self) -> float:
        """Smallest scaled eigenvalue; infinite on no directions, NaN where there is no Hessian."""
        values = self.spectrum.eigenvalues
        return float(values[0]) if values.size else np.inf


class SymmetricMatrix:
    """A symmetric matrix H, (d, d), whose entries are held in some arrays: the `parts`.

    It is no abstract base class: `isinstance` of one, in each evaluation, takes a hundredth of a fit.
    """

    @property
    def parts(self) -> tuple[FloatArray, ...]:
        """The arrays."""
        raise NotImplementedError

    @property
    def finite(self) -> bool:
        """Whether all entries are."""
        return all(map(is_finite, self.parts))

    def with_parts(self, *parts: FloatArray) -> Self:
        """Return a matrix of the same shape with other entries."""
        raise NotImplementedError

    def pairs(self, vector: FloatArray) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """Return the entries of a vector (d,) for rows and columns of each part, to be broadcast."""
        raise NotImplementedError

    def diagonal(self) -> FloatArray:
        """Return its diagonal: (d,)."""
        raise NotImplementedError

    def largest_in_rows(self) -> FloatArray:
        """Return the largest entry of each row, with its sign: (d,)."""
        raise NotImplementedError

    def dot(self, vector: FloatArray) -> FloatArray:
        """Return the product with a vector (d,); `@` takes three times longer on a small array."""
        raise NotImplementedError

    def __matmul__(self, vector: FloatArray) -> FloatArray:
        return self.dot(vector)

    def __abs__(self) -> Self:
        return self.with_parts(*map(np.abs, self.parts))

    def scale(self, scaling: FloatArray) -> Self:
        """Return D⁻¹ H D⁻¹ for a diagonal D (d,)."""
        pairs = zip(self.parts, self.pairs(scaling), strict=True)
        return self.with_parts(*(part / (a * b) for part, (a, b) in pairs))

    def mask(self, labels: FloatArray) -> Self:
        """Return the matrix without the entries that join unknowns of different labels (d,)."""
        pairs = zip(self.parts, self.pairs(labels), strict=True)
        return self.with_parts(*(part * (a == b) for part, (a, b) in pairs))

    def mix_sides(self, minus: SymmetricMatrix, sides: FloatArray) -> Self:
        """Mix with `minus`: this one where two unknowns are on the right (sides 1), it on the left, else the mean."""
        pairs = zip(self.parts, minus.parts, self.pairs(sides), strict=True)
        return self.with_parts(*(mix_sides(right, left, a + b) for right, left, (a, b) in pairs))


def diagonal_scaling(matrix: SymmetricMatrix, floor: FloatArray | None = None) -> FloatArray:
    """Return a positive D, shape (d,), for which D⁻¹ H D⁻¹ has rows of largest entry about one.

    For a positive semi-definite H this is the root of the diagonal (Jacobi), so that everything computed in the
    scaled variables is the same whatever the units of the unknowns. Where off-diagonal entries are larger, as they
    may be in an indefinite H, a few rounds of symmetric equilibration follow.

    Parameters
    ----------
    matrix : SymmetricMatrix
        H.
    floor : array, shape (d,), optional
        Diagonal entries too small to matter, below which D² does not go.
    """
    size = abs(matrix)
    diagonal = size.diagonal() if floor is None else np.maximum(size.diagonal(), floor)
    scaling: FloatArray = jacobi_scaling(diagonal, size.largest_in_rows())
    # |H_ij| <= sqrt(H_ii H_jj) for a semi-definite H: Jacobi's scaling passes at once. Only an indefinite one goes on.
    for _ in range(EQUILIBRATIONS):
        largest = size.scale(scaling).largest_in_rows()
        if (largest <= EQUILIBRATED).all():
            break
        scaling = equilibrate(scaling, largest)
    return scaling


STIFFENINGS = (1.0, 1e2, 1e4, 1e6)
"""By how much directions across the constraints expected to be active are made stiffer, in turn."""

RAISED = 2.0
"""Multiple of the smallest eigenvalue by which an indefinite matrix is shifted inside a trust region."""


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

    @classmethod
    def identity(cls, d: int, factor: float) -> Dense:
        """Return a multiple of the identity (d, d)."""
        return cls(factor * np.eye(d))

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
        self, normals: FloatArray, floor: FloatArray | None = None, reach: FloatArray | None = None
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
        floor : array, shape (d,), optional
            See `diagonal_scaling`.
        reach : array, shape (d,), optional
            Half-widths of the trust region.

        References
        ----------
        .. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, sections 3.4 and 16.7.
        """
        # The usual case: a Cholesky factorization of the scaled H less the floor shows that H is definite.
        diagonal = self.diagonal()
        square = diagonal if floor is None else np.maximum(diagonal, floor)
        if smallest(square) > 0.0:
            # A positive definite matrix needs no more than Jacobi's scaling.
            scaling = np.sqrt(square)
            scaled = self.array / (scaling[:, None] * scaling)
            factor = CholeskyFactor.of_scaled(scaled, scaling) if _has_curvature(scaled) else None
            if factor is not None:
                return self, factor
        convex = _convex(self.array, normals, floor, reach)
        return (self if convex is self.array else Dense(convex)), CholeskyFactor.of(convex)

    def solve(self, gradient: FloatArray, factor: CholeskyFactor, room: Room) -> tuple[FloatArray, FloatArray]:
        """Minimize ``gᵀd + ½ dᵀBd`` inside a room, B being this matrix; result as of `solve_programme`."""
        return solve_programme(gradient, self.array, factor, room)

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


def _find_spectrum(array: FloatArray, flat: FloatArray, free: IntArray, normals: FloatArray) -> Spectrum:
    """Return the eigenvalues of a matrix (d, d) in the null space of normals (k, f) of the free unknowns (f,)."""
    lowest = np.zeros(len(array))
    if not is_finite(array):
        return Spectrum(np.array([np.nan]), lowest)
    block = array[np.ix_(free, free)]
    scaling = diagonal_scaling(Dense(block), flat[free])
    # With theta = D^-1 y the normals are N D^-1, and their null space is another one than that of N.
    null = null_space(normals / scaling)
    if null.size == 0:
        return Spectrum(np.zeros(0), lowest)
    values, vectors = np.linalg.eigh(null.T @ (block / (scaling[:, None] * scaling)) @ null)
    lowest[free] = null @ vectors[:, 0] / scaling
    return Spectrum(values, lowest / norm(lowest))


def null_space(normals: FloatArray) -> FloatArray:
    """Return an orthonormal basis of the null space of normals (k, d): shape (d, d - r)."""
    if normals.size == 0:
        return np.eye(normals.shape[1])
    _, sizes, right = np.linalg.svd(unit_rows(normals)[0])
    return np.asarray(right[np.count_nonzero(sizes > 1e-11) :].T)


def _add_to_diagonal(matrix: FloatArray, amount: float) -> FloatArray:
    """Return the matrix with an amount added to each entry of its diagonal."""
    changed = matrix.copy()
    changed.reshape(-1)[:: len(matrix) + 1] += amount
    return changed


def _has_curvature(scaled: FloatArray) -> bool:
    """Return whether all eigenvalues of a scaled matrix are above `EIGENVALUE_FLOOR`."""
    return is_definite(_add_to_diagonal(scaled, -EIGENVALUE_FLOOR))


def _convex(hessian: FloatArray, normals: FloatArray, floor: FloatArray | None, reach: FloatArray | None) -> FloatArray:
    """Return B for a matrix that is not positive definite, or was not found to be with Jacobi's scaling."""
    if reach is not None:
        # In the metric of the region all unknowns that move by their reach are alike: a multiple of the identity is
        # added there.
        weight = 1.0 / (reach[:, None] * reach)
        return _convex_on_face(hessian / weight, normals * reach, lambda matrix: shift_to_positive(matrix)[0]) * weight
    scaling = diagonal_scaling(Dense(hessian), floor)
    weight = scaling[:, None] * scaling
    scaled = hessian / weight
    if _has_curvature(scaled):
        return hessian
    return _convex_on_face(scaled, normals / scaling, make_absolute) * weight


def _convex_on_face(
    scaled: FloatArray, normals: FloatArray, make_definite: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    """Return a positive definite matrix that differs from a scaled one across the normals alone if that is enough."""
    across = unit_rows(normals)[0]
    across = across.T @ across
    # H + sigma N'N is H on the face, and positive definite for a large sigma if and only if H is there ([1]_, 17.4).
    for stiffness in STIFFENINGS if len(normals) else ():
        stiff = scaled + stiffness * across
        if _has_curvature(stiff):
            return stiff
    return make_definite(scaled)


def shift_to_positive(matrix: FloatArray, least: float = 0.0) -> tuple[FloatArray, bool]:
    """Return the matrix with all eigenvalues raised until the smallest is positive, or `least`, and whether it was."""
    symmetric = 0.5 * (matrix + matrix.T)
    if not matrix.size:
        return symmetric, True
    values = lapack.dsyev(symmetric, compute_v=0)[0]
    lowest, highest = float(values[0]), float(values[-1])
    margin = max(EIGENVALUE_FLOOR * max(abs(lowest), abs(highest)), least)
    if lowest > margin:
        return symmetric, True
    margin = margin or EIGENVALUE_REPLACEMENT  # without any curvature nothing says how large it is
    return _add_to_diagonal(symmetric, margin - RAISED * min(lowest, 0.0)), False


def make_absolute(matrices: FloatArray) -> FloatArray:
    """Return symmetric matrices (..., d, d) with eigenvalues that are not positive replaced by absolute values."""
    values, vectors = np.linalg.eigh(matrices)
    convex = (vectors * positive_eigenvalues(values)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return np.asarray(0.5 * (convex + np.swapaxes(convex, -1, -2)))
