"""The programs that JAX compiles: cost, derivatives, costates, simulations and single functions of one experiment.

They differentiate the simulation as it is. A step is one row of `switchfit.discretization.propagation.propagate`, whose
derivatives JAX finds; those of an implicit step follow from the implicit function theorem
(`switchfit.discretization.steps`). A Hessian is differentiated forward first, then backward: the other way round, JAX
would lose the rules of users' `jax.custom_jvp` functions inside a scan at the second derivative.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jax import Array

from switchfit.discretization import path_costs, propagation, sampled_states
from switchfit.discretization.arguments import Arguments
from switchfit.discretization.model import Model
from switchfit.discretization.signals import Piece
from switchfit.engine.evaluation import Matrix
from switchfit.engine.jax.gauss_newton import differentiate_residuals
from switchfit.problem.structure import Structure

Method = Literal["forward", "discrete-adjoint"]

NOT_BACKWARD = "Reverse-mode differentiation does not work"
"""What JAX says of a loop of unknown length."""


@partial(jax.jit, static_argnames=("structure", "method", "matrix"))
def derivatives(
    arguments: Arguments,
    tau: Array,
    p: Array,
    side: Array,
    multipliers: Array | None = None,
    *,
    structure: Structure,
    method: Method,
    matrix: Matrix = "exact",
) -> tuple[Array, ...]:
    """Return the cost, gradient (D,) and Hessian (D, D) of one experiment in its transition times (N,) and its p (M,).

    With multipliers (m,), the derivatives are those of ``J + multipliers . c``, and the constraints (m,) and their
    derivatives (m, D) follow.

    The method "discrete-adjoint" differentiates the slopes of J backward for the Hessian, where JAX can, "forward"
    forward. With the matrix "none" the Hessian is NaN.
    """
    model, theta = Model(structure, arguments), jnp.concatenate([tau, p])
    if matrix == "gauss-newton":
        return differentiate_residuals(model, theta, side)

    if matrix == "none":
        g, J = _differentiate(method, lambda theta: (_evaluate(model, theta, side)[0],) * 2, theta)
        return J, g, jnp.full((theta.size, theta.size), jnp.nan)
    lam = jnp.zeros(0) if multipliers is None else multipliers
    evaluate = partial(_evaluate, model, side=side, constrained=multipliers is not None)

    # Row k of H: the slope of the Lagrangian along e_k by one tangent, and its gradient is D (D J . e_k).
    def along(direction: Array) -> tuple[Array, ...]:
        def slope(theta: Array) -> tuple[Array, tuple[Array, ...]]:
            (J, c), (J_d, c_d) = jax.jvp(evaluate, (theta,), (direction,))
            # c_d is the column of the Jacobian along this direction: vmap stacks them on axis 1.
            lagrangian_d = J_d + lam @ c_d
            return lagrangian_d, (J, lagrangian_d, c, c_d)

        row, (J, lagrangian_d, c, c_d) = _differentiate(method, slope, theta)
        return J, lagrangian_d, row, c, c_d

    # D tangents at once: the primal pass, the costliest part, is shared by them (out_axes None).
    found: tuple[Array, ...] = jax.vmap(along, out_axes=(None, 0, 0, None, 1))(jnp.eye(theta.size))
    return found[:3] if multipliers is None else found


def _evaluate(model: Model, theta: Array, side: Array, constrained: bool = False) -> tuple[Array, Array]:
    """Return the cost, and the constraints (m,) if they are asked for."""
    N = model.structure.N
    path, p = propagation.propagate(model, theta[:N], theta[N:], side), theta[N:]
    c = path_costs.compute_path_constraints(model, path, p) if constrained else jnp.zeros(0)
    return path_costs.compute_path_cost(model, path, p), c


def _differentiate(method: Method, function: Callable[[Array], tuple[Array, Any]], theta: Array) -> tuple[Array, Any]:
    """Return the derivative (D,) of the first result, and the second; JAX cannot go back through an endless loop."""
    found = _try_backward(function, theta) if method == "discrete-adjoint" else None
    return found or jax.jacfwd(function, has_aux=True)(theta)


def _try_backward(function: Callable[[Array], tuple[Array, Any]], at: Array) -> tuple[Array, Any] | None:
    """Return the derivative of the first result, and the second; None if there is a loop of unknown length."""
    try:
        return jax.grad(function, has_aux=True)(at)
    except ValueError as error:
        # `jax.lax.while_loop` has no rule for going back: JAX says so by a ValueError alone, whose text is all there is
        # to tell it by.
        if NOT_BACKWARD not in str(error):
            raise
        return None


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
        # D J / D nudge_r at nudge = 0 is the cost to go's derivative in x at the start of row r: psi of (6),
        # discretized.
        path = propagation.propagate(model, tau, p, jnp.ones(()), nudges)
        J, c = path_costs.compute_path_cost(model, path, p), path_costs.compute_path_constraints(model, path, p)
        return J + multipliers @ c, path.before

    rows = arguments.nodes.shape[0] - 1 + structure.N
    found = _try_backward(lagrangian, jnp.zeros((rows, structure.n)))
    if found is None:
        raise ValueError(
            "costates, from which insertion rates follow, need derivatives that JAX does not have through a loop of "
            "unknown length, as jax.lax.while_loop: write jax.lax.scan, or jax.lax.fori_loop with fixed ends."
        )
    costates, states = found
    return states, costates


@partial(jax.jit, static_argnames=("structure", "tangents"))
def simulate_rows(
    arguments: Arguments, tau: Array, p: Array, *, structure: Structure, tangents: bool
) -> tuple[Array, list[Array], tuple[Array, ...], tuple[Array, ...]]:
    """Simulate one experiment.

    Returns
    -------
    cost : J
    late : for each late Measurements the outputs of all sensors at its samples, (K, q)
    rows : states before and after each of R rows, 2 x (R, n), and the outputs of all sensors there, 2 x (R, q)
    derivatives : those of the rows at fixed times, along an additional last axis of length D; empty without `tangents`
    """
    model, N, theta = Model(structure, arguments), structure.N, jnp.concatenate([tau, p])

    def see(t: Array, x: Array, p: Array) -> Array:
        return jnp.concatenate([jnp.zeros(0), *(model.observe(h, t, x, p) for h, _ in structure.outputs)])

    def run(theta: Array) -> tuple[Any, Any]:
        path = propagation.propagate(model, theta[:N], theta[N:], jnp.ones(()))
        return (path.before, path.after), path

    see_all = jax.vmap(see, in_axes=(0, 0, None))
    moving, path = jax.jacfwd(run, has_aux=True)(theta) if tangents else run(theta)
    times, opening = (path.layout.start, path.layout.end), path.layout.first_row[1:]
    states, J = (path.before, path.after), path_costs.compute_path_cost(model, path, p)
    rows = *states, *(see_all(*at, p) for at in zip(times, states, strict=True))
    late = [k for k, sensor in enumerate(structure.measurements) if sensor.delay is not None]
    seen = [see_all(samples.time, x, p) for samples, x in (sampled_states.see_samples(model, path, k, p) for k in late)]
    if not tangents:
        return J, seen, rows, ()

    # At the rows that begin or end at a transition, dx/dt times the derivative of the time is subtracted.
    def fix_times(values: Array, moving: Array, side: int) -> Array:
        for i in range(N):
            row = opening[i] - 1 + side
            piece = jax.tree.map(lambda a, row=row: a[row], path.pieces)
            slope = propagation.switch_mode(model, i + side, partial(model.field, piece=piece), tau[i], values[row], p)
            # The end of a row at tau_i moves with tau_i: d/dtau x(tau, tau) = x_tau + f, of which the first is wanted.
            moving = moving.at[row, :, i].add(-slope)
        return moving

    def see_along(t: Array, x: Array, x_d: Array) -> Array:
        # Transition times are the first N unknowns, on which outputs depend by the state alone.
        in_x, in_p = jax.jacfwd(see, argnums=(1, 2))(t, x, p)
        return in_x @ x_d + jnp.pad(in_p, ((0, 0), (N, 0)))

    derivatives = fix_times(path.before, moving[0], 1), fix_times(path.after, moving[1], 0)
    return J, seen, rows, (*derivatives, *map(jax.vmap(see_along), times, states, derivatives))


@partial(jax.jit, static_argnames=("structure", "function", "which"))
def call_model(
    arguments: Arguments,
    *given: object,
    structure: Structure,
    function: Callable[..., Array],
    which: tuple[int, ...] = (),
) -> Array:
    """Return ``function(model, *which, *given)``, compiled."""
    return function(Model(structure, arguments), *which, *given)


def compute_fields(model: Model, times: Array, states: Array, pieces: Piece, p: Array) -> Array:
    """Return the vector fields of all modes at times (L,), with the signals of L cells, and states (L, n)."""

    def at_point(t: Array, x: Array, piece: Piece) -> Array:
        return jnp.stack([model.field(mode, piece)(t, x, p) for mode in range(len(model.structure.modes))])

    return jax.vmap(at_point)(times, states, pieces)
