"""Faults of the noise model that a search cannot explain by modes: outliers, or a wrong sigma."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from switchfit.estimation.estimates import Estimate
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem

OUTLIER_FROM = 5.0
"""Robust standard deviations beyond which a residual is an outlier: of normal noise, one in two million is."""

SIGMA_OF_MEDIAN = 1.4826
"""Standard deviation of normal noise, in units of the median of its absolute values."""


def count_outliers(estimate: Estimate) -> int:
    """Return the number of outliers of a fit, in all channels."""
    # By the median, which outliers do not move as they move a root mean square.
    sizes = [np.abs(channel.values) for channel in estimate.residuals.channels]
    return sum(int(np.sum(size > OUTLIER_FROM * SIGMA_OF_MEDIAN * np.median(size))) for size in sizes)


def assume_fault(problem: Problem, fault: str, estimate: Estimate) -> Problem:
    """Return the problem with a robust loss in place of squares, or with sigma as large as the residuals of a fit.

    Parameters
    ----------
    problem : Problem
    fault : {"outliers", "sigma"}
    estimate : Estimate
        Of the same data.
    """
    runs = []
    for e, run in enumerate(problem.experiments):
        sizes = iter([channel.rms for channel in estimate.residuals.channels if channel.experiment == e])
        data = []
        for item in run.data:
            if isinstance(item, Measurements):
                # Channels come in the order of the data, one for each column of each item.
                factors = [next(sizes, 1.0) for _ in range(item.values.shape[1])]
                change = {"loss": "huber"} if fault == "outliers" else {"sigma": np.asarray(item.sigma) * factors}
                item = replace(item, **change)
            data.append(item)
        runs.append(replace(run, data=data))
    return replace(problem, experiments=runs)
