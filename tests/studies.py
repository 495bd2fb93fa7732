"""Problems for studies of many fits: smooth ones, ones with collapsing modes, and ones with kinks at samples."""

from __future__ import annotations

import numpy as np
from models import drive, fishing, heated_room, linear, rest

import switchfit as sf


def vehicle() -> sf.Problem:
    """The paper's vehicle with the cost 1/2 |x|^2: two switches and the friction."""
    return drive(sf.RunningCost(lambda t, x, p: 0.5 * (x @ x)))


ROOM = heated_room()


def thermostat() -> tuple[sf.Problem, np.ndarray]:
    """A room whose heater goes on and off three times, forty samples; and a truth."""
    times = np.linspace(0.25, 10.0, 40)
    data = sf.Measurements(times, np.zeros(40), sigma=0.02)
    run = sf.Experiment(data, ("on", "off", "on", "off", "on", "off"), (1.5, 3.5, 5.0, 6.5, 8.5), 0.0, 10.0)
    parameters = {"power": sf.Parameter(1.2, lower=0.2, upper=5.0), "k": sf.Parameter(0.6, lower=0.05, upper=3.0)}
    return sf.Problem(ROOM, run, parameters), np.array([1.83, 3.4, 5.32, 6.7, 8.1, 1.0, 0.8])


RAMPS = sf.HybridSystem(
    {"rest": rest, "up": lambda t, x, p: 0.0 * x + p["rate"], "down": lambda t, x, p: 0.0 * x - 1.0}, [0.0]
)


def ramps() -> tuple[sf.Problem, np.ndarray]:
    """Ramps between samples that are few and noisy: most fits end at a kink, where a transition meets a sample."""
    times = np.linspace(0.5, 6.0, 12)
    data = sf.Measurements(times, np.zeros(12), sigma=0.4)
    run = sf.Experiment(data, ("rest", "up", "rest", "down"), (1.3, 2.6, 4.3), 0.0, 6.0)
    return sf.Problem(RAMPS, run, {"rate": sf.Parameter(1.0, lower=0.1, upper=4.0)}), np.array([1.1, 2.8, 4.6, 1.2])


MULTISTART = {"fishing": fishing, "linear": linear, "vehicle": vehicle}
"""Problems without data: every start fits the same."""

MEASURED = {"thermostat": thermostat, "ramps": ramps}
"""Problems with data that are drawn anew for every fit, each with its truth."""
