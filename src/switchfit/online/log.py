"""What an online estimator said at each sample of a log that was fed to it, and `replay`, which feeds one."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.arrays import FloatArray
from switchfit.online.estimator import OnlineEstimator
from switchfit.online.samples import list_updates
from switchfit.online.state import Alarm, Now, OnlineStatus
from switchfit.problem.measurements import Measurements
from switchfit.problem.origin import Origin
from switchfit.problem.problem import Problem
from switchfit.problem.validation.arrays import as_array
from switchfit.problem.validation.objects import as_callable, as_instances
from switchfit.runtime.presentation import Figure, Printed, draw_figure, format_line


@dataclass(frozen=True, eq=False)
class OnlineLog(Printed):
    """What an online estimator said at each of K updates; print it for a summary.

    Attributes
    ----------
    times : (K,)
    modes : tuple of str
        Of the system.
    mode : (K,) int
        Position of the mode among these.
    probability : (K, modes)
    since : (K,)
        When the mode began.
    parameters, standard_errors : dict of str to (K, ...) array
        The errors are those of free parameters.
    statistic : (K,)
    threshold : float
    status : tuple of OnlineStatus
    seconds : (K,)
        What each update took.
    alarms, retracted : tuple of Alarm
        In the order in which they came.
    now : Now
        After the last update.
    time_unit : str
    origin : Origin or None
        The date at which times are 0, where they are dates.
    units : dict of str to str
        Of the parameters.

    See Also
    --------
    replay

    Examples
    --------
    >>> log = sf.replay(heater_problem(), threshold=20.0)
    >>> log.times.shape == log.since.shape == log.statistic.shape
    True
    """

    times: FloatArray
    modes: tuple[str, ...]
    mode: NDArray[np.int64]
    probability: FloatArray
    since: FloatArray
    parameters: Mapping[str, FloatArray]
    standard_errors: Mapping[str, FloatArray]
    statistic: FloatArray
    threshold: float
    status: tuple[OnlineStatus, ...]
    seconds: FloatArray
    alarms: tuple[Alarm, ...]
    retracted: tuple[Alarm, ...]
    now: Now
    time_unit: str
    origin: Origin | None
    units: Mapping[str, str]

    def __repr__(self) -> str:
        return format_line(self, f"{len(self.times)} updates", f"{len(self.alarms)} alarms")

    def delays(self, truth: ArrayLike) -> FloatArray:
        """Return how late each true change was declared: (N,); NaN for one that was not, before the next.

        Parameters
        ----------
        truth : (N,) array_like
            Times of the changes.

        See Also
        --------
        OnlineLog.latency

        Examples
        --------
        >>> sf.replay(heater_problem()).delays([2.0]).shape
        (1,)
        """
        true = as_array(truth, "truth").reshape(-1)
        # A false alarm that was retracted is no detection, however early it came.
        kept = [alarm for alarm in self.alarms if alarm not in self.retracted]
        found = []
        # An alarm belongs to the last true change before it; one before the first is false.
        for begin, end in zip(true, np.append(true, np.inf)[1:], strict=True):
            own = [alarm.time - begin for alarm in kept if begin <= alarm.time < end]
            found.append(min(own, default=np.nan))
        return np.array(found)

    def latency(self) -> dict[str, float]:
        """Return the median, the 90th and 99th percentile and the maximum of the seconds of an update.

        See Also
        --------
        OnlineLog.delays

        Examples
        --------
        >>> sorted(sf.replay(heater_problem()).latency())
        ['max', 'p50', 'p90', 'p99']
        """
        values = np.percentile(self.seconds, [50, 90, 99, 100]).tolist()
        return dict(zip(("p50", "p90", "p99", "max"), values, strict=True))

    def plot(self) -> Figure:
        """Draw modes, statistic and parameters over time; return the Matplotlib figure.

        See Also
        --------
        replay

        Examples
        --------
        >>> figure = sf.replay(heater_problem()).plot()
        """
        return draw_figure(self)


def _stack(given: list[dict[str, FloatArray]]) -> dict[str, FloatArray]:
    """Return arrays by name, one entry for each of the given."""
    return {name: np.array([each[name] for each in given]) for name in given[-1]}


def build_log(problem: Problem, said: list[Now]) -> OnlineLog:
    """Return the log of what was said at updates; there must have been one."""
    last, run = said[-1], problem.experiments[0]
    modes = tuple(problem.system.modes)

    def collect(read: Callable[[Now], Any]) -> Any:
        return np.array([read(now) for now in said])

    return OnlineLog(
        times=collect(lambda now: now.time),
        modes=modes,
        mode=collect(lambda now: modes.index(now.mode)),
        probability=collect(lambda now: [now.mode_probability.get(mode, 0.0) for mode in modes]),
        since=collect(lambda now: now.since),
        parameters=_stack([now.parameters for now in said]),
        standard_errors=_stack([now.standard_errors for now in said]),
        statistic=collect(lambda now: now.statistic),
        threshold=last.threshold,
        status=tuple(now.status for now in said),
        seconds=collect(lambda now: now.seconds),
        alarms=tuple(now.alarm for now in said if now.alarm is not None),
        retracted=tuple(now.retracted for now in said if now.retracted is not None),
        now=last,
        time_unit=run.time_unit,
        origin=run.origin,
        units={name: parameter.unit for name, parameter in problem.parameters.items()},
    )


def replay(
    problem: Problem,
    data: Sequence[Measurements] | Measurements | None = None,
    *,
    callback: Callable[[Now], object] | None = None,
    **settings: Any,
) -> OnlineLog:
    """Feed a log to an `OnlineEstimator`, sample by sample.

    Parameters
    ----------
    problem : Problem
        As for `OnlineEstimator`.
    data : Measurements or sequence of Measurements, optional
        The samples, one for each of the problem's own, which they are by default.
    callback : callable, optional
        ``callback(now)`` after each update; it stops if that returns true.
    settings
        Of `OnlineEstimator`.

    Returns
    -------
    OnlineLog

    Raises
    ------
    ValueError
        As `OnlineEstimator`, or if the data do not match the problem's.

    See Also
    --------
    find_modes : the best sequence for a log as a whole.

    Examples
    --------
    >>> log = sf.replay(heater_problem(), threshold=20.0)
    >>> [(alarm.mode, round(alarm.transition_time, 1)) for alarm in log.alarms]
    [('off', 2.5)]
    """
    online = OnlineEstimator(problem, **settings)
    # The model's own sensors say how values are observed; other data replace their numbers alone.
    own = problem.experiments[0].data
    given = as_instances(own if data is None else data, "data", Measurements, "sf.Measurements")
    if len(given) != len(own):
        raise ValueError(f"the problem has {len(own)} Measurements; got {len(given)} as data.")
    if callback is not None:
        as_callable(callback, "callback", "a function callback(now)", arguments=1)
    said: list[Now] = []
    updates = list_updates([(item.times, item.values) for item in given])
    if not updates:
        raise ValueError("the problem has no samples to replay: give data.")
    for t, y in updates:
        said.append(online.update(t, y))
        if callback is not None and callback(said[-1]):
            break
    return build_log(problem, said)
