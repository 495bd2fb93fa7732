"""The simulated experiment of Miller and Murphey, Section V: estimate mu, tau_1 and tau_2 of equation (18)."""

import numpy as np

import switchfit as sf
from switchfit.models import skid_steer

TRUTH = {"mu": 0.7, "tau": (6.0, 10.0)}
SEQUENCE = ("stick", "slip", "stick")


def truth() -> sf.Trajectory:
    """The vehicle with the true values, from rest, with a node every 0.1 s."""
    times = np.linspace(0.0, 15.0, 151)
    nodes = sf.Measurements(times, np.zeros((len(times), 6)))
    run = sf.Experiment(nodes, SEQUENCE, TRUTH["tau"], t0=0.0, tf=15.0)
    return sf.simulate(sf.Problem(skid_steer(), run, {"mu": TRUTH["mu"]}))


def make_problem() -> sf.Problem:
    """Cost 1/2 |x - x_m|² with x_m the truth, started from (mu, tau_1, tau_2) = (0.8, 5, 9)."""
    measured = truth()
    reference = sf.ReferenceSignal.from_samples(measured.times, measured.states)
    run = sf.Experiment(reference, SEQUENCE, (5.0, 9.0), t0=0.0, tf=15.0)
    return sf.Problem(skid_steer(), run, {"mu": sf.Parameter(0.8, lower=0.05, upper=2.0)})


if __name__ == "__main__":
    print(sf.estimate(make_problem()))
