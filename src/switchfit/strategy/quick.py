"""What all strategies are made of: short fits from a point, whose failures are bad points and not errors."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from switchfit.fit.evaluator import Evaluator
from switchfit.fit.solution import minimize_cost, minimize_with_constraints
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem

ITERATIONS = 60
"""Iterations of a short fit: what has not converged by then is in a valley that leads nowhere."""

TOLERANCE = 1e-5
"""On the KKT residual of a short fit; the fit that ends a strategy has that of `estimate`."""


MET = 1e-5
"""Value of a guard or terminal constraint, in its own unit, up to which a short fit counts as having met it."""


class End(NamedTuple):
    """Where a short fit ended: theta (d,), the cost there, and the evaluations that it took."""

    theta: FloatArray
    cost: float
    evaluations: int

    @property
    def failed(self) -> bool:
        """Whether the model could not be evaluated."""
        return not np.isfinite(self.cost)


def fit_briefly(problem: Problem, theta: FloatArray, iterations: int = ITERATIONS) -> End:
    """Return where a short fit from theta (d,) ends; its cost is infinite where it cannot begin, or violates guards."""
    failed = End(theta, np.inf, 0)
    try:
        with np.errstate(all="ignore"):  # far from the data numbers may overflow
            evaluator = Evaluator(problem, theta)
            if problem.constraint_names:
                result, held = minimize_with_constraints(evaluator, theta, TOLERANCE, iterations)
                if any(not abs(value) <= MET for _, value, _ in held):
                    return failed._replace(evaluations=result.evaluations)
            else:
                result = minimize_cost(evaluator, theta, "auto", TOLERANCE, iterations)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError):
        return failed
    return End(result.theta, result.cost, result.evaluations) if np.isfinite(result.cost) else failed
