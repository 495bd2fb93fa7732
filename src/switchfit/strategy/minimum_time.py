"""Many starts where J is the time that it takes: over a horizon that shrinks with the best end."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.fit.result import Fit
from switchfit.problem.parameter import Parameter
from switchfit.problem.problem import Problem
from switchfit.strategy.many_starts import MOST_STARTS, SAME_COST, Starts, try_starts
from switchfit.strategy.short_fit import End

MARGIN_OF_SHORTER_HORIZON = 1.02
"""Horizon over which starts are drawn, in units of the time of the best end: with room for others to end there too."""

STARTS_UNTIL_FEASIBLE = 8
"""Starts over the whole horizon at a time, until one meets the constraints."""

SAME_RATE = 1e-9
"""Relative difference of J from the time, or of its derivatives, that is rounding."""


def is_minimum_time(problem: Problem, fit: Fit) -> bool:
    """Return whether J is proportional to tf - t0, as it is at the start and at the end of a fit."""
    if len(problem.experiments) != 1 or not fit.history:
        return False
    run, where = problem.experiments[0], problem.unknowns.times[0]
    if not run.has_free_tf or np.any(where < 0):
        return False
    if any(np.isfinite(tau.lower) or np.isfinite(tau.upper) or tau.prior for tau in run.transition_times):
        return False
    place, first = int(where[-1]), fit.history[0]
    rate = float(fit.gradient[place])
    # J is the clock if it depends on tf alone, with one rate at the start and at the end; a running cost of 1 looks the
    # same as a terminal one of tf.
    others = np.delete(fit.gradient, place)
    pairs = ((fit.cost, fit.theta[place]), (first.cost, first.theta[place]))
    proportional = all(abs(cost - rate * (tf - run.t0)) <= SAME_RATE * abs(cost) for cost, tf in pairs)
    return rate > 0 and proportional and bool(np.all(np.abs(others) <= SAME_RATE * rate))


def try_shorter_horizons(problem: Problem, fit: Fit) -> Starts:
    """Return the lowest end of starts over shorter and shorter horizons, beginning with that of a fit.

    How many starts were tried and agree is that of the last horizon, over which none was better.
    """
    end = End(fit.theta, np.inf if fit.violated else fit.cost, 0)
    evaluations, tried, seed = 0, 0, 0
    while True:
        # A random start over a horizon that is far too long is nowhere near an end that meets the constraints: it
        # shrinks with each better end.
        given = problem if end.failed else _shorten_horizon(problem, end.theta)
        found = try_starts(given, end.theta, seed=seed, most=STARTS_UNTIL_FEASIBLE if end.failed else MOST_STARTS)
        evaluations, tried, seed = evaluations + found.end.evaluations, tried + len(found.costs), seed + 1
        lower = not found.end.failed and (end.failed or found.end.cost < end.cost * (1 - SAME_COST))
        end = found.end if lower else end
        stopped = found.ended in ("time", "interrupted")
        if stopped or (not lower and not end.failed) or (end.failed and tried >= MOST_STARTS):
            return found._replace(end=end._replace(evaluations=evaluations))


def _shorten_horizon(problem: Problem, theta: FloatArray) -> Problem:
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
        tf=replace(
            run.tf, value=tf, upper=min(run.t0 + MARGIN_OF_SHORTER_HORIZON * (tf - run.t0), float(run.tf.upper))
        ),
    )
    return replace(problem, experiments=(shorter,))
