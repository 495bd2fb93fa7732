"""How a fit ended, as data from which the report writes its message."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from switchfit.optimize import Result, Status
from switchfit.optimize.diagnosis import Finding
from switchfit.problem.comparisons import find_comparison
from switchfit.problem.constraints import ActiveConstraint, Constraint
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem
from switchfit.problem.readers import find_unread
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import Printed

NAMED = 4
"""Largest number of unknowns named for a flat direction."""

SMALL_WEIGHT = 0.1
"""Unknowns with a weight below this in a direction of unit length are not named."""


@dataclass(frozen=True)
class Kink(Printed):
    """An unknown that ended where the derivative of the cost jumps through zero; print it for a short sentence.

    Attributes
    ----------
    unknown : str
    value : float
        Value of the unknown at the kink.
    left, right : float
        Derivatives of J on both sides of it.

    See Also
    --------
    Estimate.kinks, Status

    Examples
    --------
    >>> import switchfit as sf
    >>> kink = sf.Kink("tau_1", value=2.0, left=-0.3, right=0.4)
    >>> kink.left < 0 < kink.right
    True
    """

    unknown: str
    value: float
    left: float
    right: float


@dataclass(frozen=True)
class Termination(Printed):
    """How a fit ended; print it for the message. The fields are those of `Fit` of the same names.

    Attributes
    ----------
    status : Status
    cost, optimality, tolerance : float
    iterations, earlier_iterations : int
        All iterations, and those before the last refinement of the mesh.
    active : tuple of ActiveConstraint
    kinks : tuple of Kink
    idle : tuple of str
    smallest_eigenvalue : float
        Smallest eigenvalue of the Hessian on the free directions, each unknown scaled to unit curvature, if the status
        is SADDLE or SINGULAR; else NaN.
    flat_direction : tuple of (str, float)
        Unknowns with the largest components of its eigenvector, and these components.
    violated : tuple of (str, float)
        Guards and terminal constraints that are violated, and their values.
    reason : Issue or None
        Why the line search failed, or the error with which the fit ended. If a function compares with an unknown, and
        the fit ended at a jump of J in it or with a large integration error, a "switch": the unknown, which function
        and where; also of a fit that has converged.
    unread, absent : tuple of str

    See Also
    --------
    Estimate.termination, Status

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> fit = sf.estimate(heater_problem())

    >>> fit.termination.status.name
    'CONVERGED'
    >>> bool(fit.termination.optimality < 1e-7)
    True
    """

    status: Status
    cost: float = np.nan
    optimality: float = np.nan
    tolerance: float = np.nan
    iterations: int = 0
    earlier_iterations: int = 0
    active: tuple[ActiveConstraint, ...] = ()
    kinks: tuple[Kink, ...] = ()
    idle: tuple[str, ...] = ()
    smallest_eigenvalue: float = np.nan
    flat_direction: tuple[tuple[str, float], ...] = ()
    violated: tuple[tuple[str, float], ...] = ()
    reason: Issue | None = None
    unread: tuple[str, ...] = ()
    absent: tuple[str, ...] = ()

    @classmethod
    def of_error(cls, text: str) -> Termination:
        """Return the termination of a fit that ended with an error, whose message is `text`.

        See Also
        --------
        Termination

        Examples
        --------
        >>> import switchfit as sf
        >>> sf.Termination.of_error("the log is empty").status.name
        'ERROR'
        """
        return cls(Status.ERROR, reason=Issue("error", (text,)))


def termination_of(result: Result, problem: Problem, earlier: int = 0) -> Termination:
    """Return how a fit ended, from the optimizer's result.

    Parameters
    ----------
    result : Result
        In theta; its constraints are those of the problem.
    problem : Problem
    earlier : int
        Iterations before, on coarser meshes, where the optimizer resumed a fit.
    """
    names = problem.unknowns.names
    smallest: float = np.nan
    flat: tuple[tuple[str, float], ...] = ()
    if result.status in (Status.SADDLE, Status.SINGULAR):  # eigenvalues take time, and no other status needs them
        smallest, flat = result.smallest_eigenvalue, _list_largest(result.flat_direction, names)
    return Termination(
        status=result.status,
        cost=result.cost,
        optimality=result.optimality,
        tolerance=result.tolerance,
        iterations=earlier + result.iterations,
        earlier_iterations=earlier,
        active=_list_active(result, problem),
        kinks=tuple(Kink(names[i], float(result.theta[i]), left, right) for i, left, right in result.kinks),
        idle=tuple(names[i] for i in result.idle),
        smallest_eigenvalue=smallest,
        flat_direction=flat,
        violated=result.violated,
        reason=None if result.reason is None else _describe_failure(result, result.reason, problem),
        **find_unread(problem)._asdict(),
    )


def _list_largest(direction: FloatArray, names: Sequence[str]) -> tuple[tuple[str, float], ...]:
    """Return the unknowns with the largest components of a direction (d,) of unit length, and these components."""
    parts = np.abs(direction)
    largest = [i for i in np.argsort(-parts, kind="stable").tolist() if parts[i] > SMALL_WEIGHT][:NAMED]
    return tuple((names[i], float(direction[i])) for i in largest)


def _list_active(result: Result, problem: Problem) -> tuple[ActiveConstraint, ...]:
    if not result.active:
        return ()
    multipliers = dict(zip(problem.constraints.names, result.multipliers.tolist(), strict=True))
    found = [constraint for constraint in result.active if isinstance(constraint, Constraint)]
    return tuple(ActiveConstraint(**vars(constraint), multiplier=multipliers[constraint]) for constraint in found)


def describe_switch(problem: Problem, i: int) -> Issue | None:
    """Return that a function compares with an unknown, and where; None if no function does.

    Parameters
    ----------
    problem : Problem
    i : int
        Index of the unknown in theta.
    """
    comparison = find_comparison(problem, i)
    return None if comparison is None else Issue("switch", (problem.unknowns.names[i], comparison))


def _describe_failure(result: Result, found: Finding, problem: Problem) -> Issue | None:
    """Return why the line search failed, with the names of the unknowns; of a fit that has converged a "switch" alone.

    A jump of J is a switch if a function compares with the unknown: where, is the second subject of the issue.
    """
    names = problem.unknowns.names
    for i, value in found.places if found.kind == "jump" else ():
        switch = describe_switch(problem, i)
        if switch is not None:
            return replace(switch, figures={"before": found.before, "after": found.after, "at": value})
    if result.status.successful:
        return None
    figures: dict[str, float | tuple[float, ...]] = {}
    subjects: tuple[str, ...] = ()
    if found.kind in ("wrong slope", "jump", "kink"):
        figures |= {"before": found.before, "after": found.after}
    if found.kind == "wrong slope":
        subjects = tuple(names[i] for i, _, _ in found.entries)
        figures |= {
            "derivatives": tuple(stated for _, stated, _ in found.entries),
            "differences": tuple(measured for _, _, measured in found.entries),
        }
    elif found.kind in ("jump", "kink", "not finite"):
        subjects = tuple(names[i] for i, _ in found.places)
        figures["at"] = tuple(value for _, value in found.places)
    elif found.kind == "rounding":
        figures["noise"] = found.noise
    elif found.kind == "valley":
        figures["condition"] = found.condition
    if problem.estimates_delays:
        figures["delayed"] = 1.0
    return Issue(found.kind, subjects, figures)
