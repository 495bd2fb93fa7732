"""Variables of the optimizer: unknowns scaled to the size of one, or their logarithms.

    theta = s z,  or  theta = o + exp(z):      d theta / dz = D,    g_z = D g,    H_z = D H D + diag(E g),

with E = d^2 theta / dz^2, 0 or theta - o. Unknowns whose size is near one are not scaled: s = 1. The origin o of a
logarithm is 0; for a transition time it is the t0 of its experiment.
"""

from __future__ import annotations

from types import ModuleType
from typing import NamedTuple

import numpy as np

from switchfit.arrays import BoolArray, FloatArray, Traced

ORDINARY = (1e-3, 1e3)
"""Range of sizes in which an unknown is not scaled; the tolerance on the gradient is then that of theta itself."""

LEAST_PART_OF_GUESS = 1e-15
"""Part of its first guess that an unknown on a logarithmic scale keeps without a lower bound of its own. At 0 the cost
has no slope in the logarithm, and far below there is nothing left of its curvature but rounding."""


class Variables(NamedTuple):
    """The change of variables: ``size`` (d,), powers of 2, of a logarithm the first guess, ``log`` (d,) of bool, and
    ``origin`` (d,) of logarithms.
    """

    size: Traced  # NumPy; of JAX where many problems are evaluated as one batch
    log: Traced
    origin: Traced = 0.0

    @classmethod
    def of(
        cls, theta: FloatArray, bounds: FloatArray, log: BoolArray, keep: BoolArray, origin: FloatArray
    ) -> Variables:
        """Return variables scaled by the first guess, or by the bounds if it is 0.

        Parameters
        ----------
        theta : (d,)
        bounds : (2, d), lower and upper
        log : (d,) of bool
        keep : (d,) of bool, unknowns that are not scaled
        origin : (d,)
        """
        largest = np.where(np.isfinite(bounds), np.abs(bounds), 0.0).max(axis=0)
        # A guess of 0 has no size: the larger bound tells in which unit it is counted.
        typical = np.where(theta != 0.0, np.abs(theta), largest)
        outside = (typical > 0) & ((typical < ORDINARY[0]) | (typical > ORDINARY[1])) & ~keep & ~log
        # A power of 2, so that scaling causes no rounding.
        size = 2.0 ** np.round(np.log2(np.where(outside, typical, 1.0)))
        return cls(np.where(log, np.abs(theta - origin), size), log, origin)

    @property
    def identity(self) -> bool:
        """Whether the variables equal theta."""
        return not self.log.any() and bool(np.all(self.size == 1.0))

    @np.errstate(over="ignore")  # a step too far on a logarithmic scale is refused, as J is not finite there
    def outward(self, z: Traced, xp: ModuleType = np) -> Traced:
        """Return theta at z: (d,)."""
        return xp.where(self.log, self.origin + xp.exp(xp.where(self.log, z, 0.0)), self.size * z)

    def inward(self, theta: Traced, xp: ModuleType = np) -> Traced:
        """Return z at theta (d,): of a logarithm, a bound at the origin is `LEAST_PART_OF_GUESS` first guesses away."""
        away = theta - self.origin
        # Twice `where`: a derivative of the case left out must be finite as well.
        positive = xp.where(self.log, xp.where(away > 0, away, LEAST_PART_OF_GUESS * self.size), 1.0)
        return xp.where(self.log, xp.log(positive), theta / self.size)

    def sizes_inward(self, sizes: FloatArray) -> FloatArray:
        """Return sizes of z for sizes of theta (d,); the size of a logarithm is 1."""
        return np.where(self.log, 1.0, sizes / self.size)

    def slopes(self, theta: Traced, xp: ModuleType = np) -> tuple[Traced, Traced]:
        """Return D and E at theta: (d,) each."""
        away = theta - self.origin
        return xp.where(self.log, away, self.size), xp.where(self.log, away, 0.0)

    def derivatives_outward(
        self, theta: Traced, gradient: Traced, hessian: Traced, xp: ModuleType = np
    ) -> tuple[Traced, Traced]:
        """Return the gradient and Hessian in theta from those in z."""
        D, E = self.slopes(theta, xp)
        gradient = gradient / D
        return gradient, (hessian - xp.diag(E * gradient)) / xp.outer(D, D)

    def derivatives_inward(
        self, theta: Traced, gradient: Traced, hessian: Traced, xp: ModuleType = np
    ) -> tuple[Traced, Traced]:
        """Return the gradient and Hessian in z from those in theta."""
        D, E = self.slopes(theta, xp)
        return D * gradient, hessian * xp.outer(D, D) + xp.diag(E * gradient)
