"""A capacitor that is charged through one resistor and discharged through another one."""

from functools import cache

import numpy as np

import switchfit as sf
from support import models

MODES = {"charge": lambda t, x, p: p["k"][0] * (1.0 - x), "discharge": lambda t, x, p: -p["k"][1] * x}
CAPACITOR = sf.HybridSystem(MODES, [0.0], state_names=("voltage",))
TIMES = np.linspace(0.05, 2.0, 40)
TRUTH = np.array([0.63, 2.0, 1.0])
GUESS = np.array([0.8, 1.5, 0.7])
SIGMA = 0.01


def voltage(times, tau=TRUTH[0], k=TRUTH[1:]):
    """x(t) in closed form."""
    at_tau = 1.0 - np.exp(-k[0] * tau)
    return np.where(times < tau, 1.0 - np.exp(-k[0] * times), at_tau * np.exp(-k[1] * (times - tau)))


def noise(seed):
    return SIGMA * np.random.default_rng(seed).normal(size=40)


def run(values, tau=GUESS[0]):
    return sf.Experiment(sf.Measurements(TIMES, values, sigma=SIGMA), ("charge", "discharge"), (tau,), 0.0, 2.0)


def capacitor(values, *, k=GUESS[1:], tau=GUESS[0], **settings):
    return sf.Problem(CAPACITOR, run(values, tau), {"k": k}, **settings)


@cache
def refined_fit():
    """The guess is slow, the truth fast: the mesh of the guess is too coarse for it."""
    return sf.estimate(models.slow_guess(8.0, 10))
