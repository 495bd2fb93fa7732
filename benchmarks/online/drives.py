"""Simulated drives of the skid-steered vehicle, and what an estimator is told of them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from switchfit.models import skid_steer

PERIOD, SIGMA, MU, GUESS, BOUNDS = 0.1, 0.05, 0.7, 0.8, (0.05, 2.0)
"""s; m of positions and rad of headings; s/m."""
SENSORS = {"positions": (0, 2), "positions and headings": (0, 2, 4)}
"""Measured states."""
SYSTEM = skid_steer()
"""One system for all drives: its programs are compiled once."""


class Drive(NamedTuple):
    """Times of the changes (N,), times of the samples (K,), and their values (K, 3): both positions and the heading."""

    taus: np.ndarray
    times: np.ndarray
    values: np.ndarray

    def read(self, sensor: str) -> Iterator[tuple[float, np.ndarray]]:
        """Yield the samples, one after the other."""
        return zip(self.times.tolist(), self.values[:, : len(SENSORS[sensor])], strict=True)


def simulate(taus: np.ndarray, length: float, rng: np.random.Generator) -> Drive:
    """Return a drive that begins in "stick" and changes at these times."""
    modes = tuple(("stick", "slip")[k % 2] for k in range(len(taus) + 1))
    run = sf.Experiment(sf.RunningCost(lambda t, x, p: 0.0), modes, tuple(taus), 0.0, length)
    times = PERIOD * np.arange(1, round(length / PERIOD) + 1)
    truth = sf.Problem(SYSTEM, run, {"mu": MU}, max_transitions=2 * len(taus) + 4)
    states = sf.simulate(truth, times=times).states[:, SENSORS["positions and headings"]]
    return Drive(taus, times, states + SIGMA * rng.standard_normal(states.shape))


def build_problem(sensor: str) -> sf.Problem:
    """Return what the estimator is told: the model, the sensor, and a guess of mu."""
    seen = SENSORS[sensor]
    data = sf.Measurements(
        [PERIOD, 2 * PERIOD], np.zeros((2, len(seen))), lambda t, x, p: jnp.stack([x[k] for k in seen]), SIGMA
    )
    run = sf.Experiment(data, ("stick",), (), 0.0, 1.0)
    return sf.Problem(SYSTEM, run, {"mu": sf.Parameter(GUESS, lower=BOUNDS[0], upper=BOUNDS[1])})
