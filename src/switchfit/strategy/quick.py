"""Short fits from a point, the building block of all strategies: a failure has an infinite cost and is no error."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple

import numpy as np

from switchfit.engine.protocol import Evaluation
from switchfit.fit.evaluator import Evaluator
from switchfit.fit.following import Follower
from switchfit.fit.solution import minimize_cost
from switchfit.optimize import IterationRecord, LinearConstraints, Status
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem
from switchfit.runtime.errors import HiddenSwitchError

ITERATIONS = 60
"""Iterations of a short fit: what has not converged by then is in a valley that leads nowhere."""

TOLERANCE = 1e-5
"""On the KKT residual of a short fit; the fit that ends a strategy has that of `estimate`."""


_deadline: ContextVar[float] = ContextVar("deadline", default=math.inf)
_callback: ContextVar[Callable[[IterationRecord], object] | None] = ContextVar("callback", default=None)


class OutOfTimeError(Exception):
    """The time budget of a search is spent."""


@contextmanager
def limit_time(seconds: float, callback: Callable[[IterationRecord], object] | None = None) -> Iterator[None]:
    """Let searches inside the context end after so many seconds, or with that around it, or where a callback, called
    with each iteration of their fits, returns true.
    """
    token = _deadline.set(min(_deadline.get(), time.perf_counter() + seconds))
    called = _callback.set(callback or _callback.get())
    try:
        yield
    finally:
        _deadline.reset(token)
        _callback.reset(called)


def is_late() -> bool:
    """Return whether the time budget is spent."""
    return time.perf_counter() > _deadline.get()


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
            follower = _TimedFollower(meshes) if constraints is None else None
            result = minimize_cost(
                meshes, theta, "auto", TOLERANCE, iterations, _callback.get(), constraints, follower=follower
            )
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
    theta = np.clip(theta, problem.unknowns.lower, problem.unknowns.upper)
    for run, where in zip(problem.experiments, problem.unknowns.times, strict=True):
        free = where[where >= 0]
        theta[free] = np.maximum.accumulate(np.clip(theta[free], run.t0, run.end))
    return theta
