"""The problem of the samples that an online estimator keeps, for `sf.estimate`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from switchfit.problem.data import FloatArray, Input, Measurements
from switchfit.problem.experiment import Experiment
from switchfit.problem.parameter import Parameter
from switchfit.problem.problem import Problem

ENTRIES, STATES = "state at the start of the window", "initial state"
"""Names of the parameters that stand for what is before a window."""

NO_EFFECT = 1e-12
"""Part of the largest second derivative below which one counts as none."""


class Arrival(NamedTuple):
    """What the samples before a window say of its unknowns d, A entries for the state at its start and U parameters.

    Attributes
    ----------
    center : (U,), the parameters where d is 0
    gradient, matrix : (A + U,), (A + U, A + U), of the cost
    state, tangent : (n,), (n, A + U)
    """

    center: FloatArray
    gradient: FloatArray
    matrix: FloatArray
    state: FloatArray
    tangent: FloatArray


class Kept(NamedTuple):
    """What has been measured since the start of the window, and what was found.

    Attributes
    ----------
    data : list of Measurements
    inputs : Input or None
    horizon : (t0, tf)
    sequence : tuple of str
    times : (N,)
    theta : (U,), parameters and initial states in the order of the problem's theta
    arrival : Arrival or None, if nothing has left the window
    """

    data: list[Measurements]
    inputs: Input | None
    horizon: tuple[float, float]
    sequence: tuple[str, ...]
    times: FloatArray
    theta: FloatArray
    arrival: Arrival | None


def build_kept_problem(problem: Problem, kept: Kept) -> Problem:
    """Return the problem with other samples and inputs, which begins at what was found."""
    run, arrival = problem.experiments[0], kept.arrival
    states, offset = problem.unknowns.initial_states[0], int(problem.unknowns.is_time.sum())
    own = problem.system.initial_state if run.initial_state is None else run.initial_state
    places = states.tolist() if arrival is None else []
    initial: Any = own
    if any(place >= 0 for place in places):
        initial = [
            replace(entry, value=float(kept.theta[place - offset])) if place >= 0 else entry
            for entry, place in zip(own, places, strict=True)
        ]
    parameters = dict(problem.parameters)
    for name, of in problem.unknowns.parameters.items():
        shape = np.shape(parameters[name].value)
        value = kept.theta[of.start - offset : of.stop - offset].reshape(shape)
        parameters[name] = replace(parameters[name], value=value)
    data = kept.data
    if arrival is not None:
        initial, sensor = _describe_arrival(problem, arrival, kept.horizon[0])
        data = [sensor, *data]
        known = {ENTRIES: len(arrival.gradient) - len(arrival.center), STATES: int((states >= 0).sum())}
        parameters = {name: replace(parameter, prior=None) for name, parameter in parameters.items()}
        parameters |= {name: Parameter(np.zeros(size)) for name, size in known.items() if size}
    t0, tf = kept.horizon
    sequence, times = _drop_empty_modes(kept.sequence, np.clip(kept.times, t0, tf).tolist(), t0, tf)
    now = Experiment(
        tuple(data),
        sequence,
        times,
        t0,
        tf,
        inputs=kept.inputs,
        initial_state=initial,
        parameter_map=run.parameter_map,
    )
    return replace(problem, experiments=(now,), parameters=parameters)


def _drop_empty_modes(
    sequence: tuple[str, ...], times: list[float], t0: float, tf: float
) -> tuple[tuple[str, ...], tuple[float, ...]]:
    """Return a sequence and its times without modes of no length, which a wrong model or outliers make."""
    names: list[str] = []
    begins: list[float] = []
    for name, begin, end in zip(sequence, [t0, *times], [*times, tf], strict=True):
        if end > begin and names[-1:] != [name]:
            names.append(name)
            begins.append(begin)
    return tuple(names), tuple(begins[1:])


def _describe_arrival(problem: Problem, arrival: Arrival, t0: float) -> tuple[Any, Measurements]:
    """Return the initial state as a function of the parameters, and the cost of the samples before as a measurement.

    With ``H = R'R`` and ``g = R's`` the cost is ``|R d + s|^2 / 2`` but for a constant: R d is measured to be -s.
    """
    unknowns, run = problem.unknowns, problem.experiments[0]
    values, vectors = np.linalg.eigh(arrival.matrix)
    there = values > NO_EFFECT * values[-1]
    R = (vectors[:, there] * np.sqrt(values[there])).T
    s = (vectors[:, there] / np.sqrt(values[there])).T @ arrival.gradient
    own = {problem_name: name for name, problem_name in run.parameter_map.items()}
    names, has_entries = (
        [own.get(name, name) for name in unknowns.parameters],
        len(arrival.gradient) > len(arrival.center),
    )
    if (unknowns.initial_states[0] >= 0).any():
        names.append(STATES)

    def move(p: Any) -> Any:
        parameters = [jnp.ravel(jnp.asarray(p[name])) for name in names]
        entries = [p[ENTRIES]] if has_entries else []
        return jnp.concatenate([*entries, jnp.concatenate([*parameters, jnp.zeros(0)]) - arrival.center])

    def begin(p: Any) -> Any:
        return arrival.state + arrival.tangent @ move(p)

    sensor = Measurements([t0], [-s], observe=lambda t, x, p: R @ move(p), sigma=1.0)
    return begin, sensor
