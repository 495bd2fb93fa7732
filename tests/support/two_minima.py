"""Problems that have a wrong minimum beside the right one, and guesses that lead to the wrong one.

A local fit ends at the wrong one, and looks good there; `test_other_minima.py` has the strategies find the right one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from support.models import first_state, one_run, simulate_log
from switchfit.optimize import Status
from switchfit.strategy.search import BY_OTHER_MINIMUM


class TwoMinima(NamedTuple):
    """A problem, and what is known of its two minima."""

    build: Callable[[], sf.Problem]
    truth: tuple[float, ...]
    wrong: tuple[float, float]
    """Between which the first transition time is at the wrong minimum."""

    right: tuple[float, float]
    """And at the right one."""

    gain: float
    """By how much J is lower there, at least."""

    level: str | None = "good"
    """The verdict on the wrong minimum by itself."""

    found_level: str | None = None
    """That on the right one, where it matters."""

    as_from_truth: str = ""
    """How J compares with that of a fit from the truth: "same" (to 1e-6) or "not higher" (by 0.01); else not asked."""

    status: Status | None = None
    """How the fit to the wrong minimum ends, where it matters."""

    steps: tuple[str, ...] | None = None
    """The strategies that are tried, where nothing else may be."""


def springs(friction: float) -> sf.Problem:
    """A mass on two springs. Their fields differ by nothing where it passes 0, at 6.8 s: a switch as long before it as
    the right one is behind leaves noise of the right size, too, and is 16 standard errors off."""

    def spring(kind):
        dry = (lambda v: friction * jnp.sign(v)) if friction else (lambda v: 0.0)
        return lambda t, x, p: jnp.stack([x[1], -p[kind] * x[0] - p["damping"] * x[1] - dry(x[1])])

    system = sf.HybridSystem({kind: spring(kind) for kind in ("soft", "hard")}, [1.0, 0.0])
    log = sf.Measurements(np.arange(0.0, 16.0, 0.1), np.zeros(160), sigma=0.03, observe=lambda t, x, p: x[0])
    guess = {"hard": 9.01, "soft": 4.02, "damping": 0.105}
    problem = one_run(system, log, ("hard", "soft"), (6.66,), 16.0, guess)
    return simulate_log(problem, [7.0, 9.0, 4.0, 0.1], seed=10)


def wet_road() -> sf.Problem:
    """A wheel brakes on a road that becomes wet at 0.9 s; 0.02 s earlier, with more noise, is a minimum, too: the guess
    lies beside it."""

    def roll(road):
        def wheel(t, x, p):
            slip = (x[0] - 0.3 * x[1]) / x[0]
            force = 2.0 * 9.81 * p[road] * slip * p["s"] / (slip**2 + p["s"] ** 2)
            return jnp.stack([-force - 0.01 * x[0], 90.0 * force - 500.0])

        return wheel

    wheel = sf.HybridSystem({road: roll(road) for road in ("dry", "wet")}, lambda p: jnp.stack([p["v"], p["v"] / 0.3]))
    log = sf.Measurements(np.arange(0.02, 1.6, 0.02), np.zeros((79, 2)), sigma=[0.1, 0.5])
    slips = {name: sf.Parameter(value, scale="log") for name, value in {"dry": 0.88, "wet": 0.51, "s": 0.097}.items()}
    problem = one_run(wheel, log, ("dry", "wet"), (0.87,), 1.58, slips | {"v": 25.0})
    (run,) = simulate_log(problem, [0.9, 0.9, 0.5, 0.1, 25.0], seed=18).experiments
    sigmas = {name: sf.Parameter(value, scale="log") for name, value in {"sigma_v": 0.09, "sigma_w": 0.57}.items()}
    run = replace(run, data=replace(run.data[0], sigma=list(sigmas)))
    return replace(problem, experiments=run, parameters=problem.parameters | sigmas)


def pendulum() -> sf.Problem:
    """It is driven until 5.3 s, and rests by dry friction. Its J has two minima, 5 standard errors of mu apart."""

    def swing(t, x, p, drive=0.0):
        return jnp.stack([x[1], drive - 9.81 * jnp.sin(x[0]) - p["mu"] * jnp.sign(x[1]) - p["c"] * x[1]])

    def driven(t, x, p):
        return swing(t, x, p, p["torque"] * jnp.cos(2.5 * t))

    log = sf.Measurements(np.arange(0.1, 14.0, 0.1), np.zeros(139), sigma=0.01, observe=first_state)
    system = sf.HybridSystem({"driven": driven, "free": swing}, [0.3, 0.0])
    guess = {"mu": 0.37, "c": 0.125, "torque": 1.56}
    problem = one_run(system, log, ("driven", "free"), (5.28,), 14.0, guess)
    return simulate_log(problem, [5.3, 0.4, 0.15, 2.0], 22)


def faster_leak(seed: int) -> sf.Problem:
    """A lag is driven in steps and leaks faster from 5.2 s on. It is at rest from 5.6 to 7.2 s: a switch there or a
    little later leaves noise of the right size."""
    steps = [0.0, 0.7, 1.9, 3.3, 4.1, 5.6, 7.2, 8.8, 9.5]
    command = sf.Input(steps, [0.0, 1.0, 2.0, 1.0, -1.0, 0.0, 2.0, 3.0, 1.0])
    leaks = {name: (lambda t, x, p, u, k=name: p["gain"] * u - p[k] * x) for name in ("slow", "fast")}
    log = sf.Measurements(np.linspace(0.1, 10.0, 67), np.zeros(67), sigma=0.03)
    guess = {"gain": 0.6, "slow": 1.0, "fast": 1.0}
    problem = one_run(sf.HybridSystem(leaks, [0.0]), log, ("slow", "fast"), (7.5,), 10.0, guess, inputs=command)
    return simulate_log(problem, [5.2, 1.2, 0.5, 1.5], seed)


LEAK, STEP = (30.0, 34.0, 1.0, 0.1, 0.5), (16.2, 0.05)


def hidden_leak(seed: int) -> sf.Problem:
    """The noise is so large that chi-square of 400 samples does not tell where the leak was."""
    modes = {
        "usual": lambda t, x, p: p["in"] - p["k"] * x,
        "leak": lambda t, x, p: p["in"] - p["out"] - p["k"] * x,
    }
    log = sf.Measurements(np.linspace(0.25, 100.0, 400), np.zeros(400), sigma=1.0)
    guess = {"in": 0.8, "k": 0.14, "out": 0.3}
    problem = one_run(sf.HybridSystem(modes, [10.0]), log, ("usual", "leak", "usual"), (20.0, 50.0), 100.0, guess)
    return simulate_log(problem, LEAK, seed)


def hidden_step() -> sf.Problem:
    """1.5 is added to a measured state: J jumps where the time passes a sample."""
    modes = dict.fromkeys(("before", "after"), lambda t, x, p: -p["k"] * x)
    system = sf.HybridSystem(modes, [10.0], {("before", "after"): lambda t, x, p: x + 1.5})
    log = sf.Measurements(np.arange(0.5, 40.0), np.zeros(40), sigma=0.5)
    return simulate_log(one_run(system, log, tuple(modes), (20.0,), 40.0, {"k": 0.04}), STEP, 58)


ANYWHERE = (-np.inf, np.inf)
SPRINGS, LAG = (7.0, 9.0, 4.0, 0.1), (5.2, 1.2, 0.5, 1.5)
BY_OTHER = ("local", BY_OTHER_MINIMUM)

TWO_MINIMA = {
    "on the other side of where modes agree": TwoMinima(
        partial(springs, 0.0), SPRINGS, (6.0, 6.8), ANYWHERE, 1.0, steps=BY_OTHER
    ),
    "the same with dry friction": TwoMinima(partial(springs, 0.03), SPRINGS, (6.0, 6.8), ANYWHERE, 1.0, steps=BY_OTHER),
    "estimated sigmas": TwoMinima(
        wet_road, (0.9, 0.9, 0.5, 0.1, 25.0, 0.1, 0.5), (0.875, 0.885), (0.895, 0.905), 5.0, None, "good", "not higher"
    ),
    "a pendulum that turns once more": TwoMinima(
        pendulum, (5.3, 0.4, 0.15, 2.0), ANYWHERE, ANYWHERE, 1.0, as_from_truth="same"
    ),
    "narrow and far from a kink": TwoMinima(
        partial(faster_leak, 0), LAG, (7.2, 10.0), (5.05, 5.35), 0.0, status=Status.CONVERGED_AT_KINK
    ),
    "narrow and far away": TwoMinima(
        partial(faster_leak, 1), LAG, (7.2, 10.0), (5.05, 5.35), 0.0, status=Status.CONVERGED
    ),
    "hidden by chi-square": TwoMinima(
        partial(hidden_leak, 0), LEAK, ANYWHERE, ANYWHERE, 2.0, as_from_truth="not higher"
    ),
    "hidden by chi-square, another log": TwoMinima(
        partial(hidden_leak, 42), LEAK, ANYWHERE, ANYWHERE, 2.0, as_from_truth="not higher"
    ),
    "a step hidden by chi-square": TwoMinima(hidden_step, STEP, ANYWHERE, ANYWHERE, 2.0, as_from_truth="not higher"),
}
