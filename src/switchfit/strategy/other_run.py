"""The problem of another run from a fit: its parameters, and what the run says of itself.

The other run may be given whole, as an experiment or a problem, or as a log alone; then it is the fit's only experiment
with other data, and whatever the log leaves out is as it was there. `validate` alone asks for it.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from switchfit.problem.data import count_from
from switchfit.problem.dates import Dates
from switchfit.problem.experiment import Experiment, show_time
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem
from switchfit.problem.validation.messages import join_names, shorten
from switchfit.problem.validation.tables import list_columns
from switchfit.uncertainty.judged_fit import JudgedFit


def build_other_problem(estimate: JudgedFit, other: Any) -> Problem:
    """Return the problem of another run, in which the parameters of a fit begin at their fitted values, without priors.

    Parameters
    ----------
    estimate : JudgedFit
    other : Experiment, list of Experiment, Problem, Measurements or Log
    """
    if isinstance(other, Problem):
        given, runs = other, list(other.experiments)
    else:
        given = estimate.evaluator_at_solution().problem
        runs = list(other) if isinstance(other, (list, tuple)) else [other]
        if not runs or not all(isinstance(item, Experiment) for item in runs):
            runs = [_build_experiment(estimate, given, other)]
    parameters = {}
    for name, parameter in given.parameters.items():
        if name in estimate.parameters:
            value = estimate.parameters[name]
            # Bounds of the other problem do not know the fitted value: they are widened to hold it.
            bounds = {"lower": np.minimum(parameter.lower, value), "upper": np.maximum(parameter.upper, value)}
            held = parameter.fixed or name in estimate.fixed
            # The prior is in the fitted value already: once more it would pull the prediction, and count in chi-square.
            parameter = replace(parameter, value=value, **bounds, prior=None, fixed=held)
        parameters[name] = parameter
    return replace(given, experiments=runs, parameters=parameters)


def _build_experiment(estimate: JudgedFit, problem: Problem, other: Any) -> Experiment:
    """Return the only experiment of a fit with the data of another log."""
    run, given = problem.experiments[0], list(other) if isinstance(other, (list, tuple)) else [other]
    items = run.measurements
    # A pandas table has columns too, but no times: for that there is no way to know which column counts them.
    is_log = list_columns(other) is not None and hasattr(other, "times")
    if not is_log and not (given and all(isinstance(item, Measurements) for item in given)):
        raise TypeError(
            "validate needs another run: an sf.Experiment or a list of them, an sf.Problem, sf.Measurements or a log; "
            f"got {shorten(other)}."
        )
    if len(problem.experiments) > 1 or run.inputs is not None or len(items) != len(run.data):
        raise ValueError(
            "another log has measurements alone, but the fit has several experiments, inputs, or other data than "
            "sf.Measurements: give validate an sf.Experiment, which says what the other run is."
        )
    if is_log:
        given = [_read_channels(other, item) for item in items]
    if len(given) != len(items):
        raise ValueError(f"the fit has {len(items)} Measurements; got {len(given)} for the other run.")
    data = _count_dates([_complete(new, item) for new, item in zip(given, items, strict=True)], run)
    first, last = min(item.seen_times[0] for item in data), max(item.times[-1] for item in data)
    # A horizon that came from the data of the fit comes from these data; one that was given stays.
    t0 = first if "t0" in run.taken_from_data else run.t0
    # The other run has transition times of its own, estimated from its data: those of the fit are no more than a guess,
    # and where they do not lie inside the new horizon, even spaces are one.
    times = estimate.transition_times[0]
    if np.any(np.diff([t0, *times, last]) <= 0):
        times = np.linspace(t0, last, len(run.mode_sequence) + 1)[1:-1]
    guesses = tuple(
        replace(tau, value=np.clip(time, tau.lower, tau.upper), prior=None)
        for tau, time in zip(run.transition_times, times, strict=True)
    )
    return replace(run, data=data, t0=t0, tf=run.tf if run.has_free_tf else last, transition_times=guesses)


def _count_dates(data: list[Measurements], run: Experiment) -> list[Measurements]:
    """Return Measurements of another log with dates as numbers since the origin of the run of the fit."""
    dated = [item for item in data if isinstance(item.times, Dates)]
    if dated and run.origin is None:
        raise ValueError(
            "the other log has dates, and the times of the fit are numbers: give validate an sf.Experiment, whose "
            "origin says at which date its times are 0."
        )
    # Times of both logs count from the same date, so that a guess of a transition means the same moment.
    counted = data if run.origin is None else [count_from(item, run.origin, run.time_unit) for item in data]
    if dated and "t0" not in run.taken_from_data and min(item.times[0] for item in counted) > run.end:
        raise ValueError(
            f"the other log begins at {dated[0].times[0]!r}, after the end of the fit's horizon at "
            f"{show_time(run, run.end)}: give validate an sf.Experiment, which says when the other run begins."
        )
    return counted


def _read_channels(log: Any, like: Measurements) -> Measurements:
    """Return the Measurements of a log's columns that are called like the channels of others."""
    if like.names is None:
        raise ValueError(
            "the channels of the fit have no names by which to find the columns of the log: give its Measurements "
            "names, or give validate sf.Measurements."
        )
    missing = [name for name in like.names if name not in log]
    if missing:
        raise ValueError(f"the log has no column {join_names(missing)}; it has {join_names(list(log.columns))}.")
    values = np.stack([np.asarray(log[name], dtype=np.float64) for name in like.names], axis=1)
    return Measurements(log.times, values, names=like.names)


def _complete(new: Measurements, like: Measurements) -> Measurements:
    """Return Measurements with what is left out in them taken from others, where the channels are as many."""
    if new.values.shape[1] != like.values.shape[1]:
        raise ValueError(
            f"the Measurements of the fit have {like.values.shape[1]} channels, those of the other run "
            f"{new.values.shape[1]}."
        )
    # What a log does not say about its sensor is as in the fit: the same instrument on another day.
    names = ("sigma", "observe", "names", "units")
    left_out = {name: getattr(like, name) for name in names if getattr(new, name) is None}
    if "sigma" in left_out:
        # One sigma a sample belongs to those samples, of which the other run has others.
        if isinstance(like.sigma, np.ndarray) and like.sigma.ndim == 2:
            raise ValueError(
                "sigma differs from sample to sample in the fit: give the Measurements of the other run their "
                "own sigma."
            )
        left_out |= {"loss": like.loss, "loss_scale": like.loss_scale}
    return replace(new, delay=new.delay or like.delay, **left_out)
