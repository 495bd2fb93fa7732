"""Many starts where J is the time that it takes: over a horizon that shrinks with the best end.

The upper bound of a free tf is arbitrary, and arcs of all lengths below it meet the constraints: on the way of a
pendulum to rest each may be longer by a full turn. Few of the starts that are drawn over all of the horizon end at the
shortest. But nothing that takes longer than the best end is better than it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from switchfit.estimation.estimator import Estimate
from switchfit.problem.data import FloatArray
from switchfit.problem.parameter import Parameter
from switchfit.problem.problem import Problem
from switchfit.strategy.quick import End
from switchfit.strategy.starts import MOST, SAME_COST, Starts, try_starts

MARGIN = 1.02
"""Horizon over which starts are drawn, in units of the time of the best end: with room for others to end there too."""

FEW = 8
"""Starts over the whole horizon at a time, until one meets the constraints."""

SAME = 1e-9
"""Relative difference of J from the time, or of its derivatives, that is rounding."""


def is_minimum_time(problem: Problem, fit: Estimate) -> bool:
    """Return whether J is proportional to tf - t0, as it is at the start and at the end of a fit."""
    if len(problem.experiments) != 1 or not fit.history:
        return False
    run, where = problem.experiments[0], problem.unknowns.times[0]
    if not run.has_free_tf or np.any(where < 0) or not all(_is_unbounded(tau) for tau in run.transition_times):
        return False
    place, first = int(where[-1]), fit.history[0]
    rate = float(fit.gradient[place])
    others = np.delete(fit.gradient, place)
    pairs = ((fit.cost, fit.theta[place]), (first.cost, first.theta[place]))
    proportional = all(abs(cost - rate * (tf - run.t0)) <= SAME * abs(cost) for cost, tf in pairs)
    return rate > 0 and proportional and bool(np.all(np.abs(others) <= SAME * rate))


def try_shorter_horizons(problem: Problem, fit: Estimate) -> Starts:
    """Return the lowest end of starts over shorter and shorter horizons, beginning with that of a fit.

    How many starts were tried and agree is that of the last horizon, over which none was better.
    """
    end = End(fit.theta, np.inf if fit.violated else fit.cost, 0)
    evaluations, tried, seed = 0, 0, 0
    while True:
        given = problem if end.failed else shorten_horizon(problem, end.theta)
        found = try_starts(given, end.theta, seed=seed, most=FEW if end.failed else MOST)
        evaluations, tried, seed = evaluations + found.end.evaluations, tried + len(found.costs), seed + 1
        lower = not found.end.failed and (end.failed or found.end.cost < end.cost * (1 - SAME_COST))
        end = found.end if lower else end
        stopped = found.ended in ("time", "interrupted")
        if stopped or (not lower and not end.failed) or (end.failed and tried >= MOST):
            return found._replace(end=end._replace(evaluations=evaluations))


def shorten_horizon(problem: Problem, theta: FloatArray) -> Problem:
    """Return the problem with a horizon that ends a little behind the tf of theta (d,), and its guess shrunk to it."""
    run = problem.experiments[0]
    if not isinstance(run.tf, Parameter):
        raise TypeError("tf is fixed.")
    tf = float(theta[problem.unknowns.times[0][-1]])
    factor = (tf - run.t0) / (float(run.tf.value) - run.t0)
    guesses = [run.t0 + factor * (time - run.t0) for time in run.initial_times[:-1].tolist()]
    shorter = replace(
        run,
        transition_times=tuple(guesses),
        tf=replace(run.tf, value=tf, upper=min(run.t0 + MARGIN * (tf - run.t0), float(run.tf.upper))),
    )
    return replace(problem, experiments=(shorter,))


def _is_unbounded(parameter: Parameter) -> bool:
    """Return whether a transition time is free, and bounded by its neighbors alone."""
    return not (parameter.fixed or np.isfinite(parameter.lower) or np.isfinite(parameter.upper) or parameter.prior)
