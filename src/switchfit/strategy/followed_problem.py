"""The problem as a beam follows it: delays at their guesses, and more noise where transitions reset the state."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from switchfit.problem.experiment import Experiment
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem, keep_with_problem

SOFTER_DEVIATIONS = 3.0
"""Standard deviations of a channel that a beam takes for noise where transitions reset the state and nothing good is
found otherwise. Births are on a grid, and each sample between one and where the state jumps is off by all of the jump.
With 1, 11 of 16 gearboxes that shift at a speed end right, with 3, 15; with 10, 9 of 16 balls whose speed is measured,
not 16."""


@keep_with_problem
def fix_delays(problem: Problem) -> Problem:
    """Return the problem with delays that are parameters at their guesses, as a beam follows it."""
    if not problem.estimates_delays:
        return problem

    def fix(run: Experiment, item: Measurements) -> Measurements:
        if not isinstance(item.delay, str):
            return item
        parameter = problem.parameters[run.parameter_map.get(item.delay, item.delay)]
        return replace(item, delay=float(parameter.value))

    return _replace_measurements(problem, fix)


@keep_with_problem
def soften(problem: Problem) -> Problem:
    """Return the problem as a beam follows it, with more noise where its size is known."""

    def soften(run: Experiment, item: Measurements) -> Measurements:
        if item.sigma is None or item.sigma_names:
            return item
        # Never less than it was: a channel that hardly varies keeps its sigma.
        return replace(item, sigma=np.maximum(item.sigma, SOFTER_DEVIATIONS * np.nanstd(item.values, axis=0)))

    return _replace_measurements(fix_delays(problem), soften)


def _replace_measurements(problem: Problem, change: Callable[[Experiment, Measurements], Measurements]) -> Problem:
    """Return a problem with other Measurements."""
    runs = []
    for run in problem.experiments:
        data = [change(run, item) if isinstance(item, Measurements) else item for item in run.data]
        runs.append(replace(run, data=data))
    return replace(problem, experiments=runs)
