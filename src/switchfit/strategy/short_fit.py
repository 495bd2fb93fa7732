"""Short fits from a point, of which all strategies are made: one that fails ends at an infinite cost."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.engine.evaluation import Evaluation
from switchfit.fit.minimization import minimize_cost
from switchfit.meshes.evaluator import Evaluator
from switchfit.meshes.follower import Follower
from switchfit.optimize import LinearConstraints, Status
from switchfit.problem.problem import Problem
from switchfit.runtime.errors import HiddenSwitchError
from switchfit.strategy.time_limit import callback_of_search, check_time

LEAST_RELATIVE_GAIN = 1e-6
"""Part of J by which the model has to be lower for a fit."""

ITERATIONS_OF_SHORT_FIT = 60
"""Iterations of a short fit: what has not converged by then is in a valley that leads nowhere."""

TOLERANCE_OF_SHORT_FIT = 1e-5
"""On the KKT residual of a short fit; the fit that ends a strategy has that of `estimate`."""


def is_lower(cost: float, than: float) -> bool:
    """Return whether a hop has led to a lower minimum."""
    return cost < than - LEAST_RELATIVE_GAIN * abs(than)


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
    iterations: int = ITERATIONS_OF_SHORT_FIT,
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
            result = minimize_cost(
                source, theta, "auto", TOLERANCE_OF_SHORT_FIT, iterations, callback_of_search.get(), constraints
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
    theta = np.clip(theta, problem.unknowns.lowest, problem.unknowns.upper)
    for run, where in zip(problem.experiments, problem.unknowns.times, strict=True):
        free = where[where >= 0]
        # Equal times are feasible, as a mode of no length; minimum durations are left to the fit's constraints.
        theta[free] = np.maximum.accumulate(np.clip(theta[free], run.t0, run.end))
    return theta
