"""The sensors of an online estimator: their channels and weights, and the values of an update."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.online.samples import read_sigma
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem
from switchfit.problem.validation.arrays import as_array, as_index, as_number
from switchfit.problem.validation.messages import join_names, shorten


class Sensors:
    """The measurements of a problem, by the names of their channels and by their positions in the data.

    Attributes
    ----------
    items : list of Measurements
    weights : list of (q,) arrays
        1 / sigma^2 of the channels of each.
    spacing : float or None
        The usual time between samples; None if no sensor has two.
    """

    def __init__(self, problem: Problem) -> None:
        self.items = _check_problem(problem)
        self.weights = [read_sigma(item) ** -2.0 for item in self.items]
        self._channels: dict[str, tuple[int, int]] = {}
        for k, item in enumerate(self.items):
            for column, name in enumerate(item.names or ()):
                # Of two channels with one name the first has it; the other is reached by the position of its sensor.
                self._channels.setdefault(name, (k, column))
        gaps = [float(np.median(np.diff(item.times))) for item in self.items if len(item.times) > 1]
        self.spacing = min(gaps, default=None)

    def read(self, y: object) -> dict[int, FloatArray]:
        """Return the values (q,) of the sensors of an update by their places, NaN where one is missing."""
        if y is not None and not isinstance(y, Mapping):
            if len(self.items) > 1:
                raise ValueError(
                    f"there are {len(self.items)} sensors: give y as a dict, by the names of channels, or by the "
                    "positions of the sensors in the data."
                )
            y = {0: y}
        found: dict[int, FloatArray] = {}
        for key, value in ({} if y is None else y).items():
            if isinstance(key, str):
                if key not in self._channels:
                    known = ", ".join(self._channels) or "none has a name"
                    raise ValueError(f"y has {shorten(key)}, which is no channel; there are: {known}.")
                k, column = self._channels[key]
                found.setdefault(k, np.full(len(self.weights[k]), np.nan))[column] = as_number(value, key)
                continue
            k = as_index(key, "the position of a sensor", len(self.items))
            found[k] = as_array(value, f"y of sensor {k}").reshape(-1)
            if found[k].size != len(self.weights[k]):
                raise ValueError(f"y must have {len(self.weights[k])} values of a sensor; got {found[k].size}.")
        for row in found.values():
            if np.isinf(row).any():
                raise ValueError(f"y must be finite, or NaN where a value is missing; got {shorten(row.tolist())}.")
        # A sensor of which all values are missing has said nothing: it takes no place in the log.
        return {k: row for k, row in found.items() if np.isfinite(row).any()}


def _check_problem(problem: Problem) -> list[Measurements]:
    """Return the sensors of a problem that can be estimated online; ValueError for others."""
    run = problem.experiments[0]
    sensors = list(run.measurements)
    wrong = {
        f"{len(problem.experiments)} runs": len(problem.experiments) > 1,
        "other data": len(sensors) < len(run.data),
        "jumps at known times": bool(run.jumps),
        "a sigma that is left out": any(item.sigma is None for item in sensors),
        "a sigma that is a parameter": any(item.sigma_names for item in sensors),
        "a delay that is a parameter": any(isinstance(item.delay, str) for item in sensors),
    }
    found = [what for what, is_there in wrong.items() if is_there]
    if found:
        raise ValueError(
            "an online estimator takes one run of sf.Measurements whose sigma and delay are numbers, which tell a "
            f"change of mode from noise; the problem has {join_names(found)}."
        )
    return sensors
