"""Growing horizon: the log is taken in step by step, and transitions enter when the data of their time come.

On the beginning of a log few transitions count, and the parameters that act there are found before what follows depends
on them. A window is the log up to some time. For each window, and for each number k of transitions that may have
happened in it, the best fit with the first k transitions is kept: it begins at the best fit with k transitions on the
window before, or at that with k - 1, with the k-th transition put into the part of the log that is new. No transition
has to be decided upon while its data are still to come, as in the dynamic programming of change points ([1]_).

References
----------
.. [1] I. E. Auger, C. E. Lawrence, Algorithms for the optimal identification of segment neighborhoods, Bull. Math.
   Biol. 51 (1989) 39-54.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.fit.evaluator import Evaluator
from switchfit.fit.variation import assume_noise
from switchfit.problem.costs import TerminalConstraint, TerminalCost
from switchfit.problem.data import FloatArray, Measurements, ReferenceSignal
from switchfit.problem.experiment import Experiment
from switchfit.problem.jump import Jump
from switchfit.problem.parameter import Parameter
from switchfit.problem.priors import LogNormal, Normal
from switchfit.problem.problem import GIVEN, Problem
from switchfit.runtime.progress import show_detail
from switchfit.strategy.quick import End, fit_briefly

WINDOWS_EACH = 3
"""Windows for each mode of the sequence."""

FEWEST_WINDOWS = 9

INSIDE = (0.15, 0.5, 0.85)
"""Where in the new part of the log a transition is tried."""

TRIED = 2
"""Fits from the best of these places."""

ITERATIONS = 25
"""Iterations of a fit on a window: the next one corrects it."""

REFERENCE_POINTS = 100
"""Points of a reference signal that count as samples."""

LOOSE = 1.0
"""Standard deviation of the priors that keep parameters near their guesses while nothing determines them, as a part of
the guess, or of the way between its bounds, beside noise of `assume_noise`. The last fit is without them."""


TIED = 0.1
"""The same of the priors that keep the shared parameters of a run by itself near those of all runs."""


def can_grow(problem: Problem) -> bool:
    """Return whether the horizon can grow: there are transitions, and data along the runs that have them.

    What stays excluded, and why:

    - Costs without data: the minimum of a running cost on a part of the horizon is that of another problem.
    - Data at `FEWEST_WINDOWS` times or fewer, of all runs with transitions together: a window brings in too little to
      say whether a transition has happened.

    `choice` does not ask where there are guards or terminal constraints: what is met at the end says nothing of a part
    of the horizon, and guards place the transitions by themselves.
    """
    along = [list_sample_times(run) for run in problem.experiments if run.transition_times]
    return sum(map(len, along)) > FEWEST_WINDOWS


def grow_horizon(problem: Problem, theta: FloatArray) -> End:
    """Return where fits of growing parts of the logs end, all of them at last.

    Several runs grow together, each by as many windows as it has, with the parameters that they share kept near
    their common values. After each window a fit of all of them together, each with the number of transitions that fits
    it best, moves these. A free tf is an unknown in the last window alone.

    Parameters
    ----------
    problem : Problem
    theta : (d,)
        The first guess. Its transition times are tried among others, in every part of the log.
    """
    shared = find_shared(problem)
    rest = theta[_count_times(problem) :].copy()
    runs = [GrowingRun(problem, e, theta, shared) for e in range(len(problem.experiments))]
    count = max(len(run.windows) for run in runs)
    evaluations = 0
    for window in range(1, count + 1):
        show_detail(f"window {window} of {count}")
        for run in runs:
            evaluations += run.grow(-(-window * len(run.windows) // count), rest)
        if any(run.is_lost for run in runs):
            return End(theta, np.inf, evaluations)
        for run in runs:
            rest[run.places[run.own]] = run.best.rest[run.own]
        if shared:
            rest, taken = _fit_together(problem, runs, rest, whole=window == count)
            evaluations += taken
    final = fit_briefly(problem, _assemble(problem, runs, rest))
    return final._replace(evaluations=final.evaluations + evaluations)


def find_shared(problem: Problem) -> frozenset[str]:
    """Return the names of the free parameters that several runs depend on."""
    used = Counter(name for e in range(len(problem.experiments)) for name in set(_list_names(problem, e)))
    return frozenset(name for name, times in used.items() if times > 1 and not problem.parameters[name].fixed)


def _list_names(problem: Problem, e: int) -> list[str]:
    """Return the problem's names of the parameters of a run."""
    run = problem.experiments[e]
    return [run.parameter_map.get(name, name) for name, _, _ in problem.structures[e].parameters]


def _count_times(problem: Problem) -> int:
    return int(problem.unknowns.is_time.sum())


class Beginning(NamedTuple):
    """The fit of a part of a log: all its times (k,), a free tf among them where it is in the part, the other unknowns
    of the run, shared ones among them, and J."""

    times: FloatArray
    rest: FloatArray
    cost: float


class GrowingRun:
    """One run: for each number of transitions the best fit of the part of its log that is looked at."""

    def __init__(self, problem: Problem, e: int, theta: FloatArray, shared: frozenset[str]) -> None:
        self.problem, self.run, self.shared = problem, _allow_priors(problem.experiments[e]), shared
        self.noise = assume_noise(problem)
        self.free = problem.unknowns.times[e] >= 0
        ends = problem.ends_of_modes(theta)[e]
        self.guess, self.end = ends[1:-1], float(ends[-1])
        self.windows = _choose_windows(self.run, self.end)
        self.names = set(_list_names(problem, e))
        spans = {name: span for name, span in problem.unknowns.parameters.items() if name in self.names}
        states = problem.unknowns.initial_states[e]
        taken = [np.arange(span.start, span.stop) for span in spans.values()]
        self.places = np.concatenate([*taken, states[states >= 0]]).astype(np.intp) - _count_times(problem)
        are_own = [np.full(span.stop - span.start, name not in shared) for name, span in spans.items()]
        self.own = np.concatenate([*are_own, np.ones(int(np.sum(states >= 0)), dtype=bool)]).astype(bool)
        beginning = Beginning(np.zeros(0), theta[_count_times(problem) :][self.places], np.inf)
        self.known, self.before, self.index = {0: beginning}, self.run.t0, 0

    @property
    def is_whole(self) -> bool:
        """Whether all of the log is looked at."""
        return self.index == len(self.windows)

    @property
    def is_lost(self) -> bool:
        """Whether no fit of all of the log with all transitions was found."""
        return self.is_whole and len(self.guess) not in self.known

    @property
    def best(self) -> Beginning:
        """The best fit; with all transitions where all of the log is looked at."""
        if self.is_whole:
            return self.known[len(self.guess)]
        return min(self.known.values(), key=lambda one: one.cost)

    @property
    def upto(self) -> float:
        """The end of the part that is looked at."""
        return self.windows[self.index - 1] if self.index else self.run.t0

    def grow(self, index: int, rest: FloatArray) -> int:
        """Take in the log up to a window, the shared parameters near those in `rest`; return the evaluations."""
        if index == self.index:
            return 0
        self.before, self.index = self.upto, index
        found: dict[int, Beginning] = {}
        evaluations = 0
        for k, one in self.known.items():
            self.known[k] = one._replace(rest=np.where(self.own, one.rest, rest[self.places]))
        for k in range(len(self.guess) + 1) if not self.is_whole else [len(self.guess)]:
            starts = list(_list_starts(self.known, k, self.guess, self.before, self.upto))
            part = self._build_part(k, rest) if starts else None
            if part is None:
                continue
            if self.is_whole and self.run.has_free_tf:
                starts = [one._replace(times=np.append(one.times, max(self.end, *one.times[-1:]))) for one in starts]
            free = self.free[: len(starts[0].times)]
            ends, tried = _fit_best(part, starts, free)
            evaluations += tried + sum(fitted.evaluations for fitted in ends)
            best = min(ends, key=lambda fitted: fitted.cost, default=None)
            if best is not None and not best.failed:
                times = part.unknowns.times[0]
                known = starts[0].times.copy()
                known[free] = best.theta[times[times >= 0]]
                known[~free] = self.run.initial_times[: len(free)][~free]
                found[k] = Beginning(known, best.theta[int(free.sum()) :], best.cost)
        self.known = found or self.known
        return evaluations

    def replace_best(self, times: FloatArray, rest: FloatArray) -> None:
        """Put another fit with as many transitions in the place of the best."""
        number = next(k for k, one in self.known.items() if one is self.best)
        self.known[number] = Beginning(times, rest, self.known[number].cost)

    def _build_part(self, k: int, rest: FloatArray) -> Problem | None:
        """Return the problem of this run alone up to the window, with k transitions; None if there is none."""
        try:
            parameters = {name: self.problem.parameters[name] for name in self.problem.parameters if name in self.names}
            for name, parameter in parameters.items():
                if name in self.shared:
                    span, before = self.problem.unknowns.parameters[name], _count_times(self.problem)
                    value = rest[span.start - before : span.stop - before].reshape(parameter.shape)
                    parameters[name] = _loosen(replace(parameter, value=value, prior=None), TIED / self.noise)
                elif not self.is_whole:
                    parameters[name] = _loosen(parameter, LOOSE / self.noise)
            return _build(self.problem, self.cut(k), parameters)
        except ValueError:  # a transition that is fixed or bounded to be later, or no data yet
            return None

    def _find_least_delay(self, item: Any) -> float:
        """Return the lower bound of a delay that is a parameter; 0 of any other data."""
        if not (isinstance(item, Measurements) and isinstance(item.delay, str)):
            return 0.0
        parameter = self.problem.parameters[self.run.parameter_map.get(item.delay, item.delay)]
        return float(parameter.value if parameter.fixed else parameter.lower)

    def cut(self, k: int) -> Experiment:
        """Return the run up to the window with its first k transitions; ValueError if there is no such run."""
        if self.is_whole:
            return self.run
        run, end = self.run, self.upto
        taken = list(run.times[:k])
        if k and taken[-1].value >= end:  # guesses that are evenly spaced between the times that are fixed
            knots = np.array([run.t0, *(float(tau.value) for tau in taken), end])
            kept = np.flatnonzero([True, *(tau.fixed for tau in taken), True])
            times = np.interp(np.arange(k + 2), kept, knots[kept])[1:-1]
            taken = [
                tau if tau.fixed else replace(tau, value=_place_inside(run, tau, time, end))
                for tau, time in zip(taken, times, strict=True)
            ]
        return replace(
            run,
            data=[cut for item in run.data if (cut := _cut(item, end, self._find_least_delay(item))) is not None],
            mode_sequence=run.mode_sequence[: k + 1],
            transition_times=tuple(taken),
            tf=end,
            jumps=[Jump(time, jump) for time, jump in zip(run.jump_times, run.jump_maps, strict=True) if time < end],
        )


def _place_inside(run: Experiment, tau: Parameter, time: float, end: float) -> float:
    """Return a guess inside the bounds of a transition time; between the jumps that are bounds, not at one."""
    low, high = float(tau.lower), float(tau.upper)
    inside = float(np.clip(time, low, high))
    return 0.5 * (max(low, run.t0) + min(high, end)) if inside in run.jump_times else inside


def _build(problem: Problem, experiments: Any, parameters: dict[str, Parameter]) -> Problem:
    """Return a part of a problem, with room for as many transitions as it has, so that programs are shared."""
    given = {name: getattr(problem, name) for name in GIVEN}
    each = (len(run.transition_times) + len(run.jump_times) for run in problem.experiments)
    most = max(problem.max_transitions or 0, *each)
    return Problem(**given | {"experiments": experiments, "parameters": parameters, "max_transitions": most})


def _fit_together(problem: Problem, runs: list[GrowingRun], rest: FloatArray, *, whole: bool) -> tuple[FloatArray, int]:
    """Fit all runs up to their windows together; return all unknowns but the times, and the evaluations."""
    if whole:
        return rest, 0  # what follows is the fit of all
    cuts = []
    for run in runs:
        number = len(run.best.times) - (run.is_whole and run.run.has_free_tf)
        cuts.append(run.cut(number))
    try:
        loose = LOOSE / assume_noise(problem)
        parameters = {name: _loosen(parameter, loose) for name, parameter in problem.parameters.items()}
        joint = _build(problem, cuts, parameters)
    except ValueError:
        return rest, 0
    end = fit_briefly(joint, _assemble(joint, runs, rest), ITERATIONS)
    if end.failed:
        return rest, end.evaluations
    rest = end.theta[_count_times(joint) :]
    for run, where in zip(runs, joint.unknowns.times, strict=True):
        times = run.best.times.copy()
        times[where >= 0] = end.theta[where[where >= 0]]
        run.replace_best(times, rest[run.places])
    return rest, end.evaluations


def _assemble(problem: Problem, runs: list[GrowingRun], rest: FloatArray) -> FloatArray:
    """Return theta from the best of each run and all unknowns but the times."""
    theta = np.concatenate([np.zeros(_count_times(problem)), rest])
    for run, where in zip(runs, problem.unknowns.times, strict=True):
        theta[where[where >= 0]] = run.best.times[where >= 0]
    return theta


def list_sample_times(run: Experiment) -> FloatArray:
    """Return the times at which something is measured: (K,), ascending."""
    times = [
        item.seen_times[np.any(np.isfinite(item.values), axis=1)] for item in run.data if isinstance(item, Measurements)
    ]
    if any(isinstance(item, ReferenceSignal) for item in run.data):
        times.append(np.linspace(run.t0, run.end, REFERENCE_POINTS))
    return np.unique(np.concatenate([np.zeros(0), *times]))


def _choose_windows(run: Experiment, last: float) -> FloatArray:
    """Return the ends of the windows, the last of which is `last`: about as many samples come in with each."""
    times = list_sample_times(run)
    if not run.transition_times or not len(times):
        return np.array([last])
    count = min(max(FEWEST_WINDOWS, WINDOWS_EACH * len(run.mode_sequence)), len(times))
    ends = times[np.linspace(0, len(times) - 1, count + 1).round().astype(int)[1:-1]]
    return np.append(np.unique(ends[(ends > run.t0) & (ends < last)]), last)


def _list_starts(
    known: dict[int, Beginning], k: int, guess: FloatArray, before: float, end: float
) -> Iterator[Beginning]:
    """Yield starts of fits with k transitions on the window up to `end`."""
    if k in known:
        yield known[k]
    if k - 1 in known:
        times, rest, cost = known[k - 1]
        earliest = times[-1] if len(times) else -np.inf
        places = [before + part * (end - before) for part in INSIDE]
        if guess[k - 1] < end:
            places.append(float(guess[k - 1]))
        for place in places:
            yield Beginning(np.append(times, max(place, earliest)), rest, cost)


def _fit_best(part: Problem, starts: list[Beginning], free: NDArray[np.bool_]) -> tuple[list[End], int]:
    """Return fits from the starts with the lowest costs, and the number of costs that were evaluated."""
    thetas = [np.concatenate([start.times[free], start.rest]) for start in starts]
    thetas = [np.clip(theta, part.unknowns.lower, part.unknowns.upper) for theta in thetas]
    thetas = [theta for theta in thetas if np.all(part.unknowns.A @ theta >= part.unknowns.b)]
    if len(thetas) > TRIED:
        evaluator = Evaluator(part, thetas[0])
        thetas.sort(key=lambda theta: cost if np.isfinite(cost := evaluator.cost(theta)) else np.inf)
    return [fit_briefly(part, theta, ITERATIONS) for theta in thetas[:TRIED]], len(thetas)


def _cut(item: Any, end: float, delay: float) -> Any:
    """Return one part of the data up to `end`; None if nothing is left. Costs and constraints at tf are left out.

    Samples with a delay that is a parameter belong to the part if they do with its least value, `delay`.
    """
    if isinstance(item, Measurements):
        there = item.seen_times - delay <= end
        if not there.any():
            return None
        sigma = item.sigma
        if isinstance(sigma, np.ndarray) and sigma.ndim and len(sigma) == len(there):
            sigma = sigma[there]
        return replace(item, times=item.times[there], values=item.values[there], sigma=sigma)
    if isinstance(item, TerminalCost | TerminalConstraint):
        return None
    return item


def _allow_priors(run: Experiment) -> Experiment:
    """Return the run with 1 for a sigma that is left out: J is the same, and priors may be weighed against it."""
    unscaled = [isinstance(item, Measurements) and item.sigma is None for item in run.data]
    if not any(unscaled):
        return run
    data = [replace(item, sigma=1.0) if bare else item for item, bare in zip(run.data, unscaled, strict=True)]
    return replace(run, data=data)


def _loosen(parameter: Parameter, loose: float) -> Parameter:
    """Return a parameter with a prior about its guess, if it has none: `loose` is its width as a part of the guess."""
    if parameter.fixed or parameter.prior is not None:
        return parameter
    width = parameter.upper - parameter.lower
    size = np.abs(parameter.value)
    size = np.where(size > 0, size, np.where(np.isfinite(width) & (width > 0), width, 1.0))
    if parameter.scale == "log":
        return replace(parameter, prior=LogNormal(parameter.value, 1.0 + loose))
    return replace(parameter, prior=Normal(parameter.value, loose * size))
