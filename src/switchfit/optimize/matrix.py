"""What full matrices (`switchfit.optimize.dense`) and arrows (`switchfit.optimize.arrow`) share as Hessians in the SQP.

Nothing else in the SQP looks at the entries of a Hessian.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from switchfit.optimize.algebra import (
    EQUILIBRATED,
    EQUILIBRATIONS,
    BoolArray,
    FloatArray,
    IntArray,
    equilibrate,
    jacobi_scaling,
)
from switchfit.optimize.constraints import LinearConstraints


class Room(NamedTuple):
    """Bounds on a step d from a point.

    Attributes
    ----------
    constraints : LinearConstraints
    offsets : array, shape (m + 2 d,)
        Of ``N d >= offsets``, N being the normals of rows, lower and upper bounds; not positive.
    free : array of bool, shape (d,), or None
        Unknowns that may move at all; None if all may.
    """

    constraints: LinearConstraints
    offsets: FloatArray
    free: BoolArray | None

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds of the step: (d,) each."""
        d = self.constraints.size
        return self.offsets[-2 * d : -d], -self.offsets[-d:]


class Box(NamedTuple):
    """A trust region about a point: no unknown moves by more than ``radius * reach``.

    Attributes
    ----------
    reach : array, shape (d,)
        Half-widths at radius 1, in whose metric an indefinite Hessian is shifted.
    radius : float
        Infinite where there has been no box yet; an indefinite Hessian then gets one of radius `first`.
    first : float
    """

    reach: FloatArray
    radius: float
    first: float

    def radius_for(self, definite: bool) -> float:
        """Return the radius for a Hessian that is positive definite, or is not."""
        return self.first if self.radius == np.inf and not definite else self.radius

    def narrow(self, offsets: FloatArray, definite: bool) -> FloatArray:
        """Return the offsets of a `Room`, (m + 2 d,), with its bounds narrowed to the box."""
        radius = self.radius_for(definite)
        if radius == np.inf:
            return offsets
        narrowed = offsets.copy()
        d = len(self.reach)
        narrowed[-2 * d : -d] = np.maximum(narrowed[-2 * d : -d], -radius * self.reach)
        narrowed[-d:] = np.maximum(narrowed[-d:], -radius * self.reach)
        return narrowed

    def of(self, part: IntArray) -> Box:
        """Return the box of some of the unknowns."""
        return Box(self.reach[part], self.radius, self.first)


class Programme(NamedTuple):
    """The quadratic programme of an iteration but for its matrix.

    Attributes
    ----------
    gradient : array, shape (d,)
    room : Room
    pressed : array, shape (k, d)
        Normals of the constraints expected to be active: on their face B is H wherever it can be.
    floor : array, shape (d,), or None
        Curvature of each unknown that counts as none.
    box : Box, or None
        The trust region, in whose metric an indefinite H is shifted to make B.
    """

    gradient: FloatArray
    room: Room
    pressed: FloatArray
    floor: FloatArray | None
    box: Box | None


class ModelStep(NamedTuple):
    """Solution of the quadratic programme of an iteration.

    Attributes
    ----------
    step : array, shape (d,)
    product : array, shape (d,)
        B d, with the rows of H for unknowns that are not free.
    multipliers : array, shape (m + 2 d,), or None
        Of rows, lower and upper bounds; None where none of them presses.
    definite : bool
        Whether H was positive definite as it is on the free unknowns: B is H there.
    """

    step: FloatArray
    product: FloatArray
    multipliers: FloatArray | None
    definite: bool


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


def mix_sides(right: FloatArray, left: FloatArray, sides: NDArray[Any]) -> FloatArray:
    """Return what is found on the right where the side is positive, on the left where it is negative, else the mean."""
    return np.where(sides > 0, right, np.where(sides < 0, left, 0.5 * (right + left)))


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
