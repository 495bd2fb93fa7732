"""Positive definite matrices: their Cholesky factorization, and how indefinite ones are made definite.

A matrix that is positive definite is kept. Otherwise it is made stiffer across the constraints expected to be active,
which leaves Newton's step on their face unspoiled; if that is not enough, its eigenvalues are shifted (inside a trust
region) or replaced by their absolute values ([1]_, section 3.4).

References
----------
.. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, sections 3.4, 4.3 and 17.3.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.optimize import algebra, lapack

Change = Callable[[FloatArray], FloatArray]
"""Returns another matrix (d, d)."""

STIFFENINGS = (1.0, 1e2, 1e4, 1e6)
"""By how much directions across the constraints expected to be active are made stiffer, in turn. Without them the bed
of `algebra` takes 537 evaluations in place of 393, and 1685 in place of 1016 inside a trust region."""

EIGENVALUE_SHIFT = 2.0
"""Multiple of the smallest eigenvalue by which an indefinite matrix is shifted inside a trust region: with 2 it ends as
far above zero as it was below, as where absolute values are taken."""


def make_convex_on_face(scaled: FloatArray, normals: FloatArray, make_definite: Change) -> FloatArray:
    """Return a positive definite matrix that differs from a scaled one across the normals alone if that is enough."""
    across = algebra.unit_rows(normals)[0]
    across = across.T @ across
    # At a vertex of the constraints H may have any curvature across them: J need not be convex where no step can go.
    # H + sigma N'N is H on the face, and positive definite for a large sigma if and only if H is there ([1]_, theorem
    # 17.5), so that Newton's step on the face, and with it the quadratic rate, stays what it is.
    for stiffness in STIFFENINGS if len(normals) else ():
        stiff = scaled + stiffness * across
        if has_curvature(stiff):
            return stiff
    return make_definite(scaled)


def make_absolute(matrix: FloatArray) -> FloatArray:
    """Return a symmetric matrix (d, d) with eigenvalues that are not positive replaced by absolute values."""
    values, vectors = np.linalg.eigh(matrix)
    return compose(algebra.positive_eigenvalues(values), vectors)


def compose(values: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return the symmetric matrices (..., d, d) with these eigenvalues and eigenvectors."""
    matrices = (vectors * values[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return np.asarray(0.5 * (matrices + np.swapaxes(matrices, -1, -2)))


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


def _add_to_diagonal(matrix: FloatArray, amount: float) -> FloatArray:
    """Return the matrix with an amount added to each entry of its diagonal."""
    changed = matrix.copy()
    changed.reshape(-1)[:: len(matrix) + 1] += amount
    return changed


def has_curvature(scaled: FloatArray) -> bool:
    """Return whether all eigenvalues of a scaled matrix are above `algebra.EIGENVALUE_FLOOR`."""
    return is_definite(_add_to_diagonal(scaled, -algebra.EIGENVALUE_FLOOR))


def shift_to_positive(matrix: FloatArray, least: float = 0.0) -> tuple[FloatArray, bool]:
    """Return the matrix with all eigenvalues raised until the smallest is positive, or `least`, and whether it was."""
    symmetric = 0.5 * (matrix + matrix.T)
    if not matrix.size:
        return symmetric, True
    values = lapack.dsyev(symmetric, compute_v=0)[0]
    lowest, highest = float(values[0]), float(values[-1])
    # The step is the longer, the smaller the least eigenvalue after the shift: it is relative to the largest one, since
    # the matrix may have any unit, or the curvature `least` that its caller asks for.
    margin = max(algebra.EIGENVALUE_FLOOR * max(abs(lowest), abs(highest)), least)
    if lowest > margin:
        return symmetric, True
    margin = margin or algebra.EIGENVALUE_REPLACEMENT  # without any curvature nothing says how large it is
    return _add_to_diagonal(symmetric, margin - EIGENVALUE_SHIFT * min(lowest, 0.0)), False
