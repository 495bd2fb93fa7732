"""Toy systems that several tests share, as a user would write them.

A system stands in a test itself only where its peculiarity is what the test is about. `systems.py` is something
else: nonlinear systems with every kind of cost, and the functions inside the package that differentiate them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from operator import call
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import switchfit as sf
from switchfit.meshes.evaluator import Evaluator
from switchfit.models import skid_steer

# Vector fields and observations


def decay(t, x, p):
    """x' = -k x."""
    return -p["k"] * x


def charge(t, x, p):
    """x' = k (1 - x)."""
    return p["k"] * (1.0 - x)


def rest(t, x, p):
    """x' = 0."""
    return 0.0 * x


def climb(t, x, p):
    """x' = v."""
    return p["v"] + 0.0 * x


def climb_at_one(t, x, p):
    """x' = 1."""
    return 0.0 * x + 1.0


def first_state(t, x, p):
    """The first state alone, (1,)."""
    return x[:1]


# A problem of one run

OF_RUN = ("inputs", "initial_state", "jumps", "name", "parameter_map", "time_unit")


def one_run(
    system: sf.HybridSystem, data: Any, sequence: Any, times: Any, tf: Any, parameters: Any = None, **settings: Any
) -> sf.Problem:
    """Return the problem of one run on [0, tf]; `settings` are those of `OF_RUN`, and of the problem."""
    of_run = {name: settings.pop(name) for name in OF_RUN if name in settings}
    run = sf.Experiment(data, sequence, times, 0.0, tf, **of_run)
    return sf.Problem(system, run, parameters or {}, **settings)


def simulate_log(problem: sf.Problem, truth: Any, seed: int) -> sf.Problem:
    """Return the problem of one run whose first data are what they would be at the truth, with noise of their sigma."""
    (run,) = problem.experiments
    log, *others = run.data
    theta = np.array(truth, dtype=float)
    seen = Evaluator(problem, theta).simulate(theta)[0].seen[0][: len(log.times)]
    values = seen + log.sigma * np.random.default_rng(seed).normal(size=seen.shape)
    return replace(problem, experiments=replace(run, data=[replace(log, values=values), *others]))


def fit_problem(
    problem: sf.Problem, *, success: Any = None, status: Any = None, level: Any = None, **settings: Any
) -> sf.Estimate:
    """Return the estimate, whose success, status and level of its verdict are those that are given."""
    found = sf.estimate(problem, **settings)
    assert success in (None, found.success), found.message
    assert status in (None, found.status), found.message
    assert level in (None, found.verdict.level), str(found)
    return found


# Calls that are refused


def refused(*rows: Any, by: Any = call, error: Any = (TypeError, ValueError), exact: bool = False) -> Any:
    """Return a test of rows (what `by` is given, message), or (what, error, message) where the error is another one.

    `by` calls what it is given, unless told. An `exact` error is that itself, and none of its kinds.
    """
    table = [(row[0], row[1] if len(row) == 3 else error, row[-1]) for row in rows]

    @pytest.mark.parametrize(("given", "expected", "message"), table)
    def check(given: Any, expected: Any, message: str) -> None:
        with pytest.raises(expected, match=message) as caught:
            by(given)
        assert not exact or type(caught.value) is expected

    return check


# A state at rest, for fits of a function of t and p


STILL = sf.HybridSystem({"still": rest}, [0.0])
"""x = 0: an observation ``h(t, x, p)`` is then a curve to fit."""


def curve(
    observe: Callable[..., Any],
    times: np.ndarray,
    values: np.ndarray,
    parameters: Mapping[str, Any],
    *,
    tf: float,
    **settings: Any,
) -> sf.Problem:
    """Fit ``observe(t, x, p)`` on [0, tf] to samples of it, with no dynamics behind it; `settings` of Measurements."""
    data = sf.Measurements(times, values, observe=observe, **settings)
    return sf.Problem(STILL, sf.Experiment(data, ("still",), (), 0.0, tf), parameters)


# A state that follows the cosine


def followed(times: np.ndarray, k: float) -> np.ndarray:
    """x(t) of x' = k (cos t - x) from 0."""
    return (k**2 * np.cos(times) + k * np.sin(times) - k**2 * np.exp(-k * times)) / (1.0 + k**2)


def slow_guess(k: float, seed: int) -> sf.Problem:
    """Ten noisy samples of it with sigma = 0.01; the guess is k = 1, for whose mesh a fast truth is too fast."""
    times = np.linspace(0.4, 4.0, 10)
    values = followed(times, k) + 0.01 * np.random.default_rng(seed).normal(size=10)
    system = sf.HybridSystem({"follow": lambda t, x, p: p["k"] * (jnp.cos(t) - x)}, [0.0])
    run = sf.Experiment(sf.Measurements(times, values, sigma=0.01), ("follow",), (), 0.0, 4.0)
    return sf.Problem(system, run, {"k": 1.0}, rtol=1e-5, atol=1e-7)


# Ramps


RAMP = sf.HybridSystem({"up": climb, "rest": rest}, [0.0])
"""x = v min(t, tau) with the unknown rate v."""

LATE_RAMP = sf.HybridSystem({"wait": rest, "ramp": climb_at_one}, [0.0])
"""x = max(t - tau, 0)."""


# Heating


def heated_room(start: float = 0.2, **settings: Any) -> sf.HybridSystem:
    """A room with a heater: x' = power - k x while it is on, -k x while it is off."""
    modes = {"on": lambda t, x, p: p["power"] - p["k"] * x, "off": decay}
    return sf.HybridSystem(modes, [start], **({"state_names": ("T",), "state_units": ("K",)} | settings))


def temperature(t, tau, power, k, *, start=0.2):
    """x(t) of `heated_room` whose heater goes off at tau, in closed form."""
    on = power / k + (start - power / k) * np.exp(-k * np.minimum(t, tau))
    return np.where(t <= tau, on, on * np.exp(-k * np.maximum(t - tau, 0.0)))


def approach(times, switches, rates, levels, start=0.2):
    """x(t) of ``x' = rate (level - x)``, whose rates and levels alternate between two at the switches."""
    edges, found, x = np.array([0.0, *switches, np.inf]), np.zeros(len(times)), start
    for i, (begin, end) in enumerate(pairwise(edges.tolist())):
        rate, level = rates[i % 2], levels[i % 2]
        inside = (times >= begin) & (times < end)
        found[inside] = level + (x - level) * np.exp(-rate * (times[inside] - begin))
        x = level + (x - level) * np.exp(-rate * (end - begin))
    return found


# Switching-time optimisation


def _fleet(u: float) -> Callable[..., Any]:
    return lambda t, x, p: jnp.stack([x[0] - x[0] * x[1] - 0.4 * u * x[0], x[0] * x[1] - x[1] - 0.2 * u * x[1]])


FISHING = sf.HybridSystem({"idle": _fleet(0.0), "fishing": _fleet(1.0)}, [0.5, 0.7])
"""Lotka-Volterra fishing, the fleet being out or not."""


EIGHT_SWITCHES, FIVE_SWITCHES = tuple(12.0 * np.arange(1, 9) / 9), tuple(np.arange(1, 6) / 6)


def fishing(times: Any = EIGHT_SWITCHES, **settings: Any) -> sf.Problem:
    """J is the integral of the squared deviation from (1, 1) over twelve time units; eight switches unless told.

    It has many local minima, most with collapsed modes.
    """
    cost = sf.RunningCost(lambda t, x, p: (x[0] - 1.0) ** 2 + (x[1] - 1.0) ** 2)
    sequence = (("idle", "fishing") * (len(times) + 1))[: len(times) + 1]
    return sf.Problem(FISHING, sf.Experiment(cost, sequence, times, 0.0, 12.0), **settings)


A1, A2 = np.array([[-1.0, 0.0], [1.0, 2.0]]), np.array([[1.0, 1.0], [1.0, -2.0]])
LINEAR = sf.HybridSystem({"A1": lambda t, x, p: A1 @ x, "A2": lambda t, x, p: A2 @ x}, [1.0, 1.0])
"""Two unstable linear modes: a standard example of switching-time optimisation."""


def linear(times: Any = FIVE_SWITCHES, **settings: Any) -> sf.Problem:
    """J is the integral of x'x over one time unit; five switches unless told."""
    sequence = (("A1", "A2") * (len(times) + 1))[: len(times) + 1]
    return one_run(LINEAR, sf.RunningCost(lambda t, x, p: x @ x), sequence, times, 1.0, **settings)


# A bouncing ball


BALL_G, BALL_HEIGHT = 9.8, 50.0


def ball_system(**settings: Any) -> sf.HybridSystem:
    """A ball that is dropped from 50 m; an impact takes it to ``(x, -e v)``."""
    fall = {"air": lambda t, x, p: jnp.stack([x[1], -BALL_G + 0 * x[0]])}
    bounce = {("air", "air"): lambda t, x, p: jnp.stack([x[0], -p["e"] * x[1]])}
    return sf.HybridSystem(fall, [BALL_HEIGHT, 0.0], bounce, **settings)


def ball(times: Any, *, e: float = 0.8, system: sf.HybridSystem | None = None) -> sf.Problem:
    """Its restitution e, between 0.1 and 1, is to bring it to 20 m at 15 s, with an impact at each of some times."""
    cost = sf.TerminalCost(lambda x, p: (x[0] - 20.0) ** 2)
    run = sf.Experiment(cost, ("air",) * (len(times) + 1), times, 0.0, 15.0)
    return sf.Problem(system or ball_system(), run, {"e": sf.Parameter(e, lower=0.1, upper=1.0)})


# Guards, reset maps, samples, a running cost, terminal constraints, all depending on t, x, p


CONSTRAINED = sf.HybridSystem(
    {
        "first": lambda t, x, p: jnp.stack([x[1] * jnp.cos(t), -p["a"] * x[0] + 0.3 * x[1] ** 2]),
        "second": lambda t, x, p: jnp.stack([p["b"] * x[1] ** 2 - x[0], jnp.sin(x[0]) * p["a"] - 0.2 * x[1]]),
    },
    lambda p: jnp.stack([1.0 + 0.1 * p["a"] ** 2, p["b"]]),
    reset_maps={("first", "second"): lambda t, x, p: jnp.stack([x[0] * p["a"], x[1] + 0.1 * x[0] ** 2 * t])},
    guards={
        ("first", "second"): lambda t, x, p: x[0] * p["b"] - jnp.sin(t) * x[1],
        ("second", "first"): lambda t, x, p: p["a"] ** 2 * x[1] ** 2 + t * x[0] - 1.0,
    },
)
CONSTRAINED_SAMPLES = sf.Measurements([0.5, 1.4, 2.6], [[0.3, 0.2], [0.4, -0.2], [0.1, 0.5]], sigma=0.5)


def constrained(times: Any = (1.0, 2.0), *, second_run: bool = False, **settings: Any) -> sf.Problem:
    """Fit `CONSTRAINED` on [0, 3] with two transitions; a second run has one, and samples alone."""
    data = [
        CONSTRAINED_SAMPLES,
        sf.RunningCost(lambda t, x, p: p["b"] * x[0] ** 2 * jnp.cos(t)),
        sf.TerminalConstraint(lambda x, p: jnp.stack([x[0] * x[1] - p["a"], p["b"] * x[0] ** 2])),
    ]
    runs = [sf.Experiment(data, ("first", "second", "first"), times, 0.0, 3.0)]
    if second_run:
        runs.append(sf.Experiment(CONSTRAINED_SAMPLES, ("second", "first"), (1.2,), 0.0, 3.0))
    return sf.Problem(CONSTRAINED, runs, {"a": 0.7, "b": 0.4}, **settings)


# The paper's vehicle


MU = {"lower": 0.05, "upper": 2.0}
VEHICLE_TRUTH = np.array([6.0, 10.0, 0.7])
"""tau_1, tau_2 and mu of the paper's simulated drive."""


def drive(data: Any, guess: Any = (5.0, 9.0, 0.8)) -> sf.Problem:
    """Fit the paper's vehicle on [0, 15] s: it sticks, slips and sticks; two transition times and the friction."""
    run = sf.Experiment(data, ("stick", "slip", "stick"), guess[:2], 0.0, 15.0)
    return sf.Problem(skid_steer(), run, {"mu": sf.Parameter(guess[2], **MU)})


def positions(times: np.ndarray, sigma: float) -> sf.Measurements:
    """Measurements of X and Y, all zero: values to be replaced."""
    observe = lambda t, x, p: x[jnp.array([0, 2])]  # noqa: E731
    return sf.Measurements(times, np.zeros((len(times), 2)), observe, sigma=sigma, names=("X", "Y"))


def tracked_drive() -> sf.Problem:
    """The paper's experiment: the simulated states as a continuous reference, (18)."""
    times = np.linspace(0.0, 15.0, 151)
    path = sf.simulate(drive(sf.Measurements(times, np.zeros((151, 6))), VEHICLE_TRUTH))
    return drive(sf.ReferenceSignal.from_samples(path.times, path.states))
