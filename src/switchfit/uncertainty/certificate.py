"""How the numbers of a fit were checked, computed anew from the fit and not taken from the optimiser's word."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from switchfit.fit.evaluator import Evaluator
from switchfit.fit.result import Certificate, Fit, free_curvature
from switchfit.optimize import Status
from switchfit.uncertainty.derivative_check import (
    LARGEST_GAP,
    derivative_gap,
    observed_orders,
    orders_right,
    taylor_table,
)
from switchfit.uncertainty.identification import after

LARGE_INTEGRATION_ERROR = 1e-6
"""Relative error of J or of a constraint by halving the steps above which a fit has fewer digits than it seems."""

NEGATIVE = -1e-8
"""Eigenvalues of the scaled Hessian below this are negative curvature, not rounding."""


def certify(fit: Fit, evaluator: Evaluator | None) -> Certificate:
    """Check a fit.

    Parameters
    ----------
    fit : Fit
    evaluator : Evaluator or None
        Of its problem, its meshes refined at the solution. Without it the paper's equations are not evaluated, and
        gaps and Taylor orders are NaN.

    Returns
    -------
    Certificate
    """
    found = after(fit, None)
    scaled = found.eigenvalues
    gaps = (np.nan, np.nan)
    orders: tuple[float, ...] = (np.nan,) * 3
    if evaluator is not None:
        gaps = derivative_gap(evaluator, fit.theta)
        orders = observed_orders(taylor_table(evaluator, fit.theta).orders)
    stiff = evaluator is not None and evaluator.problem.solver == "stiff"
    smallest = float(scaled[0]) if len(scaled) else np.nan
    kinks = tuple(f"{name} at a kink ({left:.1e}, {right:.1e})" for name, left, right in fit.kinks)
    return Certificate(
        optimality=fit.optimality,
        smallest_eigenvalue=free_curvature(fit).smallest,
        smallest_scaled_eigenvalue=smallest,
        condition_number=found.condition_number if len(scaled) else np.inf,
        worst_direction=found.directions[0].summary if found.directions else "none",
        integration_error=fit.integration_error,
        integration_error_of=fit.integration_error_of,
        gradient_gap=float(gaps[0]),
        hessian_gap=float(gaps[1]),
        taylor_orders=orders,
        active=fit.active + kinks,
        failures=tuple(_failures(fit, smallest, gaps, orders, stiff=stiff)),
    )


def _failures(
    fit: Fit, smallest: float, gaps: tuple[float, float], orders: tuple[float, ...], *, stiff: bool
) -> Iterator[str]:
    """What is not as it has to be."""
    if fit.status is not Status.CONVERGED_PRECISION and not fit.optimality <= fit.tolerance:
        yield f"the KKT residual {fit.optimality:.1e} is above the tolerance {fit.tolerance:.1e}"
    if smallest < NEGATIVE:
        yield f"the Hessian has a negative eigenvalue on the free directions ({smallest:.1e}, scaled)"
    if not fit.integration_error <= LARGE_INTEGRATION_ERROR:
        yield f"the integration error of {fit.integration_error_of} is {fit.integration_error:.1e}, relative"
    if max(gaps) > LARGEST_GAP and not stiff:
        yield f"the paper's equations differ from the derivatives of J by {max(gaps):.1e}, relative"
    # The first order says nothing at a minimum, where the gradient vanishes.
    if not orders_right((np.nan, *orders[1:])):
        shown = ", ".join(f"{order:.2f}" for order in orders)
        yield f"the Taylor orders are {shown} instead of (any), 2, 3 or more: gradient or Hessian do not belong to J"
