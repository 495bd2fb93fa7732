"""The simulated experiment of Miller and Murphey, Section V: estimate mu, tau_1 and tau_2 of equation (18)."""

import numpy as np

import switchfit as sf
from switchfit.models import skid_steer

TRUTH = {"tau": (6.0, 10.0), "mu": 0.7}


def build_problem(times: np.ndarray, states: np.ndarray) -> sf.Problem:
    """Cost 1/2 |x - x_m|² with the given x_m, started from (mu, tau_1, tau_2) = (0.8, 5, 9)."""
    reference = sf.ReferenceSignal.from_samples(times, states)
    run = sf.Experiment(reference, ("stick", "slip", "stick"), (5.0, 9.0), t0=0.0, tf=15.0)
    return sf.Problem(skid_steer(), run, {"mu": sf.Parameter(0.8, lower=0.05, upper=2.0)})


def make_problem() -> sf.Problem:
    """The problem with x_m the vehicle with the true values, from rest, with a node every 0.1 s or less."""
    times = np.linspace(0.0, 15.0, 151)
    # The same problem simulates and fits, whatever x_m is: its program is compiled once.
    measured = sf.simulate(build_problem(times, np.zeros((len(times), 6))), [*TRUTH["tau"], TRUTH["mu"]])
    return build_problem(measured.times, measured.states)


if __name__ == "__main__":
    print(sf.estimate(make_problem()))
