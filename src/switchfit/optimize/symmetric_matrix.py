"""Symmetric matrices held in parts, and their diagonal scaling: what full matrices and arrows have in common.

The SQP asks a Hessian for no more than `Dense` and `Arrow` both offer; nothing else in it looks at their entries.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Self

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.optimize import algebra


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

    def diagonal(self) -> FloatArray:
        """Return the diagonal: (d,)."""
        raise NotImplementedError

    def largest_in_rows(self) -> FloatArray:
        """Return the largest entry of each row: (d,)."""
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


def diagonal_scaling(matrix: SymmetricMatrix, floor: FloatArray | float = 0.0) -> FloatArray:
    """Return a positive D, shape (d,), for which D⁻¹ H D⁻¹ has rows of largest entry about one.

    For a positive semi-definite H this is the root of the diagonal (Jacobi), so that everything computed in the
    scaled variables is the same whatever the units of the unknowns. Where off-diagonal entries are larger, as they
    may be in an indefinite H, a few rounds of symmetric equilibration follow.

    Parameters
    ----------
    matrix : SymmetricMatrix
        H.
    floor : array, shape (d,), or 0
        Diagonal entries too small to matter, below which D² does not go.
    """
    # Jacobi's scaling is within a factor d of the best one of all diagonal scalings (van der Sluis, Numer. Math. 14
    # (1969) 14-23), for a positive definite H.
    size = matrix.absolute()
    scaling: FloatArray = algebra.jacobi_scaling(np.maximum(size.diagonal(), floor), size.largest_in_rows())
    # |H_ij| <= sqrt(H_ii H_jj) for a semi-definite H: Jacobi's scaling passes at once. Only an indefinite one goes on.
    for _ in range(algebra.EQUILIBRATIONS):
        largest = size.scale(scaling).largest_in_rows()
        if (largest <= algebra.EQUILIBRATED).all():
            break
        scaling = algebra.equilibrate(scaling, largest)
    return scaling
