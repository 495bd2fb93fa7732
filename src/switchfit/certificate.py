"""How the numbers of a fit were checked, computed anew from the fit and not taken from the optimiser's word."""

from __future__ import annotations

import numpy as np

from switchfit.check import derivative_gap
from switchfit.data import FloatArray
from switchfit.evaluate import Evaluator
from switchfit.result import Certificate, Fit


def certify(fit: Fit, evaluator: Evaluator) -> Certificate:
    """Check a fit.

    Parameters
    ----------
    fit : Fit
    evaluator : Evaluator
        Of its problem; its meshes refined at the solution.

    Returns
    -------
    Certificate
    """
    values, scaled, direction = curvature_on_free_directions(fit)
    gaps = derivative_gap(evaluator, fit.theta)
    kinks = tuple(f"{name} at a kink ({left:.1e}, {right:.1e})" for name, left, right in fit.kinks)
    return Certificate(
        optimality=fit.optimality,
        smallest_eigenvalue=float(values[0]) if len(values) else np.nan,
        smallest_scaled_eigenvalue=float(scaled[0]) if len(scaled) else np.nan,
        condition_number=float(scaled[-1] / scaled[0]) if len(scaled) and scaled[0] > 0 else np.inf,
        worst_direction=in_words(fit, direction),
        integration_error=fit.integration_error,
        gradient_gap=gaps[0],
        hessian_gap=gaps[1],
        active=fit.active + kinks,
    )


def curvature_on_free_directions(fit: Fit) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Eigenvalues (k,) of the Hessian on the free directions, those with scaled unknowns, and the weakest (d,)."""
    Z = fit.free_basis
    if Z.shape[1] == 0 or not np.isfinite(fit.hessian).all():
        return np.zeros(0), np.zeros(0), np.zeros(len(fit.theta))
    size = 1 / np.sqrt(np.maximum(np.abs(np.diag(fit.hessian)), np.finfo(float).tiny))
    basis = np.linalg.qr(Z / size[:, None])[0]
    scaled, vectors = np.linalg.eigh(basis.T @ (fit.hessian * np.outer(size, size)) @ basis)
    return np.linalg.eigvalsh(Z.T @ fit.hessian @ Z), scaled, size * (basis @ vectors[:, 0])


def in_words(fit: Fit, direction: FloatArray) -> str:
    """The unknowns that a direction mostly consists of, in units of their curvature."""
    weight = np.abs(direction) * np.sqrt(np.abs(np.diag(fit.hessian)))
    if not weight.any() or not np.isfinite(weight).all():
        return "none"
    strong = [i for i in np.argsort(-weight) if weight[i] > 0.3 * weight.max()][:4]
    if len(strong) == 1:
        return f"{fit.theta_names[strong[0]]} alone"
    return " and ".join(fit.theta_names[i] for i in strong) + " trade off"
