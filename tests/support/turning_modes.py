"""Logs of a state that rises, turns and falls, whose mode sequence is searched for."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from support.mode_libraries import fall, rise

TIMES = np.linspace(0.0, 8.0, 81)
SIGMA = 0.05
FREE = {"rate": sf.Parameter(0.8, lower=0.1, upper=3.0)}


def turn(t, x, p):
    return p["rate"] * jnp.stack([-x[1], x[0]])


SYSTEM = sf.HybridSystem({"rise": rise, "fall": fall, "turn": turn}, [0.2, 1.0])


SEQUENCE, SWITCHES = ("rise", "turn", "fall"), (2.5, 5.5)


def simulate(sequence=SEQUENCE, times=SWITCHES, seed=0, sigma=SIGMA, system=SYSTEM, force=5.0):
    """Values of both states with noise, rate being 1."""
    run = sf.Experiment(sf.RunningCost(lambda t, x, p: x[0]), sequence, times, 0.0, 8.0)
    problem = sf.Problem(system, run, {"rate": 1.0, "force": force}, max_transitions=3)
    states = sf.simulate(problem, times=TIMES).states
    return states + sigma * np.random.default_rng(seed).standard_normal(states.shape)


def make_run(
    sequence=SEQUENCE, times=SWITCHES, seed=0, name=None, given=("rise",), values=None, at=TIMES, start=None, **log
):
    values = simulate(sequence, times, seed) if values is None else values
    data = sf.Measurements(at, values, **({"sigma": SIGMA} | log))
    return sf.Experiment(data, given, (), 0.0, 8.0, initial_state=start, name=name)


def make_problem(*, system=SYSTEM, parameters=FREE, **changes):
    return sf.Problem(system, make_run(**changes), parameters)


def kinds_of(warnings, kind):
    return [warning for warning in warnings if warning.kind == kind]


CHAIN = {"first": "rise", "last": "fall", "successions": {"rise": "turn", "turn": "fall"}}
