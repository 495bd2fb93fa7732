"""Strictly convex quadratic programmes with a feasible zero step, and the room in which a step may go.

    minimize  gᵀd + ½ dᵀBd   subject to   C d >= c,   c <= 0,

is solved in stages. Newton's step −B⁻¹g, if it is feasible, is the solution. Otherwise, with B = D L Lᵀ D (D the
root of the diagonal) and e = Lᵀ D d, it becomes a least-distance problem,

    minimize  ½‖e + q‖²   subject to   G e >= c,   ‖q‖ = 1,

in which nothing has a scale any more (`least_distance`).
"""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from switchfit.arrays import BoolArray, FloatArray, IntArray
from switchfit.optimize import algebra
from switchfit.optimize.least_distance import find_least_distance
from switchfit.optimize.linear_constraints import LinearConstraints
from switchfit.optimize.positive_definite import CholeskyFactor

SHORT_STEP = 0.01
"""Part of Newton's step, in the metric of the matrix, below which a step is refined: of the sixteen digits of q, with
which e is found, two or more are lost in e itself."""

OUTSIDE = 1e-8
"""Part of a step by which it may leave the room. The tolerance of daqp is one in the metric of the matrix: a million
times as much along directions in which that is nearly flat."""


class _Product(Protocol):
    """A matrix B, full or in parts, by its products."""

    def dot(self, vector: FloatArray, /) -> FloatArray: ...


class _Solver(Protocol):
    """A factorization of B, of a full matrix or of one in parts."""

    def solve(self, vector: FloatArray, /) -> FloatArray: ...


class Room(NamedTuple):
    """Where a step d may go: ``lower <= N d <= upper``; d = 0 may.

    Attributes
    ----------
    normals : array, shape (m + d, d)
        Rows, and the identity.
    lower, upper : arrays, shape (m + d,)
    """

    normals: FloatArray
    lower: FloatArray
    upper: FloatArray

    @classmethod
    def around(cls, constraints: LinearConstraints, slack: FloatArray) -> Room:
        """Return the room around a feasible point with the given slack (m + 2 d,)."""
        m, d = constraints.A.shape
        slack = np.maximum(slack, 0.0)
        upper = np.concatenate([np.full(m, np.inf), slack[m + d :]])
        return cls(constraints.normals[: m + d], -slack[: m + d], upper)

    @property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds of the step: (d,), (d,)."""
        d = self.normals.shape[1]
        return self.lower[-d:], self.upper[-d:]

    def holds(self, step: FloatArray) -> bool:
        """Return whether a step (d,) is inside."""
        products = self.normals.dot(step)
        return np.count_nonzero((self.lower <= products) & (products <= self.upper)) == products.size

    def narrow(self, reach: FloatArray) -> Room:
        """Return the part of the room in which no unknown moves by more than its `reach` (d,)."""
        narrowed = Room(self.normals, self.lower.copy(), self.upper.copy())
        lower, upper = narrowed.bounds
        np.maximum(lower, -reach, out=lower)
        np.minimum(upper, reach, out=upper)
        return narrowed

    def of(self, part: IntArray, free: BoolArray | None = None) -> Room:
        """Return the room of some of the unknowns, the others being held; what is not free (d,) is too."""
        m = len(self.normals) - self.normals.shape[1]
        kept = np.concatenate([np.arange(m), m + part])
        normals = self.normals[kept][:, part]
        return Room(normals if free is None else normals * free[part], self.lower[kept], self.upper[kept])

    def press(self, step: FloatArray, pull: FloatArray) -> FloatArray:
        """Return a step (d,) exactly on each of its bounds that pulls (m + d,): kinks depend on it."""
        (lower, upper), own = self.bounds, pull[-step.size :]
        return np.minimum(np.maximum(np.where(own > 0.0, lower, np.where(own < 0.0, upper, step)), lower), upper)

    def _move_inside(self, step: FloatArray) -> FloatArray:
        """Return the step (d,) inside that is nearest to one: itself, unless it leaves by more than `OUTSIDE`."""
        products, size = self.normals.dot(step), algebra.largest(np.abs(step))
        if max(algebra.largest(self.lower - products), algebra.largest(products - self.upper)) <= OUTSIDE * size:
            return step
        # The nearest step inside, in units of the step's size: one more least-distance problem, of rows alone.
        rows, lengths = algebra.unit_rows(self.normals)
        low, high = (self.lower - products) / (size * lengths), (self.upper - products) / (size * lengths)
        found = find_least_distance(np.zeros(step.size), rows, low, high)
        return np.zeros(step.size) if found is None else np.clip(step + size * found[0], *self.bounds)


def newton_step(gradient: FloatArray, matrix: _Product, factor: _Solver) -> FloatArray:
    """Return −B⁻¹g (d,), refined once: the residual is computed with B itself, not with its factor."""
    step = -factor.solve(gradient)
    step -= factor.solve(gradient + matrix.dot(step))
    return step


def solve_programme(
    gradient: FloatArray, matrix: FloatArray, factor: CholeskyFactor, room: Room
) -> tuple[FloatArray, FloatArray]:
    """Minimize ``gᵀd + ½ dᵀBd`` inside a room.

    Returns
    -------
    step, pull : arrays, shape (d,), (m + d,)
        ``B d + g = Nᵀ pull``, positive where a lower bound presses and negative where an upper one does.
    """
    # The usual case: nothing is in the way, at the price of two triangular solves.
    newton = newton_step(gradient, matrix, factor)
    if room.holds(newton):
        return newton, np.zeros(len(room.lower))
    # In white variables, d = length D⁻¹ L⁻ᵀ e, nothing has a scale any more.
    target = factor.whiten(gradient)
    length = algebra.norm(target)
    rows, lengths = algebra.unit_rows(factor.whiten(room.normals))
    lower, upper = room.lower / (length * lengths), room.upper / (length * lengths)
    found = find_least_distance(target / length, rows, lower, upper)
    if found is None:  # the zero step is feasible; a search along it ends at once
        return np.zeros(gradient.size), np.zeros(lower.size)
    e, pull = found
    # Where constraints cut nearly all of Newton's step, e is the small difference of two vectors of length one, and has
    # lost the digits that they share.
    if algebra.norm(e) < SHORT_STEP:
        # One step of refinement, with a residual that is computed with B itself: the same programme for the error, with
        # what is active now.
        active = pull != 0.0
        missing = np.where(pull > 0.0, lower, upper) - rows.dot(e)
        residual = factor.whiten(gradient + matrix.dot(length * factor.unwhiten(e))) / length - rows.T.dot(pull)
        lower, upper = np.where(active, missing, -np.inf), np.where(active, missing, np.inf)
        refined = find_least_distance(residual, rows, lower, upper, active)
        if refined is not None:
            e, pull = e + refined[0], np.where(active, pull + refined[1], 0.0)
    pull = length * pull / lengths
    return room._move_inside(room.press(length * factor.unwhiten(e), pull)), pull


def solve_in_span(
    gradient: FloatArray, matrix: FloatArray, span: FloatArray, rows: FloatArray, lower: FloatArray, upper: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Minimize the programme of the steps ``d = S w`` with the matrix ``Sᵀ B S`` and ``lower <= rows d <= upper``.

    The result is that of `solve_programme`: the step (d,), and what the rows exert.
    """
    wide = np.full(len(matrix), np.inf)
    normals = np.concatenate([rows.dot(span), np.eye(wide.size)])
    inside = Room(normals, np.append(lower, -wide), np.append(upper, wide))
    found, pull = solve_programme(span.T.dot(gradient), matrix, CholeskyFactor.of(matrix), inside)
    return span.dot(found), pull[: len(rows)]
