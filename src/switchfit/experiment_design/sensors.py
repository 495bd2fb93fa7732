"""The sensors of a run: what they are called, and which sets of them their number or their costs allow.

A set is listed if no larger one is allowed that has all of it, with the most samples of each sensor.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.problem.experiment import Experiment
from switchfit.problem.validation.arrays import as_count, as_positive
from switchfit.problem.validation.messages import join_names, shorten

MOST_SENSORS = 12
"""Sensors of which all sets are looked at."""


def name_sensors(run: Experiment) -> tuple[str, ...]:
    """Return what each of the `Measurements` of a run is called: the names of its channels, or sensor 1, 2, ...

    Parameters
    ----------
    run : Experiment
    """
    names = [", ".join(item.names or ()) or f"sensor {k}" for k, item in enumerate(run.data, start=1)]
    return tuple(f"{name} ({k})" if names.count(name) > 1 else name for k, name in enumerate(names, start=1))


def list_sample_limits(
    run: Experiment, labels: tuple[str, ...], samples: Any, sensors: Any, budget: float | None
) -> list[NDArray[np.intp]]:
    """Return the most samples of each sensor, (S,), for each largest set of sensors that number or costs allow."""
    counts = samples if isinstance(samples, Mapping) else dict.fromkeys(labels, samples)
    costs = sensors if isinstance(sensors, Mapping) else dict.fromkeys(labels, 1.0)
    for what, given in (("samples", counts), ("sensors", costs)):
        if unknown := [name for name in given if name not in labels]:
            raise ValueError(f"{what} names {shorten(unknown[0])}; the sensors are {join_names(labels)}.")
    # Costs without a budget limit nothing, and a budget needs costs.
    if (budget is None) == isinstance(sensors, Mapping):
        raise ValueError("budget and the costs of sensors belong together: give sensors={name: cost} and budget.")
    whole = np.array([len(item.times) for item in run.data])
    for s, name in enumerate(labels):
        if counts.get(name) is not None:
            whole[s] = min(whole[s], as_count(counts[name], f"samples of {name}", at_least=1))
    if sensors is None:
        return [whole]
    if len(labels) > MOST_SENSORS:
        raise ValueError(f"sensors can be chosen among {MOST_SENSORS}; there are {len(labels)}.")
    prices = np.array([as_positive(costs[name], f"cost of {name}") if name in costs else 0.0 for name in labels])
    most = as_count(sensors, "sensors", at_least=1) if budget is None else as_positive(budget, "budget")
    # All sets of sensors, of which `MOST_SENSORS` keeps the number small.
    every = np.array(list(product((0, 1), repeat=len(labels))))
    allowed = every[every @ prices <= most]
    # More sensors never tell less: sets inside an allowed one need not be tried.
    largest = [own for own in allowed if not any(np.all(other >= own) and np.any(other > own) for other in allowed)]
    if not np.any(largest):
        raise ValueError(f"no sensor is within the budget of {most:g}; got costs {shorten(dict(costs))}.")
    return [whole * own for own in largest]
