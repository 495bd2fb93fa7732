"""Fits to simulated logs: a ball, a thermostat, an epidemic, many runs; and ten measured tosses."""

from __future__ import annotations

from typing import Any

import numpy as np

import switchfit as sf
from benchmarks.starts.case import Case, draw_anywhere, sample_states


def _on(t: Any, x: Any, p: Any) -> Any:
    return p["power"] - p["k"] * x


def _off(t: Any, x: Any, p: Any) -> Any:
    return -p["k"] * x


ROOM = sf.HybridSystem({"on": _on, "off": _off}, [0.2], state_names=("T",), state_units=("K",))
HEATED = np.array([1.83, 3.4, 5.32, 6.7, 8.1, 1.0, 0.8])


def thermostat(count: int = 64) -> Case:
    """A room whose heater goes on and off three times, forty samples: five times, power and loss, over all bounds."""
    times = np.linspace(0.25, 10.0, 40)
    parameters = {"power": sf.Parameter(1.2, lower=0.2, upper=5.0), "k": sf.Parameter(0.6, lower=0.05, upper=3.0)}

    def build(values: np.ndarray) -> sf.Problem:
        data = sf.Measurements(times, values, sigma=0.02)
        run = sf.Experiment(data, ("on", "off") * 3, (1.5, 3.5, 5.0, 6.5, 8.5), 0.0, 10.0)
        return sf.Problem(ROOM, run, parameters)

    temperatures = sample_states(build(np.zeros(40)), HEATED, times)[:, 0]
    problem = build(temperatures + np.random.default_rng(1).normal(0.0, 0.02, 40))
    return Case(problem, HEATED, draw_anywhere(problem, count, seed=4), noisy=True)
