"""What a user writes, for mypy: lists wherever sequences are taken, numbers of all kinds, figures, plain attributes.

`make check` runs mypy over this file, `tests/house/test_typing.py` runs it.
"""

from __future__ import annotations

from pathlib import Path

import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure

import switchfit as sf


def on(t, x, p):  # type: ignore[no-untyped-def]
    return p["heating"] - 0.2 * x


def off(t, x, p):  # type: ignore[no-untyped-def]
    return -0.2 * x


def make_problem() -> sf.Problem:
    """A heater that is switched off, given by lists throughout."""
    system = sf.HybridSystem(
        modes={"on": on, "off": off},
        initial_state=[0.0],
        reset_maps={("on", "off"): lambda t, x, p: x},
        state_names=["T"],
        state_units=["K"],
    )
    times = [1, 2, 3.5, 4, 5, 6]
    values = [1.8, 3.3, 5.0, 5.4, 4.5, 3.6]
    log = sf.Measurements(times, values, observe=lambda t, x, p: x[jnp.array([0])], sigma=[0.1], names=["T"])
    _several = sf.Measurements(np.array(times), [[v] for v in values], sigma=0.1)
    _reference = sf.ReferenceSignal.from_samples([0, 3, 6, 8], [[0.0], [4.0], [3.0], [1.0]], names=["T"], weights=[1.0])
    run = sf.Experiment(
        data=[log],
        mode_sequence=["on", "off"],
        transition_times=[4],
        t0=0,
        tf=8,
        inputs=None,
        initial_state=[sf.Parameter(0.1)],
        parameter_map={"heating": "power"},
        jumps=[sf.Jump([2.5], lambda t, x, p: x), sf.Jump(5, lambda t, x, p: x)],
    )
    _other = sf.Experiment(log, ("on", "off"), (sf.Parameter(4.0, lower=3, upper=5),), 0.0, 8.0)
    _guessed = sf.Experiment(log, ["on", "off"], None, t0=0.0)
    _driven = sf.Input([0, 1, 2], [[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]], kind="linear")
    return sf.Problem(system, [run], {"power": 2, "unused": sf.Parameter([1, 2], lower=[0, 0], fixed=True)})


def misuse() -> None:
    """What mypy must refuse: a comment that is not needed is an error too, so that types cannot become Any."""
    sf.Experiment([], 5, [])  # type: ignore[arg-type]
    sf.HybridSystem({}, [0.0], state_names=3)  # type: ignore[arg-type]
    _figure: int = sf.Estimate.load("x").plot()  # type: ignore[assignment]
    sf.Input([0.0], [0.0], kind="step")  # type: ignore[arg-type]


def use(problem: sf.Problem, folder: Path) -> list[float]:
    """What is done with results."""
    estimate: sf.Estimate = sf.estimate(problem, start=[4.0, 2.0, 0.1], max_iterations=100)
    _figure: Figure = estimate.plot()
    _residuals: Figure = estimate.plot_residuals()
    power: float = estimate.parameters["power"]
    tau: float = float(estimate.transition_times[0][0])
    interval: tuple[float, float] = estimate.profile("power").interval()
    estimate.save(folder / "out.json")
    loaded = sf.Estimate.load(str(folder / "out.json"))
    _level: str = loaded.verdict.level
    moved = sf.simulate(problem, [4.1, 2.0, 0.1])
    J: float = sf.evaluate(problem, [4.1, 2.0, 0.1]).cost
    _bands = sf.predict(estimate, [1, 2, 3])
    _many = sf.estimate_many([problem, problem])
    _passed: bool = sf.check_derivatives(problem, [4.1, 2.0, 0.1]).passed
    _names: tuple[str, ...] = problem.theta_names
    return [power, tau, *interval, J, float(moved.states[-1, 0])]
