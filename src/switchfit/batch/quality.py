"""How well each of many fits explains its data, and where it ended: from J and theta alone, without a simulation.

With J half a sum of squares, and V that of the data about their means, the share of the variance that is explained is
``1 - J / V``. So it needs V once for each data set, where a single fit compares its trajectory channel by channel.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.problem.data import FloatArray, Measurements
from switchfit.problem.experiment import Experiment
from switchfit.problem.problem import Problem
from switchfit.problem.unknowns import get_min_duration
from switchfit.runtime import special

AT_END = 1e-9
"""Duration of a mode, as a part of the horizon, or distance from a bound, as a part of it, that counts as zero."""


def describe_ends(
    problem: Problem, theta: FloatArray, cost: FloatArray, variation: FloatArray | float
) -> dict[str, NDArray[Any]]:
    """Return the fields `explained`, `collapsed` and `at_bounds` of `Fits`, (R,) each.

    Parameters
    ----------
    problem : Problem
        Its bounds, modes and horizons; its data may differ from those that were fitted.
    theta : (R, d)
    cost : (R,)
    variation : float or (R,)
        Sum of `switchfit.fit.variation.measure_variation` over the experiments.
    """
    unknowns, priors = problem.unknowns, problem.unknowns.priors
    squares = cost - np.array([priors.evaluate(each)[0] for each in theta]) if priors.any else cost
    total = np.broadcast_to(np.asarray(variation, dtype=float), cost.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        explained = np.where(total == 0, np.where(squares <= 0, 1.0, 0.0), 1 - squares / total)
    free = ~unknowns.is_time
    near = AT_END * np.maximum(np.abs(theta), 1e-300)
    with np.errstate(invalid="ignore"):
        held = (theta <= unknowns.lower + near) | (theta >= unknowns.upper - near)
        collapsed = sum(map(partial(_count_collapsed, problem), problem.experiments, problem.ends_of_modes(theta)))
    return {
        "explained": np.where(np.isnan(total) | np.isnan(cost), np.nan, explained),
        "collapsed": np.asarray(collapsed, dtype=np.int64),
        "at_bounds": np.sum(held & free & ~np.isnan(theta), axis=1).astype(np.int64),
    }


def _count_collapsed(problem: Problem, experiment: Experiment, ends: FloatArray) -> NDArray[np.int64]:
    """Return how many modes of an experiment last no longer than they must, from their ends (R, N + 2): (R,)."""
    least = np.array([get_min_duration(problem.min_duration, mode) for mode in experiment.mode_sequence])
    shortest = least + AT_END * (experiment.end - experiment.t0)
    found: NDArray[np.int64] = np.sum(np.diff(ends, axis=1) <= shortest, axis=1)
    return found


def count_samples(problem: Problem) -> int:
    """Return the measured values that are not missing."""
    return sum(item.count for run in problem.experiments for item in run.data if isinstance(item, Measurements))


def count_priors(problem: Problem) -> int:
    """Return the unknowns that have a prior."""
    return int(np.count_nonzero(problem.unknowns.priors.precision))


def measure_variance(cost: FloatArray, freedom: NDArray[np.int64], sigma_known: bool | None) -> FloatArray:
    """Return by what covariances are multiplied: 1 if sigma is known, the residual variance if not; NaN where neither
    is: (R,).
    """
    if sigma_known:
        return np.ones(len(cost))
    there = (freedom > 0) & (sigma_known is False)
    return np.where(there, 2 * cost / np.maximum(freedom, 1), np.nan)


def measure_quantile(level: float, freedom: NDArray[np.int64], sigma_known: bool | None) -> FloatArray:
    """Return the two-sided quantile of each fit, as of `Fit.quantile`: (R,)."""
    tail = 0.5 + level / 2
    found = special.stdtrit(freedom, tail) if sigma_known is False else special.ndtri(tail)
    return np.broadcast_to(found, freedom.shape)
