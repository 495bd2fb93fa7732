"""The programs that JAX compiles: cost and derivatives of one experiment.

They differentiate the simulation as it is. A step is one row of `switchfit.discretization.propagation.propagate`, whose
derivatives JAX finds; those of an implicit step follow from the implicit function theorem
(`switchfit.discretization.implicit_rows.stages`). A Hessian is differentiated forward first, then backward: the other
way round, JAX would lose the rules of users' `jax.custom_jvp` functions inside a scan at the second derivative.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp

from switchfit.discretization.arguments import Arguments
from switchfit.discretization.model import Model
from switchfit.discretization.propagation import compute_path_constraints, compute_path_cost, propagate
from switchfit.engine.jax.gauss_newton import differentiate_residuals
from switchfit.engine.protocol import Matrix
from switchfit.problem.structure import Structure

Array = jax.Array
Method = Literal["forward", "discrete-adjoint"]

NOT_BACKWARD = "Reverse-mode differentiation does not work"
"""What JAX says of a loop of unknown length."""


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

    The method "discrete-adjoint" differentiates the slopes of J backward for the Hessian, where JAX can, "forward"
    forward. With the matrix "none" the Hessian is NaN.
    """
    model, theta = Model(structure, arguments), jnp.concatenate([tau, p])
    if matrix == "gauss-newton":
        return differentiate_residuals(model, theta, side)

    differentiate = _differentiate_backward if method == "discrete-adjoint" else _differentiate_forward
    if matrix == "none":
        g, J = differentiate(lambda theta: (_evaluate(model, theta, side)[0],) * 2, theta)
        return J, g, jnp.full((theta.size, theta.size), jnp.nan)
    return _differentiate_twice(partial(_evaluate, model, side=side), theta, jnp.zeros(0), differentiate)[:3]


def _evaluate(model: Model, theta: Array, side: Array, constrained: bool = False) -> tuple[Array, Array]:
    """Return the cost, and the constraints (m,) if they are asked for."""
    N = model.structure.N
    path, p = propagate(model, theta[:N], theta[N:], side), theta[N:]
    c = compute_path_constraints(model, path, p) if constrained else jnp.zeros(0)
    return compute_path_cost(model, path, p), c


def _differentiate_twice(
    evaluate: Callable[[Array], tuple[Array, Array]],
    theta: Array,
    multipliers: Array,
    differentiate: Callable[..., Any],
) -> tuple[Array, Array, Array, Array, Array]:
    """Return what `differentiate_constrained` does of a function that returns J and c."""

    # Row k of H: the slope of the Lagrangian along e_k by one tangent, and its gradient is D (D J . e_k).
    def along(direction: Array) -> tuple[Array, Array, Array, Array, Array]:
        def slope(theta: Array) -> tuple[Array, tuple[Array, ...]]:
            (J, c), (J_d, c_d) = jax.jvp(evaluate, (theta,), (direction,))
            # c_d is the column of the Jacobian along this direction: vmap stacks them on axis 1.
            lagrangian_d = J_d + multipliers @ c_d
            return lagrangian_d, (J, lagrangian_d, c, c_d)

        row, (J, lagrangian_d, c, c_d) = differentiate(slope, theta)
        return J, lagrangian_d, row, c, c_d

    return jax.vmap(along, out_axes=(None, 0, 0, None, 1))(jnp.eye(theta.size))


def _differentiate_forward(function: Callable[[Array], tuple[Array, Any]], theta: Array) -> tuple[Array, Any]:
    """Return the derivative (D,) of the first result, and the second."""
    derivative, other = jax.jacfwd(function, has_aux=True)(theta)
    return derivative, other


def _differentiate_backward(function: Callable[[Array], tuple[Array, Any]], theta: Array) -> tuple[Array, Any]:
    """Do what `_differentiate_forward` does, backward; forward through a loop of unknown length, as JAX cannot else."""
    try:
        derivative, other = jax.grad(function, has_aux=True)(theta)
    except ValueError as error:
        if NOT_BACKWARD not in str(error):
            raise
        return _differentiate_forward(function, theta)
    return derivative, other


@partial(jax.jit, static_argnames=("structure",))
def differentiate_constrained(
    arguments: Arguments, tau: Array, p: Array, side: Array, multipliers: Array, *, structure: Structure
) -> tuple[Array, Array, Array, Array, Array]:
    """Differentiate ``J + multipliers . c`` of one experiment.

    Returns
    -------
    cost, slope, hessian : J, and the derivatives of the Lagrangian (D,) and (D, D)
    c, jacobian : the constraints (m,) and their derivatives (m, D)
    """
    evaluate = partial(_evaluate, Model(structure, arguments), side=side, constrained=True)
    return _differentiate_twice(evaluate, jnp.concatenate([tau, p]), multipliers, _differentiate_backward)


@partial(jax.jit, static_argnames=("structure",))
def differentiate_in_states(
    arguments: Arguments, tau: Array, p: Array, multipliers: Array, *, structure: Structure
) -> tuple[Array, Array]:
    """Return the states at the starts of all rows, and the derivatives of ``J + multipliers . c`` in them: (R, n).

    Samples at t0 lie before the first row, and are left out.
    """
    # The nudge of row 0 comes behind the samples at t0, which it does not change; late samples are steps from there on.
    later = [
        s if sensor.delay is not None else s._replace(weight=jnp.where(s.cell[:, None] < 0, 0.0, s.weight))
        for s, sensor in zip(arguments.samples, structure.measurements, strict=True)
    ]
    model = Model(structure, arguments._replace(samples=tuple(later)))

    def lagrangian(nudges: Array) -> tuple[Array, Array]:
        path = propagate(model, tau, p, jnp.ones(()), nudges)
        return compute_path_cost(model, path, p) + multipliers @ compute_path_constraints(model, path, p), path.before

    rows = arguments.nodes.shape[0] - 1 + structure.N
    try:
        costates, states = jax.grad(lagrangian, has_aux=True)(jnp.zeros((rows, structure.n)))
    except ValueError as error:
        if NOT_BACKWARD not in str(error):
            raise
        raise ValueError(
            "costates, from which insertion rates follow, need derivatives that JAX does not have through a loop of "
            "unknown length, as jax.lax.while_loop: write jax.lax.scan, or jax.lax.fori_loop with fixed ends."
        ) from error
    return states, costates
