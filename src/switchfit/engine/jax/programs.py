"""The programs that JAX compiles: cost and derivatives of one experiment."""

from __future__ import annotations

from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp

from switchfit.discretization.arguments import Arguments
from switchfit.discretization.model import Model
from switchfit.discretization.propagation import compute_path_cost, propagate
from switchfit.engine.jax.backward_sweep import backward_sweep
from switchfit.engine.jax.constraints import constraints
from switchfit.engine.jax.forward import forward_gradient, forward_hessian
from switchfit.engine.jax.forward_sweep import forward_sweep
from switchfit.engine.jax.second_order import adjoint_hessian, gauss_newton_hessian
from switchfit.engine.protocol import Matrix
from switchfit.problem.structure import Structure

Array = jax.Array
Method = Literal["forward", "discrete-adjoint", "autodiff"]


@partial(jax.jit, static_argnames=("structure", "method", "matrix"))
def derivatives(
    arguments: Arguments,
    tau: Array,
    p: Array,
    side: Array,
    *,
    structure: Structure,
    method: Method,
    matrix: Matrix = "exact",
) -> tuple[Array, Array, Array]:
    """Return the cost, gradient (D,) and Hessian (D, D) of one experiment in its transition times (N,) and its p (M,).

    With the matrix "none" the Hessian is NaN.
    """
    model = Model(structure, arguments, stages_in_loop=method in ("forward", "autodiff"))
    if method == "autodiff":
        return _autodiff(model, tau, p, side)
    first = forward_sweep(model, tau, p, side)
    if method == "forward" or matrix == "gauss-newton":  # both need the tangents, and no adjoint
        cost, gradient = forward_gradient(model, first, p)
        if matrix == "gauss-newton":
            return cost, gradient, gauss_newton_hessian(model, first, p)
        if matrix == "exact":
            return cost, gradient, forward_hessian(model, first, p)
    else:
        back = backward_sweep(model, first, p)
        cost, gradient = back.cost, back.gradient
        if matrix == "exact":
            return cost, gradient, adjoint_hessian(model, first, back, p)
    return cost, gradient, jnp.full((gradient.size, gradient.size), jnp.nan)


@partial(jax.jit, static_argnames=("structure",))
def differentiate_constrained(
    arguments: Arguments,
    tau: Array,
    p: Array,
    side: Array,
    multipliers: Array,
    *,
    structure: Structure,
) -> tuple[Array, Array, Array, Array, Array]:
    """Differentiate ``J + multipliers . c`` of one experiment.

    Returns
    -------
    cost, slope, hessian : J, and the derivatives of the Lagrangian (D,) and (D, D)
    c, jacobian : the constraints (m,) and their derivatives (m, D)
    """
    model = Model(structure, arguments)
    first = forward_sweep(model, tau, p, side)
    c, A = constraints(model, first, p)
    back = backward_sweep(model, first, p, multipliers)
    return back.cost, back.gradient, adjoint_hessian(model, first, back, p, multipliers), c, A


def _autodiff(model: Model, tau: Array, p: Array, side: Array) -> tuple[Array, Array, Array]:
    """Return J and its derivatives by JAX alone, forward over forward."""
    N = model.structure.N

    def cost(theta: Array) -> Array:
        path = propagate(model, theta[:N], theta[N:], side)
        return compute_path_cost(model, path, theta[N:])

    theta = jnp.concatenate([tau, p])
    return cost(theta), jax.jacfwd(cost)(theta), jax.jacfwd(jax.jacfwd(cost))(theta)
