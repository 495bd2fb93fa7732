"""Hops of transition times over samples: each sample is a kink of J, with a minimum in many of the intervals.

The quadratic model about the middle of each interval near by (`interval_models`) says how low J may be there, with all
other unknowns following. Of the best intervals a second model is made about that minimum.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.engine.evaluation import Matrix
from switchfit.meshes.evaluator import Evaluator
from switchfit.problem.experiment import Experiment
from switchfit.problem.problem import Problem
from switchfit.strategy.beam_grid import list_sample_times
from switchfit.strategy.interval_models import MATRICES, MOST_SECOND_MODELS, list_hops
from switchfit.strategy.short_fit import End, fit_briefly, is_lower, make_feasible, prepare_meshes

FURTHEST = 2
"""Sample intervals on either side that are looked at."""

DOUBTED = 0.03
"""Part of J by which the first model may be above it for a second one. With 1e-3 one of 100 searches for the order of
three linear modes ended above the truth, with 1e-2 none."""

HOPPING_ROUNDS = 12

NEAR_INTERVALS_IN_ERRORS = 3.0
"""Standard errors of a time within which another sample interval has to begin, if a minimum in it may be lower."""


def hop_over_samples(problem: Problem, best: End, known: Evaluator | None = None) -> End:
    """Return where fits end that begin in other sample intervals than the end of a fit, on known meshes where these
    suit it.
    """
    evaluations, evaluator = 0, prepare_meshes(problem, best.theta, known)
    if evaluator is None:
        return best._replace(evaluations=0)
    for _ in range(HOPPING_ROUNDS):
        # The first start that lowers J begins the next round: the others were chosen about a minimum that is left now.
        for start in choose_hops(evaluator, best.theta, best.cost):
            end = fit_briefly(problem, make_feasible(problem, start), evaluator=evaluator)
            evaluations += end.evaluations
            if is_lower(end.cost, best.cost):
                best = end
                break
        else:
            break
    return best._replace(evaluations=evaluations)


def choose_hops(
    evaluator: Evaluator,
    theta: FloatArray,
    cost: float,
    free: NDArray[np.bool_] | None = None,
    reach: FloatArray | None = None,
    matrices: Sequence[Matrix] = MATRICES[:1],
) -> list[FloatArray]:
    """Return starts in sample intervals near by where J may be lower than the cost at theta, the best first.

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
    cost : float
    free : (d,) bool, optional
        Unknowns that may move; those at a bound do not.
    reach : (d,), optional
        Largest distance of an interval from a time; any if left out.
    matrices : sequence of str, optional
        The first that leads to a minimum is that of a model. Of all hops of a beam the exact one alone leads lower.
    """
    unknowns = evaluator.problem.unknowns
    # The distance of a time from the nearer end of an interval.
    far = np.full(len(theta), np.inf) if reach is None else reach
    intervals = [
        [
            (place, low, high)
            for place, low, high in _list_intervals(run, unknowns.times[e], list_sample_times(run), theta)
            if max(low - theta[place], theta[place] - high) <= far[place]
        ]
        for e, run in enumerate(evaluator.problem.experiments)
    ]
    movable = np.ones(len(theta), bool) if free is None else free
    hops = list_hops(evaluator, theta, intervals, movable, matrices)
    # First models rank intervals, second ones decide: that about the middle of an interval errs, and may be above J
    # where a fit ends below it (`DOUBTED`).
    near = sorted(hops, key=lambda hop: hop[0])[:MOST_SECOND_MODELS]
    again = [find_lowest(start) for lowest, start, find_lowest in near if lowest < cost + DOUBTED * abs(cost)]
    return [start for lowest, start in sorted(again, key=lambda hop: hop[0]) if is_lower(lowest, cost)]


def look_near(evaluator: Evaluator, theta: FloatArray, cost: float, errors: FloatArray) -> list[FloatArray]:
    """Return starts in sample intervals beside a minimum where J may be lower than a cost, the best first.

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
        A minimum.
    cost : float
    errors : (d,)
        Standard errors; 0 of unknowns that are held, as by a kink.
    """
    reach = np.where(errors > 0.0, NEAR_INTERVALS_IN_ERRORS * errors, np.inf)
    return choose_hops(evaluator, theta, cost, errors > 0.0, reach, MATRICES)


def _list_intervals(
    run: Experiment, where: NDArray[np.intp], nodes: FloatArray, theta: FloatArray
) -> Iterator[tuple[int, float, float]]:
    """Yield the place of a time in theta, and the ends of an interval near by in which it may be."""
    ends = run.ends_of_modes(np.where(where >= 0, theta[where], run.initial_times))
    for i, place in enumerate(where.tolist()[: len(ends) - 2]):  # without a free tf
        # The interval in which the time is has j = k. It is left out, since the fit has been there; so are intervals
        # whose middle is beyond a neighbouring transition.
        k = int(np.searchsorted(nodes, theta[place], "right")) - 1
        for j in range(max(k - FURTHEST, 0), min(k + FURTHEST, len(nodes) - 2) + 1):
            low, high = nodes[j], nodes[j + 1]
            if place >= 0 and j != k and ends[i] < 0.5 * (low + high) < ends[i + 2]:
                yield place, float(low), float(high)
