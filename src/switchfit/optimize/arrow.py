"""Arrow-shaped Hessians: many runs with unknowns of their own, and a few unknowns that the runs share.

Two unknowns of different runs never meet in one term of J, so that with the own unknowns of each run first

        ( H_1             G_1 )
    H = (      ...        ... )        H_e: blocks (k, k),  G_e: borders (k, s),  C: corner (s, s).
        (           H_R   G_R )
        ( G_1' ...  G_R'  C   )

All is done block by block, at a cost that is linear in the number R of runs: products, the Cholesky factorization (own
unknowns first, then the Schur complement ``C - sum_e G_e' H_e^-1 G_e`` of the shared ones), the quadratic programme,
and making H positive definite. Constraints join unknowns of one run at most, so that they keep this shape.

Runs with fewer than k own unknowns are padded with unknowns that are zero: ones on the diagonal, nothing beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias

import numpy as np

from switchfit.arrays import BoolArray, FloatArray, IntArray
from switchfit.optimize import algebra, qp
from switchfit.optimize.curvature import FreeCurvature, Spectrum
from switchfit.optimize.dense import Dense
from switchfit.optimize.positive_definite import STIFFENINGS, compose
from switchfit.optimize.qp import Room
from switchfit.optimize.symmetric_matrix import SymmetricMatrix, diagonal_scaling

Hessian: TypeAlias = "Dense | Arrow"
"""What the SQP takes for H: nothing in it asks which of the two it has."""


@dataclass(frozen=True, eq=False)
class ArrowLayout:
    """Where each unknown stands.

    Attributes
    ----------
    size : int
        d, the number of unknowns.
    own : (R, k) int array
        Positions of the own unknowns of each run; d, one past the last, where it has fewer than k.
    shared : (s,) int array
        Positions of all others.
    """

    size: int
    own: IntArray
    shared: IntArray

    @classmethod
    def of(cls, size: int, places: Sequence[IntArray]) -> ArrowLayout:
        """Return the layout of runs, each of which depends on the unknowns at the given places."""
        used = [np.unique(where[where >= 0]) for where in places]
        # An unknown that one run alone depends on is its own; one that no run depends on counts as shared, with a row
        # of 0.
        count = np.bincount(np.concatenate(used), minlength=size)
        alone = [where[count[where] == 1] for where in used]
        own = np.full((len(used), max(map(len, alone))), size, dtype=np.intp)
        for e, where in enumerate(alone):
            own[e, : len(where)] = where
        return cls(size, own, np.flatnonzero(count != 1))

    def slots(self, e: int, places: IntArray) -> IntArray:
        """Return the index of unknowns of run e in its own (k) and the shared (s) ones, one after the other."""
        order = np.concatenate([self.own[e], self.shared])
        return np.array([np.flatnonzero(order == place)[0] for place in places], dtype=np.intp)

    def split(self, vector: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the own (R, k), zero where padded, and shared (s,) entries of a vector (d,)."""
        return np.append(vector, 0.0)[self.own], vector[self.shared]

    def join(self, own: FloatArray, shared: FloatArray) -> FloatArray:
        """Return the vector (d,) with these own (R, k) and shared (s,) entries."""
        vector = np.zeros(self.size + 1)
        vector[self.own] = own
        vector[self.shared] = shared
        return vector[:-1]


@dataclass(frozen=True, eq=False)
class Arrow(SymmetricMatrix):
    """A symmetric matrix of the shape above.

    Attributes
    ----------
    layout : ArrowLayout
    blocks, borders, corner : (R, k, k), (R, k, s), (s, s) arrays
    """

    layout: ArrowLayout
    blocks: FloatArray
    borders: FloatArray
    corner: FloatArray

    @classmethod
    def of_runs(cls, layout: ArrowLayout, parts: FloatArray) -> Arrow:
        """Return the sum of symmetric matrices (R, k + s, k + s), one a run, in the order of `ArrowLayout.slots`."""
        k = layout.own.shape[1]
        stacked = 0.5 * (parts + np.swapaxes(parts, 1, 2))
        blocks = stacked[:, :k, :k].copy()
        # Ones where a run is padded: its block stays regular, and the unknown that is not there stays zero.
        padded = layout.own == layout.size
        blocks[:, np.arange(k), np.arange(k)] += padded
        return cls(layout, blocks, stacked[:, :k, k:], stacked[:, k:, k:].sum(0))

    @property
    def parts(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Blocks, borders and corner."""
        return self.blocks, self.borders, self.corner

    def with_parts(self, *parts: FloatArray) -> Arrow:
        """Return a matrix of the same shape with other entries."""
        return Arrow(self.layout, *parts)

    def pairs(self, vector: FloatArray) -> tuple[tuple[FloatArray, FloatArray], ...]:
        """Return the entries of a vector (d,), 1 where padded, for rows and columns of each part, to be broadcast."""
        own, shared = np.append(vector, 1.0)[self.layout.own], vector[self.layout.shared]
        return (own[:, :, None], own[:, None, :]), (own[:, :, None], shared), (shared[:, None], shared)

    def dot(self, vector: FloatArray) -> FloatArray:
        """Return the product with a vector: (d,)."""
        own, shared = self.layout.split(vector)
        of_own = (self.blocks @ own[..., None])[..., 0] + self.borders @ shared
        return self.layout.join(of_own, np.einsum("eks,ek->s", self.borders, own) + self.corner @ shared)

    def diagonal(self) -> FloatArray:
        """(d,)."""
        return self.layout.join(np.diagonal(self.blocks, axis1=1, axis2=2), np.diagonal(self.corner))

    def largest_in_rows(self) -> FloatArray:
        """Return the largest entry of each row: (d,)."""
        own = np.maximum(self.blocks.max(2, initial=0.0), self.borders.max(2, initial=0.0))
        shared = np.maximum(self.borders.max((0, 1), initial=0.0), self.corner.max(1, initial=0.0))
        return self.layout.join(own, shared)

    def dense(self) -> FloatArray:
        """Return the matrix in full: (d, d)."""
        d, layout = self.layout.size, self.layout
        full = np.zeros((d + 1, d + 1))
        full[layout.own[:, :, None], layout.own[:, None, :]] = self.blocks
        full[layout.own[:, :, None], layout.shared] = self.borders
        full[layout.shared[:, None, None], layout.own] = np.moveaxis(self.borders, 2, 0)
        full[layout.shared[:, None], layout.shared] = self.corner
        return full[:d, :d]

    def plus_diagonal(self, value: float | FloatArray) -> Arrow:
        """Return H + value I, or H + diag(value) for a value (d,)."""
        k = self.blocks.shape[1]
        own, shared = self.layout.split(np.broadcast_to(value, self.layout.size))
        return replace(self, blocks=self.blocks + own[:, :, None] * np.eye(k), corner=self.corner + np.diag(shared))

    def held(self, free: BoolArray) -> Arrow:
        """Return the matrix with rows and columns of the identity for the unknowns that are not free."""
        kept = self.change(np.asarray(free, dtype=float), lambda part, a, b: part * a * b)
        return kept.plus_diagonal(np.where(free, 0.0, 1.0))

    def keep(self, free: BoolArray) -> tuple[Arrow, IntArray]:
        """Return the matrix with those unknowns decoupled that are not free (d,), and the places of all."""
        return self.held(free), np.arange(self.layout.size)

    def convexify(
        self, normals: FloatArray, floor: FloatArray, reach: FloatArray | None = None
    ) -> tuple[Arrow, ArrowFactor]:
        """Return a positive definite B of the same shape that equals H wherever H can be kept, and its factorization.

        As `Dense.convexify` does, outside of a trust region. Where H is not positive definite on the face of the
        constraints, eigenvalues of its blocks are replaced, and then those of the Schur complement of the shared
        unknowns.

        Parameters
        ----------
        normals : (r, d)
            Normals of the constraints expected to be active; each joins unknowns of one run, or shared ones.
        floor : (d,)
            See `diagonal_scaling`.
        reach : None
            There is no trust region, whose one radius would suit no run.
        """
        layout, scaling = self.layout, diagonal_scaling(self, floor)
        scaled = self.scale(scaling)
        # N'N, with the rows of the scaled unknowns.
        rows = algebra.unit_rows(normals / scaling)[0]
        own, shared = np.append(rows, np.zeros((len(rows), 1)), axis=1)[:, layout.own], rows[:, layout.shared]
        across = Arrow(
            layout, np.einsum("rek,rel->ekl", own, own), np.einsum("rek,rs->eks", own, shared), shared.T @ shared
        )
        for stiffness in (0.0, *STIFFENINGS) if len(normals) else (0.0,):
            pairs = zip(scaled.parts, across.parts, strict=True)
            stiff = scaled.with_parts(*(part + stiffness * other for part, other in pairs))
            if ArrowFactor.of(stiff.plus_diagonal(-algebra.EIGENVALUE_FLOOR)) is not None:
                convex = stiff.scale(1.0 / scaling) if stiffness else self
                break
        else:
            convex = _replace_eigenvalues(scaled).scale(1.0 / scaling)
        factor, ridge = ArrowFactor.of(convex), algebra.EIGENVALUE_FLOOR
        while factor is None:  # rounding, where a block is nearly singular
            convex, ridge = convex.plus_diagonal(ridge * scaling**2), 10.0 * ridge
            factor = ArrowFactor.of(convex)
        return convex, factor

    def solve(self, gradient: FloatArray, factor: ArrowFactor, room: Room) -> tuple[FloatArray, FloatArray]:
        """Minimize ``gᵀd + ½ dᵀBd`` inside a room, B being this matrix; result as of `solve_programme`.

        The programme is solved with the constraints that the step before has violated, until it violates no other:
        since it is strictly convex, that is the solution with all of them.
        """
        step = newton = qp.newton_step(gradient, self, factor)
        pull, size = np.zeros(len(room.lower)), np.sqrt((room.normals**2).sum(1))
        working = np.zeros(0, dtype=np.intp)
        # Thousands of rows for many runs, few of which matter: the working set only grows, so that the loop ends.
        while True:
            products = room.normals @ step
            # From the second round on rounding may violate a row.
            rounding = 1e-13 * size * np.max(np.abs(step), initial=0.0) if working.size else 0.0
            violated = (products < room.lower - rounding) | (products > room.upper + rounding)
            violated[working] = False
            if not violated.any():
                return room.press(step, pull), pull
            working = np.union1d(working, np.flatnonzero(violated))
            rows = room.normals[working]
            # The step is a combination of Newton's and of B⁻¹ C', C being the working set: as many unknowns as that
            # has.
            spanning = np.array([newton, *(factor.solve(row) for row in rows)]) * factor.scaling
            span = np.linalg.qr(spanning.T)[0] / factor.scaling[:, None]
            reduced = np.array([self.dot(direction) for direction in span.T]) @ span
            within = room.lower[working], room.upper[working]
            step, pull[working] = qp.solve_in_span(gradient, reduced, span, rows, *within)

    def curvature(self, normals: FloatArray, held: BoolArray, flat: FloatArray) -> FreeCurvature:
        """Return the curvature in the null space of normals (k, d), as `Dense.curvature`.

        Block by block where each normal is that of a bound, to see that all eigenvalues are positive. All other cases
        are rare enough to be left to the algebra of full matrices.
        """
        # A normal with one entry is that of a bound: its null space is made of coordinates, and the arrow keeps its
        # shape there.
        rows, places = np.nonzero(normals)
        if len(rows) != len(normals) or not self.finite:
            return Dense(self.dense()).curvature(normals, held, flat)
        left_out = held.copy()
        left_out[places] = True

        def find_spectrum() -> Spectrum:
            # Scaled as in full: eigenvalues have no unit.
            kept = self.held(~left_out)
            scaled = kept.scale(diagonal_scaling(kept, flat))
            if left_out.all() or ArrowFactor.of(scaled.plus_diagonal(-algebra.EIGENVALUE_FLOOR)) is None:
                return Dense(self.dense()).curvature(normals, held, flat).spectrum
            return Spectrum(np.inf, np.zeros(len(held)))

        return FreeCurvature(np.eye(len(held))[:, ~left_out], find_spectrum)


@dataclass(frozen=True, eq=False)
class ArrowFactor:
    """``B = D L Lᵀ D`` with own unknowns first: L_e of the blocks, ``W_e = L_e⁻¹ G_e``, and L_s of the complement.

    White vectors are the own ones of all runs, padding included, followed by the shared ones: (R k + s,).
    """

    layout: ArrowLayout
    scaling: FloatArray
    own: FloatArray  # (R, k, k)
    border: FloatArray  # (R, k, s)
    shared: FloatArray  # (s, s)

    @classmethod
    def of(cls, matrix: Arrow) -> ArrowFactor | None:
        """Return the factorization; None where the matrix is not positive definite."""
        variances = matrix.diagonal()
        if not np.all(variances > 0.0):
            return None
        scaling = np.sqrt(variances)
        scaled = matrix.scale(scaling)
        try:
            # H_e = L_e L_e', W_e = L_e^-1 G_e, and L_s L_s' = C - sum_e W_e' W_e: the Schur complement of the blocks.
            # The matrix is positive definite if and only if all of these exist.
            own = np.asarray(np.linalg.cholesky(scaled.blocks), float)
            border = np.asarray(np.linalg.solve(own, scaled.borders), float)
            shared = np.linalg.cholesky(scaled.corner - np.einsum("eks,ekt->st", border, border))
        except np.linalg.LinAlgError:
            return None
        return cls(matrix.layout, np.asarray(scaling, float), own, border, shared)

    @cached_property
    def _inverses(self) -> tuple[FloatArray, FloatArray]:
        """L_e⁻¹ and L_s⁻¹: each is used a few times, and NumPy has no triangular solve of many small systems."""
        return np.asarray(np.linalg.inv(self.own), float), np.asarray(np.linalg.inv(self.shared), float)

    def solve(self, vector: FloatArray) -> FloatArray:
        """Return B⁻¹ v."""
        of_own, of_shared = self._inverses
        # Forward substitution: y_e = L_e^-1 v_e, then L_s^-1 (v_s - sum_e W_e' y_e); backward: the shared ones first,
        # then L_e^-T (y_e - W_e x_s).
        own, shared = self.layout.split(vector / self.scaling)
        own = (of_own @ own[..., None])[..., 0]
        shared = of_shared.T @ (of_shared @ (shared - np.einsum("eks,ek->s", self.border, own)))
        own = (np.swapaxes(of_own, 1, 2) @ (own - self.border @ shared)[..., None])[..., 0]
        return self.layout.join(own, shared) / self.scaling


def _replace_eigenvalues(scaled: Arrow) -> Arrow:
    """Return the matrix with eigenvalues of its blocks, and of the Schur complement, that are not positive replaced."""
    values, vectors = np.linalg.eigh(scaled.blocks)
    # An eigenvalue that is replaced is made large enough for the shared unknowns not to lose their own curvature to it.
    # (v' G)^2 / lam is what an eigenvalue lam takes from the diagonal of the Schur complement, which is 1 at most after
    # scaling: with lam >= 2 sum_s (v' G_s)^2 one eigenvalue takes half of it at most.
    coupling = (np.swapaxes(vectors, 1, 2) @ scaled.borders) ** 2
    changed = np.maximum(algebra.positive_eigenvalues(values), 2.0 * coupling.sum(2))
    changed = np.where(values > algebra.EIGENVALUE_FLOOR, values, changed)
    # Blocks that are positive definite stay as they are, to the last bit.
    indefinite = values[:, 0] <= algebra.EIGENVALUE_FLOOR
    blocks = np.where(indefinite[:, None, None], compose(changed, vectors), scaled.blocks)
    tie = np.einsum("eks,ekt->st", scaled.borders, np.linalg.solve(blocks, scaled.borders))
    # B has the borders of H: its Schur complement C - sum_e G_e' B_e^-1 G_e is convex with the tie added to the corner.
    corner = tie
    if corner.size:
        complement = Dense.of(scaled.corner - tie, len(tie))
        corner = complement.convexify(np.zeros((0, len(tie))))[0].array + tie
    return Arrow(scaled.layout, blocks, scaled.borders, 0.5 * (corner + corner.T))
