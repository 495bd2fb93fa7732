"""Linear inequalities and bounds, each with a name for messages.

In a fit the rows are the order of the transition times with their shortest durations, and what users bound beside the
unknowns themselves. All iterates satisfy them; `feasibility` says how exactly.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from switchfit.arrays import BoolArray, FloatArray, IntArray
from switchfit.optimize import algebra

NO_PLACES = np.zeros(0, dtype=np.intp)
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
    """

    A: FloatArray
    b: FloatArray
    lower: FloatArray
    upper: FloatArray
    names: tuple[object, ...]

    @cached_property
    def movable(self) -> BoolArray:
        """Which unknowns their bounds leave any room, shape (d,)."""
        return np.asarray(self.lower < self.upper)

    @cached_property
    def normals(self) -> FloatArray:
        """Inward normals of rows, lower and upper bounds, shape (m + 2 d, d)."""
        identity = np.eye(self.lower.size)
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
            # theta_i - theta_j >= 0 holds exactly where both are the same number; with a duration in between, or other
            # factors, rounding decides on which side of 0 the sum is.
            places = np.flatnonzero(row)
            if np.any(np.abs(row[places]) != 1.0):
                continue
            if places.size == 1:
                found[k] = (int(places[0]), -1, bound * float(row[places[0]]))
            elif places.size == 2 and bound == 0.0 and row[places].sum() == 0.0:
                found[k] = (int(np.argmax(row)), int(np.argmin(row)), 0.0)
        return found

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
        # One comparison for all constraints, of the largest rounding of any: it saves the rows of `is_active` and the
        # steps bit by bit of `feasibility` at most points. Twice the reach of these, to be on the safe side.
        A, b = self._largest_sizes
        return algebra.smallest(slack) > 32 * algebra.EPS * (b + max(A, 1.0) * size)

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
