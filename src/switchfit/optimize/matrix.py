"""Protocol of the Hessian in the SQP, for full matrices and for arrows.

`switchfit.optimize.dense.Dense` and `switchfit.optimize.arrow.Arrow` have these methods; nothing else in the SQP looks
at the entries of a matrix.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from switchfit.optimize.algebra import EQUILIBRATED, EQUILIBRATIONS, FloatArray, equilibrate, jacobi_scaling
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
    free: NDArray[np.bool_] | None

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

    def of(self, part: NDArray[np.intp]) -> Box:
        """Return the box of some of the unknowns."""
        return Box(self.reach[part], self.radius, self.first)


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
    unscaled : array, shape (k,)
        The same of the Hessian as it is.
    lowest : array, shape (d,)
        The direction of the smallest scaled eigenvalue, of unit length in theta.
    """

    eigenvalues: FloatArray
    unscaled: FloatArray
    lowest: FloatArray

    def itself(self) -> Spectrum:
        """Return the spectrum, for a `Curvature` whose spectrum is known."""
        return self


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
    idle: NDArray[np.bool_] | None = None

    @cached_property
    def spectrum(self) -> Spectrum:
        """Eigenvalues and the lowest direction."""
        return self.find_spectrum()

    @property
    def smallest(self) -> float:
        """Smallest scaled eigenvalue; infinite on no directions, NaN where there is no Hessian."""
        values = self.spectrum.eigenvalues
        return float(values[0]) if values.size else np.inf


class SymmetricMatrix(Protocol):
    """A symmetric matrix H, (d, d)."""

    @property
    def finite(self) -> bool:
        """Whether all entries are."""
        ...

    def dense(self) -> FloatArray:
        """Return the matrix in full: (d, d)."""
        ...

    def diagonal(self) -> FloatArray:
        """Return its diagonal: (d,)."""
        ...

    def largest_in_rows(self) -> FloatArray:
        """Return the largest entry of each row, with its sign: (d,)."""
        ...

    def __matmul__(self, vector: FloatArray, /) -> FloatArray: ...

    def __abs__(self) -> Self: ...

    def scale(self, scaling: FloatArray, /) -> Self:
        """Return D⁻¹ H D⁻¹ for a diagonal D (d,)."""
        ...

    def mask(self, labels: FloatArray, /) -> Self:
        """Return the matrix without the entries that join unknowns of different labels (d,)."""
        ...

    def mix_sides(self, minus: Any, sides: FloatArray, /) -> Self:
        """Mix with `minus`: this one where two unknowns are on the right (sides 1), it on the left, else the mean."""
        ...

    def is_definite_on(self, free: NDArray[np.bool_] | None, /) -> bool:
        """Return whether it is positive definite on the free unknowns (d,) of bool, or on all."""
        ...

    def minimize_model(
        self,
        gradient: FloatArray,
        room: Room,
        pressed: FloatArray,
        floor: FloatArray | None,
        box: Box | None = None,
        /,
    ) -> ModelStep:
        """Minimize ``gᵀd + ½ dᵀBd`` inside `room`, where B is H made positive definite on the free unknowns.

        Parameters
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
        ...

    def curvature(
        self, constraints: LinearConstraints, rows: NDArray[np.intp], held: NDArray[np.bool_], flat: FloatArray, /
    ) -> Curvature:
        """Return the unmodified curvature in the null space of the constraints at `rows`, without those held (d,).

        Diagonal entries below `flat` (d,) count as zero.
        """
        ...


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
    for _ in range(EQUILIBRATIONS):
        largest = size.scale(scaling).largest_in_rows()
        if (largest <= EQUILIBRATED).all():
            break
        scaling = equilibrate(scaling, largest)
    return scaling
