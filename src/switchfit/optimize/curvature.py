"""Curvature on the free directions: their basis, and the lowest end of the Hessian's spectrum on them.

The free directions are those that active constraints and kinks leave: the null space of the constraints' normals.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from switchfit.arrays import BoolArray, FloatArray
from switchfit.optimize import algebra

DEPENDENT_NORMALS = 1e-11
"""Singular value of unit normals below which they depend on one another: entries are 0 and 1 before they are scaled by
the unknowns' sizes, so that all that is above rounding counts."""


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
class FreeCurvature:
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


def null_space(normals: FloatArray) -> FloatArray:
    """Return an orthonormal basis of the null space of normals (k, d): shape (d, d - r)."""
    if normals.size == 0:
        return np.eye(normals.shape[1])
    # Rows of length one, so that the limit has no unit. Where modes collapse, rows depend on one another: of tau_1 <=
    # tau_2 <= tau_3 at one time and bounds on them any two say what the third says.
    _, sizes, right = np.linalg.svd(algebra.unit_rows(normals)[0])
    return np.asarray(right[np.count_nonzero(sizes > DEPENDENT_NORMALS) :].T)
