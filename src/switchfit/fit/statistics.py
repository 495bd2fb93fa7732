"""Counts of data, variance of the noise, quantiles and intervals, from numbers: for one fit or for many."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.problem.problem import Problem
from switchfit.runtime import special


def measure_quantile(level: float, freedom: Any, sigma_known: bool | None) -> Any:
    """Return the two-sided quantiles of fits with these degrees of freedom, as of `Fit.quantile`: (R,)."""
    tail = 0.5 + level / 2
    return special.stdtrit(freedom, tail) if sigma_known is False else np.full(np.shape(freedom), special.ndtri(tail))


def count_samples(problem: Problem) -> int:
    """Return the measured values that are not missing."""
    return sum(item.count for item in problem.measurements)


def count_priors(problem: Problem) -> int:
    """Return the unknowns that have a prior."""
    return int(np.count_nonzero(problem.unknowns.priors.precision))


def measure_variance(cost: Any, freedom: Any, sigma_known: bool | None) -> Any:
    """Return by what covariances are multiplied: 1 if sigma is known, the residual variance if not; NaN where neither
    is: (R,), or one number.
    """
    if sigma_known:
        return np.ones(np.shape(cost))
    there = (freedom > 0) & (sigma_known is False)
    return np.where(there, 2 * cost / np.maximum(freedom, 1), np.nan)


def interval(theta: FloatArray, half: FloatArray, log: NDArray[np.bool_], origin: FloatArray) -> FloatArray:
    """Return ``theta -+ half``, or if `log` ``o + (theta - o) exp(-+ half / (theta - o))``, o the origin: (..., 2)."""
    away = theta - origin
    with np.errstate(over="ignore"):  # of an unknown that is not told from 0
        factor = np.exp(np.where(log, half / np.where(log, away, 1.0), 0.0))
    low, high = (np.where(log, origin + end, theta) for end in (away / factor, away * factor))
    return np.stack([np.where(log, low, theta - half), np.where(log, high, theta + half)], axis=-1)
