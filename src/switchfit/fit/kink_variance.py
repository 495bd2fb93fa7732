"""Variances of unknowns at kinks, where the derivative of J jumps through zero, and of those that follow.

The density exp(-J) has two slopes at a kink; its second moment there takes the place of the inverse curvature.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.fit.scaled_hessian import LEAST_DETERMINED_EIGENVALUE
from switchfit.runtime import special

STEEP_KINK = 100.0
"""Slope at a kink, times the standard deviation of the parabola beside it, from which on the curvature is left out: it
changes the variance by less than 1e-3, and further out integrals with it lose all digits."""


def free_kinks(
    inverse: FloatArray, hessian: FloatArray, kinks: Sequence[tuple[int, float, float]], scale: float
) -> FloatArray:
    """Return the inverse of a Hessian, as of `inverse_on`, with the unknowns at kinks free as well: (d, d).

    The K unknowns at kinks are those that `inverse`, C, holds. If they move by x, the others follow by -C H_.K x, and
    with the slopes g of J at the kinks

        J = J0 + sum_k g_k(x_k) |x_k| + x' S x / 2,     S = H_KK - H_K. C H_.K.                                    (1)

    The density exp(-J / scale) of one kinked x has the second moment v scale (`measure_kink_variance`): the normal one
    with the curvature 1 / v has it too. With 1 / v in place of the diagonal of S, V is the inverse of S, and

        inverse = C + F V F',     F = E_K - C H_.K,                                                                  (2)

    the columns of F being how all unknowns follow. A smooth J, g = 0, has 1 / v = S_kk: (2) is then the inverse of H.

    Parameters
    ----------
    inverse : (d, d)
        Not scaled; what is NaN stays NaN, and does not follow.
    hessian : (d, d)
    kinks : sequence of (int, float, float)
        Where in theta each of them is, and the derivatives of J to its left and right.
    scale : float
        By what the inverse will be multiplied to become a covariance.
    """
    if not kinks or not (np.isfinite(hessian).all() and np.isfinite(scale)):
        return inverse
    places = [place for place, _, _ in kinks]
    follow = np.eye(len(hessian))[:, places] - np.nan_to_num(inverse) @ hessian[:, places]  # F
    S = hessian[places] @ follow  # (1)
    # In units of sqrt(scale), J / scale has the curvature S and the slopes g / sqrt(scale).
    with np.errstate(divide="ignore"):  # residuals of 0
        slopes = np.array([(-left, right) for _, left, right in kinks]) / np.sqrt(scale)
    variances = measure_kink_variance(slopes, np.diag(S))
    # V = D (1 + D S D - diag(D S D))^-1 D, D^2 = diag(v): also where v = 0.
    root = np.sqrt(variances)
    coupled = root[:, None] * S * root
    np.fill_diagonal(coupled, 1.0)
    if np.linalg.eigvalsh(coupled)[0] > LEAST_DETERMINED_EIGENVALUE:
        V = root[:, None] * np.linalg.inv(coupled) * root
    else:  # J is no minimum along all kinks together: each of them as if the others were held
        V = np.diag(variances)
    return np.asarray(inverse + follow @ V @ follow.T)  # (2)


def measure_kink_variance(slopes: FloatArray, curvatures: FloatArray) -> FloatArray:
    """Return the second moment about 0 of the density exp(-g |x| - s x^2 / 2), g on each side another: (K,).

    With u = g / sqrt(s), the integrals of 1, x and x^2 times the density of one side, x > 0, are

        Z = sqrt(pi / 2 s) erfcx(u / sqrt(2)),     M1 = (1 - g Z) / s,     M2 = (Z - g M1) / s,                      (1)

    M1 and M2 by parts, from s x exp(-J) = -d exp(-J) / dx - g exp(-J). Without curvature Z = 1 / g and M2 = 2 / g^3.
    The result is (M2 + M2) / (Z + Z) of both sides. It is 0, the unknown stays held, where there is no slope and no
    curvature, and where J falls again before it has risen by 1/2: g x + s x^2 / 2 has its maximum -g^2 / 2 s.

    Parameters
    ----------
    slopes : (K, 2)
        g, of both sides; below 0 is rounding.
    curvatures : (K,)
    """
    g, s = np.maximum(slopes, 0.0), curvatures[:, None]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        u = g / np.sqrt(np.where(s > 0.0, s, 0.0))
        Z = np.sqrt(np.pi / (2.0 * s)) * special.erfcx(u / np.sqrt(2.0))
        M2 = (Z - g * (1.0 - g * Z) / s) / s  # (1)
        steep = ~(u < STEEP_KINK)
        Z, M2 = np.where(steep, 1.0 / g, Z), np.where(steep, 2.0 / g**3, M2)
        variances = M2.sum(axis=1) / Z.sum(axis=1)
    falls = (g**2 < -s).any(axis=1)
    return np.where(np.isfinite(variances) & ~falls, variances, 0.0)
