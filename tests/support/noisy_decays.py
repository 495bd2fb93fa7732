"""A decay and a line, seen with noise."""

import jax.numpy as jnp
import numpy as np

from support.models import curve

TIMES = np.linspace(0.25, 6.0, 24)


def observed(h, values, parameters, sigma, times=TIMES):
    return curve(h, times, values, parameters, sigma=sigma, tf=6.0)


def decay(t, x, p):
    return jnp.array([p["a"] * jnp.exp(-p["k"] * t)])


def one_line(result) -> str:
    """What is printed of a result, without its line breaks."""
    return " ".join(str(result).split())
