"""The online estimator: mode, transition times and parameters while the samples come in.

Hypotheses on the mode sequence are those of the beam (`switchfit.strategy.beam`). Each sample takes all of them one
step; each has a child in every mode that may follow, a birth; the best are kept. A further change of mode costs half
the threshold, so that the best hypothesis has one more than what was declared as soon as twice the difference of the
costs exceeds the threshold: the generalised likelihood ratio, with all times and parameters free in both.

The hypotheses that decide are propagated anew over the window after each sample, in one Gauss-Newton iteration each:
where the model is nonlinear, they follow the estimate that all samples of the window give together.
"""

from __future__ import annotations

import time as clock
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from copy import copy
from dataclasses import replace
from functools import cached_property, lru_cache
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.arrays import FloatArray
from switchfit.engine.hypotheses import Hypotheses
from switchfit.estimation.estimates import Estimate
from switchfit.estimation.estimating import estimate
from switchfit.online.calibration import calibrate
from switchfit.online.feed import Feed
from switchfit.online.files import append_update, read_journal, read_state
from switchfit.online.held_inputs import HeldInputs
from switchfit.online.information import invert
from switchfit.online.kept_problem import build_kept_problem
from switchfit.online.samples import hold_inputs
from switchfit.online.sensors import Sensors
from switchfit.online.state import Alarm, Best, Now, OnlineStatus
from switchfit.online.tracker import StoppedError, Tracker, TrackerSettings
from switchfit.online.window_start import Start
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem
from switchfit.problem.validation.arrays import as_count, as_finite, as_number, as_positive
from switchfit.problem.validation.messages import join_names, shorten
from switchfit.problem.validation.names import as_names, require_known
from switchfit.problem.validation.objects import as_instance, as_path
from switchfit.runtime import special
from switchfit.runtime.files import write_atomically
from switchfit.strategy.beam import Beam
from switchfit.strategy.library import build_library
from switchfit.strategy.sequences import Rules

THRESHOLD = 12.0
"""Of 200 drives of 20 s without a change 5 % exceed it."""

RECENT, IMPROBABLE, OUTLIER = 20, 1e-6, 1e-4
"""How many of the last samples show whether the model is lost: their residuals together are then less probable than the
second number. One sample alone counts at most as much as one with the third."""

DRIFT_AFTER = 0.1
"""Part of the window after which parameters that drift get new values."""

LONGEST_GAP, MOST_BETWEEN = 1.5, 50
"""Time between samples, as a multiple of the usual one, above which nodes are put between: changes happen there, too;
and how many at most."""

CORNERS_WARNING = (
    "the steps of updates do not end there, and errors of what acts there, as a friction, come out too small. "
    "OnlineEstimator.estimate() has the right ones."
)
"""Of 30 logs of a block that comes to rest all paths are right; the error of its friction is 2.6 times too small."""


class OnlineEstimator:
    """Estimates mode, transition times and parameters while the samples come in.

    Each `update` takes one sample, and says in which mode the system is, since when, and with which parameters. With no
    window, `estimate` gives what `sf.estimate` does with all samples so far. `now` is what the last update said, None
    before the first, `threshold` that of the statistic, `held` the inputs that hold, None without any, `spacing` the
    usual time between samples.

    Parameters
    ----------
    problem : Problem
        Of one run. The first of its `mode_sequence` is the mode at t0. Of its Measurements `observe`, sigma, names and
        delays are used, and the usual time between samples; not their values. There may be none.
    window : float, optional
        How long samples are kept, in the experiment's time unit. What older ones say stays as a quadratic cost, so that
        time and memory are constant. All are kept if it is left out.
    false_alarms : float, optional
        How often an alarm may come where nothing changes, per time unit: the threshold is then found by simulation, see
        `calibrate`.
    threshold : float, optional
        Of the statistic, instead; 12 if both are left out.
    successions : mapping of str to sequence of str, optional
        The modes that may follow each mode; all if left out.
    min_duration : float or mapping of str to float, optional
        Shortest time that a mode lasts.
    renews : mapping of str to str or sequence of str, optional
        Parameters that have a new value whenever a mode begins: ``{"slip": "mu"}``. Once that is declared, samples from
        before count for the other parameters and the state alone, and the change cannot be retracted.
    drift : mapping of str to float, optional
        Parameters that change slowly: the standard deviation of their random walk after one time unit. It needs a
        window, in which they are constant; it acts on what is known from before.
    max_switches : int
        Largest number of changes in the window, or altogether if there is none.
    budget : float, optional
        Seconds that an update may take: where they are spent, it leaves out first the refinement of the best
        hypotheses, then new ones, and says so. The sample itself is always taken.
    capacity : int
        Number of times for which there is room.
    width : int
        Number of hypotheses.

    Raises
    ------
    ValueError
        For a problem of several runs, costs that are no Measurements, a sigma that is unknown or a parameter, a delay
        that is a parameter, jumps, or a model without machine code.

    See Also
    --------
    replay : feeds a log.
    calibrate : finds the threshold for a rate of false alarms.
    find_modes : finds the mode sequence of a whole log.

    Examples
    --------
    A heater that is switched off at 2 s, measured five times a second:

    >>> heat, cool = (lambda t, x, p: p["a"] - x), (lambda t, x, p: -x)
    >>> sensor = sf.Measurements([0.2, 0.4], [0.0, 0.0], sigma=0.01)
    >>> run = sf.Experiment(sensor, ("heat",), t0=0.0, tf=4.0, initial_state=[0.0])
    >>> problem = sf.Problem(sf.HybridSystem({"heat": heat, "cool": cool}, [0.0]), run, {"a": sf.Parameter(1.5)})
    >>> online = sf.OnlineEstimator(problem)
    >>> for k in range(1, 16):
    ...     t = 0.2 * k
    ...     now = online.update(t, 1 - np.exp(-min(t, 2.0)) if t <= 2.0 else (1 - np.exp(-2.0)) * np.exp(2.0 - t))
    >>> now.mode, round(now.since, 3)
    ('cool', 2.0)
    """

    def __init__(
        self,
        problem: Problem,
        *,
        window: float | None = None,
        false_alarms: float | None = None,
        threshold: float | None = None,
        successions: Mapping[str, Any] | None = None,
        min_duration: float | Mapping[str, float] | None = None,
        renews: Mapping[str, str | Sequence[str]] | None = None,
        drift: Mapping[str, float] | None = None,
        max_switches: int = 8,
        budget: float | None = None,
        capacity: int = 4096,
        width: int = 40,
    ) -> None:
        self.problem = as_instance(problem, "problem", Problem, "an sf.Problem")
        self.window = np.inf if window is None else as_positive(window, "window")
        if threshold is not None and false_alarms is not None:
            raise ValueError("give threshold or false_alarms, not both: one follows from the other.")
        self.threshold = THRESHOLD if threshold is None else as_positive(threshold, "threshold")
        self.budget = np.inf if budget is None else as_positive(budget, "budget")
        self.capacity, births = as_count(capacity, "capacity", at_least=1), as_count(max_switches, "max_switches")
        renewed = _read_table(renews, "renews", "a mode and the parameters that are new when it begins: {'slip': 'mu'}")
        walks = _read_table(drift, "drift", "a parameter and the standard deviation of its random walk: {'mu': 0.01}")
        self._sensors = Sensors(problem)
        run = problem.experiments[0]
        given: dict[str, Any] = {"successions": successions, "min_duration": min_duration, "max_switches": births}
        library = build_library(problem, first=run.mode_sequence[0], **given)
        self._given_settings = given | {"renews": renews, "drift": drift, "window": window, "width": width}
        self._given_settings["capacity"] = self.capacity
        if walks and window is None:
            raise ValueError("drift acts on what is known from before the window: set window=.")
        # What is before a window is a shift of its first state, n entries; with no window, and nothing renewed, none.
        entries, slots = problem.structures[0].n if window is not None or renewed else 0, max(births, 1)
        # Entries take slots of births: the engine knows no other unknowns of a hypothesis than times and p.
        self._beam = Beam(problem, 0, replace(library, max_switches=slots + entries))
        if self._beam.corners:
            where = ", ".join(self._beam.corners)
            warnings.warn(
                f"the modes have corners of the state ({where}): {CORNERS_WARNING}", RuntimeWarning, stacklevel=2
            )
        rules = Rules.of(library, self._beam.modes)
        self._settings = TrackerSettings(
            rules, slots, entries, as_count(width, "width", at_least=1), 0.5 * self.threshold
        )
        self._given = problem.unknowns.initial[~problem.unknowns.is_time]
        require_known(renewed, "renews", problem.system.modes)
        self._renews = {mode: self._find_places(names, f"renews of {mode!r}") for mode, names in renewed.items()}
        self._walks = np.zeros(self._beam.into.shape[1])  # variances of random walks after one time unit
        for name in walks:
            self._find_places(name, "drift")
            step = as_positive(walks[name], f"drift of {name}")
            self._walks[self._slices[name]] = as_positive(step * step, f"the square of the drift of {name}")
        # One wild sample shall not make a model that is right look lost: its share of chi-square is cut off here.
        self._outlier = float(special.chdtri(sum(map(len, self._sensors.weights)), OUTLIER))
        self._inputs = HeldInputs(run)
        self._journal: Path | None = None
        self.reset()
        if false_alarms is not None:
            self.set_threshold(calibrate(self, false_alarms).threshold)

    def _find_places(self, names: object, what: str) -> NDArray[np.intp]:
        """Return the positions of free parameters, a name or several, among the D unknowns of the engine."""
        chosen = as_names((names,) if isinstance(names, str) else names, what, "the name of a parameter, or several")
        if not chosen:
            raise ValueError(f"{what} is empty: name a parameter, or leave it out.")
        for name in chosen:
            if name not in self._slices:
                known = join_names(self._slices)
                raise ValueError(f"{what} has {shorten(name)}, which is no free parameter; there are: {known}.")
        own = np.r_[tuple(self._slices[name] for name in chosen)]
        return np.flatnonzero(self._beam.into[:, own].any(axis=1))

    def _build_like(self, problem: Problem, threshold: float) -> OnlineEstimator:
        """Return an estimator of another problem with the same settings, without a budget: for `calibrate`."""
        return OnlineEstimator(problem, **self._given_settings, threshold=threshold)

    @property
    def held(self) -> FloatArray | None:
        """The inputs that hold since the last update that had some, (q,); None before."""
        return self._inputs.held

    def set_threshold(self, threshold: float) -> None:
        """Set the threshold of the statistic, and forget all samples.

        See Also
        --------
        calibrate

        Examples
        --------
        >>> online = sf.OnlineEstimator(heater_problem())
        >>> online.set_threshold(20.0)
        >>> online.threshold
        20.0
        """
        self.threshold = as_positive(threshold, "threshold")
        self._settings = self._settings._replace(penalty=0.5 * self.threshold)
        self.reset()

    def reset(self) -> None:
        """Forget all samples.

        See Also
        --------
        OnlineEstimator.update

        Examples
        --------
        >>> online = sf.OnlineEstimator(heater_problem())
        >>> now = online.update(0.1, [0.5])
        >>> online.reset()
        >>> online.now is None
        True
        """
        self._feed = Feed(self._beam.engine, self.problem.experiments[0].t0, self.capacity)
        self.spacing = self._sensors.spacing
        self._tracker = self._start_tracking()
        self._inputs.held = None
        self._renewed = float(self._feed.nodes[0])
        self._alarms: list[Alarm] = []
        self._values, self._fitted = 0, (0.0, 0)  # values so far; lowest cost and values at the last update
        # What the last updates have added to twice the cost, with how many values.
        self._recent: list[tuple[float, int]] = []
        self._stopped: float | None = None  # since when the model cannot be simulated
        self._lost: float | None = None  # when the samples were last far from what is predicted
        self._costs = {"births": 0.0, "polish": 0.0}
        self.now: Now | None = None

    def _start_tracking(self) -> Tracker:
        beam = copy(self._beam)
        beam.grid = self.spacing or beam.grid
        return Tracker(beam, self._settings, self._given[beam.own], self._feed)

    # --- samples ---------------------------------------------------------------------------------------------------

    def update(self, t: float, y: object = None, *, u: ArrayLike | Mapping[str, float] | None = None) -> Now:
        """Take a sample, and return what is known then.

        Parameters
        ----------
        t : float
            Time stamp. Samples may come late or out of order, inside the window.
        y : (q,) array_like or dict, optional
            Values of the only sensor, NaN where one is missing; in a dict, by the names of channels, or those of whole
            sensors by their positions in the data. Left out, only time goes on.
        u : float, (q,) array_like or dict of str to float, optional
            Inputs from t on, until others come. Without any, they are those of the problem's experiment.

        Raises
        ------
        ValueError
            For a sample that comes too late, a second one of a sensor at one time, a wrong number of values, infinite
            ones, unknown names, where there is no room left, or if the model can no longer be simulated: the status of
            `now` is then STOPPED, until `reset`.

        See Also
        --------
        replay

        Examples
        --------
        >>> online = sf.OnlineEstimator(heater_problem())
        >>> now = online.update(0.1, [0.5])
        >>> now.time, now.mode
        (0.1, 'on')
        """
        began = clock.perf_counter()
        t = as_finite(as_number(t, "t"), "t")
        if self._stopped is not None:
            raise StoppedError(self._stopped)
        samples = self._sensors.read(y)
        if self._journal is not None:
            # Before anything is computed: a process that is killed in between finds the sample again.
            append_update(self._journal, t, samples, u)
        changed = self._place(t, samples, u)
        try:
            complete = self._follow(changed, began)
            self.now = self._judge(t, began, complete=complete)
        except StoppedError as error:
            # The model cannot be simulated any more, and no later sample changes that: all updates are refused until
            # `reset`.
            self._stopped = error.t
            if self.now is not None:
                self.now = replace(self.now, status=OnlineStatus.STOPPED, alarm=None, retracted=None)
            raise
        return self.now

    def _follow(self, changed: int, began: float) -> bool:
        """Take the hypotheses to the last node; return whether there was time for all of the work."""
        births = self._may("births", began)
        self._tracker.advance(changed, births)
        self._charge("births", began, births)
        # After the step and before the polish: what leaves the window must not be computed anew from its start.
        self._slide()
        middle = clock.perf_counter()
        polish = births and self._may("polish", began)
        if polish:
            self._tracker.polish()
        self._charge("polish", middle, polish)
        return polish

    def _may(self, what: str, began: float) -> bool:
        """Return whether a part of the work fits into what is left of the budget."""
        return clock.perf_counter() - began + self._costs[what] <= self.budget

    def _charge(self, what: str, began: float, done: bool) -> None:
        """Note what a part of the work has taken; what was left out is tried again some time."""
        usual = self._costs[what]
        self._costs[what] = 0.8 * usual + 0.2 * (clock.perf_counter() - began) if done else 0.95 * usual

    def _place(self, t: float, samples: dict[int, FloatArray], u: ArrayLike | Mapping[str, float] | None) -> int:
        """Put the samples of an update into the log, and return the first node that is to be computed."""
        feed, tracker = self._feed, self._tracker
        # A sample that comes with a delay belongs to the state at t - delay: that is its node.
        seen = [(t - float(self._sensors.items[k].delay), k) for k in samples]
        begin = float(feed.nodes[tracker.first])
        for time, k in [(t, None), *seen]:
            node = feed.find(time)
            if time < begin or (time == begin and tracker.start is not None):
                raise ValueError(
                    f"the sample at t = {time:.9g} comes too late: there was one at {feed.last:.9g}, and what is kept "
                    f"begins at {begin:.9g}."
                )
            if k is not None and feed.nodes[node] == time and feed.has_sample(k, node):
                raise ValueError(f"there are two samples of one sensor at t = {time:.9g}.")
        # Nothing is new so far: `changed` falls to the earliest node that this update touches.
        changed = feed.count if self.now is not None else 0
        held = self._inputs.hold(u)
        if t > feed.last:
            gap = t - feed.last
            # The spacing of the log is known with its second sample: the tracker, whose births are scaled by it, begins
            # anew.
            if self.spacing is None and self.now is not None:
                self.spacing, changed = gap, 0
                self._tracker = self._start_tracking()
            # A long gap gets nodes of its own: a row must not be much longer than what the hypotheses were linearised
            # for.
            count = ceil(min(gap / (LONGEST_GAP * (self.spacing or gap)), MOST_BETWEEN))
            for time in self._inputs.list_times(feed.last, t, count, held):
                node = feed.insert(time)
                self._inputs.write(feed, node - 1, held)
        elif feed.nodes[feed.find(t)] != t:
            changed = min(changed, feed.insert(t))
        for time, k in seen:
            node = feed.find(time)
            if feed.nodes[node] != time:
                node = feed.insert(time)
            there = np.isfinite(samples[k])
            feed.add(k, node, np.where(there, samples[k], 0.0), np.where(there, self._sensors.weights[k], 0.0))
            self._values += int(there.sum())
            changed = min(changed, node)
        return changed

    def _slide(self) -> None:
        """Let nodes leave the window."""
        feed, tracker = self._feed, self._tracker
        while tracker.first + 2 < feed.count and feed.nodes[tracker.first + 1] < feed.last - self.window:
            tracker.leave()
        begins = float(feed.nodes[tracker.first])
        if self._walks.any() and begins - self._renewed >= DRIFT_AFTER * self.window:
            # A random walk: its variance grows with the time since the parameters were last renewed.
            variances = self._beam.into @ self._walks * (begins - self._renewed)
            places = np.flatnonzero(variances)
            tracker.renew(places, variances[places])
            self._renewed = begins
        if tracker.first and feed.count + MOST_BETWEEN >= feed.capacity:
            tracker.drop_nodes()

    def estimate(self, **settings: Any) -> Estimate:
        """Fit the samples that are kept, by `sf.estimate` from where the estimator stands.

        With no window it is the estimate from all samples. With one, `problem` of the estimate begins where the window
        does: what samples before it say is a measurement of its first state and of the parameters.

        Parameters
        ----------
        settings
            Of `sf.estimate`; its strategy is "local" by default.

        Raises
        ------
        ValueError
            If nothing has been measured.

        See Also
        --------
        estimate

        Examples
        --------
        >>> online = sf.OnlineEstimator(heater_problem())
        >>> for k in range(1, 9):
        ...     now = online.update(0.1 * k, [0.4 * k])
        >>> online.estimate().success
        True
        """
        if self.now is None or not self._values:
            raise ValueError("nothing has been measured yet: give samples to `update` first.")
        kept = build_kept_problem(self.problem, self.now, *self._collect(self.now), self._describe_arrival())
        return estimate(kept, **{"strategy": "local", **settings})

    # --- files -----------------------------------------------------------------------------------------------------

    def save(self, path: str | Path) -> None:
        """Write the state to a file, atomically; `load` goes on from it, bit for bit.

        Parameters
        ----------
        path : path

        Raises
        ------
        ValueError
            If the model can no longer be simulated: what was saved before stays.

        See Also
        --------
        OnlineEstimator.load, OnlineEstimator.keep_journal

        Examples
        --------
        >>> online = sf.OnlineEstimator(heater_problem())
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> now = online.update(0.1, [0.5])
        >>> with TemporaryDirectory() as folder:
        ...     online.save(Path(folder) / "state")
        ...     sf.OnlineEstimator.load(Path(folder) / "state", heater_problem()).now.time
        0.1
        """
        if self._stopped is not None:
            raise StoppedError(self._stopped)
        # What is not here follows from the problem and the settings, or is computed anew at the next update.
        names = ("_renewed", "_values", "_fitted", "_recent", "_lost", "_alarms", "threshold", "spacing")
        others = {name: getattr(self, name) for name in names}
        others |= {"held": None if self.held is None else self.held.tolist(), "shape": self._shape}
        write_atomically(self._tracker.pack(others), as_path(path, "path"))
        if self._journal is not None:
            write_atomically(b"", self._journal)  # the saved state has what was in it

    def keep_journal(self, path: str | Path) -> None:
        """Take the samples of a journal, if there is one, and write each update to it before it is done, so that
        nothing is lost if the process is killed.

        `save` empties it: a saved state and a journal together are always all samples.

        Parameters
        ----------
        path : path

        See Also
        --------
        OnlineEstimator.load

        Examples
        --------
        >>> online = sf.OnlineEstimator(heater_problem())
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     online.save(Path(folder) / "state")
        ...     online.keep_journal(Path(folder) / "journal")
        ...     now = online.update(0.1, [0.5])
        ...     (Path(folder) / "journal").read_text()
        '{"t": 0.1, "y": {"0": [0.5]}, "u": null}\\n'
        """
        self._journal, file = None, as_path(path, "path")
        for t, y, u in read_journal(file):
            with suppress(ValueError):  # the update that was refused then
                self.update(t, y, u=u)
        self._journal = file

    @property
    def _shape(self) -> list[Any]:
        """What has to be the same where the hypotheses are taken up again."""
        problem, settings, engine = self.problem, self._settings, self._tracker.beam.engine
        channels = [list(item.names or ()) for item in self._sensors.items]
        names = [list(problem.system.modes), list(problem.parameters), channels]
        return [*names, settings.width, settings.births, engine.record_size]

    @classmethod
    def load(cls, path: str | Path, problem: Problem, **settings: Any) -> OnlineEstimator:
        """Return the estimator that was saved.

        Parameters
        ----------
        path : path
        problem : Problem
            The same as then: a file has no functions.
        settings
            Those of the estimator that was saved, but for its threshold.

        Raises
        ------
        OSError
            If a file cannot be read.
        ValueError
            If it is no saved estimator, or one of another problem or with other settings.

        See Also
        --------
        OnlineEstimator.save

        Examples
        --------
        >>> online = sf.OnlineEstimator(heater_problem())
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> with TemporaryDirectory() as folder:
        ...     online.save(Path(folder) / "state")
        ...     again = sf.OnlineEstimator.load(Path(folder) / "state", heater_problem())
        >>> again.update(0.1, [0.5]).time
        0.1
        """
        file = as_path(path, "path")
        numbers, arrays = read_state(file)
        online = cls(problem, **settings, threshold=numbers["threshold"])
        online.spacing, online._values, online._renewed = (numbers[n] for n in ("spacing", "_values", "_renewed"))
        online._inputs.held = None if numbers["held"] is None else np.array(numbers["held"])
        online._alarms = [Alarm(*each) for each in numbers["_alarms"]]
        online._tracker = online._start_tracking()
        # The engine of the beam has its limits and tolerances only after a first step; its records are then those of
        # the file.
        online._tracker.step(births=False)  # gives the engine its settings
        if numbers["shape"] != online._shape:
            raise ValueError(f"{file} was saved for another problem, or with other settings: give the same ones.")
        online._tracker.unpack(numbers, arrays)
        if online._tracker.kept:  # it has had a sample
            online.now = online._judge(online._feed.last, clock.perf_counter(), complete=True)
        online._fitted, online._lost, online._recent = (numbers[name] for name in ("_fitted", "_lost", "_recent"))
        return online

    def _collect(self, now: Now) -> tuple[list[Measurements], dict[str, Any]]:
        """Return what has been measured since the start of the window, and what else the run has since then."""
        tracker, feed, first = self._tracker, self._feed, self._tracker.first
        data = []
        for k, item in enumerate(self._sensors.items):
            times, values, weights = feed.samples(k)
            there = times > feed.nodes[first] if tracker.start is not None else np.ones(len(times), dtype=bool)
            shown = np.where(weights > 0, values, np.nan)[there]
            if np.isfinite(shown).any():
                sigma = self._sensors.weights[k] ** -0.5
                data.append(replace(item, times=times[there] + item.delay, values=shown, sigma=sigma))
        inputs = self.problem.experiments[0].inputs
        if inputs is not None and self.held is not None:
            inputs = hold_inputs(inputs, feed.nodes[first:-1].copy(), feed.signals[first : feed.count - 1, 0].copy())
        # The path of now may have fewer transitions than have left the window by another.
        past, t0 = min(len(tracker.left), len(now.transition_times)), float(feed.nodes[first])
        sequence, times = now.mode_sequence[past:], now.transition_times[past:]
        given = {"inputs": inputs, "mode_sequence": sequence, "transition_times": times}
        return data, given | {"t0": t0, "tf": feed.last}

    def _describe_arrival(self) -> Start | None:
        start, A, S = self._tracker.start, self._settings.entries, self._beam.births
        if start is None:
            return None
        acting = np.flatnonzero((start.tangent[:, :A] != 0).any(0))
        into = self._beam.into
        into = into[:, np.concatenate([acting, np.arange(S, into.shape[1])])]
        matrix, theta = into.T @ start.matrix @ into, self._read_theta(start.moved)
        return Start(theta, start.cost, start.gradient @ into, matrix, start.state, start.tangent @ into)

    @cached_property
    def _slices(self) -> dict[str, slice]:
        """Where the free parameters are, after the times of the engine."""
        unknowns = self.problem.unknowns
        shift = self._beam.births - int(unknowns.is_time.sum())
        return {name: slice(of.start + shift, of.stop + shift) for name, of in unknowns.parameters.items()}

    def _read_theta(self, moved: FloatArray) -> FloatArray:
        """Return parameters and initial states, (U,), where the point of linearisation has moved (D,)."""
        theta = self._given.copy()
        theta[self._beam.own[self._beam.places]] += moved[self._beam.births :]
        return theta

    # --- what is said ----------------------------------------------------------------------------------------------

    def _judge(self, t: float, began: float, *, complete: bool) -> Now:
        """Compare the hypotheses, declare or retract changes, and return what is known."""
        tracker, penalty = self._tracker, self._settings.penalty
        kept, found = tracker.latest
        value = tracker.value(kept.switches, found)
        b, exact, more = tracker.find_best(kept, found, value)
        without = np.inf if exact is None else float(value[exact])
        # Twice the logarithm of the likelihood ratio: of what was declared against more changes, without the price of
        # the change.
        statistic = -np.inf if more is None else 2 * (without + penalty - float(value[more]))
        # Below the threshold nothing is declared; what was declared is retracted below half of it.
        if exact is not None and b not in (exact, more) and without - value[b] <= 0.5 * penalty:
            b = exact
        own, count = kept.take(slice(b, b + 1)), int(kept.switches[b])
        modes, times = own.modes[0, : count + 1], tracker.times(own, found.moved[b : b + 1])[0, :count]
        # Before `_declare` and `_renew`, which move the window's start and change the hypotheses.
        best = self._describe(count, found, b)
        walked = self._measure_walks(best) if self._walks.any() else 0.0
        past = tuple(tracker.left)
        alarm, retracted = self._declare(t, modes, times, statistic, best)
        if alarm is not None and alarm.mode in self._renews:
            self._renew(alarm)
        self._judge_fit(float(value[b]), is_explained=alarm is not None)
        # Of a library, places are modes.
        names = [self._beam.modes[k] for k in (*(each.mode for each in past), *modes.tolist())]
        all_times = np.maximum.accumulate([*(each.time for each in past), *times]) if past or len(times) else times
        return Now(
            time=self._feed.last,
            mode=names[-1],
            since=float(all_times[-1]) if len(all_times) else self.problem.experiments[0].t0,
            mode_sequence=tuple(names),
            transition_times=all_times,
            parameters=self._read_parameters(best),
            alarm=alarm,
            retracted=retracted,
            statistic=statistic,
            threshold=self.threshold,
            status=self._find_status(alarm, retracted, len(self._beam.own) + len(times), complete),
            seconds=clock.perf_counter() - began,
            best=best,
            past_errors=tuple(each.error for each in past),
            walked=walked,
            modes=self._beam.modes,
            hypotheses=(kept.mode, value),
        )

    def _declare(
        self, t: float, modes: NDArray[np.int64], times: FloatArray, statistic: float, best: Best
    ) -> tuple[Alarm | None, Alarm | None]:
        """Declare a sequence of modes; return the alarm, and the one that it retracts."""
        declared = self._tracker.declared
        if declared.tolist() == modes.tolist():
            return None, None
        # How many modes from the start are as they were declared: an alarm stands for the rest, and those that it
        # replaces are retracted.
        common = int(np.minimum.accumulate(declared[: len(modes)] == modes[: len(declared)]).sum())
        count = len(declared) - common
        retracted = self._alarms[-count] if 0 < count <= len(self._alarms) else None
        if count:
            del self._alarms[-count:]
        self._tracker.declared = modes.copy()
        if common == len(modes) or not (len(times) or self._tracker.left):
            return None, retracted
        if len(times):
            time, error = float(times[-1]), float(np.sqrt(np.diag(invert(best.matrix))[best.times][-1]))
        else:  # another mode than was declared since what left the window
            _, time, error = self._tracker.left[-1]
        alarm = Alarm(t, self._beam.modes[modes[-1]], time, error, statistic)
        # Two changes at once are one alarm, which the list has for each of them: a retraction counts changes.
        self._alarms += [alarm] * (len(modes) - common)  # it declares so many changes
        return alarm, retracted

    def _judge_fit(self, lowest: float, *, is_explained: bool) -> None:
        """Note whether the last samples are what the model predicts: each raises the lowest cost by half a chi-square.

        A model that has lost them stays so until a change of mode explains them, or they have left the window.
        """
        now, (before, known) = self._feed.last, self._fitted
        self._recent = [*self._recent, (min(2 * (lowest - before), self._outlier), self._values - known)][-RECENT:]
        self._fitted = lowest, self._values
        # By how much twice the lowest cost has risen over the last updates is chi-square of as many values, if the
        # model holds.
        jumps, counts = (sum(each) for each in zip(*self._recent, strict=True))
        if counts and jumps > _find_limit(counts):
            self._lost = now
        elif is_explained or (self._lost is not None and now - self._lost > self.window):
            self._lost = None

    def _renew(self, alarm: Alarm) -> None:
        """Let the window begin with a mode, and its parameters have new values."""
        feed, tracker = self._feed, self._tracker
        while tracker.first + 2 < feed.count and (
            tracker.start is None or feed.nodes[tracker.first] <= alarm.transition_time
        ):
            tracker.leave()
        places = self._renews[alarm.mode]
        tracker.renew(places, np.full(len(places), np.inf))

    def _find_status(self, alarm: Alarm | None, retracted: Alarm | None, unknowns: int, complete: bool) -> OnlineStatus:
        if self._values < unknowns:
            return OnlineStatus.WAITING
        if alarm is not None:
            return OnlineStatus.ALARM
        if retracted is not None:
            return OnlineStatus.RETRACTED
        if self._lost is not None:
            return OnlineStatus.LOST
        return OnlineStatus.TRACKING if complete else OnlineStatus.OVERRUN

    def _describe(self, count: int, found: Hypotheses, b: int) -> Best:
        """Return the linearised cost of a hypothesis with so many times in the window, in these and the problem's
        parameters.
        """
        of_engine, A = (found.matrices[b].copy(), found.tangents[b].copy()), self._settings.entries
        theta, times = self._read_theta(found.moved[b]), slice(A, A + count)
        artificial = self._tracker.artificial
        return Best(theta, found.states[b].copy(), times, self._slices, of_engine, artificial, self._beam.into)

    def _measure_walks(self, best: Best) -> FloatArray:
        """Return the variances by which parameters that drift have moved away from the constants of the window, (D,).

        The estimate misses what comes at a time s by the share W(s) of the information that there was before. That
        grows from its value W at the start of the window to 1; evenly, the mean of W(s)^2 is ``(1 + W + W^2) / 3``.
        """
        start, W, into = self._tracker.start, np.zeros(len(self._walks)), self._beam.into
        if start is not None:
            before = np.diag(invert(into.T @ start.matrix @ into))
            np.divide(np.diag(invert(best.matrix)), before, out=W, where=np.isfinite(before))
            W = np.minimum(W, 1.0)
        return self._walks * (self._feed.last - self._feed.nodes[self._tracker.first]) * (1 + W + W**2) / 3

    def _read_parameters(self, best: Best) -> dict[str, FloatArray]:
        """Return the values of all parameters, the fixed ones too."""
        given = {name: np.asarray(each.value, dtype=np.float64) for name, each in self.problem.parameters.items()}
        S = self._beam.births
        found = {name: best.theta[of.start - S : of.stop - S] for name, of in best.parameters.items()}
        return given | {name: value.reshape(given[name].shape) for name, value in found.items()}


@lru_cache
def _find_limit(counts: int) -> float:
    """Return what twice the cost of so many values exceeds with the probability `IMPROBABLE`."""
    return float(special.chdtri(counts, IMPROBABLE))


def _read_table(given: Any, what: str, form: str) -> Mapping[Any, Any]:
    """Return a mapping, an empty one for None; TypeError for anything else."""
    if given is not None and not isinstance(given, Mapping):
        raise TypeError(f"{what} must be a dict of {form}; got {shorten(given)}.")
    return given or {}
