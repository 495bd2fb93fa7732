"""How the cost of a joint fit grows with the number of runs: five unknowns of each run's own, three shared."""

from __future__ import annotations

import sys
import time
from typing import Any
from unittest.mock import patch

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from benchmarks.report import Report
from benchmarks.timing import ms
from switchfit.engine.native.program_cache import _program_of
from switchfit.fit import minimization
from switchfit.meshes.evaluator import Evaluator

RUNS = (10, 20, 40, 80, 160)
SHARED = {"k": 2.0, "c": 0.3, "b": 0.2}
SIGMA = 0.01


def run(report: Report, quick: bool) -> None:
    """An iteration against the number of runs, by blocks and with full matrices."""
    sizes = RUNS[:3] if quick else RUNS
    rows = []
    least: dict[str, list[float]] = {"evaluation": [], "by blocks": [], "full": []}
    for count in sizes:
        problem = pushed(count)
        began, before = time.perf_counter(), _program_of.cache_info().misses
        evaluator = Evaluator(problem)
        evaluator(problem.initial_theta)
        first, programs = time.perf_counter() - began, _program_of.cache_info().misses - before
        alone = _fastest(lambda at=evaluator, theta=problem.initial_theta: at(theta, arrow=True))
        blocks, iterations = _iteration(evaluator, by_blocks=True)
        full, _ = _iteration(evaluator, by_blocks=False)
        for name, seconds in zip(least, (alone, blocks, full), strict=True):
            least[name].append(seconds)
        d = len(problem.theta_names)
        rows.append((count, d, f"{first:.2g} s", programs, ms(alone), iterations, ms(blocks), ms(full)))
        report.data[f"runs {count}"] = {
            "d": d, "first": first, "programs": programs, "evaluation": alone, "by blocks": blocks, "full": full,
        }  # fmt: skip
    report.section("A joint fit against the number of runs: 5 own unknowns each, 3 shared, 20 to 40 samples each")
    header = ("runs", "unknowns", "mesh and first evaluation", "new programs", "(J, g, H)", "iterations")
    report.table((*header, "an iteration by blocks", "an iteration with full matrices"), rows)
    exponents = {name: float(np.polyfit(np.log(sizes), np.log(times), 1)[0]) for name, times in least.items()}
    said = ", ".join(f"{name} {exponent:.2f}" for name, exponent in exponents.items())
    report.note(
        f"Fitted exponents in the number of runs (1 is linear): {said}. An iteration is a whole minimisation, with its "
        "line searches and the checks at its end, divided by its iterations."
    )
    report.data["runs exponents"] = exponents
    report.target("exponent of an iteration in the number of runs", 1.1, exponents["by blocks"], "")


def pushed(count: int, seed: int = 0) -> sf.Problem:
    """Oscillators that are pushed, and let go at an unknown time: shared stiffness and dampings, simulated data.

    Of each run's own are when it is let go, its state at the start, the force and the position of rest. The guess is
    near enough for the number of iterations not to depend on that of the runs.
    """
    random = np.random.default_rng(seed)
    runs, own, truth = [], {}, []
    for e in range(count):
        times = np.linspace(0.0, 6.0, 20 + 20 * e // count)
        names = {"force": f"force_{e}", "rest": f"rest_{e}"}
        true = {"tau": random.uniform(2.0, 3.0), "force": random.uniform(1.0, 2.0), "rest": random.normal(0.0, 0.2)}
        start = random.normal(0.0, 0.3, 2)
        own |= {names["force"]: 1.05 * true["force"], names["rest"]: true["rest"] + 0.02}
        truth.append((true, start))
        data = sf.Measurements(times, np.zeros(len(times)), observe=position, sigma=SIGMA)
        unknown = [sf.Parameter(x + 0.02) for x in start]
        tau = sf.Parameter(true["tau"] + 0.05, lower=0.5, upper=5.5)
        runs.append(sf.Experiment(data, ("push", "free"), (tau,), 0.0, 6.0, initial_state=unknown, parameter_map=names))
    parameters = {**{name: sf.Parameter(1.05 * value, lower=0.0) for name, value in SHARED.items()}, **own}
    blank = sf.Problem(OSCILLATOR, runs, parameters)
    theta = [true["tau"] for true, _ in truth] + list(SHARED.values())
    theta += [true[name] for true, _ in truth for name in ("force", "rest")]
    theta += [x for _, start in truth for x in start]
    measured = [_noisy(blank, e, np.array(theta), random) for e in range(count)]
    return sf.Problem(OSCILLATOR, measured, parameters)


def _noisy(problem: sf.Problem, e: int, theta: np.ndarray, random: np.random.Generator) -> sf.Experiment:
    """Experiment e with the samples that theta gives, and noise."""
    given = problem.experiments[e]
    item = given.data[0]
    path = sf.simulate(problem, theta, experiment=e)
    values = np.interp(item.times, path.times, path.states[:, 0]) + SIGMA * random.normal(size=len(item.times))
    data = sf.Measurements(item.times, values, observe=position, sigma=SIGMA)
    return sf.Experiment(
        data,
        given.mode_sequence,
        given.transition_times,
        given.t0,
        given.tf,
        initial_state=given.initial_state,
        parameter_map=given.parameter_map,
    )


def push(t: Any, x: Any, p: Any) -> Any:
    """A constant force."""
    return free(t, x, p) + jnp.array([0.0, 1.0]) * p["force"]


def free(t: Any, x: Any, p: Any) -> Any:
    """Linear and cubic damping."""
    return jnp.stack([x[1], -p["k"] * (x[0] - p["rest"]) - p["c"] * x[1] - p["b"] * x[1] ** 3])


def position(t: Any, x: Any, p: Any) -> Any:
    """What is measured."""
    return x[:1]


OSCILLATOR = sf.HybridSystem({"push": push, "free": free}, [0.0, 0.0], state_names=("x", "v"))


def _fastest(call: Any, repetitions: int = 15) -> float:
    seconds = []
    for _ in range(repetitions):
        began = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - began)
    return min(seconds)


def _iteration(evaluator: Evaluator, by_blocks: bool) -> tuple[float, int]:
    """Seconds of an iteration in the fastest of three fits, and the iterations."""
    theta = evaluator.problem.initial_theta
    seconds, iterations = [], 0
    for _ in range(3):
        began = time.perf_counter()
        with patch.object(minimization, "MANY_RUNS", 1 if by_blocks else sys.maxsize):
            result = minimization.minimize_cost(evaluator, theta, "exact", 1e-7, 200)
        iterations = result.iterations
        seconds.append((time.perf_counter() - began) / iterations)
    return min(seconds), iterations
