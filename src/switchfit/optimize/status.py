"""What a minimisation returns: its status, its history and its result."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np

from switchfit.optimize.algebra import FloatArray
from switchfit.optimize.matrix import Curvature


class Status(Enum):
    """How a minimisation ended: a sentence with the remedy, to be filled in by `Result.message`."""

    CONVERGED = "Converged: the optimality {optimality:.1e} is below the tolerance {tolerance:.1e}."
    CONVERGED_PRECISION = (
        "Converged to the limit of double precision: the optimality {optimality:.1e} is above the tolerance "
        "{tolerance:.1e}, but the decrease still predicted is below the rounding error of the cost {cost:.6e}. "
        "Ask for a larger tolerance."
    )
    CONVERGED_AT_KINK = (
        "Converged at a kink of the cost: {kinks}. The one-sided derivatives have opposite signs, so this is a "
        "minimiser although no gradient vanishes there; covariances do not apply to such an unknown."
    )
    MAX_ITERATIONS = (
        "Stopped after {iterations} iterations{earlier} with optimality {optimality:.1e} above the tolerance "
        "{tolerance:.1e}. "
        "Raise max_iterations, use hessian='exact', or start closer."
    )
    LINE_SEARCH_FAILED = (
        "The line search found no decrease of the cost along a descent direction (optimality {optimality:.1e}), nor "
        "did it after a fresh start from there. {reason}"
    )
    INTERRUPTED = "Interrupted after {iterations} iterations with optimality {optimality:.1e}: the best point so far."
    NONFINITE_START = (
        "The cost or its derivatives are not finite at the starting point. Start elsewhere, or check the model there."
    )
    SADDLE = (
        "A stationary point but no minimum: the scaled Hessian on the free directions has the eigenvalue "
        "{smallest_eigenvalue:.1e}, and no step along it decreased the cost. Start elsewhere."
    )
    SINGULAR = (
        "Converged, but the cost is flat to second order along {direction} (scaled eigenvalue "
        "{smallest_eigenvalue:.1e}): these unknowns are not identified. Fix one of them or add data."
    )
    COLLAPSED = (
        "Converged (optimality {optimality:.1e}), with a mode that has no duration: the cost depends neither on where "
        "it would stand nor on what acts in it alone ({idle}). Leave it out of mode_sequence, start from another "
        "guess, or give min_duration."
    )
    INFEASIBLE = (
        "The constraints are not met: {violated}. Start nearer to a point that meets them, or check that one can."
    )
    ERROR = "The fit ended with an error, and was left where it was. {error}"

    @property
    def successful(self) -> bool:
        """Whether the point is a local minimiser as far as second-order conditions can tell."""
        return self in (Status.CONVERGED, Status.CONVERGED_PRECISION, Status.CONVERGED_AT_KINK)

    @property
    def converged(self) -> bool:
        """Whether the minimisation ended as it should: also where J is flat in some direction, or a mode collapsed."""
        return self.successful or self in (Status.SINGULAR, Status.COLLAPSED)


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

    def counted_on(self, last: IterationRecord | None) -> IterationRecord:
        """This record of a minimisation that was resumed, counted on from the last record before; None: the first."""
        if last is None:
            return self
        return replace(self, iteration=self.iteration + last.iteration, evaluations=self.evaluations + last.evaluations)


Callback = Callable[[IterationRecord], object]
"""Gets each `IterationRecord`; a true return value stops the minimisation."""


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
    active : tuple of str
        Names of the constraints that hold with equality.
    multipliers : array, shape (m + 2 d,)
        Of rows, lower and upper bounds, in the order of `LinearConstraints.names`.
    kinks : tuple of (int, float, float)
        Coordinate, left and right derivative, where the solution sits at a kink.
    curvature : Curvature
        The Hessian on the directions left free by active constraints and kinks.
    tolerance : float
        The tolerance asked for.
    history : tuple of IterationRecord
        The start and every iteration.
    violated : str
        Equality constraints that are not met, with their values.
    idle : tuple of int
        Coordinates on which J does not depend at theta, by the word of the caller's `idle`, and those that active rows
        tie to them; they are not in `free_basis`.
    reason : str
        What was seen where the line search failed, and what to do.
    earlier : int
        How many of the iterations belong to minimisations before, which this one resumed.
    """

    theta: FloatArray
    cost: float
    gradient: FloatArray
    hessian: FloatArray
    optimality: float
    iterations: int
    evaluations: int
    status: Status
    active: tuple[str, ...]
    multipliers: FloatArray
    kinks: tuple[tuple[int, float, float], ...]
    curvature: Curvature
    tolerance: float
    history: tuple[IterationRecord, ...]
    violated: str = ""
    idle: tuple[int, ...] = ()
    reason: str = ""
    earlier: int = 0

    @property
    def successful(self) -> bool:
        """Whether the status is one of the successful ones."""
        return self.status.successful

    @property
    def free_basis(self) -> FloatArray:
        """Orthonormal basis of the directions left free by active constraints and kinks, shape (d, k)."""
        return self.curvature.basis

    @property
    def free_eigenvalues(self) -> FloatArray:
        """Eigenvalues, ascending, of the diagonally scaled Hessian on the free directions, shape (k,).

        The smallest alone where the Hessian has the shape of an arrow.
        """
        return self.curvature.spectrum.eigenvalues

    @property
    def smallest_eigenvalue(self) -> float:
        """The smallest of these; NaN if there are none."""
        values = self.free_eigenvalues
        return float(values[0]) if values.size else np.nan

    @property
    def smallest_unscaled_eigenvalue(self) -> float:
        """The smallest eigenvalue of ``free_basisᵀ H free_basis``; NaN if there are none."""
        values = self.curvature.spectrum.unscaled
        return float(values[0]) if values.size else np.nan

    @property
    def flat_direction(self) -> FloatArray:
        """Eigenvector, in theta and of unit length, that belongs to `smallest_eigenvalue`, shape (d,)."""
        return self.curvature.spectrum.lowest

    @property
    def message(self) -> str:
        """The status as a sentence with this result's numbers and names."""
        kinks = ", ".join(
            f"theta[{i}] = {self.theta[i]:.10g}, where the derivative jumps from {left:.1e} to {right:.1e}"
            for i, left, right in self.kinks
        )
        direction, smallest = "", np.nan
        if self.status in (Status.SADDLE, Status.SINGULAR):  # no others ask for eigenvalues
            smallest = self.smallest_eigenvalue
            order = np.argsort(-np.abs(self.flat_direction), kind="stable")
            largest = [i for i in order if abs(self.flat_direction[i]) > 0.1][:4]
            direction = " ".join(f"{self.flat_direction[i]:+.2g} theta[{i}]" for i in largest) or "no direction"
        sentence = self.status.value.format(
            optimality=self.optimality,
            tolerance=self.tolerance,
            cost=self.cost,
            iterations=self.iterations,
            smallest_eigenvalue=smallest,
            kinks=kinks,
            direction=direction,
            violated=self.violated,
            idle=", ".join(f"theta[{i}]" for i in self.idle),
            reason=self.reason,
            earlier=f", {self.earlier} of them before the mesh was refined," if self.earlier else "",
        )
        return sentence + (f" Active: {'; '.join(self.active)}." if self.active else "")
