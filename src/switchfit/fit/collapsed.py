"""Collapsed modes: modes of zero duration, whose two transition times are equal.

If a collapsed mode lies between two intervals of the same mode, as B in (A, B, A), the cost does not depend on its
position: to the integration error, J is constant as its two transition times move together. Nor does the cost depend on
a parameter that acts in collapsed modes alone. Such unknowns are *idle*: no data determine them, and the curvature of J
along them is that of the integration error, of either sign.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from switchfit.fit.evaluator import Evaluator
from switchfit.optimize.algebra import EPS
from switchfit.problem.data import FloatArray
from switchfit.problem.experiment import Experiment, drop_jumps
from switchfit.problem.problem import Problem

CHANGES = (0.1, -0.1)
"""Relative changes of a parameter to test its effect; if it is 0, relative to the range between its bounds."""

NO_EFFECT = 1e-12
"""Relative change of the cost that may be rounding: a parameter that changes it by less has no effect."""

OPENED = 1e-3
"""Duration of collapsed modes, as a part of the horizon, when the effect of a parameter in them is tested."""


def idle_unknowns(evaluator: Evaluator, theta: FloatArray, parameters: bool) -> NDArray[np.bool_]:
    """Return which unknowns may be fixed, as J does not depend on them while collapsed modes remain collapsed: (d,).

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
    parameters : bool
        Whether to test parameters too, with a few evaluations of J for each. Of transition times that coincide, only
        the first is returned, which leaves the others free to move away from it.
    """
    problem = evaluator.problem
    idle = np.zeros(len(theta), dtype=bool)
    for group in _list_idle_groups(problem, theta):
        idle[group[0]] = True
    opened = _open_modes(problem, theta) if parameters else theta
    if not np.array_equal(opened, theta):
        for i in _list_parameters(problem):
            idle[i] = _is_idle(evaluator, theta, opened, i)
    return idle


def _list_idle_groups(problem: Problem, theta: FloatArray) -> Iterator[NDArray[np.intp]]:
    """Yield the indices in theta of transitions that coincide and may move together without effect.

    No transition among them is fixed or at an end of the horizon, the modes before and after them are the same, and no
    reset map, guard or jump lies in between.
    """
    system = problem.system
    for e, experiment in enumerate(problem.experiments):
        sequence, where = experiment.mode_sequence, problem.unknowns.times[e]
        for first, last in _list_coincident(problem, theta, e):
            passed = [*zip(sequence[first : last + 1], sequence[first + 1 : last + 2], strict=True)]
            smooth = all(system.reset_map(*pair) is None and system.guard(*pair) is None for pair in passed)
            smooth = smooth and not np.any((experiment.passed_by_jumps > first) & (experiment.passed_by_jumps <= last))
            if smooth and sequence[first] == sequence[last + 1] and np.all(where[first : last + 1] >= 0):
                yield where[first : last + 1]


def _list_coincident(problem: Problem, theta: FloatArray, e: int) -> Iterator[tuple[int, int]]:
    """Yield the first and last of two or more transitions that coincide strictly inside the horizon."""
    experiment, times = problem.experiments[e], _get_times(problem, theta, e)
    if not np.any(times[1:] - times[:-1] <= _estimate_rounding(experiment)):  # the usual case: tested at every step
        return
    short, room = _find_collapsed(problem, theta, e)
    first = 0
    for i in range(1, len(times) + 1):
        if i < len(times) and short[i]:
            continue
        if i - first > 1 and not np.any(room[[first, i - 1]]):
            yield first, i - 1
        first = i


def _open_modes(problem: Problem, theta: FloatArray) -> FloatArray:
    """Return theta with transition times moved so that every collapsed mode lasts a little, if there is room."""
    opened = theta.copy()
    for e, (experiment, where) in enumerate(zip(problem.experiments, problem.unknowns.times, strict=True)):
        times, short = _get_times(problem, theta, e), _find_collapsed(problem, theta, e)[0]
        if not short.any():
            continue
        gap = OPENED * experiment.initial_length * short
        knots = np.concatenate([[experiment.t0], times, [experiment.end]])
        for i in range(1, len(times) + 1):
            knots[i] = max(knots[i], knots[i - 1] + gap[i - 1])
        for i in range(len(times), 0, -1):
            knots[i] = min(knots[i], knots[i + 1] - gap[i])
        opened[where[where >= 0]] = knots[1:-1][where >= 0]
    return opened


def _find_collapsed(problem: Problem, theta: FloatArray, e: int) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Return which modes of experiment e have no duration (N + 1,), and which transitions are at an end of it (N,).

    A free tf counts as a transition at the end, to a mode that lasts.
    """
    experiment = problem.experiments[e]
    times, rounding = _get_times(problem, theta, e), _estimate_rounding(experiment)
    knots = experiment.ends_of_modes(times)
    at_end = (times - experiment.t0 <= rounding) | (knots[-1] - times <= rounding)
    short = np.diff(knots) <= rounding
    return np.append(short, [False] * (len(times) + 1 - len(short))), at_end


def _get_times(problem: Problem, theta: FloatArray, e: int) -> FloatArray:
    """Return the transition times of experiment e, and a free tf behind them: (N,), without jumps."""
    experiment, times = problem.experiments[e], problem.vectors(theta, e)[0]
    return np.array(drop_jumps(experiment, times)) if len(experiment.jump_times) else times


def _estimate_rounding(experiment: Experiment) -> float:
    """Return the rounding error of the difference of two times of an experiment."""
    return 32 * EPS * max(experiment.end - experiment.t0, abs(experiment.t0), abs(experiment.end))


def _list_parameters(problem: Problem) -> list[int]:
    """Return the indices in theta of the model's parameters."""
    return [i for span in problem.unknowns.parameters.values() for i in range(span.start, span.stop)]


def _is_idle(evaluator: Evaluator, theta: FloatArray, opened: FloatArray, i: int) -> bool:
    """Return whether parameter i has no effect on J at theta, but has one where the collapsed modes last a little."""
    unknowns = evaluator.problem.unknowns
    low, high = unknowns.lower[i], unknowns.upper[i]
    size = abs(theta[i]) or (high - low if np.isfinite(high - low) else 1.0)

    def has_effect(at: FloatArray) -> bool:
        base = evaluator.cost(at)
        for change in CHANGES:
            moved = at.copy()
            moved[i] = np.clip(at[i] + change * size, low, high)
            if not abs(evaluator.cost(moved) - base) <= NO_EFFECT * abs(base):
                return True
        return False

    return not has_effect(theta) and has_effect(opened)
