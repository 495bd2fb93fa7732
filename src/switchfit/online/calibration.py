"""The threshold for a rate of false alarms, by simulation of a system whose mode does not change."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.fit.comparison import compare
from switchfit.meshes.evaluator import Evaluator
from switchfit.online.samples import hold_inputs, list_updates, read_sigma
from switchfit.online.state import OnlineStatus
from switchfit.problem.problem import Problem
from switchfit.problem.validation.arrays import as_count, as_number, as_positive
from switchfit.problem.validation.messages import shorten

NEVER = 100.0
"""Threshold in the simulations, which their statistics do not reach."""

EXCESS = 1.179
"""Mean of M - m over the runs whose maximum M exceeds the median m, where the rate falls as exp(-(h - m)): the integral
of ``2 (1 - exp(-u)) / u`` from 0 to log 2."""


class Calibration(NamedTuple):
    """The threshold for a rate of false alarms.

    Attributes
    ----------
    threshold : float
    false_alarms : float
        The rate that was asked for, per time unit.
    seconds : float
        Length of each run.
    maxima : (runs,) array
        The largest statistic of each.

    See Also
    --------
    calibrate

    Examples
    --------
    >>> found = sf.calibrate(sf.OnlineEstimator(heater_problem()), false_alarms=0.01, seconds=2.0, runs=10)
    >>> found.seconds, len(found.maxima)
    (2.0, 10)
    """

    threshold: float
    false_alarms: float
    seconds: float
    maxima: FloatArray

    def __str__(self) -> str:
        runs, beyond = len(self.maxima), int((self.maxima > self.threshold).sum())
        return (
            f"threshold {self.threshold:.4g} for {self.false_alarms:.3g} false alarms per time unit, from {runs} runs "
            f"of {self.seconds:.4g} without a change; {beyond} of them exceed it"
        )


def calibrate(
    online: Any,
    false_alarms: float,
    *,
    seconds: float = 20.0,
    runs: int = 100,
    correlation: float = 0.0,
    seed: int = 0,
) -> Calibration:
    """Find the threshold for a rate of false alarms.

    The system is simulated in one mode, with noise; the largest statistic M of each run is what a threshold would have
    to exceed. Half of the runs exceed their median m, at the rate ``log(2) / seconds``; beyond it, the rate is taken to
    fall as ``exp(-(h - m) / s)``, for which the mean of ``M - m`` over those that do is 1.179 s.

    Parameters
    ----------
    online : OnlineEstimator
        Whose problem and settings are used. If it has had samples, the mode, state and parameters are the present ones,
        otherwise those with which the problem begins.
    false_alarms : float
        Rate, per time unit.
    seconds : float
        Length of a run, in the experiment's time unit.
    runs : int
        At least 10.
    correlation : float
        Of the noise from one sample to the next: a sensor whose noise is correlated raises more alarms.
    seed : int

    Returns
    -------
    Calibration
        Give its threshold to `OnlineEstimator.set_threshold`.

    Raises
    ------
    ValueError
        For a rate or a length that is not positive, a correlation outside [0, 1), fewer than 10 runs, or where the
        time between samples is not known.

    See Also
    --------
    OnlineEstimator : does this if it is given `false_alarms`.

    Examples
    --------
    >>> online = sf.OnlineEstimator(heater_problem())
    >>> found = sf.calibrate(online, false_alarms=0.01, seconds=2.0, runs=10)
    >>> len(found.maxima)
    10
    """
    if not hasattr(online, "_build_like"):
        raise TypeError(f"online must be an sf.OnlineEstimator; got {shorten(online)}.")
    rate, length = as_positive(false_alarms, "false_alarms"), as_positive(seconds, "seconds")
    if as_count(runs, "runs") < 10:
        raise ValueError(f"runs must be at least 10, to know how the statistic is distributed; got {runs}.")
    phi = as_number(correlation, "correlation")
    if not 0 <= phi < 1:
        raise ValueError(f"correlation must be at least 0 and below 1; got {phi}.")
    problem = _build_quiet_problem(online, length)
    theta = problem.initial_theta
    # One trajectory for all runs: it has no changes, and noise enters its samples alone.
    comparisons = compare(Evaluator(problem, theta), theta)[1][0]
    trial = online._build_like(problem, NEVER)
    rng, maxima = np.random.default_rng(seed), []
    for _ in range(runs):
        trial.reset()
        noisy = []
        for item, comparison in zip(problem.experiments[0].data, comparisons, strict=True):
            noise = rng.standard_normal(comparison.fitted.shape)
            for k in range(1, len(noise)):
                # First-order autoregressive, with variance 1 at every sample.
                noise[k] = phi * noise[k - 1] + np.sqrt(1 - phi**2) * noise[k]
            noisy.append((item.times, comparison.fitted + item.sigma * noise))
        largest = 0.0
        for t, y in list_updates(noisy):
            now = trial.update(t, y)
            # As long as there are fewer values than unknowns, a statistic means nothing, and nothing is declared.
            if now.status is not OnlineStatus.WAITING:
                largest = max(largest, now.statistic)
        maxima.append(largest)
    found = np.array(maxima)
    middle = float(np.median(found))
    # s of the docstring: the mean excess over the median, by `EXCESS`. 0 where no run exceeds it.
    tail = float((found[found > middle] - middle).mean()) / EXCESS if (found > middle).any() else 0.0
    # log(2) / length exp(-(h - m) / s) = rate, solved for h; never below the median, where the tail is not exponential.
    threshold = middle + tail * max(np.log(np.log(2)) - np.log(length) - np.log(rate), 0.0)
    return Calibration(threshold, rate, length, found)


def _build_quiet_problem(online: Any, length: float) -> Problem:
    """Return the problem of one run in the present mode, with empty samples at the usual times."""
    problem, now = online.problem, online.now
    run = problem.experiments[0]
    t0 = run.t0 if now is None else now.time
    data = []
    for item in run.data:
        # By the problem's own times if it has some, else by what the samples so far have shown.
        gap = float(np.median(np.diff(item.times))) if len(item.times) > 1 else online.spacing
        if gap is None:
            raise ValueError(
                "how often the sensors measure is not known yet, for simulations: give their Measurements times, or "
                "samples to `update` first."
            )
        times = t0 + item.delay + gap * np.arange(1, int(length / gap) + 1)
        values = np.zeros((len(times), item.values.shape[1]))
        data.append(replace(item, times=times, values=values, sigma=read_sigma(item)))
    changes: dict[str, Any] = {"mode_sequence": run.mode_sequence[:1]}
    if online.held is not None and run.inputs is not None:
        changes["inputs"] = hold_inputs(run.inputs, np.array([t0]), online.held[None])
    parameters = problem.parameters
    if now is not None:
        # False alarms where the system is now: their rate depends on the mode, its state and its parameters.
        changes |= {"mode_sequence": (now.mode,), "initial_state": now.state}
        parameters = {name: replace(each, value=now.parameters[name]) for name, each in parameters.items()}
    quiet = replace(run, data=tuple(data), transition_times=(), t0=t0, tf=t0 + length, **changes)
    return replace(problem, experiments=(quiet,), parameters=parameters)
