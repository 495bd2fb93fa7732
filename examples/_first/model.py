"""The model: a mode is a function that returns dx/dt."""

import switchfit as sf

OUTSIDE = 10.0  # degC


def on(t, x, p):
    """dx/dt with heating. x has an entry for each state; p the parameters of problem.toml; t is the time."""
    return p["heating"] - p["loss"] * (x - OUTSIDE)


def off(t, x, p):
    """dx/dt without."""
    return -p["loss"] * (x - OUTSIDE)


room = sf.HybridSystem(
    modes={"on": on, "off": off},
    initial_state=[15.0],  # overridden by problem.toml
    state_names=("T",),
    state_units=("degC",),
)
