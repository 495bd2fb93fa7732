"""Whether it is the noise and not the modes that a search cannot explain: outliers, or a wrong sigma."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from switchfit.estimation.estimator import Estimate
from switchfit.problem.data import FloatArray, Measurements
from switchfit.problem.problem import Problem
from switchfit.uncertainty.quality import measure_quality

Fault = Literal["outliers", "sigma"]

FAR = 5.0
"""Robust standard deviations beyond which a residual is an outlier: of normal noise, one in two million is."""

MOST_OUTLIERS = 0.2
"""Share of outliers above which it is the model that is wrong."""

MEDIAN = 1.4826
"""Standard deviation of normal noise, in units of the median of its absolute values."""


def find_fault(estimate: Estimate) -> Fault | None:
    """Return which noise explains the residuals of a fit that chi-square rejects; None if they are no noise.

    Outliers are few and come alone. Where sigma is wrong, residuals are white and normal, of another size.

    Parameters
    ----------
    estimate : Estimate
    """
    suspect = measure_quality(estimate).suspect
    return suspect if suspect != "model" else None


def _find_far(values: FloatArray) -> NDArray[np.bool_]:
    """Return which of the residuals (n,) are outliers."""
    size = np.abs(values)
    return np.asarray(size > FAR * MEDIAN * float(np.median(size)))


def count_far(estimate: Estimate) -> int:
    """Return the number of outliers of a fit, in all channels."""
    return sum(int(_find_far(channel.values).sum()) for channel in estimate.residuals.channels)


def assume(problem: Problem, fault: Fault, estimate: Estimate) -> Problem:
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
                factors = [next(sizes, 1.0) for _ in range(item.values.shape[1])]
                change = {"loss": "huber"} if fault == "outliers" else {"sigma": np.asarray(item.sigma) * factors}
                item = replace(item, **change)
            data.append(item)
        runs.append(replace(run, data=data))
    return replace(problem, experiments=runs)
