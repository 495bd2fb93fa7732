"""SciPy's `least_squares` on the ten tosses: residuals from `solve_ivp`, a Jacobian by grouped differences.

`least_squares` is what SciPy's documentation recommends where the cost is a sum of squares, with ``x_scale="jac"`` for
unknowns of different sizes, bounds by ``method="trf"``, and ``jac_sparsity`` where most of the Jacobian is zero: each
toss knows only mu and its own five unknowns, so that six differences give all 51 columns.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import scipy.integrate
import scipy.optimize
import scipy.sparse

GRAVITY = 9.81
RTOL, ATOL = 1e-8, 1e-10


def residuals_of_toss(times: np.ndarray, positions: np.ndarray, tau: float, mu: float, start: np.ndarray) -> np.ndarray:
    """Modelled less measured positions of one toss, (2 K,): it slides until tau, then lies."""
    speed = math.hypot(start[2], start[3])
    ax, ay = -mu * GRAVITY * start[2] / speed, -mu * GRAVITY * start[3] / speed
    sliding = times[times < tau]
    found = scipy.integrate.solve_ivp(
        lambda t, x: [x[2], x[3], ax, ay], (0.0, tau), start, t_eval=np.append(sliding, tau), rtol=RTOL, atol=ATOL
    ).y[:2]
    rest = np.repeat(found[:, -1:], len(times) - len(sliding), axis=1)
    return (np.concatenate([found[:, :-1], rest], axis=1).T - positions).ravel()


class Tosses:
    """All tosses together; theta as `problems.tosses_theta` has it. Called with a guess it returns SciPy's result."""

    def __init__(self, samples: list[tuple[np.ndarray, np.ndarray]], lower: np.ndarray, upper: np.ndarray) -> None:
        self.samples, self.bounds = samples, (lower, upper)
        K = len(samples)
        blocks = []
        for e, (times, _) in enumerate(samples):
            block = np.zeros((2 * len(times), 5 * K + 1))
            block[:, [e, K, *range(K + 1 + 4 * e, K + 5 + 4 * e)]] = 1.0
            blocks.append(block)
        self._sparsity = scipy.sparse.csr_matrix(np.concatenate(blocks))

    def residuals(self, theta: np.ndarray) -> np.ndarray:
        """All residuals; J is half their squared norm."""
        K = len(self.samples)
        starts = theta[K + 1 :].reshape(K, 4)
        parts = [
            residuals_of_toss(times, positions, theta[e], theta[K], starts[e])
            for e, (times, positions) in enumerate(self.samples)
        ]
        return np.concatenate(parts)

    def __call__(self, theta: np.ndarray) -> Any:
        """Fit from theta."""
        return scipy.optimize.least_squares(
            self.residuals,
            theta,
            bounds=self.bounds,
            x_scale="jac",
            jac_sparsity=self._sparsity,
            ftol=1e-12,
            xtol=1e-10,
            gtol=1e-10,
            max_nfev=300,
        )
