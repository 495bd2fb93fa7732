"""A ball with eight bounces whose times are known to 30 ms, with the ground as a guard and without."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from benchmarks.starts.case import Case, draw_around, sample_states

GRAVITY, END, SIGMA = 9.81, 3.45, 0.005
BOUNCES = 8
FALL = np.array([0.8, 1.0, 0.5])
"""Restitution, height (m) and speed upwards (m/s) at the start."""
SPREAD = np.array([0.03] * BOUNCES + [0.1, 0.1, 0.3])


def ball_on_guards(count: int = 100) -> Case:
    """An impact is where the height is 0."""
    return _ball(GUARDED, count)


def ball_without_guards(count: int = 100) -> Case:
    """The times of the impacts are unknowns like any other."""
    return _ball(FREE, count)


def impact_times(e: float, height: float, speed: float) -> np.ndarray:
    """Return the times of the impacts in closed form."""
    down = np.sqrt(speed**2 + 2 * GRAVITY * height)
    flights = 2 * down / GRAVITY * e ** np.arange(1, BOUNCES)
    return np.cumsum([(speed + down) / GRAVITY, *flights])


def _ball(system: sf.HybridSystem, count: int) -> Case:
    truth = np.concatenate([impact_times(*FALL), FALL])
    times = np.arange(1, int(END / 0.02) + 1) * 0.02

    def build(values: np.ndarray, theta: np.ndarray) -> sf.Problem:
        data = sf.Measurements(times, values, observe=_height, sigma=SIGMA, names=("height",))
        run = sf.Experiment(data, ("air",) * (BOUNCES + 1), tuple(theta[:BOUNCES]), 0.0, END)
        e, height, speed = theta[BOUNCES:]
        parameters = {
            "e": sf.Parameter(e, lower=0.1, upper=1.0),
            "height": sf.Parameter(height, lower=0.1, upper=3.0, unit="m"),
            "speed": sf.Parameter(speed, lower=-3.0, upper=3.0, unit="m/s"),
        }
        return sf.Problem(system, run, parameters)

    heights = sample_states(build(np.zeros(len(times)), truth), truth, times)[:, 0]
    starts = draw_around(truth, SPREAD, count, seed=0)
    problem = build(heights + np.random.default_rng(1).normal(0.0, SIGMA, len(times)), starts[0])
    return Case(problem, truth, starts, noisy=True)


def _air(t: Any, x: Any, p: Any) -> Any:
    return jnp.stack([x[1], -GRAVITY + 0.0 * x[0]])


def _bounce(t: Any, x: Any, p: Any) -> Any:
    return jnp.stack([x[0], -p["e"] * x[1]])


def _height(t: Any, x: Any, p: Any) -> Any:
    return x[:1]


def _start(p: Any) -> Any:
    return jnp.stack([p["height"], p["speed"]])


FREE = sf.HybridSystem({"air": _air}, _start, reset_maps={("air", "air"): _bounce}, state_names=("z", "vz"))
GUARDED = sf.HybridSystem(
    {"air": _air},
    _start,
    reset_maps={("air", "air"): _bounce},
    guards={("air", "air"): lambda t, x, p: x[0]},
    state_names=("z", "vz"),
)
