"""Simulated logs with a state that is not measured: of two tanks one level is seen, of a pendulum the angle."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from benchmarks.modes.truths import LENGTH, Make, Truth, draw_sequence, draw_times
from benchmarks.starts.applications import TANK_MODES

STEP, SHORTEST, MOST_SWITCHES, OFF = 0.1, 1.0, 4, 0.8
"""Sample interval and shortest mode (s), switches of a truth, and the part of all parameters that is the guess."""

TANKS = sf.HybridSystem(TANK_MODES, [1.0, 0.5], state_names=("upper", "lower"))
FLOWS = {"pump": 0.5, "pipe": 0.6, "drain": 0.3}


def _swing(brake: bool, drive: bool) -> Callable[..., Any]:
    def mode(t: Any, x: Any, p: Any) -> Any:
        damping = p["brake"] if brake else 0.05
        return jnp.stack([x[1], -9.81 * jnp.sin(x[0]) - damping * x[1] + (p["torque"] if drive else 0.0)])

    return mode


PENDULUM = sf.HybridSystem(
    {"free": _swing(False, False), "braked": _swing(True, False), "driven": _swing(False, True)},
    [0.8, 0.0],
    state_names=("angle", "speed"),
)
TORQUES = {"brake": 1.0, "torque": 3.0}


def two_tanks(lacking: bool = False) -> Make:
    """Return simulations of two tanks: a pump into the upper one, a valve to the lower one, whose level is measured."""
    return _simulate(TANKS, FLOWS, lambda t, x, p: x[1:], 0.01, 20_000, lacking)


def pendulum(lacking: bool = False) -> Make:
    """Return simulations of a pendulum that swings, is braked or driven; its angle is measured."""
    return _simulate(PENDULUM, TORQUES, lambda t, x, p: x[:1], 0.01, 30_000, lacking)


def _simulate(
    system: sf.HybridSystem,
    parameters: dict[str, float],
    observe: Callable[..., Any],
    sigma: float,
    first_seed: int,
    lacking: bool,
) -> Make:
    """Return simulations of 1 to 4 switches; `lacking`: the library has not the mode in the middle of the truth."""
    at = STEP * np.arange(1, round(LENGTH / STEP) + 1)

    def build(values: np.ndarray, sequence: tuple[str, ...], times: tuple[float, ...], part: float) -> sf.Problem:
        data = sf.Measurements(at, values, observe=observe, sigma=sigma, names=("seen",))
        guess = {name: sf.Parameter(part * v, lower=v / 10, upper=10 * v) for name, v in parameters.items()}
        return sf.Problem(system, sf.Experiment(data, sequence, times, 0.0, LENGTH), guess)

    def make(seed: int) -> Truth:
        random = np.random.default_rng(first_seed + seed)
        switches = int(random.integers(1, MOST_SWITCHES + 1))
        sequence = draw_sequence(random, tuple(system.modes), switches + 1)
        times = draw_times(random, switches, SHORTEST)
        truth = build(np.zeros((len(at), 1)), sequence, tuple(times), 1.0)
        states = sf.simulate(truth, times="samples").states
        clean = np.array([observe(0.0, x, parameters) for x in states])
        missing = sequence[switches // 2 + 1] if lacking else ""
        library = tuple(name for name in system.modes if name != missing)
        problem = build(clean + random.normal(0.0, sigma, clean.shape), library[:1], (), OFF)
        settings = {"library": library, "max_switches": MOST_SWITCHES + 2, "min_duration": SHORTEST / 4}
        return Truth(problem, sequence, times, np.array([*parameters.values()]), settings, not lacking)

    return make
