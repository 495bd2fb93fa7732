"""How the numbers of a fit were checked, computed anew from the fit and not taken from the optimiser's word."""

from __future__ import annotations

import numpy as np

from switchfit.check import derivative_gap
from switchfit.evaluate import Evaluator
from switchfit.result import Certificate, Fit, free_curvature


def certify(fit: Fit, evaluator: Evaluator | None) -> Certificate:
    """Check a fit.

    Parameters
    ----------
    fit : Fit
    evaluator : Evaluator or None
        Of its problem, its meshes refined at the solution. Without it the paper's equations are not evaluated and
        the gaps are NaN.

    Returns
    -------
    Certificate
    """
    curvature = free_curvature(fit)
    scaled = curvature.scaled
    gaps = (np.nan, np.nan) if evaluator is None else derivative_gap(evaluator, fit.theta)
    kinks = tuple(f"{name} at a kink ({left:.1e}, {right:.1e})" for name, left, right in fit.kinks)
    return Certificate(
        optimality=fit.optimality,
        smallest_eigenvalue=curvature.smallest,
        smallest_scaled_eigenvalue=float(scaled[0]) if len(scaled) else np.nan,
        condition_number=float(scaled[-1] / scaled[0]) if len(scaled) and scaled[0] > 0 else np.inf,
        worst_direction=_in_words(curvature.weakest),
        integration_error=fit.integration_error,
        gradient_gap=float(gaps[0]),
        hessian_gap=float(gaps[1]),
        active=fit.active + kinks,
    )


def _in_words(names: tuple[str, ...]) -> str:
    """The unknowns that a direction mostly consists of."""
    if len(names) < 2:
        return f"{names[0]} alone" if names else "none"
    return " and ".join(names) + " trade off"
