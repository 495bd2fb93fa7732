"""What many fits found: arrays with one entry a fit."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy.special
from numpy.typing import NDArray

from switchfit.batch.chunks import Work, run_chunks
from switchfit.fit.evaluator import evaluator_of
from switchfit.fit.hidden import refuse_hidden_switches
from switchfit.fit.result import interval
from switchfit.fit.solution import is_sigma_known
from switchfit.optimize import Status
from switchfit.problem.data import FloatArray, Measurements
from switchfit.problem.problem import Problem
from switchfit.problem.validation import as_callable, as_level, as_path
from switchfit.runtime.presentation import format_html, format_text
from switchfit.runtime.progress import show_progress


@dataclass(frozen=True, eq=False)
class Fits:
    """Many fits of one model; R of them, d unknowns in the order of `theta_names`.

    Attributes
    ----------
    theta_names, theta_units : tuple of str
    requested : int
        Fits that were asked for; more than R if it was stopped.
    runs : (R,) int
        Number of each fit, from 0.
    start, theta : (R, d)
    cost : (R,)
    gradient, hessian : (R, d), (R, d, d)
    optimality : (R,)
    iterations, evaluations : (R,) int
    status : (R,) str
        Name of the `Status` of each.
    message : (R,) str
        A sentence with a remedy where a fit is not an ordinary minimum, otherwise empty.
    free : (R,) int
        Directions that constraints and kinks leave free.
    covariance : (R, d, d)
        As `Estimate.covariance`; NaN where the cost has no noise model.
    samples : (R,) int
        Measured values that are not missing.
    sigma_known : bool or None
        Whether the noise of the measurements is known; None where the cost has no noise model.
    log_scaled : tuple of str
        Unknowns that were estimated on a logarithmic scale.
    seconds : float
        Wall time of all.

    See Also
    --------
    estimate_many, monte_carlo, multistart, bootstrap

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> fits = sf.estimate_many([heater_problem(), heater_problem()])
    >>> len(fits), fits.success
    (2, array([ True,  True]))
    >>> fits.theta.round(3)
    array([[2.462, 0.393],
           [2.462, 0.393]])
    """

    theta_names: tuple[str, ...]
    theta_units: tuple[str, ...]
    requested: int
    runs: NDArray[np.intp]
    start: FloatArray
    theta: FloatArray
    cost: FloatArray
    gradient: FloatArray
    hessian: FloatArray
    optimality: FloatArray
    iterations: NDArray[np.int64]
    evaluations: NDArray[np.int64]
    status: NDArray[np.str_]
    message: NDArray[np.str_]
    free: NDArray[np.int64]
    covariance: FloatArray
    samples: NDArray[np.int64]
    sigma_known: bool | None
    log_scaled: tuple[str, ...]
    seconds: float

    def __len__(self) -> int:
        """Number of fits that were done."""
        return len(self.cost)

    @cached_property
    def success(self) -> NDArray[np.bool_]:
        """Which of them converged, by `Status.successful`: (R,). Many fits have no verdict, an `Estimate` has."""
        good = [status.name for status in Status if status.successful]
        return np.isin(self.status, good)

    @property
    def failures(self) -> list[tuple[int, str]]:
        """Number and message of each fit that did not converge."""
        return [(int(self.runs[k]), str(self.message[k])) for k in np.flatnonzero(~self.success)]

    @property
    def standard_errors(self) -> FloatArray:
        """Square roots of the variances: (R, d)."""
        with np.errstate(invalid="ignore"):
            return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    def confidence_intervals(self, level: float = 0.95) -> FloatArray:
        """Return intervals theta +- quantile x standard error of each fit: (R, d, 2).

        They take the cost for one parabola: of a transition time with samples within its interval, and at a kink,
        where they are NaN, those of a single `Estimate.confidence_intervals` are better.

        See Also
        --------
        Estimate.confidence_intervals, MonteCarlo.coverage

        Examples
        --------
        >>> import switchfit as sf
        >>> from switchfit.models import heater_problem
        >>> fits = sf.estimate_many([heater_problem()])
        >>> fits.confidence_intervals(0.9).round(2)
        array([[[2.43, 2.49],
                [0.38, 0.4 ]]])
        """
        level = as_level(level)
        freedom, tail = np.maximum(self.samples - self.free, 1), 0.5 + level / 2
        quantile = scipy.special.stdtrit(freedom, tail) if self.sigma_known is False else scipy.special.ndtri(tail)
        half = np.reshape(quantile, (-1, 1)) * self.standard_errors
        return interval(self.theta, half, np.isin(self.theta_names, self.log_scaled))

    def __str__(self) -> str:
        return format_text(self)

    def _repr_html_(self) -> str:
        return format_html(self)


def check_long_run(client: Any, folder: Any, callback: Any) -> None:
    """Raise for settings of a long run of the wrong type, before anything long is done."""
    if client is not None and not hasattr(client, "submit"):
        raise TypeError(f"client must be a dask.distributed.Client; got {type(client).__name__}.")
    if folder is not None:
        as_path(folder, "folder")
    if callback is not None:
        as_callable(callback, "callback", "a function callback(done, total)", arguments=2)


def repeat(
    problem: Problem,
    work: Work,
    count: int,
    title: str,
    began: float,
    *,
    client: Any,
    folder: str | Path | None,
    callback: Callable[[int, int], object] | None,
) -> dict[str, Any]:
    """Do `count` runs with a bar on the terminal: the fields of `Fits`.

    Parameters
    ----------
    problem : Problem
        One of those that are fitted: its names, and whether its noise is known.
    work, count, client, folder : as of `run_chunks`
    title : str
        Of the bar.
    began : float
        ``time.perf_counter()`` when the call began.
    callback : callable ``(done, total)``, a true value stops; or None

    Raises
    ------
    ValueError
        For a problem with a switch that is hidden in a function, with which no fit could be right.
    """
    _refuse_hidden_switches(problem)
    progress, end = show_progress(callback, title)
    try:
        runs, arrays = run_chunks(work, count, client=client, folder=folder, progress=progress)
    finally:
        end()
    return _collect_fields(problem, count, runs, arrays, time.perf_counter() - began)


def _refuse_hidden_switches(problem: Problem) -> None:
    """Raise what `estimate` would raise about the model, before thousands of fits list it one by one."""
    try:
        evaluator, theta = evaluator_of(problem), problem.initial_theta
        gradient = evaluator(theta).gradient
    except Exception:  # a guess at which the model cannot be evaluated: the fits that begin there will say so
        return
    if np.isfinite(gradient).all():
        refuse_hidden_switches(evaluator, theta, gradient)


def _collect_fields(
    problem: Problem, requested: int, runs: NDArray[np.intp], arrays: dict[str, NDArray[Any]], seconds: float
) -> dict[str, Any]:
    """Return the fields of `Fits` from what the chunks found, covariances scaled by the residual
    variance where needed.
    """
    known = is_sigma_known(problem)
    samples = arrays["samples"]
    freedom = samples - arrays["free"]
    scale = np.ones(len(samples)) if known else np.full(len(samples), np.nan)
    if known is False:
        scale = np.where(freedom > 0, 2 * arrays["cost"] / np.maximum(freedom, 1), np.nan)
    named = {f.name for f in fields(Fits)}
    found = {name: array for name, array in arrays.items() if name in named}
    found["covariance"] = scale[:, None, None] * arrays["covariance"]
    return {
        "theta_names": problem.theta_names,
        "theta_units": problem.unknowns.units,
        "requested": requested,
        "runs": runs,
        "sigma_known": known,
        "log_scaled": problem.unknowns.log_names,
        "seconds": seconds,
        **found,
    }


def count_samples(problem: Problem) -> int:
    """Return the measured values that are not missing."""
    return sum(item.count for run in problem.experiments for item in run.data if isinstance(item, Measurements))
