"""The times at which the command line simulates."""

from __future__ import annotations

from typing import Literal

import numpy as np

from switchfit.problem.data import FloatArray
from switchfit.problem.experiment import Experiment
from switchfit.runtime.errors import InputError

MOST_TIMES = 10_000_000


def choose_times(given: str, experiment: Experiment) -> FloatArray | Literal["samples"] | None:
    """Return the times that ``--times`` stands for, (K,): a step from t0 to tf, "samples", or None if it is left out.

    Parameters
    ----------
    given : str
    experiment : Experiment

    Raises
    ------
    InputError
        If it is neither, or the step makes no or too many times.
    """
    if not given:
        return None
    if given == "samples":
        return "samples"
    try:
        step = float(given)
    except ValueError:
        raise InputError(f"--times must be a step, such as 0.1, or 'samples'; got {given!r}.") from None
    t0, tf = experiment.ends_of_modes(experiment.initial_times)[[0, -1]].tolist()
    if not (0 < step < np.inf and (tf - t0) / step < MOST_TIMES):
        raise InputError(
            f"--times must be a positive step that makes at most {MOST_TIMES:,} times from t0 = {t0:g} to tf = {tf:g}; "
            f"got {given}."
        )
    count = int(np.floor((tf - t0) / step * (1 + 1e-12)))
    return np.minimum(t0 + step * np.arange(count + 1), tf)
