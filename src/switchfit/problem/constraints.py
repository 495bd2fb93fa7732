"""Linear constraints on theta as data: durations of modes, and bounds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from switchfit.runtime.presentation import Printed

ConstraintKind = Literal["collapsed", "minimum duration", "lower bound", "upper bound", "known jump"]


@dataclass(frozen=True)
class Constraint(Printed):
    """A linear constraint; print it for a sentence about it when it is active.

    Attributes
    ----------
    kind : {"collapsed", "minimum duration", "lower bound", "upper bound", "known jump"}
        "collapsed" is a minimum duration of 0: when it is active, the mode has zero duration. "known jump" is the bound
        of a transition time at the time of a `Jump`, on whose other side its guess does not lie.
    value : float
        The minimum duration in the time unit of the run, or the bound in the unit of the unknown.
    unknown : str
        Name of the unknown that has the bound; empty for a duration.
    mode : str
        Name of the mode that has the duration; empty for a bound.
    position : int or None
        Index of that mode in the mode sequence, from 0; None for a bound.
    run : str
        Name of the experiment that has the mode; empty for a bound, and if there is only one experiment.
    """

    kind: ConstraintKind
    value: float
    unknown: str = ""
    mode: str = ""
    position: int | None = None
    run: str = ""


@dataclass(frozen=True)
class ActiveConstraint(Constraint):
    """A linear constraint that holds with equality at a solution; print it for a short sentence.

    Attributes
    ----------
    kind, value, unknown, mode, position, run : as in `Constraint`
    multiplier : float
        Its Lagrange multiplier, 0 or more: the decrease of J per unit by which the constraint is relaxed; where a
        transition time is at a sample time, of J on the side that the constraint allows.

    See Also
    --------
    Estimate.active : those of a fit.
    Termination, Issue

    Examples
    --------
    >>> problem = heater_problem()
    >>> bounded = {**problem.parameters, "k": sf.Parameter(0.3, upper=0.35, unit="1/h")}
    >>> fit = sf.estimate(sf.Problem(problem.system, problem.experiments[0], bounded))
    >>> active = fit.active[0]
    >>> active.kind, active.unknown, active.value, active.multiplier > 0
    ('upper bound', 'k', 0.35, True)
    >>> print(active)
    k at its upper bound 0.35
    """

    multiplier: float = 0.0
