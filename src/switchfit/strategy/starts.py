"""Many starts: short fits from random points inside the bounds, until it is unlikely that a minimum was missed.

Short fits from a point, the building block of all strategies: a failure has an infinite cost and is no error.

Random starts all over the feasible set of bounds, order and minimum durations.

Many starts where J is the time that it takes: over a horizon that shrinks with the best end.

The upper bound of a free tf is arbitrary, and arcs of all lengths below it meet the constraints: on the way of a
pendulum to rest each may be longer by a full turn. Few of the starts that are drawn over all of the horizon end at the
shortest. But nothing that takes longer than the best end is better than it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.engine.evaluation import Evaluation
from switchfit.estimation.estimator import Estimate
from switchfit.fit.accuracy import Follower
from switchfit.fit.evaluator import Evaluator
from switchfit.fit.solution import minimize_cost
from switchfit.optimize import IterationRecord, LinearConstraints, Status
from switchfit.optimize.least_distance import nearest_feasible
from switchfit.problem.parameter import Parameter
from switchfit.problem.problem import Problem
from switchfit.runtime.errors import HiddenSwitchError
from switchfit.runtime.progress import show_detail

ITERATIONS = 60
"""Iterations of a short fit: what has not converged by then is in a valley that leads nowhere."""

TOLERANCE = 1e-5
"""On the KKT residual of a short fit; the fit that ends a strategy has that of `estimate`."""

_is_late: ContextVar[Callable[[], bool]] = ContextVar("is_late", default=bool)
_callback: ContextVar[Callable[[IterationRecord], object] | None] = ContextVar("callback", default=None)

MOST_DRAWN = 2**30
"""Length of SciPy's Sobol sequences."""

FACTOR = 10.0
"""Range of an unknown without bounds: a positive guess is divided and multiplied by this factor, on a logarithmic
scale; any other guess varies by plus or minus so many times its size. Times on a logarithmic scale are drawn on that
scale, from the time since t0 of the first guess divided by this factor to the end of the horizon."""

MOST = 128
"""Starts at most; a study of more is what `multistart` is for."""

AGREE = 3
"""Ends at the lowest cost after which the search may stop."""

SAME_COST = 1e-6
"""Part of the cost by which two ends of one minimum differ at most."""

MARGIN = 1.02
"""Horizon over which starts are drawn, in units of the time of the best end: with room for others to end there too."""

FEW = 8
"""Starts over the whole horizon at a time, until one meets the constraints."""

SAME = 1e-9
"""Relative difference of J from the time, or of its derivatives, that is rounding."""


class OutOfTimeError(Exception):
    """The time budget of a search is spent."""


@contextmanager
def limit_time(
    seconds: float, clock: Callable[[], float], callback: Callable[[IterationRecord], object] | None = None
) -> Iterator[None]:
    """Let searches inside the context end after so many seconds of a clock, or with that around it, or where a
    callback, called with each iteration of their fits, returns true.
    """
    end, around = clock() + seconds, _is_late.get()
    token = _is_late.set(lambda: clock() > end or around())
    called = _callback.set(callback or _callback.get())
    try:
        yield
    finally:
        _is_late.reset(token)
        _callback.reset(called)


def is_late() -> bool:
    """Return whether the time budget is spent."""
    return _is_late.get()()


def check_time() -> None:
    """Raise an OutOfTimeError once the time budget is spent. What takes long asks again and again."""
    if is_late():
        raise OutOfTimeError


class _TimedFollower(Follower):
    """Checks the time before each evaluation: where none is lower, a line search alone may take 60 of them."""

    def _evaluate(self, theta: FloatArray, evaluate: Callable[[Evaluator], Evaluation[Any]]) -> Evaluation[Any]:
        check_time()
        return super()._evaluate(theta, evaluate)


class End(NamedTuple):
    """Where a short fit ended: theta (d,), the cost there, and the evaluations that it took."""

    theta: FloatArray
    cost: float
    evaluations: int

    @property
    def failed(self) -> bool:
        """Whether the model could not be evaluated, or a constraint is not met."""
        return not np.isfinite(self.cost)


def prepare_meshes(problem: Problem, theta: FloatArray, known: Evaluator | None = None) -> Evaluator | None:
    """Return the problem on meshes for theta (d,), those that are known where they suit; None where it cannot be
    integrated there.
    """
    try:
        with np.errstate(all="ignore"):
            return known if known is not None and Follower(known).suits(theta) else Evaluator(problem, theta)
    except (ValueError, ArithmeticError):
        return None


def fit_briefly(
    problem: Problem,
    theta: FloatArray,
    iterations: int = ITERATIONS,
    evaluator: Evaluator | None = None,
    constraints: LinearConstraints | None = None,
) -> End:
    """Return where a short fit from theta (d,) ends; with an infinite cost where it cannot begin, or where guards or
    terminal constraints are not met: their violation may make the cost as low as it likes.

    It works on the meshes of the evaluator, if one is given, and stays on them where the constraints are given that
    hold some of the unknowns. Once the time budget is spent, it raises an OutOfTimeError.
    """
    check_time()
    failed = End(theta, np.inf, 0)
    try:
        with np.errstate(all="ignore"):  # far from the data numbers may overflow
            meshes = evaluator or Evaluator(problem, theta)
            source = _TimedFollower(meshes) if constraints is None else meshes
            result = minimize_cost(source, theta, "auto", TOLERANCE, iterations, _callback.get(), constraints)
    except HiddenSwitchError:  # every fit would be wrong
        raise
    except (ValueError, ArithmeticError, np.linalg.LinAlgError):
        return failed
    if result.status is Status.INTERRUPTED:  # by Ctrl-C or a callback: the end of all work, not of this fit alone
        raise KeyboardInterrupt
    usable = np.isfinite(result.cost) and not result.violated
    return End(result.theta, result.cost if usable else np.inf, result.evaluations)


def make_feasible(problem: Problem, theta: FloatArray) -> FloatArray:
    """Return theta (d,) inside its bounds, the times of each run inside its horizon and in order."""
    theta = np.clip(theta, problem.unknowns.lowest, problem.unknowns.upper)
    for run, where in zip(problem.experiments, problem.unknowns.times, strict=True):
        free = where[where >= 0]
        theta[free] = np.maximum.accumulate(np.clip(theta[free], run.t0, run.end))
    return theta


def draw_starts(problem: Problem, count: int, seed: int) -> FloatArray:
    """Return starts from a scrambled Sobol sequence: (S, d); the first is the problem's initial guess.

    Parameters
    ----------
    problem : Problem
        Unknowns without bounds are drawn around their guesses (`FACTOR`).
    count, seed : int
    """
    from scipy.stats import qmc  # here, since importing it takes longer than most fits

    unknowns = problem.unknowns
    sobol = qmc.Sobol(len(unknowns.names), seed=seed)
    cube = sobol.random(1 << max(count - 1, 0).bit_length())[:count]
    low, high, log = _compute_ranges(problem)
    points = low + cube * (high - low)
    points[:, log] = low[log] * (high[log] / low[log]) ** cube[:, log]
    for experiment, where in zip(problem.experiments, unknowns.times, strict=True):
        # Those of the modes may differ; what this leaves infeasible is moved to the nearest feasible point.
        shortest = min(problem.durations[mode] for mode in experiment.mode_sequence)
        for begin, end, group in _list_stretches(experiment, where):
            # Sorted uniform numbers are uniform over all ordered times; minimum durations are added to their gaps.
            room = end - begin - (len(group) + 1) * shortest
            ordered = np.sort(cube[:, group], axis=1)
            if unknowns.log[group].all():
                first = unknowns.initial[group[0]] - experiment.t0
                low, high = max(begin - experiment.t0, first / FACTOR), end - experiment.t0
                points[:, group] = experiment.t0 + low * (high / low) ** ordered
                continue
            points[:, group] = begin + max(room, 0.0) * ordered + shortest * np.arange(1, len(group) + 1)
    points[0] = unknowns.initial
    # Each unknown is measured by its distance from the guess, which is feasible.
    sizes = np.maximum(np.abs(points - unknowns.initial), 1e-9 * (1 + np.abs(unknowns.initial)))
    pairs = zip(points, sizes, strict=True)
    return np.array([nearest_feasible(problem.constraints, point, size) for point, size in pairs])


def _compute_ranges(problem: Problem) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Return the range of each unknown, (d,) and (d,), and whether it is drawn on a logarithmic scale, (d,)."""
    unknowns = problem.unknowns
    guess, is_time = unknowns.initial, unknowns.is_time
    size = np.where(guess != 0, np.abs(guess), 1.0)
    open_low = ~np.isfinite(unknowns.lower) | (unknowns.log & (unknowns.lower <= 0))
    open_high = ~np.isfinite(unknowns.upper)
    ratio = (guess > 0) & (open_low | open_high) & (unknowns.lower >= 0) | unknowns.log
    low = np.where(ratio, size / FACTOR, guess - FACTOR * size)
    high = np.where(ratio, size * FACTOR, guess + FACTOR * size)
    low = np.where(open_low | ratio & (unknowns.lower <= 0), np.maximum(low, unknowns.lower), unknowns.lower)
    high = np.where(open_high, np.maximum(high, low), unknowns.upper)
    ratio &= ~is_time & (low > 0)
    return np.where(is_time, 0.0, low), np.where(is_time, 1.0, high), ratio


def _list_stretches(experiment: Any, where: NDArray[np.intp]) -> list[tuple[float, float, NDArray[np.intp]]]:
    """Return groups of free transition times with the fixed times (or ends of the horizon) that enclose them."""
    knots = np.concatenate([[experiment.t0], experiment.initial_times, [experiment.end]])
    fixed = [0, *(np.flatnonzero(where < 0) + 1).tolist(), len(knots) - 1]
    return [(float(knots[a]), float(knots[b]), where[a : b - 1]) for a, b in pairwise(fixed) if b - a > 1]


class Starts(NamedTuple):
    """Where short fits ended: the lowest end, the costs of all (n,), and why there are no more (`Step.ended`)."""

    end: End
    costs: FloatArray
    ended: str

    def count_agreeing(self, cost: float, accuracy: float) -> int:
        """Return how many ended where a fit did whose J is `cost`: at the lowest end, if that is at this J.

        Short fits have meshes of their own, whose J is accurate to `accuracy` alone; among themselves ends of one
        minimum differ by `SAME_COST`.
        """
        lowest = self.end.cost
        if not abs(lowest - cost) <= accuracy + SAME_COST * abs(cost):
            return 0
        return int(np.sum(self.costs <= max(lowest, cost) + accuracy + SAME_COST * abs(cost)))


def try_starts(
    problem: Problem,
    theta: FloatArray,
    *,
    seed: int = 0,
    most: int = MOST,
    is_enough: Callable[[float], bool] = lambda cost: False,
) -> Starts:
    """Return the lowest end of short fits from random starts, theta (d,) among them.

    They stop where, after n fits that ended in w different minima, no more than half a minimum is expected to be
    missing ([1]_), and the lowest has been found `AGREE` times. Ctrl-C and the end of the time budget end them as well,
    once one has ended.

    Parameters
    ----------
    problem : Problem
    theta : (d,)
        Where the best fit so far ended.
    seed : int
    most : int
        Starts at most.
    is_enough : callable
        Asked after each fit whether its J is low enough to end the search.

    References
    ----------
    .. [1] C. G. E. Boender, A. H. G. Rinnooy Kan, Bayesian stopping rules for multistart global optimization methods,
       Math. Program. 37 (1987) 59-80.
    """
    ends, ended = [], "most"
    starts = np.vstack([theta, draw_starts(problem, most, seed)[1:]])
    try:
        for start in starts:
            end = fit_briefly(problem, start)
            ends.append(end)
            show_detail(f"start {len(ends) - 1} of at most {most - 1}", min(one.cost for one in ends))
            if _is_enough(np.array([one.cost for one in ends if not one.failed])):
                ended = "settled"
                break
            if is_enough(end.cost):
                ended = "good"
                break
    except KeyboardInterrupt:
        ended = "interrupted"
    except OutOfTimeError:
        ended = "time"
    best = min(ends, key=lambda one: one.cost, default=End(theta, np.inf, 0))
    best = best._replace(evaluations=sum(one.evaluations for one in ends))
    return Starts(best, np.array([one.cost for one in ends[1:]]), ended)


def _is_enough(costs: FloatArray) -> bool:
    """Return whether all minima are likely to be among those with these costs (n,), and the lowest was found often."""
    n = len(costs)
    if n == 0:
        return False
    ascending = np.sort(costs)
    w = 1 + int(np.sum(np.diff(ascending) > SAME_COST * np.abs(ascending[1:])))
    found = int(np.sum(ascending <= ascending[0] + SAME_COST * abs(ascending[0])))
    return found > AGREE and n > w + 2 and w * (n - 1) / (n - w - 2) < w + 0.5


def is_minimum_time(problem: Problem, fit: Estimate) -> bool:
    """Return whether J is proportional to tf - t0, as it is at the start and at the end of a fit."""
    if len(problem.experiments) != 1 or not fit.history:
        return False
    run, where = problem.experiments[0], problem.unknowns.times[0]
    if not run.has_free_tf or np.any(where < 0):
        return False
    if any(np.isfinite(tau.lower) or np.isfinite(tau.upper) or tau.prior for tau in run.transition_times):
        return False
    place, first = int(where[-1]), fit.history[0]
    rate = float(fit.gradient[place])
    others = np.delete(fit.gradient, place)
    pairs = ((fit.cost, fit.theta[place]), (first.cost, first.theta[place]))
    proportional = all(abs(cost - rate * (tf - run.t0)) <= SAME * abs(cost) for cost, tf in pairs)
    return rate > 0 and proportional and bool(np.all(np.abs(others) <= SAME * rate))


def try_shorter_horizons(problem: Problem, fit: Estimate) -> Starts:
    """Return the lowest end of starts over shorter and shorter horizons, beginning with that of a fit.

    How many starts were tried and agree is that of the last horizon, over which none was better.
    """
    end = End(fit.theta, np.inf if fit.violated else fit.cost, 0)
    evaluations, tried, seed = 0, 0, 0
    while True:
        given = problem if end.failed else shorten_horizon(problem, end.theta)
        found = try_starts(given, end.theta, seed=seed, most=FEW if end.failed else MOST)
        evaluations, tried, seed = evaluations + found.end.evaluations, tried + len(found.costs), seed + 1
        lower = not found.end.failed and (end.failed or found.end.cost < end.cost * (1 - SAME_COST))
        end = found.end if lower else end
        stopped = found.ended in ("time", "interrupted")
        if stopped or (not lower and not end.failed) or (end.failed and tried >= MOST):
            return found._replace(end=end._replace(evaluations=evaluations))


def shorten_horizon(problem: Problem, theta: FloatArray) -> Problem:
    """Return the problem with a horizon that ends a little behind the tf of theta (d,), and its guess shrunk to it."""
    run = problem.experiments[0]
    if not isinstance(run.tf, Parameter):
        raise TypeError("tf is fixed.")
    tf = float(theta[problem.unknowns.times[0][-1]])
    factor = (tf - run.t0) / (float(run.tf.value) - run.t0)
    guesses = [run.t0 + factor * (time - run.t0) for time in run.initial_times[:-1].tolist()]
    shorter = replace(
        run,
        transition_times=tuple(guesses),
        tf=replace(run.tf, value=tf, upper=min(run.t0 + MARGIN * (tf - run.t0), float(run.tf.upper))),
    )
    return replace(problem, experiments=(shorter,))
