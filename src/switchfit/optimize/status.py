"""Status, history and result of a minimization."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from switchfit.optimize.algebra import FloatArray
from switchfit.optimize.diagnosis import Finding
from switchfit.optimize.matrix import Curvature


class Status(Enum):
    """How a minimization ended, and what that means.

    See Also
    --------
    Estimate.status, Termination

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> fit = sf.estimate(heater_problem())

    >>> fit.status is sf.Status.CONVERGED
    True
    >>> fit.status.successful
    True
    """

    CONVERGED = "The optimality is below the tolerance, and the curvature on the free directions is positive."
    CONVERGED_PRECISION = (
        "The decrease that is still predicted is below the error of the cost, by rounding or by integration, or would "
        "move no unknown by a quarter of its standard error, although the optimality is above the tolerance."
    )
    CONVERGED_AT_KINK = (
        "The one-sided derivatives have opposite signs at a kink of the cost: a minimizer where no gradient vanishes."
    )
    MAX_ITERATIONS = "All iterations were done before the optimality was below the tolerance."
    LINE_SEARCH_FAILED = (
        "The line search found no decrease along a descent direction, nor did it after a fresh start from there."
    )
    INTERRUPTED = "The callback, or Ctrl-C, stopped it; the result is the best point so far."
    NONFINITE_START = "The cost or its derivatives are not finite at the starting point."
    SADDLE = "A stationary point with negative curvature from which no step decreased the cost: no minimum."
    SINGULAR = "Converged to a point from which the cost is flat to second order in some direction."
    COLLAPSED = (
        "Converged with a mode of no duration: the cost depends neither on where it would stand nor on what acts in "
        "it alone."
    )
    INFEASIBLE = "A guard or a terminal constraint is not met."
    ERROR = "The fit ended with an error, and was left where it was."

    @property
    def successful(self) -> bool:
        """Whether it converged, to a point near which nothing decreases the cost.

        It says nothing about how well the model fits: `Estimate.success` asks that the verdict is not bad as well.

        Also where that point is not the only one: where the cost is flat in some direction (`SINGULAR`), or a mode has
        collapsed (`COLLAPSED`). `is_strict_minimum` leaves these out.
        """
        return self.is_strict_minimum or self in (Status.SINGULAR, Status.COLLAPSED)

    @property
    def is_strict_minimum(self) -> bool:
        """Whether the point is the only minimizer nearby, as far as second-order conditions can tell."""
        return self in (Status.CONVERGED, Status.CONVERGED_PRECISION, Status.CONVERGED_AT_KINK)


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


Callback = Callable[[IterationRecord], object]
"""Gets each `IterationRecord`; a true return value stops the minimization."""


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
    reason : Finding or None
        Why the line search failed; None if it did not.
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
    curvature: Curvature
    tolerance: float
    iterations: int = 0
    active: tuple[object, ...] = ()
    kinks: tuple[tuple[int, float, float], ...] = ()
    history: tuple[IterationRecord, ...] = ()
    violated: tuple[tuple[str, float], ...] = ()
    idle: tuple[int, ...] = ()
    reason: Finding | None = None
    equalities: tuple[tuple[str, float, float], ...] = ()
    predicted: float = np.nan

    @property
    def free_basis(self) -> FloatArray:
        """Orthonormal basis of the directions left free by active constraints and kinks, shape (d, k)."""
        return self.curvature.basis

    @property
    def smallest_eigenvalue(self) -> float:
        """Smallest eigenvalue of the diagonally scaled Hessian on the free directions; NaN if there are none."""
        values = self.curvature.spectrum.eigenvalues
        return float(values[0]) if values.size else np.nan

    @property
    def flat_direction(self) -> FloatArray:
        """Eigenvector, in theta and of unit length, that belongs to `smallest_eigenvalue`, shape (d,)."""
        return self.curvature.spectrum.lowest
