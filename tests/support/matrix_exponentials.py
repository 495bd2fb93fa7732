"""A linear system with everything by matrix exponentials: cost, gradient and Hessian to ten digits.

Three states, three modes, three parameters in the matrices and in the initial state, a quadratic running cost and
samples. In each mode x(t) = exp(A h) x and the running cost is x' W(h) x, with both out of one matrix exponential
(Van Loan 1978): exp([[-A', Q], [0, A]] h) = [[., G], [0, F]], F = exp(A h), W = F' G.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import expm

import switchfit as sf

T0, TF = 0.5, 3.0
SAMPLES = np.array([0.5, 1.1, 1.9, 2.2, 3.0])
VALUES = np.array([[0.9, 0.1], [0.5, np.nan], [0.1, 0.4], [0.3, 0.2], [-0.2, 0.6]])
SIGMA = np.array([0.3, 0.5])
Q = np.array([[2.0, 0.3, 0.0], [0.3, 1.0, -0.2], [0.0, -0.2, 0.5]])
H = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, -1.0]])
THETA = np.array([1.3, 2.4, 0.7, 1.6, -0.4])
NAMES = ("tau_1", "tau_2", "a", "b", "c")
SEGMENT_OF_SAMPLE = (0, 0, 1, 1, 2)


def matrices(a, b, c):
    """A of each mode."""
    return [
        jnp.array([[-a, 1.0, 0.0], [-b, -0.3, c], [0.2, 0.0, -1.0]]),
        jnp.array([[0.1, b, 0.0], [-b, 0.1 * c, 0.4], [a * b, 0.0, -0.5]]),
        jnp.array([[-0.2, 0.0, c**2], [1.0, -a, 0.0], [0.0, 0.7, -b]]),
    ]


def state_at_start(a, b, c):
    return jnp.array([a**2, b - 1.0, 0.5 * c * a])


def compute_cost(theta):
    """J of theta = (tau_1, tau_2, a, b, c)."""
    knots = [T0, theta[0], theta[1], TF]
    A = matrices(*theta[2:])
    spans = [(i, knots[i + 1]) for i in range(3)]
    spans += [(i, t) for i, t in zip(SEGMENT_OF_SAMPLE, SAMPLES, strict=True)]
    powers = [jnp.block([[-A[i].T, Q], [jnp.zeros((3, 3)), A[i]]]) * (end - knots[i]) for i, end in spans]
    E = jax.vmap(expm)(jnp.stack(powers))
    F, G = E[:, 3:, 3:], E[:, :3, 3:]
    x, J, starts = state_at_start(*theta[2:]), 0.0, []
    for i in range(3):
        starts.append(x)
        J = J + x @ F[i].T @ G[i] @ x
        x = F[i] @ x
    for k, i in enumerate(SEGMENT_OF_SAMPLE):
        r = jnp.where(np.isnan(VALUES[k]), 0.0, H @ F[3 + k] @ starts[i] - np.nan_to_num(VALUES[k])) / SIGMA
        J = J + 0.5 * r @ r
    return J


@cache
def build_problem():
    modes = {f"mode {i}": lambda t, x, p, i=i: matrices(p["a"], p["b"], p["c"])[i] @ x for i in range(3)}
    system = sf.HybridSystem(modes, lambda p: state_at_start(p["a"], p["b"], p["c"]))
    samples = sf.Measurements(SAMPLES, VALUES, observe=lambda t, x, p: H @ x, sigma=SIGMA)
    run = sf.Experiment([sf.RunningCost(lambda t, x, p: x @ Q @ x), samples], tuple(system.modes), THETA[:2], T0, TF)
    made = sf.Problem(system, run, dict(zip("abc", THETA[2:].tolist(), strict=True)), rtol=1e-13, atol=1e-15)
    assert made.theta_names == NAMES
    return made
