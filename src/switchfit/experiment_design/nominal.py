"""A problem at the values for which an experiment is designed, and its information, sample by sample.

The information of a sample is ``C' C / sigma**2`` with the sensitivities C (q, D) of its q values: it does not depend
on what is measured. That of a sigma which is a parameter is ``2 / sigma**2`` for each value, apart from everything
else.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.engine.choice import engine_of
from switchfit.experiment_design.samples import Candidates
from switchfit.fit.comparison import compare
from switchfit.fit.guards import find_free_directions, place_on_guards
from switchfit.fit.scaled_hessian import inverse_on
from switchfit.meshes.evaluator import Evaluator
from switchfit.problem.problem import Problem

SIDES = (1, -1)
"""Sensitivities jump where a transition time is at a sample or a knot of an input: the information is the mean of both
sides, since the true time may be on either."""


class Nominal:
    """A problem at theta, with guarded transition times on their guards; run e is that which is designed.

    Attributes
    ----------
    theta : (d,)
    basis : (d, r), of the changes of theta that guards allow
    information, covariance : (d, d), with everything that the problem has; NaN for what cannot be estimated
    """

    def __init__(self, problem: Problem, e: int, theta: FloatArray) -> None:
        self.problem, self.e, self.theta, self.evaluator = problem, e, theta, Evaluator(problem, theta)
        self.basis = np.eye(len(theta))
        if problem.constraint_names:
            self.evaluator, self.theta = place_on_guards(problem, theta)
            self.basis = find_free_directions(problem, self.evaluator.constrained(self.theta).jacobian)
        # The Gauss-Newton matrix of values that are simulated at theta is the expected (Fisher) information.
        each_side = (self.evaluator(self.theta, side, matrix="gauss-newton").hessian for side in SIDES)
        self.information = 0.5 * sum(each_side, np.zeros((len(theta),) * 2))
        self.covariance = inverse_on(self.basis, self.information)

    @cached_property
    def candidates(self) -> Candidates:
        """The information of each sample of run e, all others being left out."""
        problem, e, found = self.problem, self.e, []
        arguments, (own, mine) = self.evaluator.arguments[e], problem.own_places[e]
        counts = [len(item.times) for item in problem.experiments[e].data]
        for s, count in enumerate(counts):
            # One sample at a time has a weight, all others 0: the Gauss-Newton matrix is then its information.
            for k in range(count):
                weights: list[Any] = [np.zeros_like(each.weight) for each in arguments.samples]
                weights[s][k] = arguments.samples[s].weight[k]
                pairs = zip(arguments.samples, weights, strict=True)
                only = arguments._replace(samples=tuple(each._replace(weight=weight) for each, weight in pairs))
                engine = engine_of(self.evaluator.runs[e], only, self.evaluator.meshes[e])
                found.append(np.zeros_like(self.information))
                for side in SIDES:
                    H = engine.derivatives(*problem.vectors(self.theta, e), side, "gauss-newton").hessian
                    # Half of each side (`SIDES`); two names of a run may be one unknown.
                    np.add.at(found[-1], (mine[:, None], mine), 0.5 * H[own[:, None], own])
        # What no candidate has: priors and other runs.
        return Candidates(np.repeat(np.arange(len(counts)), counts), np.array(found), self.information - sum(found))


def simulate_values(problem: Problem, e: int, theta: FloatArray, taken: list[NDArray[np.bool_]]) -> Problem:
    """Return the problem with values simulated at theta in run e, of those samples of each sensor that are taken.

    Parameters
    ----------
    problem : Problem
        Whose data are `Measurements`; missing values stay missing.
    e : int
    theta : (d,) array
    taken : list of (K,) bool
        Sensors without any are left out.
    """
    run, data = problem.experiments[e], []
    # Values of theta itself: residuals are 0, and J of the planned run has its minimum there.
    comparisons = compare(Evaluator(problem, theta), theta)[1][e]
    for item, comparison, kept in zip(run.data, comparisons, taken, strict=True):
        if kept.any():
            sigma = item.sigma[kept] if getattr(item.sigma, "ndim", 0) == 2 else item.sigma
            values = np.where(np.isnan(item.values), np.nan, comparison.fitted)[kept]
            data.append(replace(item, times=item.times[kept], values=values, sigma=sigma))
    runs = list(problem.experiments)
    runs[e] = replace(run, data=data)
    return replace(problem, experiments=runs)
