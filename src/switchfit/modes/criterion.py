"""Criteria by which the number of switches is chosen.

With n measured values, M parameters and initial states that act, N switches and the cost J, half a sum of squares in
units of sigma or a negative log-likelihood,

    BIC   2 J + (M + N) log n
    mBIC  2 J + (M + 2 N) log n            (Zhang and Siegmund [1]_: the place of a switch is searched for)
    AICc  2 J + 2 k + 2 k (k + 1) / (n - k - 1),   k = M + N
    cost  J + switch_cost N

If sigma is left out, ``n log(2 J / n)`` stands for 2 J, and the residual variance is one more unknown.

Where the residuals are not the noise that the criteria take them for, J exaggerates what the data say. *Discounted*, n
correlated values count as the w n independent ones that they are worth, and where sigma is too small, 2 J is divided by
the dispersion ``c = 2 J / (n - k)`` of the most flexible fit (quasi-likelihood; Burnham and Anderson [2]_, section
2.5): ``w n log(2 J / n)`` or ``w 2 J / c`` for the misfit, and log(w n) for log n.

Whether the residuals of an estimate are noise, as the criteria take them for.

Whether it is the noise and not the modes that a search cannot explain: outliers, or a wrong sigma.

References
----------
.. [1] N. R. Zhang, D. O. Siegmund, A modified Bayes information criterion with applications to the analysis of
   comparative genomic hybridization data, Biometrics 63 (2007) 22-32.
.. [2] K. P. Burnham, D. R. Anderson, Model Selection and Multimodel Inference, Springer 2002.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.estimation.estimator import Estimate
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem
from switchfit.runtime import special
from switchfit.uncertainty.residuals import explain_all
from switchfit.uncertainty.verdict import NEARLY_ALL

CriterionName = Literal["bic", "mbic", "aicc", "cost"]
CRITERIA: tuple[CriterionName, ...] = ("bic", "mbic", "aicc", "cost")

INFORMATION: tuple[CriterionName, ...] = ("bic", "mbic", "aicc")
"""Criteria that need a likelihood, and nothing but J."""

UNEXPLAINED = 1e-6
"""Probability of chi-square below which the data are not explained."""

CORRELATED = 1e-9
"""The same of correlated residuals, by Ljung and Box's statistic, whose tail is heavier than chi-square's: of 200,000
series of 150 random numbers 2e-4 had a probability below 1e-6 at 20 lags."""

WITHIN_NOISE = 0.1
"""Root mean square of residuals, in units of sigma, below which it does not matter how they are correlated: data
without noise leave errors of integration."""

FAR = 5.0
"""Robust standard deviations beyond which a residual is an outlier: of normal noise, one in two million is."""

MEDIAN = 1.4826
"""Standard deviation of normal noise, in units of the median of its absolute values."""


@dataclass(frozen=True)
class Score:
    """What the criteria need to know of a problem.

    Attributes
    ----------
    values : int
        Measured values, n.
    sigma_known : bool or None
        None if the cost is no likelihood.
    switch_cost : float
        Cost of a switch in units of J; 0 if none is given.
    smallest : float
        Cost below which errors are not measured relative to the cost.
    has_chi_square : bool
        Whether 2 J has a chi-square distribution if the model is right.
    worth : float
        Independent values for each measured value, w.
    dispersion : float
        By which 2 J is divided, c.
    """

    values: int
    sigma_known: bool | None
    switch_cost: float
    smallest: float
    has_chi_square: bool
    worth: float = 1.0
    dispersion: float = 1.0

    @classmethod
    def of(cls, problem: Problem, switch_cost: float = 0.0) -> Score:
        """Return what the criteria need to know of a problem."""
        values, known = sum(item.count for item in problem.measurements), problem.is_sigma_known
        chi_square = known is True and problem.is_least_squares
        return cls(values, known, switch_cost, problem.smallest_cost, chi_square)

    def has_information(self, chooser: object) -> bool:
        """Return whether what chooses the number of switches is an information criterion."""
        return self.sigma_known is not None and chooser in INFORMATION

    def compute(self, name: CriterionName, cost: float, parameters: int, switches: int) -> float:
        """Return a criterion.

        Parameters
        ----------
        name : {"bic", "mbic", "aicc", "cost"}
        cost : float
            J.
        parameters : int
            M, the free parameters and initial states that act.
        switches : int
            N.
        """
        if not np.isfinite(cost):
            return np.inf
        if name == "cost":
            return float(cost + self.switch_cost * switches)
        n = max(self.worth * max(self.values, 1), 1.0)
        if self.sigma_known is False:
            misfit, parameters = n * float(np.log(2 * max(cost, self.smallest) / self.values)), parameters + 1
        else:
            misfit = self.worth * 2 * cost / self.dispersion
        if name == "aicc":
            k = parameters + switches
            left = n - k - 1
            return float(misfit + 2 * k + 2 * k * (k + 1) / left) if left > 0 else np.inf
        each = 2 if name == "mbic" else 1
        return float(misfit + (parameters + each * switches) * np.log(n))

    def measure_penalty(self, name: CriterionName) -> float:
        """Return what a switch costs by a criterion, in units of J.

        Parameters
        ----------
        name : {"bic", "mbic", "aicc", "cost"}
        """
        log = float(np.log(max(self.values, 2)))
        return {"cost": self.switch_cost, "aicc": 1.0, "bic": 0.5 * log, "mbic": log}[name]

    def measure_dispersion(self, cost: float, unknowns: int) -> float:
        """Return 2 J for each degree of freedom, at least 1; 1 where it is not known to be 1 if the model is right.

        Parameters
        ----------
        cost : float
        unknowns : int
        """
        freedom = self.values - unknowns
        return max(2 * cost / freedom, 1.0) if self.has_chi_square and freedom > 0 else 1.0

    def measure_probability(self, cost: float, unknowns: int) -> float:
        """Return the probability that chi-square is at least 2 J if the model is right; NaN if 2 J is none.

        Parameters
        ----------
        cost : float
        unknowns : int
            Estimated parameters, initial states and transition times.
        """
        freedom = self.values - unknowns
        if not self.has_chi_square or freedom <= 0:
            return np.nan
        return float(special.chdtrc(freedom, 2 * cost)) if np.isfinite(cost) else 0.0


def compute_weights(criteria: Sequence[float] | FloatArray) -> FloatArray:
    """Return the weights ``exp(-(c - min) / 2)``, with the sum 1: (m,).

    Parameters
    ----------
    criteria : (m,)
    """
    given = np.asarray(criteria, dtype=float)
    if not np.isfinite(given).any():
        return np.full(len(given), np.nan)
    weights = np.exp(-0.5 * (given - given.min()))
    return np.asarray(weights / weights.sum())


def is_far_from_noise(estimate: Estimate, score: Score) -> bool:
    """Return whether residuals are too correlated to be noise.

    Where sigma is unknown, not if nearly all of the variance is explained: real logs often have such residuals with
    the right modes.

    Parameters
    ----------
    estimate : Estimate
    score : Score
    """
    if not is_correlated(estimate, score, CORRELATED):
        return False
    return score.sigma_known is True or explain_all(estimate.comparisons) < NEARLY_ALL


def is_correlated(estimate: Estimate, score: Score, level: float) -> bool:
    """Return whether residuals that matter are too correlated for noise, by a probability below `level`.

    Parameters
    ----------
    estimate : Estimate
    score : Score
    level : float
    """
    if score.has_chi_square and 2 * estimate.cost < WITHIN_NOISE**2 * score.values:
        return False
    return measure_whiteness(estimate) < level


def measure_worth(estimate: Estimate) -> float:
    """Return how many independent residuals each is worth in the most correlated channel; 1 if none is correlated.

    Parameters
    ----------
    estimate : Estimate
    """
    channels = estimate.residuals.channels
    found = [c.effective / len(c.values) for c in channels if c.whiteness * len(channels) < UNEXPLAINED]
    return min(found, default=1.0)


def measure_whiteness(estimate: Estimate) -> float:
    """Return the probability of residuals so correlated in the worst channel, times the number of channels.

    1 if no channel has enough residuals for the test.

    Parameters
    ----------
    estimate : Estimate
    """
    found = [channel.whiteness for channel in estimate.residuals.channels if np.isfinite(channel.whiteness)]
    return min(1.0, min(found) * len(found)) if found else 1.0


def count_far(estimate: Estimate) -> int:
    """Return the number of outliers of a fit, in all channels."""
    sizes = [np.abs(channel.values) for channel in estimate.residuals.channels]
    return sum(int(np.sum(size > FAR * MEDIAN * np.median(size))) for size in sizes)


def assume(problem: Problem, fault: str, estimate: Estimate) -> Problem:
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
