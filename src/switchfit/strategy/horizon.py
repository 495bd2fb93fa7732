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

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.fit.evaluator import Evaluator
from switchfit.problem.data import FloatArray, Measurements, ReferenceSignal, TerminalConstraint, TerminalCost
from switchfit.problem.experiment import Experiment
from switchfit.problem.parameter import Parameter
from switchfit.problem.priors import LogNormal, Normal
from switchfit.problem.problem import GIVEN, Problem
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
the guess, or of the way between its bounds. The last fit is without them."""


def can_grow(problem: Problem) -> bool:
    """Return whether a problem is one run with transitions, with a tf that is known and data all along it."""
    run = problem.experiments[0]
    if len(problem.experiments) != 1 or not run.transition_times or run.has_free_tf:
        return False
    return len(list_sample_times(run)) > FEWEST_WINDOWS


def grow_horizon(problem: Problem, theta: FloatArray) -> End:
    """Return where fits of growing parts of the log end, all of it at last.

    Parameters
    ----------
    problem : Problem
        Of one run.
    theta : (d,)
        The first guess. Its transition times are tried among others, in every part of the log.
    """
    run, own = problem.experiments[0], problem.unknowns.times[0]
    guess, count = problem.split(theta)[0][0], int(np.sum(own >= 0))
    known = {0: Beginning(np.zeros(0), theta[count:])}
    evaluations, before = 0, run.t0
    windows = _choose_windows(run)
    for end in windows:
        found: dict[int, Beginning] = {}
        for k in range(len(guess) + 1):
            starts = list(_list_starts(known, k, guess, before, end))
            part = _truncate(problem, end, k, loose=end < windows[-1]) if starts else None
            if part is None:
                continue
            ends, tried = _fit_best(part, starts, own[:k] >= 0)
            evaluations += tried + sum(fitted.evaluations for fitted in ends)
            best = min(ends, key=lambda fitted: fitted.cost, default=None)
            if best is not None and not best.failed:
                times, _ = part.split(best.theta)
                found[k] = Beginning(times[0], best.theta[int(np.sum(own[:k] >= 0)) :])
        known, before = found or known, end
    if len(guess) not in known:
        return End(theta, np.inf, evaluations)
    last = known[len(guess)]
    final = fit_briefly(problem, np.concatenate([last.times[own >= 0], last.rest]))
    return final._replace(evaluations=final.evaluations + evaluations)


class Beginning(NamedTuple):
    """The fit of a part of the log: all its transition times (k,), and the other unknowns."""

    times: FloatArray
    rest: FloatArray


def list_sample_times(run: Experiment) -> FloatArray:
    """Return the times at which something is measured: (K,), ascending."""
    times = [
        item.seen_times[np.any(np.isfinite(item.values), axis=1)] for item in run.data if isinstance(item, Measurements)
    ]
    if any(isinstance(item, ReferenceSignal) for item in run.data):
        times.append(np.linspace(run.t0, run.end, REFERENCE_POINTS))
    return np.unique(np.concatenate([np.zeros(0), *times]))


def _choose_windows(run: Experiment) -> FloatArray:
    """Return the ends of the windows: about as many samples come in with each."""
    times = list_sample_times(run)
    count = min(max(FEWEST_WINDOWS, WINDOWS_EACH * len(run.mode_sequence)), len(times))
    ends = times[np.linspace(0, len(times) - 1, count + 1).round().astype(int)[1:-1]]
    return np.append(np.unique(ends[(ends > run.t0) & (ends < run.end)]), run.end)


def _list_starts(
    known: dict[int, Beginning], k: int, guess: FloatArray, before: float, end: float
) -> Iterator[Beginning]:
    """Find where fits with k transitions on the window up to `end` may begin."""
    if k in known:
        yield known[k]
    if k - 1 in known:
        times, rest = known[k - 1]
        earliest = times[-1] if len(times) else -np.inf
        places = [before + part * (end - before) for part in INSIDE]
        if guess[k - 1] < end:
            places.append(float(guess[k - 1]))
        for place in places:
            yield Beginning(np.append(times, max(place, earliest)), rest)


def _fit_best(part: Problem, starts: list[Beginning], free: NDArray[np.bool_]) -> tuple[list[End], int]:
    """Fit from the starts with the lowest costs; with the number of costs that were looked at."""
    thetas = [np.concatenate([start.times[free], start.rest]) for start in starts]
    thetas = [np.clip(theta, part.unknowns.lower, part.unknowns.upper) for theta in thetas]
    thetas = [theta for theta in thetas if np.all(part.unknowns.A @ theta >= part.unknowns.b)]
    if len(thetas) > TRIED:
        evaluator = Evaluator(part, thetas[0])
        thetas.sort(key=lambda theta: cost if np.isfinite(cost := evaluator.cost(theta)) else np.inf)
    return [fit_briefly(part, theta, ITERATIONS) for theta in thetas[:TRIED]], len(thetas)


def _truncate(problem: Problem, end: float, k: int, *, loose: bool) -> Problem | None:
    """Return the problem on the log up to `end` with its first k transitions; None if it allows no such problem."""
    run = problem.experiments[0]
    given = {name: getattr(problem, name) for name in GIVEN}
    most = max(problem.max_transitions or 0, len(run.transition_times))
    parameters = {name: _loosen(parameter) if loose else parameter for name, parameter in problem.parameters.items()}
    times = run.initial_times[:k]
    if k and times[-1] >= end:
        times = np.linspace(run.t0, end, k + 2)[1:-1]
    try:
        taken = [replace(tau, value=value) for tau, value in zip(run.transition_times, times, strict=False)]
        part = replace(
            run,
            data=[cut for item in run.data if (cut := _cut(item, end, run.end)) is not None],
            mode_sequence=run.mode_sequence[: k + 1],
            transition_times=tuple(taken),
            tf=end,
        )
        return Problem(**given | {"experiments": part, "parameters": parameters, "max_transitions": most})
    except ValueError:  # a transition that is fixed or bounded to be later, or no data yet
        return None


def _cut(item: Any, end: float, tf: float) -> Any:
    """Return one part of the data up to `end`; None if nothing is left. What is said of the end holds at `tf` alone."""
    if isinstance(item, Measurements) and not isinstance(item.delay, str):
        there = item.seen_times <= end
        if not there.any():
            return None
        sigma = item.sigma
        if isinstance(sigma, np.ndarray) and sigma.ndim and len(sigma) == len(there):
            sigma = sigma[there]
        return replace(item, times=item.times[there], values=item.values[there], sigma=sigma)
    if isinstance(item, TerminalCost | TerminalConstraint) and end < tf:
        return None
    return item


def _loosen(parameter: Parameter) -> Parameter:
    """Return a parameter with a loose prior about its guess, if it has none."""
    if parameter.fixed or parameter.prior is not None:
        return parameter
    width = parameter.upper - parameter.lower
    size = np.abs(parameter.value)
    size = np.where(size > 0, size, np.where(np.isfinite(width) & (width > 0), width, 1.0))
    if parameter.scale == "log":
        return replace(parameter, prior=LogNormal(parameter.value, 1.0 + LOOSE))
    return replace(parameter, prior=Normal(parameter.value, LOOSE * size))
