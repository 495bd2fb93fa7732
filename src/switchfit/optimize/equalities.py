"""Equality constraints at a point: values, Jacobian, and the Jacobian's singular value decomposition.

The decomposition gives the null space, shortest steps and least-squares multipliers also if rows are dependent ([1]_,
section 18.3).

References
----------
.. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, chapter 18.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.optimize import algebra

DEPENDENT = 1e-10
"""Rows of a Jacobian are dependent where a singular value is below this part of the largest one."""


class Equalities(NamedTuple):
    """Equality constraints at a point: values c, (k,), and Jacobian A, (k, d)."""

    values: FloatArray
    jacobian: FloatArray

    def predict(self, step: FloatArray) -> float:
        """Return ‖c + A d‖₂ for a step d (d,)."""
        return algebra.norm(self.values + self.jacobian.dot(step))


class JacobianSVD(NamedTuple):
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
    def of(cls, jacobian: FloatArray) -> JacobianSVD:
        """Decompose a Jacobian (k, d), k > 0."""
        # Not the normal equations A A': a guard at each of several transitions that collapse into one is the same row
        # twice, up to the rounding of its derivatives.
        left, sizes, right = np.linalg.svd(jacobian)
        rank = np.count_nonzero(sizes > DEPENDENT * sizes[0])
        return cls(left[:, :rank], sizes[:rank], right[:rank].T, right[rank:].T)

    def solve(self, values: FloatArray) -> FloatArray:
        """Return the shortest v (d,) that minimizes ‖values + A v‖₂."""
        return -np.asarray(self.right.dot(self.left.T.dot(values) / self.sizes))

    def multipliers(self, force: FloatArray) -> FloatArray:
        """Return the lam (k,) that minimizes ‖force + Aᵀ lam‖₂ ([1]_, section 18.3), the shortest of them."""
        return -np.asarray(self.left.dot(self.right.T.dot(force) / self.sizes))
