"""Thermostats of which the guess is bad, with all that a problem may have."""

from dataclasses import replace

import numpy as np

import switchfit as sf
from support.thermostats import HEATER, TIMES, temperatures
from switchfit.meshes.evaluator import Evaluator
from switchfit.strategy.short_fit import fit_briefly


def two_runs(guess=(3.0, 3.0), k=0.5):
    times = np.linspace(0.25, 6.0, 24)
    truth, random = ((2.2, 1.0), (4.1, 1.3)), np.random.default_rng(2)
    runs = []
    for e, (tau, power) in enumerate(truth):
        values = temperatures(times, [tau], power, 0.5) + random.normal(0.0, 0.02, len(times))
        data = sf.Measurements(times, values, sigma=0.02)
        mapped = {"power": f"power_{e}"}
        runs.append(sf.Experiment(data, ("on", "off"), (guess[e],), 0.0, 6.0, parameter_map=mapped, name=f"room{e}"))
    powers = {f"power_{e}": sf.Parameter(1.0, lower=0.01, upper=50.0) for e in range(2)}
    return sf.Problem(HEATER, runs, {"k": sf.Parameter(k, lower=0.01, upper=5.0), **powers})


def say_no_once():
    """Return a function of a cost that is false once, and then true."""
    answers = iter((False, True))
    return lambda cost: next(answers)


SEQUENCE, TAU, BAD = ("on", "off", "on", "off"), (1.83, 5.32, 7.1), (0.5, 1.0, 9.5)
POWER, LOSS = 1.0, 0.8
GUESS = {"power": sf.Parameter(2.2, lower=0.2, upper=5.0), "k": sf.Parameter(0.4, lower=0.05, upper=3.0)}


def measure(sigma=0.02, seed=1, times=TIMES, observe=None, channels=1, **more):
    """Return measurements without values, and the noise that they get."""
    noise = np.random.default_rng(seed).normal(0.0, 0.02, (len(times), channels))
    return sf.Measurements(times, np.zeros((len(times), channels)), observe=observe, sigma=sigma, **more), noise


def is_fixed(tau):
    return isinstance(tau, sf.Parameter) and tau.fixed


def pose(logs, system=HEATER, parameters=GUESS, times=BAD, truth=(POWER, LOSS), **more):
    """Return a problem with a bad guess whose data are simulated at the truth, and the fit that begins there."""
    given = {"mode_sequence": SEQUENCE, "t0": 0.0, "tf": 10.0} | more
    run = sf.Experiment([log for log, _ in logs], transition_times=times, **given)
    problem = sf.Problem(system, run, parameters)
    near = [tau for tau, given in zip(TAU, times, strict=True) if not is_fixed(given)]
    theta = np.concatenate([near, truth])
    seen = Evaluator(problem, theta).simulate(theta)[0].seen
    filled = [replace(log, values=y[: len(noise)] + noise) for (log, noise), y in zip(logs, seen, strict=True)]
    problem = replace(problem, experiments=replace(run, data=filled))
    return problem, fit_briefly(problem, theta)
