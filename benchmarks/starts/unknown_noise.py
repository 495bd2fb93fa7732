"""Fits to logs whose noise is not known: a spring and a population with sigma left out, predators with outliers.

Without sigma there is no chi-square: only the correlation of the residuals tells a wrong end that explains 98 % of the
data from the right one. With outliers and a robust loss, it is the size of the typical residual.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from benchmarks.starts.case import Case, bound_around, draw_anywhere, sample_states


def _spring(stiffness: str) -> Any:
    return lambda t, x, p: jnp.stack([x[1], -p[stiffness] * x[0] - p["damping"] * x[1]])


SPRING = sf.HybridSystem({"soft": _spring("soft"), "hard": _spring("hard")}, [1.0, 0.0], state_names=("x", "v"))
STIFF = {"soft": 2.0, "hard": 10.0, "damping": 0.15}


def spring(count: int = 40) -> Case:
    """A vibration that is stiff for a while: two times, two stiffnesses and the damping, over all bounds."""
    times = np.linspace(0.0, 10.0, 81)[1:]

    def build(values: np.ndarray) -> sf.Problem:
        data = sf.Measurements(times, values, observe=lambda t, x, p: x[:1])
        run = sf.Experiment(data, ("soft", "hard", "soft"), (2.0, 8.0), 0.0, 10.0)
        return sf.Problem(SPRING, run, bound_around(STIFF))

    near = np.array([4.3, 6.6, *STIFF.values()])
    positions = sample_states(build(np.zeros((80, 1))), near, times)[:, :1]
    problem = build(positions + np.random.default_rng(1).normal(0.0, 0.02, positions.shape))
    return Case(problem, near, draw_anywhere(problem, count, seed=11), noisy=True)


def _grow(capacity: str) -> Any:
    return lambda t, x, p: p["rate"] * x * (1 - x / p[capacity])


CULTURE = sf.HybridSystem(
    {"narrow": _grow("narrow"), "wide": _grow("wide")}, lambda p: jnp.stack([p["start"]]), state_names=("cells",)
)
CAPACITIES = {"rate": 0.9, "narrow": 8.4, "wide": 20.0, "start": 1.0}


def growth(count: int = 40) -> Case:
    """A population whose capacity grows once: one time, rate, both capacities and the first number, over all bounds."""
    times = np.linspace(0.0, 20.0, 61)[1:]

    def build(values: np.ndarray) -> sf.Problem:
        run = sf.Experiment(sf.Measurements(times, values), ("narrow", "wide"), (15.0,), 0.0, 20.0)
        return sf.Problem(CULTURE, run, bound_around(CAPACITIES))

    near = np.array([8.88, *CAPACITIES.values()])
    cells = sample_states(build(np.zeros((60, 1))), near, times)
    problem = build(cells + np.random.default_rng(1).normal(0.0, 0.2, cells.shape))
    return Case(problem, near, draw_anywhere(problem, count, seed=12), noisy=True)


def _prey(death: str) -> Any:
    return lambda t, x, p: jnp.stack([x[0] * (p["birth"] - p["eaten"] * x[1]), x[1] * (p["fed"] * x[0] - p[death])])


POND = sf.HybridSystem({"calm": _prey("calm"), "hunted": _prey("hunted")}, [5.0, 3.0], state_names=("prey", "hunters"))
POND_RATES = {"birth": 1.0, "eaten": 0.4, "fed": 0.15, "calm": 0.65, "hunted": 1.1}


def predators(count: int = 40) -> Case:
    """Predators that are hunted from some day on, a twentieth of all counts wrong, a robust loss: over half to twice
    the rates."""
    times = np.linspace(0.0, 20.0, 101)[1:]

    def build(values: np.ndarray) -> sf.Problem:
        data = sf.Measurements(times, values, sigma=0.3, loss="soft_l1")
        run = sf.Experiment(data, ("calm", "hunted"), (5.0,), 0.0, 20.0)
        rates = {name: sf.Parameter(0.7 * v, lower=0.5 * v, upper=2 * v) for name, v in POND_RATES.items()}
        return sf.Problem(POND, run, rates)

    near = np.array([11.0, *POND_RATES.values()])
    counts = sample_states(build(np.zeros((100, 2))), near, times)
    random = np.random.default_rng(1)
    counts = counts + random.normal(0.0, 0.3, counts.shape)
    counts += (random.random(counts.shape) < 0.05) * random.normal(0.0, 8.0, counts.shape)
    problem = build(counts)
    return Case(problem, near, draw_anywhere(problem, count, seed=13), noisy=True)
