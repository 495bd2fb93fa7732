"""A thermostat of five switches, whose guesses may be far off."""

import numpy as np

import switchfit as sf
from support.models import approach, heated_room, one_run

HEATER = heated_room()
TRUTH = np.array([1.83, 3.4, 5.32, 6.7, 8.1, 1.0, 0.8])
TIMES = np.linspace(0.25, 10.0, 40)


def temperatures(times, switches, power, k):
    """Closed form of x' = P(t) - k x with the power on, off, on, ..., from 0.2."""
    return approach(times, switches, (k, k), (power / k, 0.0))


def thermostat(guess=None, sigma=0.02, modes=("on", "off") * 3):
    values = temperatures(TIMES, TRUTH[:5], *TRUTH[5:]) + np.random.default_rng(1).normal(0.0, 0.02, len(TIMES))
    parameters = {"power": sf.Parameter(1.2, lower=0.2, upper=5.0), "k": sf.Parameter(0.6, lower=0.05, upper=3.0)}
    return one_run(HEATER, sf.Measurements(TIMES, values, sigma=sigma), modes, guess, 10.0, parameters)


FAR = (0.5, 1.0, 1.5, 2.0, 9.0)
