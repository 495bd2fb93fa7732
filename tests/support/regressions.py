"""Lines that are fitted, and other runs of them."""

import numpy as np

import switchfit as sf

SIGMA = 0.3
POWERS = sf.HybridSystem({"m": lambda t, x, p: p["a"] + p["b"] * t + p["c"] * t**2 + 0 * x}, [0.0], state_names=("x",))


def design(times, count=2):
    """x = a t + b t^2 / 2 + c t^3 / 3."""
    return np.stack([times ** (k + 1) / (k + 1) for k in range(count)], axis=1)


def values(times, seed, shift=0.0):
    return shift + design(times) @ [1.2, -0.4] + SIGMA * np.random.default_rng(seed).standard_normal(len(times))


def run(times, y, sigma=SIGMA, names=("x",), initial_state=None, **settings):
    data = sf.Measurements(times, y, sigma=sigma, names=names, **settings)
    return sf.Experiment(data, ("m",), (), 0.0, 5.0, initial_state=initial_state)


def pose(runs, count=2, **parameters):
    """A polynomial with so many coefficients; the others are 0."""
    powers = {name: sf.Parameter(0.0, fixed=k >= count) for k, name in enumerate("abc")}
    return sf.Problem(POWERS, runs, powers | parameters)
