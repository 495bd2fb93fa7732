"""How often the 95 % intervals of each built-in model hold the truth.

Each case simulates logs of one model at a truth, adds the noise of its sensors, and fits every log from one guess that
is off. ``python benchmarks/vehicle_coverage.py [RUNS]`` writes ``docs/measured/vehicle-coverage.md``, which
``docs/measured.md`` includes; ``python benchmarks/vehicle_coverage.py 200 bicycle lugre`` prints the rows of some cases
alone.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from switchfit.models import bicycle, differential_drive, lugre, magic_formula, rolling_body, skid_steer, sliding_block
from switchfit.models.tyre_forces import MAGIC_FORMULA

RUNS = 200
FEW = 40
"""Logs of the cases in `SLOW`, whose modes are too long for machine code."""
SLOW = ("magic_formula, loads",)
PAGE = Path(__file__).parent.parent / "docs" / "measured" / "vehicle-coverage.md"
FAR = 5.0
"""Standard errors from the truth beyond which a fit has ended elsewhere."""
POSE = (0, 2, 4)
"""Places of X, Y and theta in the state of a skid-steered vehicle."""


class Case(NamedTuple):
    """A problem with a guess that is off, and the truth by the names of the unknowns."""

    problem: sf.Problem
    truth: Mapping[str, float]

    @property
    def theta(self) -> np.ndarray:
        """The truth in the order of theta: (d,)."""
        return np.array([self.truth[name] for name in self.problem.theta_names])


class Coverage(NamedTuple):
    """What became of the fits of a case.

    Attributes
    ----------
    intervals : (d,)
        Share of the fits with a good verdict whose 95 % interval holds the truth.
    first : float
        Share of the logs whose verdict is good after a single fit from the guess.
    good : float
        The same after `switchfit.estimate`, which tries more where the single fit is not good.
    far : int
        Fits with a good verdict that ended more than `FAR` standard errors from the truth in an unknown: wrong ends
        that are called good.
    """

    intervals: np.ndarray
    first: float
    good: float
    far: int


def draw_log(case: Case, seed: int | Sequence[int] = 0) -> sf.Problem:
    """Return the problem of a case with data that are simulated at the truth, with noise.

    With the seed [s, k] it is log k of a Monte Carlo study with the seed s.
    """
    random = np.random.default_rng(seed)
    experiments = []
    for e, experiment in enumerate(case.problem.experiments):
        path = sf.simulate(case.problem, case.theta, experiment=e)
        (data,) = experiment.data
        keep = np.append(True, np.diff(path.times) > 0)  # at a transition a trajectory has two entries
        states = [np.interp(data.times, path.times[keep], x) for x in path.states[keep].T]
        values = np.asarray(data.observe(data.times, np.array(states), {})).T  # `watch` takes rows
        noise = np.broadcast_to(data.sigma, values.shape) * random.standard_normal(values.shape)
        experiments.append(replace(experiment, data=replace(data, values=values + noise)))
    return replace(case.problem, experiments=experiments)


def watch(times: np.ndarray, columns: Sequence[int], sigma: float | Sequence[float]) -> sf.Measurements:
    """Return samples of some columns of the state, whose values a study replaces."""
    places = np.array(columns)
    return sf.Measurements(
        times, np.zeros((len(times), len(places))), observe=lambda t, x, p: x[jnp.asarray(places)], sigma=sigma
    )


def turn_as_in_the_paper() -> Case:
    """The vehicle of equation (18) on positions twice a second."""
    run = sf.Experiment(watch(np.arange(0.5, 15.0, 0.5), (0, 2), 0.05), ("stick", "slip", "stick"), (5.0, 9.0), 0, 15)
    problem = sf.Problem(skid_steer(), run, {"mu": sf.Parameter(0.8, lower=0.05, upper=2.0)})
    return Case(problem, {"tau_1": 6.0, "tau_2": 10.0, "mu": 0.7})


def turn_on_a_slope() -> Case:
    """Friction of each axle, rolling resistance, slope and mass from a pose ten times a second; forces are the input.

    Changes of the force along the vehicle tell the mass from what is constant along it.
    """
    system = skid_steer(
        forces_from_input=True, restick="reset", mu_front="mu_f", mu_rear="mu_r", rolling="rolling", slope_x="uphill",
        m_b="m_b",
    )  # fmt: skip
    forces = [[15] * 4, [30] * 4, [27, 0, 0, 27], [20] * 4, [0, 40, 40, 0], [10] * 4, [10] * 4]
    inputs = sf.Input([0.0, 2.0, 4.0, 8.0, 11.0, 15.0, 20.0], forces)
    data = watch(np.arange(0.1, 20.0, 0.1), POSE, (0.02, 0.02, 0.01))
    sequence = ("stick", "slip", "stick", "slip", "stick")
    run = sf.Experiment(data, sequence, (4.2, 8.2, 11.2, 15.2), 0.0, 20.0, inputs=inputs)
    guess = {
        "mu_f": sf.Parameter(0.7, lower=0.05, upper=3.0),
        "mu_r": sf.Parameter(0.7, lower=0.05, upper=3.0),
        "rolling": sf.Parameter(0.02, lower=-0.1, upper=0.2),
        "uphill": sf.Parameter(0.01, lower=-0.2, upper=0.2),
        "m_b": sf.Parameter(65.0, lower=20.0, upper=200.0),
    }
    times = {"tau_1": 4.05, "tau_2": 8.05, "tau_3": 11.05, "tau_4": 15.05}
    truth = times | {"mu_f": 0.8, "mu_r": 0.6, "rolling": 0.01, "uphill": 0.02, "m_b": 70.0}
    return Case(sf.Problem(system, run, guess), truth)


def slip_in_front_first() -> Case:
    """The front axle slips first, then both, then none."""
    system = skid_steer(modes=("stick", "front_slip", "slip"), restick="reset", mu_front="mu_f", mu_rear="mu_r")
    sequence = ("stick", "front_slip", "slip", "stick")
    data = watch(np.arange(0.1, 12.0, 0.1), POSE, (0.02, 0.02, 0.01))
    run = sf.Experiment(data, sequence, (3.7, 6.9, 9.3), 0.0, 12.0)
    guess = {
        "mu_f": sf.Parameter(0.5, lower=0.05, upper=3.0),
        "mu_r": sf.Parameter(0.5, lower=0.05, upper=3.0),
    }
    truth = {"tau_1": 4.05, "tau_2": 6.55, "tau_3": 9.05, "mu_f": 0.3, "mu_r": 0.6}
    return Case(sf.Problem(system, run, guess), truth)


def drive_by_measured_speeds() -> Case:
    """A vehicle that rolls at first and skids then, from its pose and the speeds of its wheels."""
    system = differential_drive(alpha_l="alpha_l", alpha_r="alpha_r")
    speeds = sf.Input([0.0, 2.0, 4.0, 6.0, 8.0, 10.0], [[6, 6], [3, 8], [7, 4], [2, 9], [8, 3], [8, 3]])
    data = watch(np.arange(0.1, 10.0, 0.1), (0, 1, 2), (0.02, 0.02, 0.01))
    run = sf.Experiment(data, ("grip", "slip"), (3.5,), 0.0, 10.0, inputs=speeds)
    guess = {"alpha_l": 1.0, "alpha_r": 1.0, "y_l": 0.4, "y_r": -0.4, "x_v": 0.0}
    truth = {"tau_1": 3.05, "alpha_l": 0.95, "alpha_r": 0.9, "y_l": 0.8, "y_r": -0.7, "x_v": -0.1}
    return Case(sf.Problem(system, run, guess), truth)


def drive_by_commands() -> Case:
    """Three steps of the command that share a delay and a lag."""
    system = differential_drive(modes="slip", speeds="commanded", delay="delay")
    runs = [
        sf.Experiment(
            watch(np.arange(0.1, 4.0, 0.1), (0, 1, 2), 0.01), ("wait", "slip"), (0.3,), 0.0, 4.0,
            inputs=sf.Input([0.0, 4.0], [command, command]), name=f"step{k}",
        )
        for k, command in enumerate([(4.0, 8.0), (6.0, 3.0), (-3.0, 5.0)])
    ]  # fmt: skip
    problem = sf.Problem(system, runs, {"y_l": 0.5, "y_r": -0.5, "x_v": 0.0, "lag": 0.1, "delay": 0.2})
    truth = {name: 0.35 for name in problem.theta_names if "tau" in name}
    return Case(problem, truth | {"y_l": 0.8, "y_r": -0.9, "x_v": -0.1, "lag": 0.2, "delay": 0.35})


def drift() -> Case:
    """A car that pulls its handbrake in a bend, from position, heading and yaw rate."""
    steering = sf.Input([0.0, 1.0, 1.5, 3.0, 6.0], [[0, 0], [0, 0], [0.1, 0], [-0.1, 0], [0, 0]], kind="linear")
    car = bicycle(m=1500.0, I_z=2500.0, a=1.2, b=1.4, initial_state=[0.0, 0.0, 0.0, 15.0, 0.0, 0.0])
    data = watch(np.arange(0.05, 5.0, 0.05), (0, 1, 2, 5), (0.05, 0.05, 0.01, 0.01))
    run = sf.Experiment(data, ("grip", "rear_slide", "grip"), (1.55, 2.25), 0.0, 5.0, inputs=steering)
    guess = {
        "C_f": sf.Parameter(6e4, lower=1e4, upper=5e5),
        "C_r": sf.Parameter(7e4, lower=1e4, upper=5e5),
        "mu": sf.Parameter(0.8, lower=0.05, upper=2.0),
    }
    return Case(sf.Problem(car, run, guess), {"tau_1": 1.425, "tau_2": 2.125, "C_f": 8e4, "C_r": 9e4, "mu": 0.6})


def throw_balls() -> Case:
    """A ball without spin and one with too much, of the same friction and rolling resistance."""
    runs = [
        sf.Experiment(
            watch(np.arange(0.05, 3.0, 0.05), (0,), 0.005), (mode, "roll"), (tau,), 0.0, 3.0, name=mode,
            parameter_map={"v_0": f"v_{mode}", "omega_0": f"omega_{mode}"},
        )
        for mode, tau in (("skid", 0.8), ("spin", 0.5))
    ]  # fmt: skip
    guess = {
        "mu": sf.Parameter(0.3, lower=0.01, upper=2.0),
        "rolling": sf.Parameter(0.0),
        "v_skid": 6.0,
        "omega_skid": sf.Parameter(0.0, fixed=True),
        "v_spin": 0.3,
        "omega_spin": 70.0,
    }
    problem = sf.Problem(rolling_body(radius=0.11, rolling="rolling"), runs, guess)
    skid, spin = (name for name in problem.theta_names if "tau" in name)
    when = {skid: 7.0 / (0.2 * 9.81 * 3.5), spin: (0.11 * 90.0 - 0.5) / (0.2 * 9.81 * 3.5)}
    return Case(problem, when | {"mu": 0.2, "rolling": 0.01, "v_skid": 7.0, "v_spin": 0.5, "omega_spin": 90.0})


def push_on_bristles() -> Case:
    """A body that a force moves within its bristles, slides, turns and slides back."""
    system = lugre(sigma_1=100.0, v_s=0.01)
    force = sf.Input([0.0, 0.4, 0.6, 0.8, 1.0, 1.2], [0.0, 1.3, 1.8, 1.8, -1.8, -1.8], kind="linear")
    data = watch(np.arange(0.02, 1.2, 0.02), (0, 1), (2e-5, 1e-2))
    run = sf.Experiment(data, ("forward", "backward"), (0.98,), 0.0, 1.2, inputs=force)
    guess = {
        "sigma_0": sf.Parameter(7e3, lower=1e3, upper=1e6),
        "sigma_2": sf.Parameter(0.6, lower=0.0, upper=10.0),
        "F_c": sf.Parameter(0.9, lower=0.1, upper=5.0),
        "F_s": sf.Parameter(1.4, lower=0.1, upper=5.0),
    }
    # At tau_1 the truth turns, v = 0.
    return Case(
        sf.Problem(system, run, guess), {"tau_1": 1.0018631, "sigma_0": 1e4, "sigma_2": 0.4, "F_c": 1.0, "F_s": 1.5}
    )


def pull_by_a_spring() -> Case:
    """A body that a spring pulls: it sticks, slips and sticks again."""
    end = sf.Input([0.0, 10.5], [0.0, 1.05], kind="linear")
    run = sf.Experiment(watch(np.arange(0.25, 10.5, 0.25), (0,), 0.002), ("forward",), (), 0.0, 10.5, inputs=end)
    guess = {
        "sigma_2": sf.Parameter(0.5, lower=0.0, upper=10.0),
        "F_c": sf.Parameter(0.9, lower=0.1, upper=5.0),
        "F_s": sf.Parameter(1.4, lower=0.1, upper=5.0),
    }
    system = lugre(k=2.0, sigma_0=2e3, sigma_1=40.0, v_s=0.01)
    return Case(sf.Problem(system, run, guess), {"sigma_2": 0.4, "F_c": 1.0, "F_s": 1.5})


def turn_on_tyres(height: float = 0.0) -> Case:
    """The vehicle on tyres of 1987 at 3 m/s: peaks and stiffnesses of both forces."""
    treads = 3.0 * np.array([[1, 1, 1, 1], [1.3, 0.7, 0.7, 1.3], [0.8, 1.2, 1.2, 0.8], [1.2] * 4, [0.9] * 4])
    speeds = sf.Input(np.linspace(0.0, 3.0, 5), treads / 0.15, kind="linear")
    free = {"a_x2": 1300.0, "a_y2": 900.0, "a_x4": 260.0, "a_y3": 950.0}
    held = {name: sf.Parameter(value, fixed=True) for name, value in MAGIC_FORMULA.items() if name not in free}
    data = watch(np.arange(0.05, 3.0, 0.05), POSE, (0.01, 0.01, 0.005))
    run = sf.Experiment(data, ("drive",), (), 0.0, 3.0, inputs=speeds)
    system = magic_formula(initial_state=(0.0, 3.0, 0.0, 0.0, 0.0, 0.0), height=height)
    return Case(sf.Problem(system, run, free | held), {name: MAGIC_FORMULA[name] for name in free})


def turn_with_loads() -> Case:
    """The same with a center of mass that is 0.2 m high: the accelerations transfer load between the tyres."""
    return turn_on_tyres(height=0.2)


def stop_a_block() -> Case:
    """A block that slides and comes to rest, from its position and speed."""
    data = watch(np.arange(0.02, 1.5, 0.02), (0, 2), (0.005, 0.02))
    run = sf.Experiment(data, ("slide", "stick"), (0.8,), 0.0, 1.5)
    zeros = {name: sf.Parameter(0.0, fixed=True) for name in ("y0", "vy0")}
    guess = {"mu": sf.Parameter(0.4, lower=0.01, upper=2.0), "x0": 0.1, "vx0": sf.Parameter(2.5, lower=0.1)}
    truth = {"tau_1": 3.0 / (0.3 * 9.81), "mu": 0.3, "x0": 0.0, "vx0": 3.0}
    return Case(sf.Problem(sliding_block(), run, guess | zeros), truth)


CASES: Mapping[str, Callable[[], Case]] = {
    "skid_steer, equation (18)": turn_as_in_the_paper,
    "skid_steer, slope and mass": turn_on_a_slope,
    "skid_steer, front_slip": slip_in_front_first,
    "differential_drive, measured": drive_by_measured_speeds,
    "differential_drive, commanded": drive_by_commands,
    "bicycle": drift,
    "rolling_body": throw_balls,
    "lugre, force": push_on_bristles,
    "lugre, spring": pull_by_a_spring,
    "magic_formula": turn_on_tyres,
    "magic_formula, loads": turn_with_loads,
    "sliding_block": stop_a_block,
}


def measure_coverage(case: Case, runs: int, seed: int = 0) -> Coverage:
    """Fit `runs` logs with noise from the guess, and count.

    Logs whose single fit is not good are fitted by `switchfit.estimate`, as a user would.
    """
    study = sf.monte_carlo(case.problem, runs, theta=case.theta, start=case.problem.initial_theta, seed=seed)
    theta, intervals, good = study.theta.copy(), study.confidence_intervals().copy(), study.levels == "good"
    first = float(np.mean(good))
    for k in np.flatnonzero(~good):
        fit = sf.estimate(draw_log(case, [seed, int(k)]))
        theta[k], intervals[k], good[k] = fit.theta, fit.confidence_intervals(), fit.verdict.level == "good"
    low, high = np.moveaxis(intervals[good], 2, 0)
    inside = (low <= study.truth) & (study.truth <= high)
    # Half a 95 % interval is 1.96 standard errors; at a kink there is no standard error, but an interval.
    far = np.abs(theta[good] - study.truth) > FAR / 1.96 * 0.5 * (high - low)
    return Coverage(inside.mean(axis=0), first, float(np.mean(good)), int(far.any(axis=1).sum()))


def describe(name: str, runs: int) -> str:
    """Return the row of a case."""
    case = CASES[name]()
    log = draw_log(case)
    check = sf.check_derivatives(log)
    found = measure_coverage(case, runs)
    covered = ", ".join(
        f"{unknown} {100 * share:.1f}" for unknown, share in zip(case.problem.theta_names, found.intervals, strict=True)
    )
    orders = ", ".join(f"{order:.2f}" for order in check.observed_orders)
    gradient = min(check.gradient_gap, check.gradient_gap_halved)
    hessian = min(check.hessian_gap, check.hessian_gap_halved)
    derivatives = f"{'passed' if check.passed else 'failed'} ({orders}; {gradient:.0e}, {hessian:.0e})"
    return f"| {name} | {derivatives} | {covered} | {100 * found.first:.1f} | {100 * found.good:.1f} | {found.far} |"


def main(runs: int, names: Sequence[str]) -> None:
    """Print the table, and write the page if it is that of all cases."""
    lines = [
        "| model | derivatives: orders; gaps to adjoints | intervals that hold the truth (%) | one fit (%) | good (%) "
        "| far |",
        "|---|---|---|---|---|---|",
    ]
    print("\n".join(lines))
    for name in CASES:
        if not names or any(name.startswith(part) for part in names):
            lines.append(describe(name, min(runs, FEW) if name in SLOW else runs))
            print(lines[-1], flush=True)
    if not names:
        last = f"{runs} logs a line; {min(runs, FEW)} of {' and '.join(SLOW)}."
        PAGE.write_text("\n".join([*lines, "", last]) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else RUNS, sys.argv[2:])
