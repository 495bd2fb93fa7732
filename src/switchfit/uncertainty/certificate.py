"""Certificate: checks of the numbers of a fit, computed from the fit and not taken from the optimizer."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from switchfit.fit.result import Fit
from switchfit.fit.termination import Kink
from switchfit.meshes.evaluator import Evaluator
from switchfit.meshes.integration_error import LARGE_INTEGRATION_ERROR
from switchfit.optimize import Status
from switchfit.problem.constraints import ActiveConstraint
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import Printed
from switchfit.uncertainty.derivative_check import UNCHECKED, DerivativeCheck, are_orders_right, compare_derivatives
from switchfit.uncertainty.identification import analyse_solution

NEGATIVE_SCALED_EIGENVALUE = -1e-8
"""Eigenvalues of the scaled Hessian below this are negative curvature, not rounding."""


@dataclass(frozen=True)
class Certificate(Printed):
    """Checks of the numbers of a fit.

    Attributes
    ----------
    optimality : float
        KKT residual at the solution.
    smallest_eigenvalue : float
        Smallest eigenvalue of the Hessian on the free directions; if it is positive, the second-order sufficient
        condition holds. NaN if nothing is free.
    smallest_scaled_eigenvalue : float
        The same with each unknown scaled to unit curvature: 1 is perfectly determined, 0 is not determined at all.
    condition_number : float
        Condition number of that scaled Hessian.
    worst_unknowns : tuple of str
        Unknowns with the largest components in the worst-determined direction, the largest first.
    integration_error : float
        Largest relative change by halving all steps of J, the guards and the terminal constraints. For J it is relative
        to J, or to 1e-3 of the first J if that is more; for a constraint, to the sum of its changes over the ranges of
        the states in the run.
    gradient_gap, hessian_gap : float
        Relative gap between the paper's equations (6)-(17) and the exact derivatives of the discretized cost; with half
        the steps if it is above 1e-4 without (`DerivativeCheck` says why), NaN if not checked.
    taylor_orders : tuple of float
        Orders of the remainders of J, of J with its gradient and of J with its Hessian along a random direction: at
        least 1, 2, 3 if the derivatives are right (2, 2, 3 at a minimum, where the gradient vanishes); NaN if a
        remainder is rounding, or if not checked.
    active : tuple of ActiveConstraint
        Constraints that hold with equality, including collapsed modes and bounds.
    kinks : tuple of Kink
    failures : tuple of Issue
        Failed checks; empty if the certificate is good.
    integration_error_of : str
        The output that has the `integration_error`: "J", or the name of a guard or terminal constraint.

    See Also
    --------
    estimate, check_derivatives, Estimate.certificate

    Examples
    --------
    >>> fit = sf.estimate(heater_problem())

    >>> fit.certificate.failures
    ()
    >>> fit.certificate.integration_error < 1e-8
    True
    >>> fit.certificate.hessian_gap < 1e-5
    True
    """

    optimality: float
    smallest_eigenvalue: float
    smallest_scaled_eigenvalue: float
    condition_number: float
    worst_unknowns: tuple[str, ...]
    integration_error: float
    gradient_gap: float
    hessian_gap: float
    taylor_orders: tuple[float, ...]
    active: tuple[ActiveConstraint, ...]
    kinks: tuple[Kink, ...]
    failures: tuple[Issue, ...]
    integration_error_of: str = "J"

    @property
    def passed(self) -> bool:
        """Whether no check failed."""
        return not self.failures

    @property
    def worst_direction(self) -> str:
        """The worst-determined direction in words, such as "tau_2 and mu trade off"; "none" if nothing is free."""
        return str(Issue("trade off", self.worst_unknowns))


def certify(fit: Fit, evaluator: Evaluator | None) -> Certificate:
    """Check a fit.

    Parameters
    ----------
    fit : Fit
    evaluator : Evaluator or None
        Evaluator of its problem, with meshes refined at the solution. Without it, the paper's equations are not
        evaluated, and gaps and Taylor orders are NaN.

    Returns
    -------
    Certificate
    """
    found, Z = analyse_solution(fit, None), fit.free_basis
    scaled, is_known = found.eigenvalues, Z.shape[1] > 0 and np.isfinite(fit.hessian).all()
    check = UNCHECKED if evaluator is None else compare_derivatives(evaluator, fit.theta, paper=True)
    smallest = float(scaled[0]) if len(scaled) else np.nan
    return Certificate(
        optimality=fit.optimality,
        smallest_eigenvalue=float(np.linalg.eigvalsh(Z.T @ fit.hessian @ Z)[0]) if is_known else np.nan,
        smallest_scaled_eigenvalue=smallest,
        condition_number=found.condition_number if len(scaled) else np.inf,
        worst_unknowns=found.directions[0].names if found.directions else (),
        integration_error=fit.integration_error,
        integration_error_of=fit.integration_error_of,
        gradient_gap=check.gradient_gap,
        hessian_gap=check.hessian_gap,
        taylor_orders=check.observed_orders,
        active=fit.active,
        kinks=fit.kinks,
        failures=tuple(_find_failures(fit, smallest, check)),
    )


def _find_failures(fit: Fit, smallest: float, check: DerivativeCheck) -> Iterator[Issue]:
    """Return the checks that failed."""
    # Such a fit ended where rounding or noise of J hides any further step: its optimality may be above the tolerance.
    as_precise_as_possible = fit.status.successful and fit.status is not Status.CONVERGED
    if not as_precise_as_possible and not fit.optimality <= fit.tolerance:
        yield Issue("optimality", figures={"optimality": fit.optimality, "tolerance": fit.tolerance})
    if smallest < NEGATIVE_SCALED_EIGENVALUE:
        yield Issue("negative curvature", figures={"eigenvalue": smallest})
    if not fit.integration_error <= LARGE_INTEGRATION_ERROR:
        yield Issue("integration error", (fit.integration_error_of,), {"error": fit.integration_error})
    yield from (issue for issue in check.failures if issue.kind == "derivative gap")
    # The first order is not tested: at a minimum, the gradient vanishes.
    if not are_orders_right((np.nan, *check.observed_orders[1:])):
        orders = Issue("Taylor orders", figures={"orders": check.observed_orders})
        yield Issue("hidden switch", (check.switch,)) if check.switch else orders
