"""Fits to simulated logs of six kinds: friction, tanks, a house, doses, a battery, a motor; states that nobody sees.

Times begin anywhere in order, parameters within a factor of 2 of the truth.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from benchmarks.starts.case import Case, bound_around, draw_anywhere, draw_around, sample_states

Build = Callable[[list[sf.Measurements]], sf.Problem]
"""A function that makes a problem of the measurements of each run."""

G = 9.81


def _slide(push: str | None, falling: float = 0.0) -> Any:
    """Return a mode of a block; its friction falls by that part while it gains speed."""

    def mode(t: Any, x: Any, p: Any) -> Any:
        mu = p["mu"] * (1 + falling * jnp.exp(-((x[1] / 0.4) ** 2)))
        return jnp.stack([x[1], (p[push] if push else 0.0) - mu * G * x[1] / jnp.sqrt(x[1] ** 2 + 1e-12)])

    return mode


def _build_block(falling: float) -> sf.HybridSystem:
    modes = {"push": _slide("a", falling), "slide": _slide(None, falling)}
    return sf.HybridSystem(modes, [0.0, 0.0], state_names=("x", "v"), state_units=("m", "m/s"))


BLOCK, REAL_BLOCK = _build_block(0.0), _build_block(0.1)


def friction(count: int = 40) -> Case:
    """A block that is pushed twice, slides and rests: three times, friction and push.

    Sigma is that of the instrument, and the friction of the log falls by a tenth with the speed, which the model does
    not know: J at the best is 2.6 times that of noise.
    """
    times, near = np.arange(1, 151) * 0.02, np.array([0.5, 1.05, 1.5, 0.3, 6.0])

    def build(system: sf.HybridSystem, values: np.ndarray) -> sf.Problem:
        data = sf.Measurements(times, values, observe=_first, sigma=5e-4, names=("x",))
        run = sf.Experiment(data, ("push", "slide", "push", "slide"), (0.75, 1.5, 2.25), 0.0, 3.0)
        return sf.Problem(system, run, bound_around({"mu": 0.3, "a": 6.0}))

    positions = sample_states(build(REAL_BLOCK, np.zeros((150, 1))), near, times)[:, :1]
    problem = build(BLOCK, positions + np.random.default_rng(1).normal(0.0, 5e-4, (150, 1)))
    return Case(problem, near, _draw(problem, near, count, seed=21))


def _first(t: Any, x: Any, p: Any) -> Any:
    return x[:1]


def _last(t: Any, x: Any, p: Any) -> Any:
    return x[1:2]


def _fill(pump: bool, valve: bool) -> Any:
    def mode(t: Any, x: Any, p: Any) -> Any:
        through = p["pipe"] * x[0] if valve else 0.0
        return jnp.stack([(p["pump"] if pump else 0.0) - through, through - p["drain"] * x[1]])

    return mode


TANK_MODES = {
    "closed": _fill(False, False),
    "fill": _fill(True, False),
    "open": _fill(False, True),
    "fill_open": _fill(True, True),
}
"""Pump on or off, valve open or not; states are the levels of the upper and the lower tank."""

TANKS = sf.HybridSystem(
    TANK_MODES,
    lambda p: jnp.stack([p["upper"], 0.1 + 0.0 * p["upper"]]),
    state_names=("upper", "lower"),
    state_units=("m", "m"),
)


def tanks(count: int = 40) -> Case:
    """A pump fills a tank whose level nobody sees, a valve opens to a second one: four times, flows, first level."""
    times, truth = np.arange(1, 61) * 10.0, {"pump": 0.004, "pipe": 0.01, "drain": 0.006, "upper": 0.3}

    def build(logs: list[sf.Measurements]) -> sf.Problem:
        run = sf.Experiment(
            logs[0], ("fill", "fill_open", "open", "closed", "open"), (120.0, 240.0, 360.0, 480.0), 0.0, 600.0
        )
        return sf.Problem(TANKS, run, bound_around(truth))

    return _simulate(build, times, 0.005, ("lower",), (90.0, 230.0, 330.0, 440.0), truth, count, seed=22, observe=_last)


HEATING, OUTSIDE = 4.0, 3.0
"""kW, °C."""


def _heat(power: float) -> Any:
    def mode(t: Any, x: Any, p: Any) -> Any:
        across = p["across"] * (x[0] - x[1])
        living = (power - across - p["loss_1"] * (x[0] - OUTSIDE)) / p["capacity_1"]
        return jnp.stack([living, (across - p["loss_2"] * (x[1] - OUTSIDE)) / p["capacity_2"]])

    return mode


HOUSE = sf.HybridSystem(
    {"off": _heat(0.0), "on": _heat(HEATING)},
    [17.0, 15.0],
    state_names=("living", "sleeping"),
    state_units=("°C", "°C"),
)


def house(count: int = 40) -> Case:
    """A heater in one of two zones goes on and off twice: four times, capacities (kWh/K), losses, coupling (kW/K)."""
    truth = {"capacity_1": 1.2, "capacity_2": 0.8, "loss_1": 0.1, "loss_2": 0.06, "across": 0.12}
    times = np.arange(1, 97) * 0.25

    def build(logs: list[sf.Measurements]) -> sf.Problem:
        run = sf.Experiment(
            logs[0], ("off", "on", "off", "on", "off"), (5.0, 9.0, 14.0, 19.0), 0.0, 24.0, time_unit="h"
        )
        return sf.Problem(HOUSE, run, bound_around(truth))

    return _simulate(build, times, 0.1, ("living", "sleeping"), (4.6, 8.3, 15.4, 21.2), truth, count, seed=23)


def _wait(t: Any, x: Any, p: Any) -> Any:
    return 0.0 * x


def _absorb(t: Any, x: Any, p: Any) -> Any:
    absorbed = p["absorption"] * x[0]
    return jnp.stack([-absorbed, absorbed / p["volume"] - p["elimination"] * x[1]])


DOSE = sf.HybridSystem(
    {"waits": _wait, "absorbs": _absorb}, [100.0, 0.0], state_names=("gut", "plasma"), state_units=("mg", "mg/L")
)


def doses(count: int = 40) -> Case:
    """An oral dose in six subjects, absorbed after a lag: each with its lag and elimination, the rest in common."""
    times = np.array([0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0])
    lags = [0.33, 0.61, 0.44, 0.92, 0.29, 0.68]
    truth = {"absorption": 1.4, "volume": 32.0}
    truth |= {f"elimination_{k}": v for k, v in enumerate((0.16, 0.24, 0.2, 0.13, 0.3, 0.18))}

    def build(logs: list[sf.Measurements]) -> sf.Problem:
        runs = [
            sf.Experiment(
                one,
                ("waits", "absorbs"),
                (1.0,),
                0.0,
                12.0,
                time_unit="h",
                parameter_map={"elimination": f"elimination_{k}"},
                name=f"subject{k}",
            )
            for k, one in enumerate(logs)
        ]
        return sf.Problem(DOSE, runs, bound_around(truth))

    return _simulate(build, times, 0.05, ("plasma",), lags, truth, count, seed=24, observe=_last, runs=6)


CURRENT = 2.0


def _load(current: float) -> Any:
    def mode(t: Any, x: Any, p: Any) -> Any:
        fast, slow = x
        return jnp.stack(
            [(p["R_fast"] * current - fast) / p["tau_fast"], (p["R_slow"] * current - slow) / p["tau_slow"]]
        )

    return mode


BATTERY = sf.HybridSystem(
    {"rest": _load(0.0), "load": _load(CURRENT)}, [0.0, 0.0], state_names=("fast", "slow"), state_units=("V", "V")
)


def battery(count: int = 40) -> Case:
    """A battery is loaded twice and relaxes: four times, two RC pairs, from what its voltage loses."""
    truth = {"R_fast": 0.02, "tau_fast": 8.0, "R_slow": 0.03, "tau_slow": 90.0}
    times = np.arange(1, 151) * 4.0

    def build(logs: list[sf.Measurements]) -> sf.Problem:
        run = sf.Experiment(logs[0], ("rest", "load", "rest", "load", "rest"), (100.0, 200.0, 300.0, 400.0), 0.0, 600.0)
        return sf.Problem(BATTERY, run, bound_around(truth))

    switches = (47.0, 171.0, 322.0, 407.0)
    return _simulate(build, times, 0.001, ("loss",), switches, truth, count, seed=25, observe=_sum)


def _sum(t: Any, x: Any, p: Any) -> Any:
    return jnp.stack([x[0] + x[1]])


def _turn(direction: float) -> Any:
    return lambda t, x, p: jnp.stack([x[1], p["gain"] * direction - p["spring"] * x[0] - p["drag"] * x[1]])


MOTOR = sf.HybridSystem(
    {"off": _turn(0.0), "forward": _turn(1.0), "back": _turn(-1.0)}, [0.0, 0.0], state_names=("angle", "speed")
)


def reference(count: int = 40) -> Case:
    """A motor on a spring, its angle as a reference signal with noise: five times, gain, spring and drag."""
    truth, times = {"gain": 3.0, "spring": 4.0, "drag": 0.4}, np.linspace(0.0, 12.0, 121)
    near = np.array([1.8, 3.1, 5.9, 8.2, 9.7, *truth.values()])

    def build(data: sf.Measurements | sf.ReferenceSignal) -> sf.Problem:
        sequence = ("forward", "off", "back", "off", "forward", "off")
        return sf.Problem(
            MOTOR, sf.Experiment(data, sequence, (2.0, 4.0, 6.0, 8.0, 10.0), 0.0, 12.0), bound_around(truth)
        )

    angles = sample_states(build(sf.Measurements(times, np.zeros((121, 2)))), near, times)[:, :1]
    noisy = angles + np.random.default_rng(1).normal(0.0, 0.02, angles.shape)
    problem = build(sf.ReferenceSignal.from_samples(times, noisy, observe=_first, names=("angle",)))
    return Case(problem, near, _draw(problem, near, count, seed=26))


def _simulate(
    build: Build,
    times: np.ndarray,
    sigma: float,
    names: tuple[str, ...],
    switches: Sequence[float],
    truth: dict[str, float],
    count: int,
    seed: int,
    observe: Callable[..., Any] | None = None,
    runs: int = 1,
) -> Case:
    """Return the case of logs that are simulated at the truth, with noise; `seed` is that of the starts."""
    near = np.array([*switches, *truth.values()])

    def measure(values: np.ndarray) -> sf.Measurements:
        return sf.Measurements(times, values, observe=observe, sigma=sigma, names=names)

    empty = build([measure(np.zeros((len(times), len(names))))] * runs)
    random, logs = np.random.default_rng(1), []
    for e in range(runs):
        states = sf.simulate(empty, near, times="samples", experiment=e).states
        exact = states if observe is None else np.array([observe(0.0, x, truth) for x in states])
        logs.append(measure(exact + random.normal(0.0, sigma, exact.shape)))
    problem = build(logs)
    return Case(problem, near, _draw(problem, near, count, seed), noisy=True)


def _draw(problem: sf.Problem, near: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Return starts (count, d): times anywhere in order, parameters within a factor of 2 of `near`."""
    factors = 2.0 ** draw_around(np.zeros(len(near)), np.ones(len(near)), count, seed)
    return np.where(problem.unknowns.is_time, draw_anywhere(problem, count, seed), near * factors)
