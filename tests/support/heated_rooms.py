"""Rooms that are heated and cool, in which many fits are done."""

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from support.models import decay, temperature
from switchfit.batch.programs import Limits

TIMES = np.linspace(0.25, 6.0, 24)
TRUTH = np.array([2.1, 0.8])


ROOM = sf.HybridSystem({"on": lambda t, x, p: 1.0 - p["k"] * x, "off": decay}, [0.2])


def room(data=None, guess=(1.7, 1.0), upper=5.0, prior=None, **settings):
    """One transition and one parameter: a room that is heated, then cools."""
    if data is None:
        data = sf.Measurements(TIMES, np.zeros(24), sigma=0.01)
    run = sf.Experiment(data, ("on", "off"), guess[:1], 0.0, 6.0)
    return sf.Problem(ROOM, run, {"k": sf.Parameter(guess[1], 0.1, upper, prior=prior)}, **settings)


LIMITS = Limits(1e-7, 200)


def measured_room(seed):
    return temperature(TIMES, TRUTH[0], 1.0, TRUTH[1]) + 0.01 * np.random.default_rng(seed).standard_normal(24)


def growing(guess):
    """x' = a x², not finite where a < 0, grows without bound within the horizon unless it is stopped in time."""
    modes = {"grow": lambda t, x, p: jnp.sqrt(p["a"]) ** 2 * x**2, "rest": lambda t, x, p: -x}
    times = np.linspace(0.1, 3.0, 30)
    values = np.where(times < 1.0, 1 / (1 - 0.5 * np.minimum(times, 1.0)), 2.0 * np.exp(1.0 - times))
    data = sf.Measurements(times, values + np.random.default_rng(0).normal(0, 0.01, 30), sigma=0.01)
    run = sf.Experiment(data, ("grow", "rest"), guess[:1], 0.0, 3.0)
    return sf.Problem(sf.HybridSystem(modes, [1.0]), run, {"a": sf.Parameter(guess[1], lower=-1.0, upper=4.0)})
