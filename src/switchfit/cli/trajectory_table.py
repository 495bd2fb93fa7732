"""The trajectories that `switchfit simulate` writes: at which times, and as CSV."""

from __future__ import annotations

import contextlib
import csv
import io
from collections.abc import Sequence
from typing import Literal

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.fit.trajectory import Trajectory
from switchfit.problem.experiment import Experiment
from switchfit.runtime.errors import InputError

MOST_SIMULATED_TIMES = 10_000_000


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
    if given in ("", "samples"):
        return "samples" if given else None
    # tf may be estimated: then the grid ends at its guess.
    t0, tf = experiment.ends_of_modes(experiment.initial_times)[[0, -1]].tolist()
    step = np.nan
    # What is no number stays NaN, which no comparison below accepts.
    with contextlib.suppress(ValueError):
        step = float(given)
    if not (0 < step < np.inf and (tf - t0) / step < MOST_SIMULATED_TIMES):
        raise InputError(
            "--times must be 'samples', or a positive step, such as 0.1, that makes at most "
            f"{MOST_SIMULATED_TIMES:,} times from "
            f"t0 = {t0:g} to tf = {tf:g}; got {given!r}."
        )
    # A quotient such as 0.3 / 0.1 is 2.9999999999999996: the last time must not be lost, nor lie behind tf by rounding.
    count = int(np.floor((tf - t0) / step * (1 + 1e-12)))
    return np.minimum(t0 + step * np.arange(count + 1), tf)


def write_trajectories(names: Sequence[str], runs: Sequence[Trajectory]) -> str:
    """Return trajectories as CSV: a row for each node or time, with the run, the mode and the states.

    Parameters
    ----------
    names : sequence of str
    runs : sequence of Trajectory

    Raises
    ------
    ValueError
        If they have times in different units.
    """
    units = {run.time_unit for run in runs}
    if len(units) > 1:
        raise ValueError(
            f"the experiments have times in different units ({', '.join(sorted(units))}), and one column of the "
            "CSV file would mix them: give each its own problem file."
        )
    (unit,) = units
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\r\n")
    # A column that some rows leave empty, so that all runs are one table.
    dated = any(run.origin is not None for run in runs)
    columns = ["t" if unit == "s" else f"t ({unit})", *(["date"] if dated else [])]
    table.writerow(["experiment", *columns, "mode", *runs[0].state_names])
    for name, run in zip(names, runs, strict=True):
        dates = [""] * len(run.times) if run.dates is None else [date.isoformat() for date in run.dates]
        for t, date, mode, x in zip(run.times.tolist(), dates, run.modes, run.states.tolist(), strict=True):
            table.writerow([name, t, *([date] if dated else []), mode, *x])
    return text.getvalue()
