"""Standard errors from the exact Hessian and from the Gauss-Newton matrix, compared."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from switchfit.fit.result import Fit
from switchfit.fit.scaled_hessian import compute_scaled_spectrum, inverse_on
from switchfit.optimize.threads import one_thread


class Disagreement(NamedTuple):
    """Difference between the standard errors from the exact Hessian and from the Gauss-Newton matrix.

    Attributes
    ----------
    factor : float
        Largest ratio of the larger to the smaller one, over all linear combinations of the unknowns.
    name : str
        The unknown whose own standard errors differ the most.
    exact, gauss_newton : float
        Its standard errors.
    """

    factor: float
    name: str
    exact: float
    gauss_newton: float


@one_thread()
def disagreement(fit: Fit) -> Disagreement | None:
    """Compare the two covariances of a fit; None if one of them is unknown.

    The ratios of the two variances over all linear combinations of the unknowns lie between the smallest and the
    largest eigenvalue of ``A v = lambda H v`` on the free directions, A being the Gauss-Newton matrix. Unknowns at
    kinks are held: their variances are mostly those of the slopes, which both matrices share.
    """
    Z, A = fit.free_basis, fit.gauss_newton
    if A is None or fit.sigma_known is None or Z.shape[1] == 0:
        return None
    both = fit.held_covariance, fit.variance_scale * inverse_on(Z, A)
    if not all(np.isfinite(covariance).all() for covariance in both):
        return None
    errors = np.sqrt([np.diag(covariance) for covariance in both])
    ratios = []
    for one, other in ((fit.hessian, A), (A, fit.hessian)):  # of each the largest, which no rounding hides
        values, vectors, size = compute_scaled_spectrum(one, Z)
        root = size[:, None] * vectors / np.sqrt(values)  # root' one root = 1
        ratios.append(float(np.linalg.eigvalsh(root.T @ other @ root)[-1]))
    held = errors[0] <= 0
    # Logarithms, as either of the two may be the larger one. Unknowns that are held have 0 in both.
    changes = np.where(held, 0.0, np.abs(np.log(np.where(held, 1.0, errors[0]) / np.where(held, 1.0, errors[1]))))
    k = int(np.argmax(changes))
    return Disagreement(max(ratios) ** 0.5, fit.theta_names[k], float(errors[0][k]), float(errors[1][k]))
