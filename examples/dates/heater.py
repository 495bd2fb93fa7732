"""A room that is heated from some day on to another, and loses warmth all the time."""

import jax.numpy as jnp

import switchfit as sf


def on(t, x, p):
    """Warmth above the outside, in K, while the heating runs; power in K per day."""
    return jnp.stack([p["power"] - p["loss"] * x[0]])


def off(t, x, p):
    """The same without heating."""
    return jnp.stack([-p["loss"] * x[0]])


HEATER = sf.HybridSystem({"on": on, "off": off}, [0.0], state_names=("warmth",), state_units=("K",))
