"""The problem of the samples that an online estimator keeps, for `sf.estimate`.

It begins where the window does. What samples before the window say is a measurement of its first state and of the
parameters.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from switchfit.arrays import Traced
from switchfit.modes.schedule import Schedule, drop_empty
from switchfit.online.state import Now
from switchfit.online.window_start import Start
from switchfit.problem.measurements import Measurements
from switchfit.problem.parameter import Parameter
from switchfit.problem.problem import Problem

START_STATE_PARAMETER, INITIAL_STATE_PARAMETER = "state at the start of the window", "initial state"
"""Names of the parameters that stand for what is before a window."""

LEAST_RELATIVE_CURVATURE = 1e-12
"""Part of the largest second derivative below which one counts as none."""


def build_kept_problem(
    problem: Problem, now: Now, data: list[Measurements], given: dict[str, Any], arrival: Start | None
) -> Problem:
    """Return the problem of what has been measured since the start of the window, which begins at what was found.

    Parameters
    ----------
    problem : Problem
    now : Now
    data : list of Measurements
    given : dict of str to value
        What else the run has since then: its inputs, its modes and their times, t0 and tf.
    arrival : Start or None, if nothing has left the window
        In U parameters and A entries for the state, the parameters being where it has moved.
    """
    run, states, offset = problem.experiments[0], problem.unknowns.initial_states[0], problem.unknowns.is_time.sum()
    own = problem.system.initial_state if run.initial_state is None else run.initial_state
    parameters = {name: replace(each, value=now.parameters[name]) for name, each in problem.parameters.items()}
    initial: Any = own
    if arrival is not None:
        initial, sensor = _describe_arrival(problem, arrival, given["t0"])
        data = [sensor, *data]
        known = {
            START_STATE_PARAMETER: len(arrival.gradient) - len(arrival.moved),
            INITIAL_STATE_PARAMETER: int((states >= 0).sum()),
        }
        # The priors are in the arrival cost.
        parameters = {name: replace(parameter, prior=None) for name, parameter in parameters.items()}
        parameters |= {name: Parameter(np.zeros(size)) for name, size in known.items() if size}
    elif (states >= 0).any():
        values = [float(now.best.theta[place - offset]) if place >= 0 else None for place in states.tolist()]
        initial = [
            entry if value is None else replace(entry, value=value) for entry, value in zip(own, values, strict=True)
        ]
    t0, tf = given["t0"], given["tf"]
    # A wrong model or outliers make modes of no duration.
    there = drop_empty(Schedule(given["mode_sequence"], np.clip(given["transition_times"], t0, tf), t0, tf))
    begins = given | {"mode_sequence": there.sequence, "transition_times": tuple(there.times), "initial_state": initial}
    return replace(problem, experiments=(replace(run, data=tuple(data), **begins),), parameters=parameters)


def _describe_arrival(problem: Problem, arrival: Start, t0: float) -> tuple[Any, Measurements]:
    """Return the initial state as a function of the parameters, and the cost of the samples before as a measurement.

    With ``H = R'R`` and ``g = R's`` the cost is ``|R d + s|^2 / 2`` but for a constant: R d is measured to be -s.
    """
    unknowns, run = problem.unknowns, problem.experiments[0]
    values, vectors = np.linalg.eigh(arrival.matrix)
    # Directions without knowledge have no row in R; a root of their rounding would measure them.
    there = values > LEAST_RELATIVE_CURVATURE * values[-1]
    R = (vectors[:, there] * np.sqrt(values[there])).T
    s = (vectors[:, there] / np.sqrt(values[there])).T @ arrival.gradient
    own = {problem_name: name for name, problem_name in run.parameter_map.items()}
    names = [own.get(name, name) for name in unknowns.parameters]
    has_entries = len(arrival.gradient) > len(arrival.moved)
    if (unknowns.initial_states[0] >= 0).any():
        names.append(INITIAL_STATE_PARAMETER)

    def move(p: Mapping[str, Traced]) -> Traced:
        parameters = [jnp.ravel(jnp.asarray(p[name])) for name in names]
        entries = [p[START_STATE_PARAMETER]] if has_entries else []
        return jnp.concatenate([*entries, jnp.concatenate([*parameters, jnp.zeros(0)]) - arrival.moved])

    def begin(p: Mapping[str, Traced]) -> Traced:
        return arrival.state + arrival.tangent @ move(p)

    sensor = Measurements([t0], [-s], observe=lambda t, x, p: R @ move(p), sigma=1.0)
    return begin, sensor
