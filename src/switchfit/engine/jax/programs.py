"""The programs that JAX compiles: cost and derivatives of one experiment.

They differentiate the simulation as it is. A step is one row of `switchfit.discretization.propagation.propagate`, whose
derivatives JAX finds; those of an implicit step follow from the implicit function theorem
(`switchfit.discretization.implicit_rows.stages`).
"""

from __future__ import annotations

from functools import partial
from typing import Literal

import jax
import jax.numpy as jnp

from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import CHUNK, count_chunks
from switchfit.discretization.model import Model
from switchfit.discretization.propagation import compute_path_constraints, compute_path_cost, propagate
from switchfit.engine.jax.gauss_newton import differentiate_residuals
from switchfit.engine.protocol import Matrix
from switchfit.problem.structure import Structure

Array = jax.Array
Method = Literal["forward", "discrete-adjoint"]


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

    The gradient is differentiated backward by the method "discrete-adjoint", forward by "forward"; the Hessian is the
    forward derivative of the gradient. With the matrix "none" it is NaN.
    """
    model, N = Model(structure, arguments), structure.N
    differentiate = jax.grad if method == "discrete-adjoint" else jax.jacfwd

    def cost(theta: Array) -> tuple[Array, Array]:
        J = compute_path_cost(model, propagate(model, theta[:N], theta[N:], side), theta[N:])
        return J, J

    def gradient(theta: Array) -> tuple[Array, tuple[Array, Array]]:
        g, J = differentiate(cost, has_aux=True)(theta)
        return g, (J, g)

    theta = jnp.concatenate([tau, p])
    if matrix == "gauss-newton":
        return differentiate_residuals(model, theta, side)
    if matrix == "none":
        _, (J, g) = gradient(theta)
        return J, g, jnp.full((theta.size, theta.size), jnp.nan)
    H, (J, g) = jax.jacfwd(gradient, has_aux=True)(theta)
    return J, g, H


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
    model, N = Model(structure, arguments), structure.N

    def lagrangian(theta: Array) -> tuple[Array, tuple[Array, Array]]:
        path, p = propagate(model, theta[:N], theta[N:], side), theta[N:]
        J, c = compute_path_cost(model, path, p), compute_path_constraints(model, path, p)
        return J + multipliers @ c, (J, c)

    def slope(theta: Array) -> tuple[tuple[Array, Array], tuple[Array, Array, Array]]:
        slope, (J, c) = jax.grad(lagrangian, has_aux=True)(theta)
        return (slope, c), (J, slope, c)

    (H, A), (J, gradient, c) = jax.jacfwd(slope, has_aux=True)(jnp.concatenate([tau, p]))
    return J, gradient, H, c, A


@partial(jax.jit, static_argnames=("structure",))
def differentiate_in_states(
    arguments: Arguments, tau: Array, p: Array, multipliers: Array, *, structure: Structure
) -> tuple[Array, Array]:
    """Return the states at the starts of all rows, and the derivatives of ``J + multipliers . c`` in them: (Q, C, n).

    Samples at t0 lie before the first row, and are left out.
    """
    later = [
        s if sensor.delay is not None else s._replace(weight=jnp.where(s.cell[:, None] < 0, 0.0, s.weight))
        for s, sensor in zip(arguments.samples, structure.measurements, strict=True)
    ]
    model = Model(structure, arguments._replace(samples=tuple(later)))

    def lagrangian(nudges: Array) -> tuple[Array, Array]:
        path = propagate(model, tau, p, jnp.ones(()), nudges)
        return compute_path_cost(model, path, p) + multipliers @ compute_path_constraints(model, path, p), path.before

    chunks = count_chunks(arguments.nodes.shape[0] - 1, structure.N)
    costates, states = jax.grad(lagrangian, has_aux=True)(jnp.zeros((chunks, CHUNK, structure.n)))
    return states, costates
