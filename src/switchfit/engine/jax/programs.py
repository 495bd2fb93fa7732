"""The programs of one experiment: J with its derivatives by one of the methods, and with its constraints."""

from __future__ import annotations

from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp

from switchfit.discretization.arguments import Arguments
from switchfit.discretization.model import Model
from switchfit.discretization.propagation import path_cost, propagate
from switchfit.engine.jax.constraints import augmented
from switchfit.engine.jax.first_order import first_order
from switchfit.engine.jax.forward import forward_hessian
from switchfit.engine.jax.second_order import adjoint_hessian, gauss_newton_hessian
from switchfit.engine.protocol import Matrix
from switchfit.problem.structure import Structure

Method = Literal["forward", "discrete-adjoint", "autodiff"]


@partial(jax.jit, static_argnames=("structure", "method", "matrix"))
def derivatives(
    arguments: Arguments,
    tau: jax.Array,
    p: jax.Array,
    side: jax.Array,
    *,
    structure: Structure,
    method: Method,
    matrix: Matrix = "exact",
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Cost, gradient (D,) and Hessian (D, D) of one experiment in its N transition times and its p (M,), traced."""
    model = Model(structure, arguments)
    if method == "autodiff":
        return _autodiff(model, tau, p, side)
    first = first_order(model, tau, p, side)
    if matrix == "none":
        return first.cost, first.gradient, jnp.full((first.gradient.size, first.gradient.size), jnp.nan)
    if matrix == "gauss-newton":
        return first.cost, first.gradient, gauss_newton_hessian(model, first, p)
    second = forward_hessian if method == "forward" else adjoint_hessian
    return first.cost, first.gradient, second(model, first, tau, p)


@partial(jax.jit, static_argnames=("structure",))
def constrained_derivatives(
    arguments: Arguments,
    tau: jax.Array,
    p: jax.Array,
    side: jax.Array,
    multipliers: jax.Array,
    penalty: jax.Array,
    *,
    structure: Structure,
) -> tuple[jax.Array, ...]:
    """Cost; gradient and Hessian of ``J + weights . c``; constraints (m,), their derivatives (m, D).

    The weights are ``multipliers + penalty c``.
    """
    model = Model(structure, arguments)
    first = first_order(model, tau, p, side)
    _, slope, weights, c, A = augmented(model, first, tau, p, multipliers, penalty)
    return first.cost, slope, adjoint_hessian(model, first, tau, p, weights), c, A


def _autodiff(model: Model, tau: jax.Array, p: jax.Array, side: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """J and its derivatives by JAX alone, forward over forward."""
    N = model.structure.N

    def cost(theta: jax.Array) -> jax.Array:
        path = propagate(model, theta[:N], theta[N:], side)
        return path_cost(model, path, theta[N:])

    theta = jnp.concatenate([tau, p])
    return cost(theta), jax.jacfwd(cost)(theta), jax.jacfwd(jax.jacfwd(cost))(theta)
