"""Many starts: short fits from random points, until it is unlikely that a minimum was missed."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.problem.problem import Problem
from switchfit.runtime.progress import show_detail
from switchfit.strategy.random_starts import draw_starts
from switchfit.strategy.short_fit import End, fit_briefly
from switchfit.strategy.time_limit import OutOfTimeError

MOST_STARTS = 128
"""Starts at most; a study of more is what `multistart` is for."""

AGREEING_ENDS = 3
"""Ends at the lowest cost after which the search may stop."""

SAME_COST = 1e-6
"""Part of the cost by which two ends of one minimum differ at most."""


class Starts(NamedTuple):
    """Where short fits ended: the lowest end, the costs of all (n,), and why there are no more (`Step.ended`)."""

    end: End
    costs: FloatArray
    ended: str

    def count_agreeing(self, cost: float, accuracy: float) -> int:
        """Return how many ended where a fit did whose J is `cost`: at the lowest end, if that is at this J.

        Short fits have meshes of their own, whose J is accurate to `accuracy` alone; among themselves ends of one
        minimum differ by `SAME_COST`.
        """
        lowest = self.end.cost
        if not abs(lowest - cost) <= accuracy + SAME_COST * abs(cost):
            return 0
        return int(np.sum(self.costs <= max(lowest, cost) + accuracy + SAME_COST * abs(cost)))


def try_starts(
    problem: Problem,
    theta: FloatArray,
    *,
    seed: int = 0,
    most: int = MOST_STARTS,
    is_enough: Callable[[float], bool] = lambda cost: False,
) -> Starts:
    """Return the lowest end of short fits from random starts, theta (d,) among them.

    They stop where, after n fits that ended in w different minima, no more than half a minimum is expected to be
    missing ([1]_), and the lowest has been found `AGREEING_ENDS` times. Ctrl-C and the end of the time budget end them
    as well, once one has ended.

    Parameters
    ----------
    problem : Problem
    theta : (d,)
        Where the best fit so far ended.
    seed : int
    most : int
        Starts at most.
    is_enough : callable
        Asked after each fit whether its J is low enough to end the search.

    References
    ----------
    .. [1] C. G. E. Boender, A. H. G. Rinnooy Kan, Bayesian stopping rules for multistart global optimization methods,
       Math. Program. 37 (1987) 59-80.
    """
    ends, ended = [], "most"
    # The first of them is the problem's guess, from which the fit before has begun: its end stands there instead.
    starts = np.vstack([theta, draw_starts(problem, most, seed)[1:]])
    try:
        for start in starts:
            end = fit_briefly(problem, start)
            ends.append(end)
            show_detail(f"start {len(ends) - 1} of at most {most - 1}", min(one.cost for one in ends))
            if _is_enough(np.array([one.cost for one in ends if not one.failed])):
                ended = "settled"
                break
            if is_enough(end.cost):
                ended = "good"
                break
    except KeyboardInterrupt:
        ended = "interrupted"
    except OutOfTimeError:
        ended = "time"
    best = min(ends, key=lambda one: one.cost, default=End(theta, np.inf, 0))
    best = best._replace(evaluations=sum(one.evaluations for one in ends))
    return Starts(best, np.array([one.cost for one in ends[1:]]), ended)


def _is_enough(costs: FloatArray) -> bool:
    """Return whether all minima are likely to be among those with these costs (n,), and the lowest was found often."""
    n = len(costs)
    if n == 0:
        return False
    ascending = np.sort(costs)
    # Minima are told apart by J alone: two with the same J would be one, which only ends the search a little earlier.
    w = 1 + int(np.sum(np.diff(ascending) > SAME_COST * np.abs(ascending[1:])))
    found = int(np.sum(ascending <= ascending[0] + SAME_COST * abs(ascending[0])))
    # w (n - 1) / (n - w - 2) is the expected number of minima ([1] of `try_starts`); only for n > w + 2 is it one.
    return found > AGREEING_ENDS and n > w + 2 and w * (n - 1) / (n - w - 2) < w + 0.5
