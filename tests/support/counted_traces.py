"""Oscillators whose vector field counts how often JAX traces it."""

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from support.models import first_state

TRACES = {"count": 0}


def counted(t, x, p):
    """A vector field that counts how often JAX traces it."""
    TRACES["count"] += 1
    return jnp.array([x[1], -p["k"] * x[0]])


TOLERANCES = {"rtol": 1e-9, "atol": 1e-11}
DAMPED = {"damped": lambda t, x, p: counted(t, x, p) - p["damping"] * x}
OSCILLATOR = sf.HybridSystem({"free": counted} | DAMPED, [1.0, 0.0])


def oscillator(tau=1.1, k=2.0, damping=0.3, samples=9, seed=0, start=None):
    """Samples at which the truth is (1.2, 2.1, 0.35), with a little noise of a given seed."""
    times = np.linspace(0.0, 3.3, samples)
    values = np.cos(np.sqrt(2.1) * times) * np.exp(-0.3 * np.maximum(times - 1.2, 0.0))
    values += 0.01 * np.random.default_rng(seed).normal(size=samples)
    data = sf.Measurements(times, values, observe=first_state, sigma=0.01)
    run = sf.Experiment(data, ("free", "damped"), (tau,), 0.0, 3.3, initial_state=start)
    return sf.Problem(OSCILLATOR, run, {"k": k, "damping": damping}, **TOLERANCES)
