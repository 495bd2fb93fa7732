"""Checks of the numbers of a fit, computed from the fit and not taken from the optimizer."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from switchfit.fit.evaluator import Evaluator
from switchfit.fit.result import Fit, free_curvature
from switchfit.fit.termination import Kink
from switchfit.optimize import Status
from switchfit.problem.constraints import ActiveConstraint
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import Printed
from switchfit.uncertainty.derivative_check import (
    LARGEST_GAP,
    are_orders_right,
    build_taylor_table,
    estimate_orders,
    measure_closing_gap,
)
from switchfit.uncertainty.identification import Combination, analyse_solution

LARGE_INTEGRATION_ERROR = 1e-6
"""Relative change of J or of a constraint by halving the steps, above which it counts as inaccurate."""

NEGATIVE = -1e-8
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
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
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
        return str(Combination(self.worst_unknowns))


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
    found = analyse_solution(fit, None)
    scaled = found.eigenvalues
    gaps = (np.nan, np.nan)
    orders: tuple[float, ...] = (np.nan,) * 3
    if evaluator is not None:
        gaps = measure_closing_gap(evaluator, fit.theta)
        orders = estimate_orders(build_taylor_table(evaluator, fit.theta).orders)
    stiff = evaluator is not None and evaluator.takes_implicit_steps
    smallest = float(scaled[0]) if len(scaled) else np.nan
    return Certificate(
        optimality=fit.optimality,
        smallest_eigenvalue=free_curvature(fit).smallest,
        smallest_scaled_eigenvalue=smallest,
        condition_number=found.condition_number if len(scaled) else np.inf,
        worst_unknowns=found.directions[0].names if found.directions else (),
        integration_error=fit.integration_error,
        integration_error_of=fit.integration_error_of,
        gradient_gap=float(gaps[0]),
        hessian_gap=float(gaps[1]),
        taylor_orders=orders,
        active=fit.active,
        kinks=fit.kinks,
        failures=tuple(_find_failures(fit, smallest, gaps, orders, stiff=stiff)),
    )


def _find_failures(
    fit: Fit, smallest: float, gaps: tuple[float, float], orders: tuple[float, ...], *, stiff: bool
) -> Iterator[Issue]:
    """Return the checks that failed."""
    if fit.status is not Status.CONVERGED_PRECISION and not fit.optimality <= fit.tolerance:
        yield Issue("optimality", figures={"optimality": fit.optimality, "tolerance": fit.tolerance})
    if smallest < NEGATIVE:
        yield Issue("negative curvature", figures={"eigenvalue": smallest})
    if not fit.integration_error <= LARGE_INTEGRATION_ERROR:
        yield Issue("integration error", (fit.integration_error_of,), {"error": fit.integration_error})
    if max(gaps) > LARGEST_GAP and not stiff:
        yield Issue("derivative gap", figures={"gap": max(gaps)})
    # The first order is not tested: at a minimum, the gradient vanishes.
    if not are_orders_right((np.nan, *orders[1:])):
        yield Issue("Taylor orders", figures={"orders": orders})
