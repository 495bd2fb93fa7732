"""What an online estimator says after each sample.

The threshold for a rate of false alarms, by simulation of a system whose mode does not change.

The problem of the samples that an online estimator keeps, for `sf.estimate`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.fit.evaluator import Evaluator
from switchfit.fit.trajectory import compare
from switchfit.modes.schedule import Schedule, drop_empty
from switchfit.online.tracker import Start, drop_artificial, invert
from switchfit.problem.inputs import Input
from switchfit.problem.measurements import Measurements
from switchfit.problem.parameter import Parameter
from switchfit.problem.problem import Problem
from switchfit.problem.validation.arrays import as_count, as_number, as_positive
from switchfit.problem.validation.messages import shorten
from switchfit.runtime.presentation import format_line

NEVER = 100.0
"""Threshold in the simulations, which their statistics do not reach."""

EXCESS = 1.179
"""Mean of M - m over the runs whose maximum M exceeds the median m, where the rate falls as exp(-(h - m)): the integral
of ``2 (1 - exp(-u)) / u`` from 0 to log 2."""

ENTRIES, STATES = "state at the start of the window", "initial state"
"""Names of the parameters that stand for what is before a window."""

NO_EFFECT = 1e-12
"""Part of the largest second derivative below which one counts as none."""


class OnlineStatus(Enum):
    """How an online estimator stands; the value is a sentence with a remedy.

    See Also
    --------
    OnlineEstimator

    Examples
    --------
    >>> sf.OnlineEstimator(heater_problem()).update(0.1).status.name
    'WAITING'
    """

    WAITING = "fewer values have been measured than there are unknowns: give it more samples"
    TRACKING = "the model follows the samples"
    ALARM = "the mode has changed: see `alarm`"
    RETRACTED = "later samples have refuted the last change of mode: see `retracted`"
    OVERRUN = "the budget of an update was spent, and a part of its work was left out: raise budget=, or lower width="
    LOST = "the samples are not what the model predicts: check sigma, the modes and the successions"
    STOPPED = (
        "the model can no longer be simulated, in no mode: see whether y, u and the model are finite, then begin anew "
        "with `reset`"
    )


class Alarm(NamedTuple):
    """A change of mode.

    Attributes
    ----------
    time : float
        Of the sample at which it was declared.
    mode : str
        The mode that has begun.
    transition_time : float
    standard_error : float
        Of the transition time.
    statistic : float
        Twice by how much the cost is lower with the change than without it.

    See Also
    --------
    OnlineEstimator, Now

    Examples
    --------
    >>> sf.replay(heater_problem(), threshold=20.0).alarms[0].mode
    'off'
    """

    time: float
    mode: str
    transition_time: float
    standard_error: float
    statistic: float


@dataclass(frozen=True, eq=False)
class Best:
    """The linearised cost of the best hypothesis, and its state, in D unknowns.

    Attributes
    ----------
    theta : (U,), parameters and initial states in the order of the problem's theta
    state : (n,)
    times : slice, of the transition times that are not past
    parameters : dict of str to slice, of the free parameters
    of_engine, artificial : ((E, E), (n, E)), (E,)
        Second derivatives and tangent in the engine's E unknowns, and what the diagonal has that is no knowledge.
    into : (E, D)
        How these unknowns follow from the D.
    """

    theta: FloatArray
    state: FloatArray
    times: slice
    parameters: dict[str, slice]
    of_engine: tuple[FloatArray, FloatArray]
    artificial: FloatArray
    into: FloatArray

    @cached_property
    def matrix(self) -> FloatArray:
        """Second derivatives of the cost, (D, D)."""
        return self.into.T @ drop_artificial(self.of_engine[0], self.artificial) @ self.into

    @property
    def tangent(self) -> FloatArray:
        """Derivatives of the state, (n, D)."""
        return self.of_engine[1] @ self.into


@dataclass(frozen=True, eq=False)
class Now:
    """What is known after a sample. It does not change afterwards: any thread may read it.

    Attributes
    ----------
    time : float
    mode : str
    since : float
        When the mode began.
    mode_sequence : tuple of str
    transition_times : (N,) array
    parameters : dict of str to array
    alarm : Alarm or None
        A change of mode that this sample has shown.
    retracted : Alarm or None
        A change that it has refuted.
    statistic, threshold : float
        Twice by how much the best hypothesis with a further change has a lower cost than the best without it, and the
        value above which that is an alarm.
    status : OnlineStatus
    seconds : float
        What the update took.
    best : Best
        The linearised cost of the best hypothesis, from which the errors follow.
    past_errors : tuple of float
        Standard errors of the transitions that have left the window.
    walked : (D,) or 0
        Variances by which parameters that drift have moved away from the constants of the window.
    modes : tuple of str
        Those of the system.
    hypotheses : ((B,), (B,))
        The mode that each hypothesis is in, and its cost with the price of its changes.

    See Also
    --------
    OnlineEstimator

    Examples
    --------
    >>> now = sf.OnlineEstimator(heater_problem()).update(0.1, [0.5])
    >>> now.state.shape, now.covariance.shape
    ((1,), (1, 1))
    """

    time: float
    mode: str
    since: float
    mode_sequence: tuple[str, ...]
    transition_times: FloatArray
    parameters: dict[str, FloatArray]
    alarm: Alarm | None
    retracted: Alarm | None
    statistic: float
    threshold: float
    status: OnlineStatus
    seconds: float
    best: Best
    past_errors: tuple[float, ...]
    walked: FloatArray | float
    modes: tuple[str, ...]
    hypotheses: tuple[NDArray[np.int64], FloatArray]

    def __repr__(self) -> str:
        return format_line(self, f"t = {self.time:.6g}", f"{self.mode} since {self.since:.6g}", self.status.name)

    @cached_property
    def mode_probability(self) -> dict[str, float]:
        """Share of the hypotheses that are in each mode, weighted by their likelihood and the price of a change."""
        mode, value = self.hypotheses
        share = np.exp(value.min() - value)
        shares = np.bincount(mode, share / share.sum(), len(self.modes))
        return dict(zip(self.modes, shares.tolist(), strict=True))

    @property
    def state(self) -> FloatArray:
        """x at `time`: (n,)."""
        return self.best.state

    @cached_property
    def _unknowns(self) -> FloatArray:
        return invert(self.best.matrix)

    @cached_property
    def covariance(self) -> FloatArray:
        """Covariance of the state: (n, n); infinite on its diagonal where the samples say nothing."""
        Z, P = self.best.tangent, self._unknowns
        used = (Z != 0).any(0)
        return np.asarray(Z[:, used] @ P[np.ix_(used, used)] @ Z[:, used].T)

    @property
    def standard_errors(self) -> dict[str, FloatArray]:
        """Standard errors of the parameters, by name."""
        errors = np.sqrt(np.diag(self._unknowns) + self.walked)
        return {name: errors[of].reshape(self.parameters[name].shape) for name, of in self.best.parameters.items()}

    @property
    def time_errors(self) -> FloatArray:
        """Standard errors of the transition times: (N,)."""
        return np.array([*self.past_errors, *np.sqrt(np.diag(self._unknowns))[self.best.times]])


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
    if not hasattr(online, "build_like"):
        raise TypeError(f"online must be an sf.OnlineEstimator; got {shorten(online)}.")
    rate, length = as_positive(false_alarms, "false_alarms"), as_positive(seconds, "seconds")
    if as_count(runs, "runs") < 10:
        raise ValueError(f"runs must be at least 10, to know how the statistic is distributed; got {runs}.")
    phi = as_number(correlation, "correlation")
    if not 0 <= phi < 1:
        raise ValueError(f"correlation must be at least 0 and below 1; got {phi}.")
    problem = build_quiet_problem(online, length)
    theta = problem.initial_theta
    comparisons = compare(Evaluator(problem, theta), theta)[1][0]
    trial = online.build_like(problem, NEVER)
    rng, maxima = np.random.default_rng(seed), []
    for _ in range(runs):
        trial.reset()
        noisy = []
        for item, comparison in zip(problem.experiments[0].data, comparisons, strict=True):
            noise = rng.standard_normal(comparison.fitted.shape)
            for k in range(1, len(noise)):
                noise[k] = phi * noise[k - 1] + np.sqrt(1 - phi**2) * noise[k]
            noisy.append((item.times, comparison.fitted + item.sigma * noise))
        largest = 0.0
        for t, y in list_updates(noisy):
            now = trial.update(t, y)
            if now.status is not OnlineStatus.WAITING:
                largest = max(largest, now.statistic)
        maxima.append(largest)
    found = np.array(maxima)
    middle = float(np.median(found))
    tail = float((found[found > middle] - middle).mean()) / EXCESS if (found > middle).any() else 0.0
    threshold = middle + tail * max(np.log(np.log(2)) - np.log(length) - np.log(rate), 0.0)
    return Calibration(threshold, rate, length, found)


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
    return np.asarray(np.diagonal(item.sigma[(~np.isnan(item.values)).argmax(0)]))


def build_quiet_problem(online: Any, length: float) -> Problem:
    """Return the problem of one run in the present mode, with empty samples at the usual times."""
    problem, now = online.problem, online.now
    run = problem.experiments[0]
    t0 = run.t0 if now is None else now.time
    data = []
    for item in run.data:
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
        changes["inputs"] = hold(run.inputs, np.array([t0]), online.held[None])
    parameters = problem.parameters
    if now is not None:
        changes |= {"mode_sequence": (now.mode,), "initial_state": now.state}
        parameters = {name: replace(each, value=now.parameters[name]) for name, each in parameters.items()}
    quiet = replace(run, data=tuple(data), transition_times=(), t0=t0, tf=t0 + length, **changes)
    return replace(problem, experiments=(quiet,), parameters=parameters)


def hold(inputs: Input, times: FloatArray, values: FloatArray) -> Input:
    """Return inputs like those of an experiment that hold values (K, q) from times (K,) on."""
    names = inputs.names
    return Input(times, dict(zip(names, values.T, strict=True)) if names else values.reshape(-1, *inputs.shape))


def build_kept_problem(
    problem: Problem, now: Now, data: list[Measurements], given: dict[str, Any], arrival: Start | None
) -> Problem:
    """Return the problem of what has been measured since the start of the window, which begins at what was found.

    Parameters
    ----------
    problem : Problem
    now : Now
    data : list of Measurements
    given : dict of str to value
        What else the run has since then: its inputs, its modes and their times, t0 and tf.
    arrival : Start or None, if nothing has left the window
        In U parameters and A entries for the state, the parameters being where it has moved.
    """
    run, states, offset = problem.experiments[0], problem.unknowns.initial_states[0], problem.unknowns.is_time.sum()
    own = problem.system.initial_state if run.initial_state is None else run.initial_state
    parameters = {name: replace(each, value=now.parameters[name]) for name, each in problem.parameters.items()}
    initial: Any = own
    if arrival is not None:
        initial, sensor = _describe_arrival(problem, arrival, given["t0"])
        data = [sensor, *data]
        known = {ENTRIES: len(arrival.gradient) - len(arrival.moved), STATES: int((states >= 0).sum())}
        parameters = {name: replace(parameter, prior=None) for name, parameter in parameters.items()}
        parameters |= {name: Parameter(np.zeros(size)) for name, size in known.items() if size}
    elif (states >= 0).any():
        values = [float(now.best.theta[place - offset]) if place >= 0 else None for place in states.tolist()]
        initial = [
            entry if value is None else replace(entry, value=value) for entry, value in zip(own, values, strict=True)
        ]
    t0, tf = given["t0"], given["tf"]
    # A wrong model or outliers make modes of no duration.
    there = drop_empty(Schedule(given["mode_sequence"], np.clip(given["transition_times"], t0, tf), t0, tf))
    begins = given | {"mode_sequence": there.sequence, "transition_times": tuple(there.times), "initial_state": initial}
    return replace(problem, experiments=(replace(run, data=tuple(data), **begins),), parameters=parameters)


def _describe_arrival(problem: Problem, arrival: Start, t0: float) -> tuple[Any, Measurements]:
    """Return the initial state as a function of the parameters, and the cost of the samples before as a measurement.

    With ``H = R'R`` and ``g = R's`` the cost is ``|R d + s|^2 / 2`` but for a constant: R d is measured to be -s.
    """
    unknowns, run = problem.unknowns, problem.experiments[0]
    values, vectors = np.linalg.eigh(arrival.matrix)
    there = values > NO_EFFECT * values[-1]
    R = (vectors[:, there] * np.sqrt(values[there])).T
    s = (vectors[:, there] / np.sqrt(values[there])).T @ arrival.gradient
    own = {problem_name: name for name, problem_name in run.parameter_map.items()}
    names = [own.get(name, name) for name in unknowns.parameters]
    has_entries = len(arrival.gradient) > len(arrival.moved)
    if (unknowns.initial_states[0] >= 0).any():
        names.append(STATES)

    def move(p: Any) -> Any:
        parameters = [jnp.ravel(jnp.asarray(p[name])) for name in names]
        entries = [p[ENTRIES]] if has_entries else []
        return jnp.concatenate([*entries, jnp.concatenate([*parameters, jnp.zeros(0)]) - arrival.moved])

    def begin(p: Any) -> Any:
        return arrival.state + arrival.tangent @ move(p)

    sensor = Measurements([t0], [-s], observe=lambda t, x, p: R @ move(p), sigma=1.0)
    return begin, sensor
