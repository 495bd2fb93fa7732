"""Samples and inputs of an experiment in the form in which an online estimator takes them.

Samples of several sensors come in the order of time, with one sigma for each channel; inputs hold until others come.
"""

from __future__ import annotations

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.problem.inputs import Input
from switchfit.problem.measurements import Measurements


def list_updates(noisy: list[tuple[FloatArray, FloatArray]]) -> list[tuple[float, dict[int, FloatArray]]]:
    """Return the samples of sensors, each with times (K,) and values (K, q), in the order of time."""
    found: dict[float, dict[int, FloatArray]] = {}
    for k, (times, values) in enumerate(noisy):
        for t, row in zip(times.tolist(), values, strict=True):
            found.setdefault(t, {})[k] = row
    return sorted(found.items(), key=lambda each: each[0])


def read_sigma(item: Measurements) -> FloatArray:
    """Return sigma of each channel, (q,): that of its first value, if it has one for each."""
    if item.sigma.ndim < 2:
        return np.broadcast_to(item.sigma, item.values.shape[1:])
    # One for each channel, of the first sample in which that is not missing.
    return np.asarray(np.diagonal(item.sigma[(~np.isnan(item.values)).argmax(0)]))


def hold_inputs(inputs: Input, times: FloatArray, values: FloatArray) -> Input:
    """Return inputs like those of an experiment that hold values (K, q) from times (K,) on."""
    names = inputs.names
    return Input(times, dict(zip(names, values.T, strict=True)) if names else values.reshape(-1, *inputs.shape))
