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

References
----------
.. [1] N. R. Zhang, D. O. Siegmund, A modified Bayes information criterion with applications to the analysis of
   comparative genomic hybridization data, Biometrics 63 (2007) 22-32.
.. [2] K. P. Burnham, D. R. Anderson, Model Selection and Multimodel Inference, Springer 2002.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.problem.problem import Problem
from switchfit.runtime import special

CriterionName = Literal["bic", "mbic", "aicc", "cost"]
CRITERIA: tuple[CriterionName, ...] = ("bic", "mbic", "aicc", "cost")

INFORMATION: tuple[CriterionName, ...] = ("bic", "mbic", "aicc")
"""Criteria that need a likelihood, and nothing but J."""


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
        # log n must not be negative: then more unknowns would cost less.
        n = max(self.worth * max(self.values, 1), 1.0)
        if self.sigma_known is False:
            # -2 log L but for a constant. J of data without noise is rounding, whose logarithm would choose.
            misfit, parameters = n * float(np.log(2 * max(cost, self.smallest) / self.values)), parameters + 1
        else:
            misfit = self.worth * 2 * cost / self.dispersion
        if name == "aicc":
            k = parameters + switches
            # With no value left, AICc is infinite: such a fit can explain anything.
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
        # Half of what the criterion adds for a switch, since criteria have 2 J and this is in units of J.
        log = float(np.log(max(self.values, 2)))
        return {"cost": self.switch_cost, "aicc": 1.0, "bic": 0.5 * log, "mbic": log}[name]

    def measure_dispersion(self, cost: float, unknowns: int) -> float:
        """Return 2 J for each degree of freedom, at least 1; 1 where it is not known to be 1 if the model is right.

        Parameters
        ----------
        cost : float
        unknowns : int
        """
        # At least 1: residuals smaller than sigma are no reason to believe the data more.
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
    # Less the smallest first: exp(-c / 2) alone underflows for the criteria of long logs.
    weights = np.exp(-0.5 * (given - given.min()))
    return np.asarray(weights / weights.sum())
