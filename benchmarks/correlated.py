"""How standard errors that allow for correlated residuals compare with the spread of the estimates.

Polynomials with d coefficients are fitted to noise of a first-order autoregressive process, in closed form, and their
residuals are judged as `switchfit.uncertainty.residuals` does it. ``python -m benchmarks.correlated [RUNS]`` prints the
table of ``docs/measured/correlated.md``: in brackets with the bias that `correct_correlation` removes.
"""

from __future__ import annotations

import sys
from typing import NamedTuple

import numpy as np
import scipy.signal
import scipy.special

from switchfit.arrays import FloatArray
from switchfit.uncertainty.chi_square import UNLIKELY_AS_NOISE
from switchfit.uncertainty.residuals import SERIOUS_WIDENING, compute_autocorrelation, correct_correlation

RUNS = 2000
CASES = (
    (0.0, 100, 3),
    (0.5, 150, 3),
    (0.7, 100, 3),
    (0.8, 60, 3),
    (0.8, 150, 3),
    (0.8, 400, 5),
    (0.9, 100, 1),
    (0.9, 300, 3),
)
"""Correlation of neighbors in the noise, number of samples, number of unknowns."""
BURN_IN = 300


class Corrected(NamedTuple):
    """Median of the standard errors over the spread of the estimates, part of 95 % intervals that hold the truth."""

    ratio: float
    coverage: float


def measure_correction(r: float, n: int, d: int, runs: int, *, biased: bool = False, seed: int = 0) -> Corrected:
    """Fit `runs` logs of noise, sigma unknown, and compare the corrected errors with the spread, over all unknowns.

    Parameters
    ----------
    r : float
        Correlation of neighbors in the noise.
    n, d : int
        Numbers of samples and of unknowns.
    runs : int
    biased : bool
        Whether the correlation of the residuals is taken as that of the noise.
    seed : int
    """
    shocks = np.random.default_rng(seed).standard_normal((runs, n + BURN_IN))
    noise = scipy.signal.lfilter([1.0], [1.0, -r], shocks, axis=1)[:, BURN_IN:]
    X = np.polynomial.legendre.legvander(np.linspace(-1, 1, n), d - 1)
    estimates = noise @ np.linalg.pinv(X).T
    residuals = noise - estimates @ X.T
    widening = np.array([_widen(z, d, biased=biased) for z in residuals])
    variance = np.sum(residuals**2, axis=1) / (n - d)
    errors = np.sqrt(np.outer(widening**2 * variance, np.diag(np.linalg.inv(X.T @ X))))
    spread = np.sqrt(np.mean(estimates**2, axis=0))  # the truth is 0
    held = np.abs(estimates) < scipy.special.stdtrit(n - d, 0.975) * errors
    return Corrected(float(np.mean(np.median(errors, axis=0) / spread)), float(held.mean()))


def _widen(z: FloatArray, d: int, *, biased: bool) -> float:
    """Return the factor of a channel: 1 unless its residuals fail the test of Ljung and Box, and it is above 1.2."""
    n = len(z)
    lags = min(10, n // 5)
    r = compute_autocorrelation(z, lags)
    probability = scipy.special.chdtrc(lags, n * (n + 2) * np.sum(r**2 / (n - np.arange(1, lags + 1))))
    first = float(r[0]) if biased else correct_correlation(float(r[0]), n, d)
    factor = float(np.sqrt((1 + first) / (1 - first)))
    return factor if probability < UNLIKELY_AS_NOISE and factor > SERIOUS_WIDENING else 1.0


def main(runs: int = RUNS) -> None:
    """Print the table."""
    print("| correlation | samples | unknowns | error / spread | 95 % intervals that hold the truth |")
    print("|---|---|---|---|---|")
    for r, n, d in CASES:
        new, old = (measure_correction(r, n, d, runs, biased=biased) for biased in (False, True))
        shares = f"{100 * new.coverage:.1f} % ({100 * old.coverage:.1f} %)"
        print(f"| {r:g} | {n} | {d} | {new.ratio:.2f} ({old.ratio:.2f}) | {shares} |")
    print(f"\n{runs} logs a line; medians of the errors.")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
