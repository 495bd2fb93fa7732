"""Criteria of optimal design: how large the covariance of some unknowns will be, as one number.

With the information F (d, d) and a basis Z (d, r) of the changes of theta that guards allow, the covariance of all
unknowns is ``V = Z (Z' F Z)^-1 Z'``, and C (s, s) that of the s unknowns that count, each divided by its scale. With
the eigenvalues v_1, ..., v_s of C, the mean variance of power q,

    m(F) = ((v_1^q + ... + v_s^q) / s)^(1/q),

is Kiefer's criterion ([1]_, chapter 6): D for q = 0, A for q = 1, and E for infinity. Where an experiment is done n
times, m is 1/n of its value: m of the best design over m of another one is the *efficiency* of that.

References
----------
.. [1] F. Pukelsheim, Optimal Design of Experiments, SIAM, 2006.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import ArrayModule, FloatArray, Traced

POWERS = {"D": 0.0, "A": 1.0, "E": 1e3}
"""Powers q of the criteria; that of E stands for infinity, from which log m differs by less than 0.001 log s."""

INFORMATION_RIDGE = 1e-12
"""Added to the information, scaled to about 1 for each unknown, so that a singular one has a finite criterion."""


class Criterion(NamedTuple):
    """What of the covariance counts.

    Attributes
    ----------
    chosen : (s,) int, positions in theta of the unknowns that count
    scales : (s,), by which these are divided
    basis : (d, r), Z
    size : (r,), typical standard errors of the unknowns that guards leave free
    """

    chosen: NDArray[np.intp]
    scales: FloatArray
    basis: FloatArray
    size: FloatArray

    def rate(self, information: Traced, power: float, xp: ArrayModule = np) -> tuple[Traced, Traced]:
        """Return log m (...,), and its derivative in the information (..., d, d).

        Parameters
        ----------
        information : (..., d, d) array
        power : float
            q.
        xp : module, optional
            NumPy or `jax.numpy`.
        """
        # In units of typical standard errors F is about 1, and the ridge small against it, in any units of theta.
        basis = self.basis * self.size[None, :]
        across = basis[self.chosen] / self.scales[:, None]
        half = across @ xp.linalg.inv(basis.T @ information @ basis + INFORMATION_RIDGE * xp.eye(len(self.size)))
        values, vectors = xp.linalg.eigh(half @ across.T)
        logs = xp.log(xp.maximum(values, 1e-300))
        # Powers of eigenvalues relative to the largest, since v^1000 overflows.
        parts = xp.exp(power * (logs - logs[..., -1:]))
        # For power 0 the limit: the mean of the logarithms, log det C / s.
        mean = xp.log(parts.mean(-1)) / power + logs[..., -1] if power else logs.mean(-1)
        # d log m / d v_i = v_i^(q - 1) / sum v^q, and dC / dF = -A F^-1 . F^-1 A': a negative semidefinite matrix, as
        # more information never makes m larger.
        weights = parts / parts.sum(-1, keepdims=True) / xp.exp(logs)
        root = xp.sqrt(weights)[..., None] * (xp.swapaxes(vectors, -1, -2) @ half @ basis.T)
        return mean, -xp.swapaxes(root, -1, -2) @ root

    def measure(self, kind: str, covariance: FloatArray) -> float:
        """Return the criterion as textbooks have it: log det C (D), its trace (A) or its largest eigenvalue (E).

        Infinite where an unknown that counts cannot be estimated: its covariance is NaN.

        Parameters
        ----------
        kind : {"D", "A", "E"}
        covariance : (d, d) array
            Of all unknowns.
        """
        C = covariance[np.ix_(self.chosen, self.chosen)] / np.outer(self.scales, self.scales)
        if not np.isfinite(C).all():
            return np.inf
        values = np.linalg.eigvalsh(C)
        return float({"D": np.log(values).sum, "A": values.sum, "E": values.max}[kind]())
