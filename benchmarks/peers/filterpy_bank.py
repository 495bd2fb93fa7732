"""filterpy: extended Kalman filters, one a mode, that interact (`IMMEstimator`).

The parameter is a further state. Each mode's step over a sample interval (Runge-Kutta, two steps) and its Jacobian are
one function that JAX compiles; filterpy does the rest in NumPy. White accelerations of the intensity q² make up for
what the mixing of the filters does to the states.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from filterpy.kalman import ExtendedKalmanFilter, IMMEstimator

from benchmarks.models import Model, integrate_sample

Step = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]


def build_steps(model: Model, period: float) -> dict[str, Step]:
    """Return, for each mode, the states and parameters one sample later with their Jacobian."""
    n = len(model.x0)

    def build(mode: str) -> Step:
        def rates(z: jax.Array) -> jax.Array:
            return jnp.concatenate([jnp.stack(model.field(mode, z[:n], z[n:], jnp)), jnp.zeros(len(z) - n)])

        def step(z: jax.Array) -> jax.Array:
            return integrate_sample(rates, z, period)

        both = jax.jit(lambda z: (step(z), jax.jacfwd(step)(z)))

        def call(z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            with jax.enable_x64(True):
                after, tangent = both(z)
            return np.asarray(after), np.asarray(tangent)

        return call

    return {mode: build(mode) for mode in model.modes}


class _Filter(ExtendedKalmanFilter):  # type: ignore[misc]
    """One mode's filter, with the signatures that `IMMEstimator` calls."""

    def __init__(self, step: Step, H: np.ndarray) -> None:
        super().__init__(H.shape[1], len(H))
        self._step, self._H = step, H

    def predict_x(self, u: object = None) -> None:
        self.x, self.F = self._step(self.x)

    def update(self, z: np.ndarray) -> None:
        super().update(z, lambda x: self._H, lambda x: self._H @ x)


class Bank:
    """The bank for a model whose positions, every other state, have the others as rates.

    Parameters
    ----------
    steps : of `build_steps`
    observed : places of the measured states
    sigma : noise of each of these
    q : intensity of the white accelerations, per square root of a second
    stay : probability that a mode stays for a sample interval
    spread : standard deviation of the first guess of the parameter
    """

    def __init__(
        self, model: Model, steps: dict[str, Step], period: float, observed: Sequence[int], sigma: Sequence[float],
        q: float, stay: float, spread: float = 0.3,
    ) -> None:  # fmt: skip
        n, M = len(model.x0), len(model.p)
        H = np.eye(n + M)[list(observed)]
        block = q**2 * np.array([[period**3 / 3, period**2 / 2], [period**2 / 2, period]])
        filters = []
        for mode in model.modes:
            one = _Filter(steps[mode], H)
            one.x = np.array([*model.x0, *model.p])
            one.P = np.diag([1e-8] * n + [spread**2] * M)
            one.Q = np.zeros((n + M, n + M))
            one.Q[:n, :n] = np.kron(np.eye(n // 2), block)
            one.R = np.diag(np.square(sigma))
            filters.append(one)
        K = len(filters)
        change = np.full((K, K), (1 - stay) / (K - 1))
        np.fill_diagonal(change, stay)
        self._bank = IMMEstimator(filters, np.eye(K)[0], change)
        self._n = n

    def update(self, t: float, y: np.ndarray) -> tuple[float, float]:
        """Return the probability of the second mode, and the parameter."""
        self._bank.predict()
        self._bank.update(y)
        return float(self._bank.mu[1]), float(self._bank.x[self._n])
