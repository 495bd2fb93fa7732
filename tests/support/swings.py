"""Problems with every kind of measurement and cost, late samples, reset maps and guards."""

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from support.models import decay, one_run

TIMES = np.linspace(0.0, 3.0, 16)
VALUES = np.random.default_rng(5).normal(size=(16, 2))


def swing(t, x, p):
    return jnp.array([x[1], -p["k"] * jnp.sin(x[0]) - 0.2 * x[1]])


def fall(t, x, p):
    return jnp.array([x[1], -p["g"] + 0.1 * t * x[0]])


MODES = {"swing": swing, "fall": fall, "rest": decay}
BOUNCE = {("fall", "swing"): lambda t, x, p: jnp.array([x[0], -0.7 * p["k"] * x[1] + 0.1 * t])}
GUARDS = {("swing", "fall"): lambda t, x, p: x[0] - 0.3 * p["k"] + 0.1 * t * x[1]}
SYSTEM = sf.HybridSystem(MODES, [0.4, 0.1], BOUNCE)
PARAMETERS = {"k": sf.Parameter(1.2, lower=0.1), "g": 0.8}


def problem(data, sequence=("swing", "fall", "swing"), times=(1.1, 2.3), system=SYSTEM, parameters=None, **settings):
    return one_run(system, data, sequence, times, 3.0, PARAMETERS | (parameters or {}), **settings)


def samples(**settings):
    return sf.Measurements(TIMES, VALUES, **{"sigma": 0.5} | settings)


DATA = {
    "late, robust": sf.Measurements(TIMES[2:], VALUES[2:], sigma="s", delay="d", loss="soft_l1"),
    "reference, running": [
        sf.ReferenceSignal.from_samples(TIMES, VALUES, weights=np.array([[2.0, 0.3], [0.3, 1.0]])),
        sf.RunningCost(lambda t, x, p: x[0] ** 2 * x[1] ** 2 + p["k"] * t * x[0]),
        sf.Measurements(TIMES[2:], VALUES[2:], sigma=0.5, delay="d"),
    ],
    "transitions, end": [
        samples(),
        sf.TransitionCost(lambda t, x, p: p["k"] * x[0] ** 2 * x[1] + (t - 1.2) ** 2 * x[1]),
        sf.TerminalCost(lambda x, p: p["k"] * x[0] ** 2 * x[1]),
    ],
}
DATA["late, robust, transitions, end"] = [DATA["late, robust"], *DATA["transitions, end"][1:]]
RICH = ("late, robust, transitions, end", "reference, running")
"""Kinds of data that have all that others have, too."""

MORE = {"s": sf.Parameter(0.7, lower=0.1), "d": sf.Parameter(0.13, lower=0.0, upper=0.25)}
