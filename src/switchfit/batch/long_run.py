"""A long run of many fits: its settings, its progress bar, and its results as the fields of `Fits`."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from switchfit.batch.chunks import Work, run_chunks
from switchfit.batch.interval_pieces import list_places
from switchfit.batch.programs import Limits
from switchfit.fit.hidden_switches import refuse_hidden_switches
from switchfit.fit.local_fit import check_settings
from switchfit.fit.statistics import count_priors, measure_variance
from switchfit.meshes.evaluator import evaluator_of
from switchfit.problem.origin import Origin
from switchfit.problem.problem import Problem
from switchfit.problem.validation.objects import as_callable, as_path
from switchfit.runtime.progress import show_progress


class LongRun(NamedTuple):
    """When fits end, where a long run is done and kept, who is told how far it is, and when it began.

    Attributes
    ----------
    limits : Limits
    client, folder : as of `run_chunks`
    callback : callable ``(done, total)``, a true value stops; or None
    began : float
        As of ``time.perf_counter()``.
    """

    limits: Limits
    client: Any
    folder: Path | None
    callback: Callable[[int, int], object] | None
    began: float

    @classmethod
    def check(cls, tolerance: Any, max_iterations: Any, client: Any, folder: Any, callback: Any) -> LongRun:
        """Return these settings; raise for those of the wrong type, before anything long is done."""
        limits = Limits(*check_settings(tolerance, max_iterations))
        if client is not None and not hasattr(client, "submit"):
            raise TypeError(f"client must be a dask.distributed.Client; got {type(client).__name__}.")
        folder = None if folder is None else as_path(folder, "folder")
        if callback is not None:
            as_callable(callback, "callback", "a function callback(done, total)", arguments=2)
        return cls(limits, client, folder, callback, time.perf_counter())


def repeat(problem: Problem, work: Work, count: int, title: str, how: LongRun) -> dict[str, Any]:
    """Do `count` runs with a bar on the terminal: the fields of `Fits`.

    Parameters
    ----------
    problem : Problem
        One of those that are fitted: its names, and whether its noise is known.
    work, count : as of `run_chunks`
    title : str
        Of the bar.
    how : LongRun

    Raises
    ------
    ValueError
        For a problem with a switch that is hidden in a function, with which no fit could be right.
    """
    _refuse_hidden_switches(problem)
    with show_progress(how.callback, title) as progress:
        runs, arrays = run_chunks(work, count, client=how.client, folder=how.folder, progress=progress)
    known, priors, unknowns = problem.is_sigma_known, count_priors(problem), problem.unknowns
    # Covariances of chunks are not scaled: where sigma is unknown, each fit has a residual variance of its own.
    variance = measure_variance(arrays["cost"], arrays["samples"] + priors - arrays["free"], known)
    return arrays | {
        "covariance": variance[:, None, None] * arrays["covariance"],
        "theta_names": problem.theta_names,
        "theta_units": unknowns.units,
        "requested": count,
        "runs": runs,
        "sigma_known": known,
        "priors": priors,
        "piece_places": list_places(problem),
        "log_scaled": unknowns.log_names,
        "log_origins": unknowns.origin,
        "seconds": time.perf_counter() - how.began,
        "date_origins": list_origins(problem),
    }


def _refuse_hidden_switches(problem: Problem) -> None:
    """Raise what `estimate` would raise about the model, before thousands of fits list it one by one."""
    try:
        evaluator, theta = evaluator_of(problem), problem.initial_theta
        gradient = evaluator(theta).gradient
    except Exception:  # a guess at which the model cannot be evaluated: the fits that begin there will say so
        return
    if np.isfinite(gradient).all():
        refuse_hidden_switches(evaluator, theta, gradient)


def list_origins(problem: Problem) -> tuple[Origin | None, ...]:
    """Return the date at which each unknown that is a date is 0; None for every other."""
    found: list[Origin | None] = [None] * len(problem.theta_names)
    for experiment, places in zip(problem.experiments, problem.unknowns.times, strict=True):
        for place in places[places >= 0].tolist():
            found[place] = experiment.origin
    return tuple(found)
