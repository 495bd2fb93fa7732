"""Full matrices as Hessians: quadratic programme, convexification, and curvature on the free directions.

References
----------
.. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, sections 3.4 and 4.3.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import BoolArray, FloatArray, IntArray
from switchfit.optimize import algebra, positive_definite, qp
from switchfit.optimize.curvature import FreeCurvature, Spectrum, null_space
from switchfit.optimize.positive_definite import Change, CholeskyFactor, make_absolute, make_convex_on_face
from switchfit.optimize.qp import Room
from switchfit.optimize.symmetric_matrix import SymmetricMatrix, diagonal_scaling


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
        eigenvalues are replaced by their absolute values ([1]_, section 3.4), or inside a trust region shifted ([1]_,
        section 4.3). All of this is done in scaled variables.

        Parameters
        ----------
        normals : array, shape (k, d)
            Normals of the constraints expected to be active.
        floor : array, shape (d,), or 0
            See `diagonal_scaling`.
        reach : array, shape (d,), optional
            Half-widths of the trust region.
        """
        # The usual case: a Cholesky factorization of the scaled H less the floor shows that H is definite.
        square = np.maximum(self.diagonal(), floor)
        if algebra.smallest(square) > 0.0:
            # A positive definite matrix needs no more than Jacobi's scaling.
            scaling = np.sqrt(square)
            scaled = self.array / (scaling[:, None] * scaling)
            factor = CholeskyFactor.of_scaled(scaled, scaling) if positive_definite.has_curvature(scaled) else None
            if factor is not None:
                return self, factor
        make_definite: Change = make_absolute
        if reach is None:
            # Negative or vanishing diagonal entries, or an H that is definite only in another scaling than Jacobi's.
            scaling = diagonal_scaling(self, floor)
            weight, rows = scaling[:, None] * scaling, normals / scaling
            if positive_definite.has_curvature(self.array / weight):
                return self, CholeskyFactor.of(self.array)
        else:
            # In the metric of the region all unknowns that move by their reach are alike: a multiple of the identity is
            # added there.
            weight, rows = 1.0 / (reach[:, None] * reach), normals * reach
            make_definite = lambda matrix: positive_definite.shift_to_positive(matrix)[0]  # noqa: E731
        convex = make_convex_on_face(self.array / weight, rows, make_definite) * weight
        return Dense(convex), CholeskyFactor.of(convex)

    def solve(self, gradient: FloatArray, factor: CholeskyFactor, room: Room) -> tuple[FloatArray, FloatArray]:
        """Minimize ``gᵀd + ½ dᵀBd`` inside a room, B being this matrix; result as of `solve_programme`."""
        return qp.solve_programme(gradient, self.array, factor, room)

    def curvature(self, normals: FloatArray, held: BoolArray, flat: FloatArray) -> FreeCurvature:
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
        return FreeCurvature(basis, partial(_find_spectrum, self.array, flat, free, normals))


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
