"""Variation of the data about their means: J of a model that knows these alone, and the noise to expect."""

from __future__ import annotations

from typing import Any

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.problem.costs import TerminalConstraint
from switchfit.problem.experiment import Experiment
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem, keep_with_problem
from switchfit.problem.reference_signals import ReferenceSignal

NO_VARIATION = 1e-9
"""Standard deviation of a channel, relative to its largest value, below which it counts as constant (rounding)."""

REFERENCE_POINTS = 400
"""Points at which a reference signal is compared with its mean."""

ASSUMED_NOISE = 0.01
"""Noise where sigma is unknown, as a part of the variation of the data."""


@keep_with_problem
def measure_variation(problem: Problem) -> FloatArray:
    """Return J of data that are met by their means alone, one for each experiment: (E,).

    NaN where J is anything but half a sum of squares of data (and priors): costs of the trajectory, a robust loss, a
    sigma that is a parameter.
    """
    if not problem.is_least_squares:
        return np.full(len(problem.experiments), np.nan)
    found = []
    for run in problem.experiments:
        items = [item for item in run.data if not isinstance(item, TerminalConstraint)]
        found.append(sum(_vary(item, run) for item in items) if items else np.nan)
    return np.array(found, dtype=np.float64)


def _vary(item: Any, run: Experiment) -> float:
    """Return half the weighted squares of data about the means of their channels; about 0 where these do not vary."""
    if isinstance(item, Measurements):
        y, w = np.nan_to_num(item.values), item.weights  # 0 where a value is missing
        mean = (w * y).sum(axis=0) / np.maximum(w.sum(axis=0), np.finfo(float).tiny)
        about_mean, about_zero = (w * (y - mean) ** 2).sum(axis=0), (w * y**2).sum(axis=0)
        return 0.5 * float(np.where(about_mean > NO_VARIATION**2 * about_zero, about_mean, about_zero).sum())
    if isinstance(item, ReferenceSignal):
        times = np.linspace(run.t0, run.end, REFERENCE_POINTS)
        followed = item.signal(times)
        deviation = followed - followed.mean(axis=0)
        return 0.5 * float(np.einsum("ki,ij,kj->", deviation, item.weights, deviation)) * float(times[1] - times[0])
    return np.nan


@keep_with_problem
def assume_noise(problem: Problem) -> float:
    """Return the standard deviation, in units of sqrt(J), that residuals may be expected to have: 1 where sigma is
    known, by itself or as a parameter; else `ASSUMED_NOISE` of what the data vary.

    A prior that shall be weak beside the data, whatever their unit, is multiplied by its square. 1 for any other cost.

    Parameters
    ----------
    problem : Problem
    """
    items = [item for run in problem.experiments for item in run.data]
    unscaled = [i for i in items if isinstance(i, ReferenceSignal) or (isinstance(i, Measurements) and i.sigma is None)]
    count = sum(item.count if isinstance(item, Measurements) else REFERENCE_POINTS for item in unscaled)
    variation = float(measure_variation(problem).sum())
    if not unscaled or not (np.isfinite(variation) and variation > 0):
        return 1.0
    return ASSUMED_NOISE * float(np.sqrt(2 * variation / count))
