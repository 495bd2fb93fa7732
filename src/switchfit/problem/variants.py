"""Variants of a problem: other values of its data, or some of its unknowns fixed at their guesses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.problem.problem import Problem


def replace_values(problem: Problem, values: Mapping[tuple[int, int], FloatArray]) -> Problem:
    """Return the problem with other values of some of its data; missing ones stay missing.

    Parameters
    ----------
    problem : Problem
    values : mapping of (int, int) to (K, q) array
        By the experiment, and the place of the `Measurements` among its data.
    """
    data = [list(run.data) for run in problem.experiments]
    for (e, k), own in values.items():
        item = data[e][k]
        data[e][k] = replace(item, values=np.where(np.isnan(item.values), np.nan, own))
    runs = [replace(run, data=items) for run, items in zip(problem.experiments, data, strict=True)]
    return replace(problem, experiments=runs)


def fix_unknowns(problem: Problem, names: Sequence[str]) -> Problem:
    """Return a problem with some of its unknowns fixed at their guesses.

    Parameters
    ----------
    problem : Problem
    names : sequence of str
        Of all entries of a parameter, or of none.
    """
    at = problem.initial_theta
    fixed = {problem.theta_names.index(name) for name in names}
    unknowns = problem.unknowns

    def fix(parameter: Any, place: int) -> Any:
        return replace(parameter, value=at[place], fixed=True) if place in fixed else parameter

    runs = []
    for e, run in enumerate(problem.experiments):
        times = tuple(fix(tau, i) for tau, i in zip(run.times, unknowns.times[e].tolist(), strict=True))
        count = len(run.transition_times)
        changes: dict[str, Any] = {"transition_times": times[:count]}
        if len(times) > count:
            changes["tf"] = times[count] if not times[count].fixed else float(times[count].value)
        states = unknowns.initial_states[e]
        if (states >= 0).any():
            initial = problem.system.initial_state if run.initial_state is None else run.initial_state
            changes["initial_state"] = [
                fix(x, i) if i >= 0 else x for x, i in zip(initial, states.tolist(), strict=True)
            ]
        runs.append(replace(run, **changes))
    parameters = dict(problem.parameters)
    for name, span in unknowns.parameters.items():
        held = [i in fixed for i in range(span.start, span.stop)]
        if any(held) and not all(held):
            raise ValueError(f"the entries of {name!r} are estimated all together, or none of them.")
        if all(held):
            given = parameters[name]
            parameters[name] = replace(given, value=at[span].reshape(given.shape), fixed=True)
    return replace(problem, experiments=runs, parameters=parameters)
