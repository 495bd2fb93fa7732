"""Functions that are minimised, and what is checked of each result."""

from types import SimpleNamespace

import numpy as np
from hypothesis import strategies as st

SEEDS = st.integers(0, 2**32 - 1)


def evaluation(cost, gradient, hessian):
    return SimpleNamespace(cost=cost, gradient=gradient, hessian=hessian)


def smooth(function):
    """An evaluate callable from theta -> (cost, gradient, hessian)."""

    def evaluate(theta, side):
        return evaluation(*function(theta))

    return evaluate


def quadratic(H, centre, offset=0.0):
    """½ (theta − centre)ᵀ H (theta − centre) + offset."""

    def function(theta):
        e = theta - centre
        return 0.5 * e @ H @ e + offset, H @ e, H

    return smooth(function)


def rosenbrock(theta):
    x, y = theta
    J = 100.0 * (y - x**2) ** 2 + (1.0 - x) ** 2
    g = np.array([-400.0 * x * (y - x**2) - 2.0 * (1.0 - x), 200.0 * (y - x**2)])
    return J, g, np.array([[1200.0 * x**2 - 400.0 * y + 2.0, -400.0 * x], [-400.0 * x, 200.0]])


def assert_feasible(result, constraints):
    for record in result.history:
        size = 1.0 + np.abs(constraints.A) @ np.abs(record.theta) + np.abs(constraints.b)
        assert np.all(constraints.A @ record.theta - constraints.b >= -1e-14 * size)
        assert np.all(record.theta >= constraints.lower)
        assert np.all(record.theta <= constraints.upper)
