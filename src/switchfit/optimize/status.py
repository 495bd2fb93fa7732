"""Status of a minimization: how it ended, and whether that counts as success."""

from __future__ import annotations

from enum import Enum


class Status(Enum):
    """How a minimization ended, and what that means.

    See Also
    --------
    Estimate.status, Termination

    Examples
    --------
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
