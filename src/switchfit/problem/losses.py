"""Robust losses: the cost of residuals that are larger than the noise explains.

With ``u = (r / sigma)**2`` and C the scale of the loss, a sample costs ``1/2 C**2 rho(u / C**2)``, as in
`scipy.optimize.least_squares` with ``f_scale = C``:

    linear    rho(z) = z
    soft_l1   rho(z) = 2 (sqrt(1 + z) - 1)
    huber     rho(z) = z for z <= 1, else 2 sqrt(z) - 1     (its second derivative jumps at z = 1)
    cauchy    rho(z) = log(1 + z)

Every function takes arrays of NumPy or JAX; ``xp`` is their module.
"""

from __future__ import annotations

from types import ModuleType

import numpy as np

from switchfit.arrays import Traced

LOSSES = ("linear", "soft_l1", "huber", "cauchy")


def robust(loss: str, scale: float, u: Traced, xp: ModuleType = np) -> Traced:
    """Return ``C**2 rho(u / C**2)``, which replaces u in the cost; the same shape.

    Parameters
    ----------
    loss : str, one of `LOSSES`
    scale : float
        C, in units of sigma.
    u : array
        Squared residuals, in units of sigma.
    """
    if loss == "linear":
        return u
    z = u / scale**2
    if loss == "cauchy":
        return scale**2 * xp.log1p(z)
    if loss == "soft_l1":
        return scale**2 * 2.0 * (xp.sqrt(1.0 + z) - 1.0)
    beyond = xp.where(z > 1.0, z, 1.0)  # the root of 0 has no derivative
    return scale**2 * xp.where(z > 1.0, 2.0 * xp.sqrt(beyond) - 1.0, z)


def influence(loss: str, scale: float, u: Traced, xp: ModuleType = np) -> Traced:
    """Return ``rho'(u / C**2)``, between 0 and 1: the weight of a residual in the Gauss-Newton matrix;
    the same shape.
    """
    z = u / scale**2
    if loss == "cauchy":
        return 1.0 / (1.0 + z)
    if loss == "soft_l1":
        return 1.0 / xp.sqrt(1.0 + z)
    if loss == "huber":
        return 1.0 / xp.sqrt(xp.where(z > 1.0, z, 1.0))
    return xp.ones_like(z)
