"""Rooms that are heated and cool, in which many fits are done."""

import numpy as np

import switchfit as sf
from support.models import decay

TIMES = np.linspace(0.25, 6.0, 24)
TRUTH = np.array([2.1, 0.8])


ROOM = sf.HybridSystem({"on": lambda t, x, p: 1.0 - p["k"] * x, "off": decay}, [0.2])


def room(data=None, guess=(1.7, 1.0), upper=5.0, prior=None, **settings):
    """One transition and one parameter: a room that is heated, then cools."""
    if data is None:
        data = sf.Measurements(TIMES, np.zeros(24), sigma=0.01)
    run = sf.Experiment(data, ("on", "off"), guess[:1], 0.0, 6.0)
    return sf.Problem(ROOM, run, {"k": sf.Parameter(guess[1], 0.1, upper, prior=prior)}, **settings)
