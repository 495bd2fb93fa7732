"""Random starts all over the feasible set of bounds, order and minimum durations."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.optimize.qp import solve_qp
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem
from switchfit.problem.unknowns import get_min_duration

MOST_DRAWN = 2**30
"""Length of SciPy's Sobol sequences."""

FACTOR = 10.0
"""Range of an unknown without bounds: a positive guess is divided and multiplied by this factor, on a logarithmic
scale; any other guess varies by plus or minus so many times its size. Times on a logarithmic scale are drawn on that
scale, from the time since t0 of the first guess divided by this factor to the end of the horizon."""


def draw_starts(problem: Problem, count: int, seed: int) -> FloatArray:
    """Return starts from a scrambled Sobol sequence: (S, d); the first is the problem's initial guess.

    Parameters
    ----------
    problem : Problem
        Unknowns without bounds are drawn around their guesses (`FACTOR`).
    count, seed : int
    """
    from scipy.stats import qmc  # here, since importing it takes longer than most fits

    unknowns = problem.unknowns
    sobol = qmc.Sobol(len(unknowns.names), seed=seed)
    cube = sobol.random(1 << max(count - 1, 0).bit_length())[:count]
    low, high, log = _compute_ranges(problem)
    points = low + cube * (high - low)
    points[:, log] = low[log] * (high[log] / low[log]) ** cube[:, log]
    for experiment, where in zip(problem.experiments, unknowns.times, strict=True):
        # Those of the modes may differ; what this leaves infeasible is moved to the nearest feasible point.
        shortest = min(get_min_duration(problem.min_duration, mode) for mode in experiment.mode_sequence)
        for begin, end, group in _list_stretches(experiment, where):
            # Sorted uniform numbers are uniform over all ordered times; minimum durations are added to their gaps.
            room = end - begin - (len(group) + 1) * shortest
            ordered = np.sort(cube[:, group], axis=1)
            if unknowns.log[group].all():
                first = unknowns.initial[group[0]] - experiment.t0
                low, high = max(begin - experiment.t0, first / FACTOR), end - experiment.t0
                points[:, group] = experiment.t0 + low * (high / low) ** ordered
                continue
            points[:, group] = begin + max(room, 0.0) * ordered + shortest * np.arange(1, len(group) + 1)
    points[0] = unknowns.initial
    return np.array([find_nearest_feasible(problem, point) for point in points])


def _compute_ranges(problem: Problem) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Return the range of each unknown, (d,) and (d,), and whether it is drawn on a logarithmic scale, (d,)."""
    unknowns = problem.unknowns
    guess, is_time = unknowns.initial, unknowns.is_time
    size = np.where(guess != 0, np.abs(guess), 1.0)
    open_low = ~np.isfinite(unknowns.lower) | (unknowns.log & (unknowns.lower <= 0))
    open_high = ~np.isfinite(unknowns.upper)
    ratio = (guess > 0) & (open_low | open_high) & (unknowns.lower >= 0) | unknowns.log
    low = np.where(ratio, size / FACTOR, guess - FACTOR * size)
    high = np.where(ratio, size * FACTOR, guess + FACTOR * size)
    low = np.where(open_low | ratio & (unknowns.lower <= 0), np.maximum(low, unknowns.lower), unknowns.lower)
    high = np.where(open_high, np.maximum(high, low), unknowns.upper)
    ratio &= ~is_time & (low > 0)
    return np.where(is_time, 0.0, low), np.where(is_time, 1.0, high), ratio


def _list_stretches(experiment: Any, where: NDArray[np.intp]) -> list[tuple[float, float, NDArray[np.intp]]]:
    """Return groups of free transition times with the fixed times (or ends of the horizon) that enclose them."""
    knots = np.concatenate([[experiment.t0], experiment.initial_times, [experiment.end]])
    fixed = [0, *(np.flatnonzero(where < 0) + 1).tolist(), len(knots) - 1]
    return [(float(knots[a]), float(knots[b]), where[a : b - 1]) for a, b in pairwise(fixed) if b - a > 1]


def find_nearest_feasible(problem: Problem, point: FloatArray) -> FloatArray:
    """Return the feasible point nearest to `point`, each unknown scaled by its distance from the initial guess."""
    constraints = problem.constraints
    inside = problem.initial_theta
    if np.all(constraints.slack(point) >= 0):
        return point
    size = np.maximum(np.abs(point - inside), 1e-9 * (1 + np.abs(inside)))
    matrix = np.diag(1 / size**2)
    offsets = -np.maximum(constraints.slack(inside), 0.0)
    step = solve_qp(-(point - inside) / size**2, matrix, constraints.normals, offsets).step
    return np.clip(inside + step, constraints.lower, constraints.upper)
