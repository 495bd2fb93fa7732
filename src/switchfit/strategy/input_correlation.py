"""Test whether residuals of another run depend on its inputs, by their correlation ([1]_).

References
----------
.. [1] T. Soderstrom, P. Stoica, System Identification, Prentice Hall 1989, section 11.2 (tests of cross-correlation).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.problem.problem import Problem
from switchfit.runtime import special
from switchfit.uncertainty.residuals import FEWEST_RESIDUALS, ResidualDiagnostics


class InputCorrelation(NamedTuple):
    """Whether the residuals of one channel depend on one input.

    Attributes
    ----------
    channel, input : str
    probability : float
        Of so large a correlation at lags 0 to `lags`, in samples, if there is none; NaN for fewer than 20 values or an
        input that is constant.
    lags : int

    See Also
    --------
    Validation

    Examples
    --------
    >>> sf.InputCorrelation("speed", "torque", probability=0.4, lags=5).input
    'torque'
    """

    channel: str
    input: str
    probability: float
    lags: int


def correlate_inputs(problem: Problem, diagnostics: ResidualDiagnostics) -> list[InputCorrelation]:
    """Test the residuals of each channel with each input of its run."""
    found = []
    for label, channel in zip(diagnostics.labels, diagnostics.channels, strict=True):
        run = problem.experiments[channel.experiment]
        if run.inputs is None:
            continue
        values = run.inputs.signal(run.t0, run.end)(channel.times)
        width = values.shape[1]
        names = run.inputs.names or (("u",) if width == 1 else tuple(f"u{k + 1}" for k in range(width)))
        for name, u in zip(names, values.T, strict=True):
            lags = len(channel.autocorrelation)
            found.append(InputCorrelation(label, name, correlate(channel.values, u, lags), lags))
    return found


def correlate(z: FloatArray, u: FloatArray, lags: int) -> float:
    """Return the probability of the correlation of residuals z (n,) with an input u (n,) at lags 0 to `lags`, or of a
    larger one, if z is white and independent of u; NaN for fewer than 20 values, or if u does not vary.

    With Phi the input at these lags, each less its mean, ``z' Phi (Phi' Phi)^+ Phi' z / (z' z / n)`` is chi-square with
    the rank of Phi degrees of freedom.

    Parameters
    ----------
    z, u : (n,)
    lags : int
    """
    if len(z) < FEWEST_RESIDUALS:
        return np.nan
    # Lags 0 ... `lags` of the input before each residual: a model that misses how an input acts leaves its trace there,
    # and not ahead of it.
    Phi = np.stack([u[lags - k : len(u) - k] for k in range(lags + 1)], axis=1)
    Phi = Phi - Phi.mean(axis=0)
    left, size, _ = np.linalg.svd(Phi, full_matrices=False)
    # A slow input is nearly the same at all lags, and a constant one at its mean 0: directions of rounding are no
    # degrees of freedom.
    kept: NDArray[np.bool_] = size > 1e-8 * max(float(np.abs(u).max(initial=0.0)), 1e-300) * np.sqrt(len(u))
    if not kept.any():
        return np.nan
    inner = z[lags:]
    square = float(inner @ inner) / len(inner)
    statistic = float(np.sum((left[:, kept].T @ inner) ** 2)) / square if square > 0 else 0.0
    return float(special.chdtrc(int(kept.sum()), statistic))
