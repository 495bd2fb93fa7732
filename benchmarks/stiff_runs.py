"""A joint fit of 19 runs, a third of them stiff: implicit steps where they take less time, beside explicit ones."""

from __future__ import annotations

import resource
import time
from typing import Any

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from benchmarks.report import Report
from benchmarks.timing import Timing, ms, take_turns
from switchfit.meshes.evaluator import Evaluator

RUNS, SAMPLES, HORIZON, SIGMA = 19, 1421, 100.0, 0.02
"""27,000 samples in all, over 100 s each."""

SLOW, FAST = 3.0, (60.0, 400.0)
"""Rates of the sensor (1/s). With one of the second, which every third run has, stability limits the explicit steps,
beside tens of implicit ones. But the mesh has a row between two samples at least: explicit rows of the first take less
time, implicit ones of the second."""

SHARED = {"link": 0.2, "curve": 0.1}
OFF = 0.3
"""Decades between the guess and the truth."""

AT_MOST = 1.3
"""Largest time of (J, g, H) with chosen steps, in that with explicit steps in all modes."""


def heat(t: Any, x: Any, p: Any) -> Any:
    """A heater, a body and a fast sensor at the body, heated."""
    return cool(t, x, p) + jnp.array([1.0, 0.0, 0.0]) * p["power"]


def cool(t: Any, x: Any, p: Any) -> Any:
    """The same without heat."""
    losses = p["loss"] * (x[0] - p["room"]) + p["curve"] * x[0] ** 2
    return jnp.stack([-losses, p["link"] * (x[0] - x[1]), p["rate"] * (x[1] - x[2])])


def observe(t: Any, x: Any, p: Any) -> Any:
    """The sensor."""
    return x[2:]


SYSTEM = sf.HybridSystem({"heat": heat, "cool": cool}, [0.0, 0.0, 0.0])


def build(runs: int, fast: float, off: float, **settings: Any) -> sf.Problem:
    """Simulated samples, guessed some decades beside the truth; each run has a switch, a power, a loss, a room."""
    random = np.random.default_rng(3)
    times = np.linspace(HORIZON / SAMPLES, HORIZON, SAMPLES)
    own: dict[str, float] = {}
    taus = random.uniform(30.0, 70.0, runs)
    for e in range(runs):
        own |= {f"power_{e}": random.uniform(0.3, 0.6), f"loss_{e}": random.uniform(0.05, 0.1)}
        own |= {f"room_{e}": random.uniform(0.5, 1.0)}

    def pose(values: list[np.ndarray], off: float, **settings: Any) -> sf.Problem:
        experiments = [
            sf.Experiment(
                sf.Measurements(times, values[e], observe, sigma=SIGMA),
                ("heat", "cool"),
                (taus[e] + 10.0 * off,),
                0.0,
                HORIZON,
                parameter_map={name: f"{name}_{e}" for name in ("power", "loss", "room", "rate")},
            )
            for e in range(runs)
        ]
        parameters = {
            name: sf.Parameter(value * 10.0 ** (off * (1 - 2 * (k % 2))), lower=0.0, scale="log")
            for k, (name, value) in enumerate((SHARED | own).items())
        }
        rates = {f"rate_{e}": sf.Parameter(SLOW if e % 3 else fast, fixed=True) for e in range(runs)}
        return sf.Problem(SYSTEM, experiments, parameters | rates, **settings)

    truth = pose([np.zeros(SAMPLES)] * runs, 0.0)
    exact = [sf.simulate(truth, truth.initial_theta, experiment=e) for e in range(runs)]
    values = [np.interp(times, path.times, path.states[:, 2]) + SIGMA * random.normal(size=SAMPLES) for path in exact]
    return pose(values, off, **settings)


def run(report: Report, quick: bool) -> None:
    """(J, g, H) with chosen, explicit and implicit steps, and a fit from a poor guess, for each fast rate."""
    for fast in FAST:
        _measure(report, 6 if quick else RUNS, fast, 10 if quick else 50)


def _measure(report: Report, runs: int, fast: float, repetitions: int) -> None:
    problems = {solver: build(runs, fast, 0.0, solver=solver) for solver in ("auto", "explicit", "stiff")}
    evaluators = {solver: Evaluator(problem) for solver, problem in problems.items()}
    calls = {name: lambda name=name: evaluators[name](problems[name].initial_theta) for name in problems}
    timings = take_turns(calls, repetitions)
    began = time.perf_counter()
    fit = sf.estimate(build(runs, fast, OFF), strategy="local")
    seconds = time.perf_counter() - began
    what = f"a third of the runs with a sensor of {fast:g} 1/s, else {SLOW:g} 1/s"
    report.section(f"{runs} runs, {runs * SAMPLES:,} samples, {len(fit.theta)} unknowns: {what}")
    report.table(
        ("steps", "rows", "modes with implicit steps", "(J, g, H)", "to explicit steps"),
        [_describe(name, evaluators[name], timings) for name in problems],
    )
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
    ended = f"{fit.status}, J = {fit.cost:.5g} after {fit.iterations} iterations, {seconds:.1f} s"
    report.note(f"A fit from {OFF} decades off: {ended}. Largest memory of the process: {memory:.0f} MB.")
    ratio = timings["auto"].median / timings["explicit"].median
    report.target(f"(J, g, H) of runs, a third with a rate of {fast:g} 1/s, to explicit steps", AT_MOST, ratio, "x")
    report.data[f"stiff runs {fast:g}"] = {name: vars(timing) for name, timing in timings.items()} | {
        "fit seconds": seconds, "memory MB": memory,
    }  # fmt: skip


def _describe(name: str, evaluator: Evaluator, timings: dict[str, Timing]) -> tuple[Any, ...]:
    rows = sum(mesh.cells for mesh in evaluator.meshes)
    implicit = sum(len(mesh.stiffness) for mesh in evaluator.meshes)
    ratio = timings[name].median / timings["explicit"].median
    return name, rows, implicit if name == "auto" else "", ms(timings[name].median), f"{ratio:.2f}"
