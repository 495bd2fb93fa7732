"""Stiff modes: one among three; known problems beside CasADi and SciPy; many runs of which a third is stiff."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from benchmarks import side_by_side, stiff_runs
from benchmarks.report import Report
from benchmarks.timing import ms, take_turns
from switchfit.meshes.evaluator import Evaluator, evaluator_of

RATE = 1e5
"""The fast rate of the stiff mode, and 5 where no mode shall be stiff."""

SHOWN = {
    "auto": "a stiff mode, implicit steps in it alone",
    "stiff": "a stiff mode, implicit steps in all modes",
    "slow, JAX": "no stiff mode, explicit steps in JAX",
    "slow": "no stiff mode, explicit steps in machine code",
}


LONGEST = 1e-4
"""Largest time of (J, g, H) of Van der Pol's oscillator, in seconds."""


def run(report: Report, quick: bool) -> None:
    """All parts."""
    compare_steps(report, quick)
    report.section("Stiff problems with a switch, side by side", side_by_side.HOW)
    for name, sides in side_by_side.STIFF_SIDES.items():
        side_by_side.show(report, name, list(sides), quick)
    found = report.data["peers: stiff: switchfit"]["hessian"]["median"]
    report.target("(J, g, H) of the stiff Van der Pol oscillator", 1e3 * LONGEST, 1e3 * found, "ms")
    stiff_runs.run(report, quick)


def compare_steps(report: Report, quick: bool) -> None:
    """(J, g, H) of the same three modes, with and without a fast rate in the second, and the steps in each mode."""
    problems = {
        "auto": three_modes(RATE),
        "stiff": three_modes(RATE, solver="stiff"),
        "slow, JAX": three_modes(5.0, engine="jax"),
        "slow": three_modes(5.0),
    }
    evaluators = {name: evaluator_of(problem) for name, problem in problems.items()}
    theta = {name: problem.initial_theta for name, problem in problems.items()}
    calls = {name: lambda name=name: evaluators[name](theta[name]) for name in problems}
    timings = take_turns(calls, 30 if quick else 200)
    rows = []
    for name, what in SHOWN.items():
        steps = ", ".join(map(str, count_steps(evaluators[name], theta[name])))
        timing = timings[name]
        rows.append(
            (what, steps, ms(timing.median), ms(timing.minimum), f"{timing.median / timings['slow'].median:.1f}")
        )
        report.data[f"stiff {name}"] = vars(timing)
    report.section("One stiff mode of three: (J, gradient, Hessian), 2 states, 2 transitions, 2 parameters, 50 samples")
    report.table(("", "steps in each mode", "median", "minimum", "to the last"), rows)


def three_modes(rate: float, **settings: object) -> sf.Problem:
    """Three modes of two states, of which the second follows a wave at a rate."""
    system = sf.HybridSystem(
        {
            "first": lambda t, x, p: jnp.array([-p["k"] * x[0] + jnp.sin(3 * t), x[0] - x[1]]),
            "fast": lambda t, x, p: jnp.array([-p["rate"] * (x[0] - jnp.cos(t)), x[0] - x[1]]),
            "last": lambda t, x, p: jnp.array([-p["k"] * x[0] * x[1], x[0] ** 2 - x[1]]),
        },
        [0.0, 1.0],
    )
    times = np.linspace(0.1, 9.9, 50)
    data = sf.Measurements(times, np.stack([np.cos(times), np.sin(times)], axis=1), sigma=0.1)
    run = sf.Experiment(data, ("first", "fast", "last"), (3.0, 6.0), 0.0, 10.0)
    return sf.Problem(system, run, {"k": 1.0, "rate": rate}, **settings)


def count_steps(evaluator: Evaluator, theta: np.ndarray) -> list[int]:
    """The steps in each mode."""
    (simulation,) = evaluator.simulate(theta)
    return [rows.stop - rows.start for rows in simulation.segments]
