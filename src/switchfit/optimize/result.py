"""Result of a minimization: the best point with its multipliers, curvature and history.

If the line search failed, the result can find out why when it is asked (`Result.reason`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.optimize.curvature import FreeCurvature
from switchfit.optimize.status import Status

Explain: TypeAlias = "Callable[[], LineSearchFailure]"
"""Finds out why a line search failed, when that is asked for."""

Callback: TypeAlias = "Callable[[IterationRecord], object]"
"""Gets each `IterationRecord`; a true return value stops the minimization."""


class LineSearchFailure(NamedTuple):
    """Why no fraction of a step decreases J although its slope is negative.

    Attributes
    ----------
    kind : {"wrong slope", "jump", "kink", "not finite", "rounding", "valley"}
    figures : mapping of str to float
        "before" and "after": J on both sides of a jump; the slope on both sides of a kink; the slope and the difference
        quotient where the slope is wrong. "noise": the rounding error of J, where that is the reason.
    places : tuple of (int, float)
        Coordinates of the jump or the kink, or of the point from which on J is not finite, and where each of them is
        there.
    """

    kind: Literal["wrong slope", "jump", "kink", "not finite", "rounding", "valley"]
    figures: Mapping[str, float]
    places: tuple[tuple[int, float], ...] = ()


@dataclass(frozen=True, eq=False)
class IterationRecord:
    """One line of the history.

    Attributes
    ----------
    iteration : int, 0 for the start
    cost, optimality : float
    step : float
        The fraction of the proposed step that was taken.
    theta : array, shape (d,)
    evaluations : int, all calls up to then
    """

    iteration: int
    cost: float
    optimality: float
    step: float
    theta: FloatArray
    evaluations: int

    def continue_from(self, last: IterationRecord | None) -> IterationRecord:
        """Return this record of a resumed minimization, counted on from the last one before (None: the first)."""
        if last is None:
            return self
        return replace(self, iteration=self.iteration + last.iteration, evaluations=self.evaluations + last.evaluations)


@dataclass(frozen=True, eq=False)
class Result:
    """Outcome of `minimize`.

    Attributes
    ----------
    theta : array, shape (d,)
        The best point found; feasible.
    cost : float
    gradient : array, shape (d,)
        Right-hand derivatives at a coordinate that is on a breakpoint (left-hand at an upper bound).
    hessian : array, shape (d, d)
        As evaluated there, not modified; NaN if the caller gives none.
    optimality : float
        KKT residual, min over multipliers of ‖g − Aᵀ lam‖₂: the steepest descent along feasible directions of length
        one, the norm of the gradient if nothing is active.
    iterations, evaluations : int
    status : Status
    active : tuple
        Those of `LinearConstraints.names` whose constraints hold with equality.
    multipliers : array, shape (m + 2 d,)
        Of rows, lower and upper bounds, in the order of `LinearConstraints.names`.
    kinks : tuple of (int, float, float)
        Coordinate, left and right derivative, where the solution sits at a kink.
    curvature : Curvature
        The Hessian on the directions left free by active constraints and kinks.
    tolerance : float
        The given tolerance on the KKT residual.
    history : tuple of IterationRecord
        The start and every iteration.
    violated : tuple of (str, float)
        Equality constraints that are not met, with their values.
    idle : tuple of int
        Coordinates on which J does not depend at theta, as the caller's `idle` finds, and those that active rows tie to
        them; they are not in `free_basis`.
    explain : callable, or None
        Finds out why the line search failed, by some dozens of evaluations; None if it did not fail.
    equalities : tuple of (str, float, float)
        Name, value and multiplier of each equality constraint; the Hessian is that of ``J + multipliers . c``.
    predicted : float
        Decrease of the cost that the quadratic model still predicts, if the status is MAX_ITERATIONS or
        LINE_SEARCH_FAILED; else NaN.
    """

    theta: FloatArray
    cost: float
    gradient: FloatArray
    hessian: FloatArray
    optimality: float
    evaluations: int
    status: Status
    multipliers: FloatArray
    curvature: FreeCurvature
    tolerance: float
    iterations: int = 0
    active: tuple[object, ...] = ()
    kinks: tuple[tuple[int, float, float], ...] = ()
    history: tuple[IterationRecord, ...] = ()
    violated: tuple[tuple[str, float], ...] = ()
    idle: tuple[int, ...] = ()
    explain: Explain | None = None
    equalities: tuple[tuple[str, float, float], ...] = ()
    predicted: float = np.nan

    @property
    def reason(self) -> LineSearchFailure | None:
        """Why the line search failed; None if it did not."""
        return None if self.explain is None else self.explain()

    @property
    def free_basis(self) -> FloatArray:
        """Orthonormal basis of the directions left free by active constraints and kinks, shape (d, k)."""
        return self.curvature.basis

    @property
    def smallest_eigenvalue(self) -> float:
        """Smallest eigenvalue of the diagonally scaled Hessian on the free directions; NaN if there are none."""
        return self.curvature.spectrum.smallest
