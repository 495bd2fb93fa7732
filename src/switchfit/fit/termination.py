"""How a fit ended, as data from which the report writes its message."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from switchfit.optimize import Result, Status
from switchfit.optimize.result import LineSearchFailure
from switchfit.problem.comparisons import find_comparisons
from switchfit.problem.constraints import ActiveConstraint
from switchfit.problem.problem import Problem
from switchfit.problem.reads import find_unread
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import Printed

MOST_NAMED_UNKNOWNS = 4
"""Largest number of unknowns named for a flat direction."""

SMALL_WEIGHT = 0.1
"""Unknowns with a weight below this in a direction of unit length are not named."""


@dataclass(frozen=True)
class Kink(Printed):
    """An unknown that ended where the derivative of the cost jumps through zero; print it for a short sentence.

    Its standard error follows from both derivatives and the curvature, see `Fit.covariance`.

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
        Unknowns on which J does not depend because modes have collapsed: the transition times of a mode of zero
        duration between two intervals of the same mode, and parameters that act in collapsed modes alone. Their values
        are arbitrary, and they are not in `free_basis`.
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
    unread : tuple of str
        Parameters that no function of the model reads: J does not depend on them.
    absent : tuple of str
        Parameters that are read only by modes, or at transitions, that do not occur in any mode_sequence.

    See Also
    --------
    Estimate.termination, Status

    Examples
    --------
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
    multipliers = dict(zip(problem.constraints.names, result.multipliers.tolist(), strict=True))
    smallest: float = np.nan
    flat: tuple[tuple[str, float], ...] = ()
    if result.status in (Status.SADDLE, Status.SINGULAR):  # eigenvalues take time, and no other status needs them
        smallest, direction = result.smallest_eigenvalue, result.curvature.spectrum.lowest
        largest = [i for i in np.argsort(-np.abs(direction), kind="stable") if abs(direction[i]) > SMALL_WEIGHT]
        flat = tuple((names[i], float(direction[i])) for i in largest[:MOST_NAMED_UNKNOWNS])
    same = {name: getattr(result, name) for name in ("status", "cost", "optimality", "tolerance", "violated")}
    return Termination(
        **same,
        iterations=earlier + result.iterations,
        earlier_iterations=earlier,
        active=tuple(ActiveConstraint(**vars(each), multiplier=multipliers[each]) for each in result.active),
        kinks=tuple(Kink(names[i], float(result.theta[i]), left, right) for i, left, right in result.kinks),
        idle=tuple(names[i] for i in result.idle),
        smallest_eigenvalue=smallest,
        flat_direction=flat,
        reason=None if result.reason is None else _describe_failure(result, result.reason, problem),
        **find_unread(problem)._asdict(),
    )


def _describe_failure(result: Result, found: LineSearchFailure, problem: Problem) -> Issue | None:
    """Return why the line search failed, with the names of the unknowns; of a fit that has converged a "switch" alone.

    A jump of J is a switch if a function compares with the unknown: where, is the second subject of the issue.
    """
    names, comparisons = problem.unknowns.names, find_comparisons(problem) if found.kind == "jump" else {}
    for i, value in found.places:
        if i in comparisons:
            return Issue("switch", (names[i], comparisons[i]), {**found.figures, "at": value})
    if result.status.successful:
        return None
    figures: dict[str, float | tuple[float, ...]] = {**found.figures}
    if found.places:
        figures["at"] = tuple(value for _, value in found.places)
    if problem.estimates_delays:
        figures["delayed"] = 1.0
    return Issue(found.kind, tuple(names[i] for i, _ in found.places), figures)
