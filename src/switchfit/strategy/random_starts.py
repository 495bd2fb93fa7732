"""Random starts all over the feasible set of bounds, order and minimum durations."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.optimize.least_distance import nearest_feasible
from switchfit.problem.experiment import Experiment
from switchfit.problem.problem import Problem

MOST_DRAWN = 2**30
"""Length of SciPy's Sobol sequences."""

RANGE_FACTOR = 10.0
"""Range of an unknown without bounds: a positive guess is divided and multiplied by this factor, on a logarithmic
scale; any other guess varies by plus or minus so many times its size. Times on a logarithmic scale are drawn on that
scale, from the time since t0 of the first guess divided by this factor to the end of the horizon."""


def draw_starts(problem: Problem, count: int, seed: int) -> FloatArray:
    """Return starts from a scrambled Sobol sequence: (S, d); the first is the problem's initial guess.

    Parameters
    ----------
    problem : Problem
        Unknowns without bounds are drawn around their guesses (`RANGE_FACTOR`).
    count, seed : int
    """
    from scipy.stats import qmc  # here, since importing it takes longer than most fits

    unknowns = problem.unknowns
    sobol = qmc.Sobol(len(unknowns.names), seed=seed)
    # A power of two, for which the points of a Sobol sequence are balanced.
    cube = sobol.random(1 << max(count - 1, 0).bit_length())[:count]
    low, high, log = _compute_ranges(problem)
    points = low + cube * (high - low)
    points[:, log] = low[log] * (high[log] / low[log]) ** cube[:, log]
    for experiment, where in zip(problem.experiments, unknowns.times, strict=True):
        # Those of the modes may differ; what this leaves infeasible is moved to the nearest feasible point.
        shortest = min(problem.durations[mode] for mode in experiment.mode_sequence)
        for begin, end, group in _list_stretches(experiment, where):
            # Sorted uniform numbers are uniform over all ordered times; minimum durations are added to their gaps.
            room = end - begin - (len(group) + 1) * shortest
            ordered = np.sort(cube[:, group], axis=1)
            if unknowns.log[group].all():
                first = unknowns.initial[group[0]] - experiment.t0
                low, high = max(begin - experiment.t0, first / RANGE_FACTOR), end - experiment.t0
                points[:, group] = experiment.t0 + low * (high / low) ** ordered
                continue
            points[:, group] = begin + max(room, 0.0) * ordered + shortest * np.arange(1, len(group) + 1)
    points[0] = unknowns.initial
    # Each unknown is measured by its distance from the guess, which is feasible.
    sizes = np.maximum(np.abs(points - unknowns.initial), 1e-9 * (1 + np.abs(unknowns.initial)))
    pairs = zip(points, sizes, strict=True)
    return np.array([nearest_feasible(problem.constraints, point, size) for point, size in pairs])


def _compute_ranges(problem: Problem) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Return the range of each unknown, (d,) and (d,), and whether it is drawn on a logarithmic scale, (d,)."""
    unknowns = problem.unknowns
    guess, is_time = unknowns.initial, unknowns.is_time
    size = np.where(guess != 0, np.abs(guess), 1.0)
    open_low = ~np.isfinite(unknowns.lower) | (unknowns.log & (unknowns.lower <= 0))
    open_high = ~np.isfinite(unknowns.upper)
    ratio = (guess > 0) & (open_low | open_high) & (unknowns.lower >= 0) | unknowns.log
    low = np.where(ratio, size / RANGE_FACTOR, guess - RANGE_FACTOR * size)
    high = np.where(ratio, size * RANGE_FACTOR, guess + RANGE_FACTOR * size)
    low = np.where(open_low | ratio & (unknowns.lower <= 0), np.maximum(low, unknowns.lower), unknowns.lower)
    high = np.where(open_high, np.maximum(high, low), unknowns.upper)
    ratio &= ~is_time & (low > 0)
    return np.where(is_time, 0.0, low), np.where(is_time, 1.0, high), ratio


def _list_stretches(experiment: Experiment, where: NDArray[np.intp]) -> list[tuple[float, float, NDArray[np.intp]]]:
    """Return groups of free transition times with the fixed times (or ends of the horizon) that enclose them."""
    knots = np.concatenate([[experiment.t0], experiment.initial_times, [experiment.end]])
    fixed = [0, *(np.flatnonzero(where < 0) + 1).tolist(), len(knots) - 1]
    return [(float(knots[a]), float(knots[b]), where[a : b - 1]) for a, b in pairwise(fixed) if b - a > 1]
