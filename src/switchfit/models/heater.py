"""A heater that is switched off: the smallest problem with a transition, for examples."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from switchfit.arrays import Traced
from switchfit.problem.experiment import Experiment
from switchfit.problem.measurements import Measurements
from switchfit.problem.parameter import Parameter
from switchfit.problem.problem import Problem
from switchfit.problem.system import HybridSystem

OFF, LOSS, SENSOR_NOISE = 2.5, 0.4, 0.2
"""True values of the simulated log: time at which the heater is switched off (h), loss rate (1/h), noise (K)."""


def heater_problem() -> Problem:
    """Return a small problem with simulated data: when was the heater switched off, and how fast does it cool?

    The state is the temperature above that of the room (K), initially 0:

    on: ``dT/dt = power - k T``; off: ``dT/dt = -k T``.

    Returns
    -------
    Problem
        Its unknowns are ``tau_1`` (h), first guess 2, and ``k`` (1/h), first guess 0.5; ``power`` is known, 10 K/h.
        The 24 measurements, one every quarter of an hour, were simulated with tau_1 = 2.5 h, k = 0.4/h and noise of
        0.2 K.

    See Also
    --------
    switchfit.models.sliding_block, switchfit.models.skid_steer : models to fit to a log.

    Examples
    --------
    >>> sf.estimate(heater_problem()).theta.round(1)
    array([2.5, 0.4])
    """
    times = np.linspace(0.25, 6.0, 24)
    # The seed stays: the numbers of the tutorial and of many tests are those of this log.
    noise = SENSOR_NOISE * np.random.default_rng(0).normal(size=len(times))
    log = Measurements(times, _temperature(times) + noise, sigma=SENSOR_NOISE, names=("thermometer",))
    system = HybridSystem({"on": _on, "off": _off}, [0.0], state_names=("T",), state_units=("K",))
    parameters = {
        "k": Parameter(0.5, lower=0.01, upper=5.0, unit="1/h"),
        "power": Parameter(10.0, fixed=True, unit="K/h"),
    }
    return Problem(system, Experiment(log, ("on", "off"), (2.0,), 0.0, 6.0, time_unit="h"), parameters)


def _on(t: Traced, x: Traced, p: Mapping[str, Traced]) -> Traced:
    return p["power"] - p["k"] * x


def _off(t: Traced, x: Traced, p: Mapping[str, Traced]) -> Traced:
    return -p["k"] * x


def _temperature(times: Traced) -> Traced:
    """Return the closed form of the solution with `OFF` and `LOSS`."""
    on = np.minimum(times, OFF)
    return 10.0 / LOSS * (1.0 - np.exp(-LOSS * on)) * np.exp(-LOSS * (times - on))
