"""Fits to logs: a thermostat, an epidemic, many runs and an enzyme, simulated; ten measured tosses."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from benchmarks import problems
from benchmarks.fits import tosses_starts
from benchmarks.starts.case import Case, draw_anywhere, draw_around, sample_states


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


POPULATION, SEEDED, DAYS = 1e6, 100.0, 120
MEASURES = np.array([30.0, 62.0, 90.0, 0.30, 0.08, 0.1])
"""Days on which contacts are restricted, freed and restricted again; contact rates open and restricted, recovery."""


def epidemic(count: int = 64) -> Case:
    """An SIR epidemic with measures on, off and on again on unknown days: dates, two rates and the recovery."""
    times = np.arange(1.0, DAYS + 1.0)

    def build(values: np.ndarray) -> sf.Problem:
        data = sf.Measurements(times, values, observe=_root_of_infected, sigma=0.5, names=("root of infected",))
        sequence = ("open", "restricted", "open", "restricted")
        run = sf.Experiment(data, sequence, (25.0, 55.0, 95.0), 0.0, float(DAYS), time_unit="d")
        parameters = {
            "open": sf.Parameter(0.25, lower=0.05, upper=1.0, unit="1/d"),
            "restricted": sf.Parameter(0.1, lower=0.01, upper=0.5, unit="1/d"),
            "recovery": sf.Parameter(0.12, lower=0.03, upper=0.5, unit="1/d"),
        }
        return sf.Problem(EPIDEMIC, run, parameters)

    infected = sample_states(build(np.zeros(DAYS)), MEASURES, times)[:, 1]
    problem = build(np.sqrt(infected) + np.random.default_rng(1).normal(0.0, 0.5, DAYS))
    return Case(problem, MEASURES, draw_anywhere(problem, count, seed=7), noisy=True)


def _spread(rate: str) -> Any:
    def mode(t: Any, x: Any, p: Any) -> Any:
        new = p[rate] * x[0] * x[1] / POPULATION
        return jnp.stack([-new, new - p["recovery"] * x[1]])

    return mode


def _root_of_infected(t: Any, x: Any, p: Any) -> Any:
    return jnp.sqrt(x[1:])


EPIDEMIC = sf.HybridSystem(
    {rate: _spread(rate) for rate in ("open", "restricted")},
    [POPULATION - SEEDED, SEEDED],
    state_names=("susceptible", "infected"),
)

RUNS, BADLY = 200, 10


def many_runs(count: int = 5) -> Case:
    """200 heated rooms with one loss coefficient, each with its own power and time; ten of them start badly."""
    random = np.random.default_rng(8)
    times = np.linspace(0.25, 6.0, 24)
    truth = np.concatenate([random.uniform(1.5, 4.5, RUNS), [0.5], random.uniform(0.8, 1.5, RUNS)])

    def build(values: np.ndarray) -> sf.Problem:
        runs = [
            sf.Experiment(
                sf.Measurements(times, values[e], sigma=0.02),
                ("on", "off"),
                (3.0,),
                0.0,
                6.0,
                parameter_map={"power": f"power_{e}"},
                name=f"room{e}",
            )
            for e in range(RUNS)
        ]
        own = {f"power_{e}": sf.Parameter(1.0, lower=0.01, upper=50.0) for e in range(RUNS)}
        return sf.Problem(ROOM, runs, {"k": sf.Parameter(0.4, lower=0.01, upper=5.0), **own})

    tau, k, power = truth[:RUNS, None], truth[RUNS], truth[RUNS + 1 :, None]
    rising = power / k + (0.2 - power / k) * np.exp(-k * np.minimum(times, tau))
    temperatures = rising * np.exp(-k * np.maximum(times - tau, 0.0))
    problem = build(temperatures + random.normal(0.0, 0.02, temperatures.shape))
    starts = np.array([_start_badly(truth, np.random.default_rng(k)) for k in range(count)])
    return Case(problem, truth, starts, noisy=True)


def _start_badly(truth: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return a start near the truth but for ten runs, which begin with a time at an end and a power far off."""
    near = 1.0 + random.uniform(-0.1, 0.1, len(truth))
    start = truth * near
    bad = random.choice(RUNS, BADLY, replace=False)
    start[bad] = random.choice([0.05, 5.9], BADLY)
    start[RUNS + 1 + bad] *= random.choice([0.05, 20.0], BADLY)
    return start


TOSSED = (
    (0.32979, -0.0790, -0.0502, -0.5343, -0.5013),
    (0.22780, -0.0402, -0.0116, -0.3148, -0.3788),
    (0.33857, -0.0244, 0.0416, -0.5895, -0.3679),
    (0.29611, -0.0739, -0.0437, -0.4834, -0.3683),
    (0.19228, -0.0090, -0.0063, -0.4383, -0.0942),
    (0.29496, -0.0322, 0.0258, -0.6001, -0.0797),
    (0.31575, -0.0171, -0.0218, -0.6337, -0.1579),
    (0.26752, -0.1056, -0.0451, -0.5784, -0.1166),
    (0.19043, -0.0230, -0.0591, -0.0599, 0.4208),
    (0.14895, -0.0532, -0.0411, -0.0995, 0.2891),
)
"""Time of sticking (s), position (m) and velocity (m/s) of each toss, and below the friction of all: from there the
joint fit ends at the least cost that a scan over the sample intervals of one toss after the other has found."""
TOSSED_FRICTION = 0.2092


def ten_tosses(count: int = 100) -> Case:
    """Ten measured tosses jointly, from the perturbed starts of the part `fits`."""
    found = np.array(TOSSED)
    near = np.concatenate([found[:, 0], [TOSSED_FRICTION], found[:, 1:].ravel()])
    return Case(problems.tosses(), near, np.array(tosses_starts(count)))


ENZYME = np.array([20.0, 5.0, 8.0, 0.02])
"""Rates of binding, release and turnover (1/s) and the amount of enzyme in the data of `enzyme`."""
ENZYME_FITTED = np.array([30.245748, 15.382107, 2.1567848, 0.071636938])
"""The optimum of the fit to these data."""


def enzyme(count: int = 64) -> Case:
    """An enzyme seen by its product alone, without transitions: a curved valley.

    Binding and release can hardly be told apart: at the optimum the smallest eigenvalue of the Hessian, its diagonal
    scaled to one, is 3e-7.
    """
    times = np.arange(1.0, 31.0)

    def build(values: np.ndarray) -> sf.Problem:
        data = sf.Measurements(times, values, observe=_product, sigma=0.001, names=("product",))
        given = zip(("binding", "release", "turnover", "enzyme"), ENZYME, strict=True)
        parameters = {name: sf.Parameter(value, lower=value / 30, upper=value * 30) for name, value in given}
        return sf.Problem(REACTION, sf.Experiment(data, ("reacts",), (), 0.0, 30.0), parameters)

    product = sample_states(build(np.zeros(30)), ENZYME, times)[:, 2]
    problem = build(product + np.random.default_rng(1).normal(0.0, 0.001, 30))
    starts = ENZYME * np.exp(draw_around(np.zeros(4), np.full(4, np.log(3.0)), count, seed=1))
    return Case(problem, ENZYME_FITTED, starts)


def _reacts(t: Any, x: Any, p: Any) -> Any:
    substrate, bound, _ = x
    binds = p["binding"] * (p["enzyme"] - bound) * substrate - p["release"] * bound
    reacts = p["turnover"] * bound
    return jnp.stack([-binds, binds - reacts, reacts])


def _product(t: Any, x: Any, p: Any) -> Any:
    return x[2:]


REACTION = sf.HybridSystem({"reacts": _reacts}, [1.0, 0.0, 0.0], state_names=("substrate", "bound", "product"))
