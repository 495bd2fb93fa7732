"""Minima of J in a transition time farther away: a scan over the time, and models of the dips that it shows.

Where the difference of two vector fields changes its sign, as it does of a mass on a spring, a switch on the other side
of that has nearly the same effect. What is left may be noise by its size at both.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.meshes.evaluator import Evaluator
from switchfit.strategy.interval_models import MATRICES, list_hops
from switchfit.strategy.short_fit import is_lower, make_feasible
from switchfit.strategy.time_limit import check_time

SCAN_FIRST, SCAN_RATIO = 3.0, 1.6
"""Distance of the first place of a scan of J over a time, in standard errors, and of each place to that before it.
Between two equal minima J is like (s (s - D))² at the distance s from one: at this ratio the places show the other."""

DIPS, MODELS_OF_DIP, MODEL_RIGHT = 8, 4, 0.2
"""Dips of J that are looked into, the lowest; models of each, one about the minimum of the last; and the part of what a
minimum is above the cost below which the error of J there makes no difference."""

CLOSE_IN_VARIANCES = 12.0
"""By how much, in variances of the noise, a point beside another minimum may be above the cost for a fit from there."""

SCAN_STEP = 1 / 40
"""Largest distance of two places, as a part of the horizon: others may be narrow. A scan from a kink begins with it."""


def find_far_minima(
    evaluator: Evaluator, theta: FloatArray, cost: float, errors: FloatArray, scale: float
) -> tuple[list[FloatArray], list[tuple[int, FloatArray]]]:
    """Return points beside other minima in a transition time at which J is lower than the cost at theta, the best
    first; and those at which it is not much higher, with the place of the time.

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
        A minimum.
    cost : float
    errors : (d,)
        Standard errors.
    scale : float
        Variance of the noise, 1 if sigma is known.
    """
    problem, found, close = evaluator.problem, [], []
    runs = range(len(problem.experiments))
    # The lowest dips of all runs together: each takes a few models, and a run without a second minimum shall take none.
    dips = sorted((cost, e, interval) for e in runs for cost, interval in _scan(evaluator, e, theta, errors))[:DIPS]
    intervals = [[interval for _, run, interval in dips if run == e] for e in runs]
    places = [place for each in intervals for place, _, _ in each]
    hops = list_hops(evaluator, theta, intervals, errors > 0.0, MATRICES)
    for place, (lowest, start, find_lowest) in zip(places, hops, strict=True):
        # A model made far from its minimum errs; each further one is made about the minimum of the last, until it is
        # right, or J itself is lower.
        least = np.inf
        for _ in range(MODELS_OF_DIP):
            point = make_feasible(problem, start)
            there = evaluator.cost(point)
            if is_lower(there, cost):
                found.append((there, point))
            if there < least:
                least, best = there, point
            # A model that is right and not lower than the cost has nothing to tell. `not >` rather than `<=`: J that is
            # no number ends the dip as well.
            if not there > cost or abs(there - lowest) < MODEL_RIGHT * (lowest - cost):
                break
            lowest, start = find_lowest(point)
        if cost < least < cost + CLOSE_IN_VARIANCES * scale:
            close.append((place, best))
    return [point for _, point in sorted(found, key=lambda each: each[0])], close


def _scan(
    evaluator: Evaluator, e: int, theta: FloatArray, errors: FloatArray
) -> Iterator[tuple[float, tuple[int, float, float]]]:
    """Yield by how much J of a run is above that at theta in another minimum, with all else as it is; and the place of
    the time in theta, and the ends of the interval in which that is.
    """
    problem = evaluator.problem
    where, run = problem.unknowns.times[e], problem.experiments[e]
    ends = run.ends_of_modes(np.where(where >= 0, theta[where], run.initial_times))
    step, here = SCAN_STEP * (ends[-1] - ends[0]), evaluator.engines[e].cost(*problem.vectors(theta, e))
    for i, place in enumerate(where.tolist()[: len(ends) - 2]):  # without a free tf
        # Nearer than that, J is still the parabola of the minimum at theta. A time at a kink has no standard error: its
        # scan begins with a whole step.
        nearest = SCAN_FIRST * errors[place] or step
        for end in (ends[i], ends[i + 2]):
            room, far = abs(end - theta[place]), [nearest]
            if place < 0 or not nearest < room:
                continue
            # Distances grow by the ratio, which shows minima that are alike (`SCAN_RATIO`), up to the step, since
            # others are narrow.
            while far[-1] < room:
                far.append(far[-1] + min((SCAN_RATIO - 1.0) * far[-1], step))
            times, count = theta[place] + np.copysign(far[:-1], end - theta[place]), len(far) - 1
            costs = np.empty(count)
            for j, t in enumerate(times.tolist()):
                moved = theta.copy()
                moved[place] = t
                check_time()
                costs[j] = evaluator.engines[e].cost(*problem.vectors(moved, e))
            # A dip: J falls to a place, and does not fall from it to the next. The last place may be one, whose
            # interval ends at the neighbouring transition.
            falls = np.append(costs[1:] < costs[:-1], False)
            for j in np.flatnonzero(falls[:-1] & ~falls[1:]).tolist():
                low, high = sorted((times[j], times[j + 2] if j + 2 < count else end))
                yield float(costs[j + 1] - here), (place, float(low), float(high))
