"""Modes with corners, and derivatives of their costs by differences."""

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from support.derivatives import differentiate
from switchfit.meshes.evaluator import Evaluator
from switchfit.problem.functions import use_float64

TIGHT = {"rtol": 1e-12, "atol": 1e-13}
KNOTS, HEIGHTS = np.array([-1.0, -0.5, 0.0, 0.3]), np.array([-2.0, -0.5, 0.0, 0.5])


def samples(tf=4.0, count=40, values=None, sigma=1.0, **settings):
    """The first state at equal times, which is compared with a cosine unless values are given."""
    times = np.linspace(0.0, tf, count + 1)[1:]
    values = np.cos(times) if values is None else values
    return sf.Measurements(times, values, lambda t, x, p: x[:1], sigma=sigma, **settings)


def problem_of(mode, start, parameters, tf=4.0, data=None, count=40, inputs=None, jumps=(), **settings):
    """One mode, with `samples` unless other data are given."""
    data = samples(tf, count) if data is None else data
    run = sf.Experiment(data, ("m",), (), 0.0, tf, inputs=inputs, jumps=jumps)
    return sf.Problem(sf.HybridSystem({"m": mode}, start), run, parameters, **settings)


def crossings_of(evaluator):
    """Times of the crossings on the path of the first experiment."""
    engine = evaluator.engines[0]
    return engine._times[engine._split.crossings]


def spring(t, x, p):
    return jnp.stack([x[1], -p["k"] * x[0] - p["c"] * jnp.sign(x[1])])


def tank(t, x, p):
    return jnp.stack([-p["k"] * jnp.sqrt(jnp.maximum(x[0], 0.0))])


def block(tau, parameters, values=None, sigma=1.0):
    """A block is pushed until tau, and comes to rest."""
    modes = {
        "push": lambda t, x, p: jnp.stack([x[1], p["a"] - p["mu"] * 9.81 * jnp.sign(x[1])]),
        "slide": lambda t, x, p: jnp.stack([x[1], -p["mu"] * 9.81 * jnp.sign(x[1])]),
    }
    run = sf.Experiment(samples(2.0, values=values, sigma=sigma), ("push", "slide"), (tau,), 0.0, 2.0)
    return sf.Problem(sf.HybridSystem(modes, [0.0, 0.0]), run, parameters, **TIGHT)


def block_at(t, q):
    tau, a, mu = q
    push, stop = a - 9.81 * mu, 9.81 * mu
    pushed, s = jnp.minimum(t, tau), jnp.minimum(jnp.maximum(t - tau, 0.0), push * tau / stop)
    return push * pushed**2 / 2 + push * tau * s - stop * s**2 / 2


def expect(solution, problem):
    """J, its gradient, Hessian and Gauss-Newton matrix, of residuals of a closed form."""
    times = problem.experiments[0].data[0].times
    x, slopes, curvatures = differentiate(lambda q: solution(times, q), problem.initial_theta)
    r = x - np.cos(times)
    return 0.5 * r @ r, r @ slopes, slopes.T @ slopes + np.einsum("k,kij->ij", r, curvatures), slopes.T @ slopes


def value_of(solution, times, q):
    """A solution at times, in float64."""
    with use_float64():
        return np.asarray(solution(jnp.asarray(times), jnp.asarray(q)))


def differences(cost, theta, directions):
    """First and second derivatives of J along directions (L, d) by central differences of the fourth order.

    Returns those of several steps: (steps, L) each.
    """
    size = np.maximum(np.abs(theta), 0.1)
    found = []
    for step in (3e-3, 1e-3, 3e-4):
        J = np.array([[cost(theta + k * step * size * d) for k in (-2, -1, 0, 1, 2)] for d in directions])
        found.append((J @ [1, -8, 0, 8, -1] / (12 * step), J @ [-1, 16, -30, 16, -1] / (12 * step**2)))
    return size, *map(np.array, zip(*found, strict=True))


def measure_errors(theta, cost, gradient, hessian):
    """Largest errors of first and second derivatives against differences of J along each unknown and each two of them,
    relative to the largest of these; the best of three steps counts.
    """
    d = len(theta)
    directions = np.array([np.eye(d)[i] + (np.eye(d)[j] if j > i else 0.0) for i in range(d) for j in range(i, d)])
    size, first, second = differences(cost, theta, directions)
    along = size * directions
    own = along @ gradient, np.einsum("li,ij,lj->l", along, hessian, along)
    off = (np.abs(theirs - mine).min(axis=0).max() for theirs, mine in zip((first, second), own, strict=True))
    return np.array(list(off)) / [np.abs(first).max(), np.abs(second).max()]


def check_derivatives(problem):
    """Compare with differences of J, and return the evaluator."""
    evaluator, theta = Evaluator(problem), problem.initial_theta
    found = evaluator(theta)
    errors = measure_errors(theta, evaluator.cost, found.gradient, found.hessian)
    assert errors.max() < 1e-6, errors
    return evaluator


def contact(t, x, p):
    return jnp.stack([x[1], -9.81 + jnp.where(x[0] < 0, -p["k"] * x[0] - p["c"] * x[1], 0.0)])


def clipped(t, x, p):
    return jnp.stack([x[1], -p["k"] * jnp.clip(x[0], -p["s"], p["s"]) - 0.1 * x[1]])


def still(t, x, p):
    return -p["c"] * jnp.sign(x) * jnp.array([1.0, 0.6, 0.5])
