"""Hops of transition times over samples: each sample is a kink of J, and there is a minimum in many of the intervals.

Between two samples J is smooth in a transition time. Of each interval near by, the quadratic model at its middle says
how low J may be there, with all other unknowns following.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from switchfit.fit.evaluator import Evaluator
from switchfit.problem.data import FloatArray, Measurements
from switchfit.problem.experiment import Experiment
from switchfit.problem.problem import Problem
from switchfit.strategy.quick import End, check_time, fit_briefly, make_feasible, prepare_meshes

FURTHEST = 2
"""Sample intervals on either side that are looked at."""

LOWER = 1e-6
"""Part of J by which the model has to be lower for a fit."""

NEAR = 1e-4
"""Part of J by which the model may be above it for a fit: that is what it is accurate to."""

MOST = 4
"""Fits that do not lower J, after which hops end."""

ROUNDS = 12


def hop_over_samples(problem: Problem, best: End) -> End:
    """Return where fits end that begin in other sample intervals than the end of a fit."""
    evaluations = 0
    for _ in range(ROUNDS):
        evaluator = prepare_meshes(problem, best.theta)
        if evaluator is None:
            break
        for start in choose_hops(evaluator, best.theta, best.cost):
            end = fit_briefly(problem, make_feasible(problem, start), evaluator=evaluator)
            evaluations += end.evaluations
            if is_lower(end.cost, best.cost):
                best = end
                break
        else:
            break
    return best._replace(evaluations=evaluations)


def is_lower(cost: float, than: float) -> bool:
    """Return whether a hop has led to a lower minimum."""
    return cost < than - LOWER * abs(than)


def choose_hops(
    evaluator: Evaluator, theta: FloatArray, cost: float, free: NDArray[np.bool_] | None = None
) -> list[FloatArray]:
    """Return starts in sample intervals near by where J may be lower than the cost at theta, the best first.

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
    cost : float
    free : (d,) bool, optional
        Unknowns that may move; those at a bound do not.
    """
    unknowns = evaluator.problem.unknowns
    inside = (unknowns.lower < theta) & (theta < unknowns.upper)
    hops = list(_list_hops(evaluator, theta, inside if free is None else inside & free))
    return [start for lowest, start in sorted(hops, key=lambda hop: hop[0])[:MOST] if lowest < cost + NEAR * abs(cost)]


def _list_hops(evaluator: Evaluator, theta: FloatArray, free: NDArray[np.bool_]) -> Iterator[tuple[float, FloatArray]]:
    """Yield the lowest J of the quadratic model of each sample interval near by, and theta there."""
    problem = evaluator.problem
    whole = evaluator(theta)
    for e, (run, where) in enumerate(zip(problem.experiments, problem.unknowns.times, strict=True)):
        nodes = list_sample_times(run)
        own, mine = problem.own_places[e]
        here = evaluator.engines[e].derivatives(*problem.vectors(theta, e), 1, "exact")
        for place, low, high in _list_intervals(run, where, nodes, theta):
            check_time()
            moved = theta.copy()
            moved[place] = 0.5 * (low + high)
            there = evaluator.engines[e].derivatives(*problem.vectors(moved, e), 1, "exact")
            gradient, hessian = whole.gradient.copy(), whole.hessian.copy()
            np.add.at(gradient, mine, (there.gradient - here.gradient)[own])
            np.add.at(hessian, (mine[:, None], mine), (there.hessian - here.hessian)[own[:, None], own])
            found = _minimize(gradient, hessian, free, place, low - moved[place], high - moved[place])
            if found is not None:
                yield whole.cost + there.cost - here.cost + found[0], moved + found[1]


def _minimize(
    gradient: FloatArray, hessian: FloatArray, free: NDArray[np.bool_], place: int, low: float, high: float
) -> tuple[float, FloatArray] | None:
    """Return the lowest value of a quadratic model with the unknown at `place` between two values, and the step (d,);
    None if it has no minimum.
    """
    step = np.zeros(len(gradient))
    try:
        step[free] = -np.linalg.solve(hessian[np.ix_(free, free)], gradient[free])
        np.linalg.cholesky(hessian[np.ix_(free, free)])
        if not low <= step[place] <= high:
            step[place] = np.clip(step[place], low, high)
            rest = free & (np.arange(len(step)) != place)
            slope = gradient[rest] + hessian[rest, place] * step[place]
            step[rest] = -np.linalg.solve(hessian[np.ix_(rest, rest)], slope)
    except np.linalg.LinAlgError:
        return None
    return float((gradient + 0.5 * hessian @ step) @ step), step


def _list_intervals(
    run: Experiment, where: NDArray[np.intp], nodes: FloatArray, theta: FloatArray
) -> Iterator[tuple[int, float, float]]:
    """Yield the place of a time in theta, and the ends of an interval near by in which it may be."""
    ends = run.ends_of_modes(np.where(where >= 0, theta[where], run.initial_times))
    for i, place in enumerate(where.tolist()):
        k = int(np.searchsorted(nodes, theta[place], "right")) - 1
        for j in range(max(k - FURTHEST, 0), min(k + FURTHEST, len(nodes) - 2) + 1):
            low, high = nodes[j], nodes[j + 1]
            if place >= 0 and j != k and ends[i] < 0.5 * (low + high) < ends[i + 2]:
                yield place, float(low), float(high)


def list_sample_times(run: Experiment) -> FloatArray:
    """Return the times at which something is measured: (K,), ascending."""
    measured = [item for item in run.data if isinstance(item, Measurements)]
    times = [item.seen_times[np.any(np.isfinite(item.values), axis=1)] for item in measured]
    return np.unique(np.concatenate([np.zeros(0), *times]))
