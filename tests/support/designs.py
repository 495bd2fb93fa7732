"""Experiments whose information has a closed form."""

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from support.models import STILL

TIMES = np.linspace(0.0, 4.0, 9)


def planned(times, channels=1, **settings):
    """Samples that are not made yet."""
    return sf.Measurements(times, np.zeros((len(times), channels)), **({"sigma": 0.1} | settings))


def line(times=TIMES, parameters=None, **settings):
    """a + b t, with a = 1 and b = 2."""
    data = planned(times, observe=lambda t, x, p: jnp.stack([p["a"] + p["b"] * t]), **settings)
    return sf.Problem(STILL, sf.Experiment(data, ("still",), (), 0.0, 4.0), {"a": 1.0, "b": 2.0} | (parameters or {}))


def line_information(times, sigma=0.1):
    slopes = np.stack([np.ones(len(times)), times])
    return slopes @ slopes.T / sigma**2


def lag(values, *, kind="hold", parameters=None, data=None, **settings):
    """x' = -k x + b u, y = x, u at knots."""
    system = sf.HybridSystem({"on": lambda t, x, p, u: -p["k"] * x + p["b"] * u}, [0.0])
    knots = np.linspace(0.0, 4.0, len(values) + (kind == "hold"))[: len(values)]
    data = planned(TIMES[1:], **(data or {}))
    run = sf.Experiment(data, ("on",), (), 0.0, 4.0, inputs=sf.Input(knots, values, kind=kind))
    return sf.Problem(system, run, {"k": 0.7, "b": 2.0} | (parameters or {}), **settings)
