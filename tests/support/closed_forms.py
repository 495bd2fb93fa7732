"""Problems whose J has a closed form, one for each kind of cost, and what each engine and method must give.

A new kind of measurement or cost gets an entry here; `test_closed_forms.py` evaluates all of them in all ways.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import switchfit as sf
from support import doses, matrix_exponentials
from support.derivatives import differentiate
from support.models import decay, one_run, rest
from support.sharp_modes import TIGHT, block, block_at, expect, problem_of, spring

Derivatives = tuple[Any, np.ndarray, np.ndarray]
"""J, its gradient (D,) and its Hessian (D, D)."""


class ClosedForm(NamedTuple):
    """A problem, its exact derivatives at the guess, and how near they must be."""

    build: Callable[[], sf.Problem]
    differentiate: Callable[[sf.Problem], Derivatives]
    errors: tuple[float, float, float]
    """Of J relative to it, of its gradient, of its Hessian."""

    relative_to: str = "entries"
    """Errors of the gradient and the Hessian: relative to each of their "entries", to the "largest", or "absolute"."""

    quick: tuple[tuple[str, str], ...] = (("native", "auto"),)
    """Engines and methods of the fast tests."""

    slow: tuple[tuple[str, str], ...] = (("jax", "auto"),)
    solution: Callable[[Any, Any], Any] | None = None
    """The first state as a function of times and theta, whose comparison with the cosine J is."""


def of_cost(cost: Callable[[Any], Any]) -> Callable[[sf.Problem], Derivatives]:
    """Return the derivatives of a function of theta."""
    return lambda problem: differentiate(cost, problem.initial_theta)


# A free final time


def closed_problem(**settings):
    """x' = a until tau, then x' = -k x until tf; J is the integral of x^2 + t, plus (x(tf) - 1/2)^2."""
    system = sf.HybridSystem({"grow": lambda t, x, p: jnp.stack([p["a"] + 0 * t]), "decay": decay}, [0.1])
    costs = [sf.RunningCost(lambda t, x, p: x[0] ** 2 + t), sf.TerminalCost(lambda x, p: (x[0] - 0.5) ** 2)]
    run = sf.Experiment(costs, ("grow", "decay"), (0.9,), 0.0, sf.Parameter(2.3, lower=0.5, upper=6.0))
    return sf.Problem(system, run, {"a": 1.2, "k": 0.7}, rtol=1e-12, atol=1e-14, **settings)


def closed_cost(theta):
    tau, tf, a, k = theta
    grown = ((0.1 + a * tau) ** 3 - 0.1**3) / (3 * a)
    top, rest = 0.1 + a * tau, tf - tau
    return grown + top**2 * (1 - jnp.exp(-2 * k * rest)) / (2 * k) + tf**2 / 2 + (top * jnp.exp(-k * rest) - 0.5) ** 2


# Jumps of the state at known times


def concentrations() -> np.ndarray:
    """Samples of the doses, with noise."""
    return doses.concentration(**doses.TRUE)[0] + 0.1 * np.random.default_rng(3).standard_normal(len(doses.TIMES))


def differentiate_doses(problem: sf.Problem) -> Derivatives:
    c, slopes, curvatures = doses.concentration(*problem.initial_theta)
    r = (c - concentrations()) / 0.01
    return 0.5 * r @ (c - concentrations()), r @ slopes, slopes.T @ slopes / 0.01 + np.tensordot(r, curvatures, 1)


# Costs of transitions


def transition_problem() -> sf.Problem:
    """x = x0 exp(-k t): ``mu = (x - a)^2 + c t`` at tau, of which the other transition has nothing."""
    modes = {"decay": decay, "stand": rest, "again": decay}
    cost = sf.TransitionCost(lambda t, x, p: (x[0] - 0.4) ** 2 + 0.3 * t, after="stand")
    return one_run(sf.HybridSystem(modes, [1.0]), cost, ("decay", "stand", "again"), (0.8, 1.7), 3.0, {"k": 0.9})


def differentiate_transition_cost(problem: sf.Problem) -> Derivatives:
    tau, _, k = problem.initial_theta
    x = np.exp(-k * tau)
    slope, bend = 2 * (x - 0.4), 2.0
    x_dd = x * np.array([[k**2, k * tau - 1], [k * tau - 1, tau**2]])
    hessian = np.zeros((3, 3))
    hessian[np.ix_([0, 2], [0, 2])] = bend * x**2 * np.outer([k, tau], [k, tau]) + slope * x_dd
    return (x - 0.4) ** 2 + 0.3 * tau, np.array([-k * x * slope + 0.3, 0.0, -tau * x * slope]), hessian


# Modes with corners


def spring_at(t, q):
    """Each half period ends at (-1)^n (1 - 2 n c / k); it sticks where that is below c / k: here after two of them."""
    (k, c), half = q, np.pi / jnp.sqrt(q[0])
    n = jnp.minimum(jnp.floor(t / half), 2.0)
    sign = jnp.where(n == 1.0, -1.0, 1.0)
    turned, middle = sign * (1.0 - 2.0 * n * c / k), sign * c / k
    return jnp.where(n == 2.0, turned, middle + (turned - middle) * jnp.cos(jnp.sqrt(k) * (t - n * half)))


def heater(t, x, p):
    return jnp.stack([-p["a"] * x[0] + p["b"] * jnp.where(x[0] < p["set"], 1.0, 0.0)])


def heater_at(t, q):
    """The relay holds the temperature, once it is reached."""
    a, b, reached = q
    return jnp.minimum(b / a * (1.0 - jnp.exp(-a * t)), reached)


def with_corners(problem: sf.Problem, solution: Callable[[Any, Any], Any]) -> ClosedForm:
    return ClosedForm(
        lambda: problem, lambda problem: expect(solution, problem)[:3], (1e-8, 1e-8, 1e-8), "largest", solution=solution
    )


CLOSED_FORMS = {
    "linear modes, a running cost and samples": ClosedForm(
        matrix_exponentials.build_problem,
        of_cost(matrix_exponentials.compute_cost),
        (1e-11, 1e-10, 1e-10),
        slow=(("native", "discrete-adjoint"), ("native", "forward"), ("native", "adjoint")),
    ),
    "jumps and samples at their times": ClosedForm(
        lambda: doses.make_problem(concentrations(), rtol=1e-11, atol=1e-13), differentiate_doses, (1e-10, 1e-9, 1e-9)
    ),
    "transition costs": ClosedForm(
        transition_problem,
        differentiate_transition_cost,
        (1e-8, 1e-7, 1e-6),
        quick=(("native", "auto"), ("native", "forward")),
    ),
    "a free final time, running and terminal cost": ClosedForm(
        closed_problem,
        of_cost(closed_cost),
        (1e-11, 1e-9, 1e-8),
        "absolute",
        quick=(("native", "auto"), ("jax", "adjoint")),
        slow=(("jax", "auto"), ("jax", "forward"), ("jax", "autodiff")),
    ),
    "corners: a spring that sticks": with_corners(
        problem_of(spring, [1.0, 0.0], {"k": 4.0, "c": 0.9}, 4.5, count=45, **TIGHT), spring_at
    ),
    "corners: a heater at its set point": with_corners(
        problem_of(heater, [0.0], {"a": 0.5, "b": 1.2, "set": 1.3}, 4.5, count=45, **TIGHT), heater_at
    ),
    "corners: a block that comes to rest": with_corners(block(0.63, {"a": 6.0, "mu": 0.3}), block_at),
}
