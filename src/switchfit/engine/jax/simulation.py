"""Simulations by JAX: states, outputs and their derivatives at all rows, of `switchfit.discretization.propagation`."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from switchfit.discretization.arguments import Arguments
from switchfit.discretization.model import Model, Piece
from switchfit.discretization.propagation import compute_path_cost, propagate, see_samples, switch_mode
from switchfit.problem.structure import Structure

Array = jax.Array


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
        path = propagate(model, theta[:N], theta[N:], jnp.ones(()))
        return (path.before, path.after), path

    see_all = jax.vmap(see, in_axes=(0, 0, None))
    moving, path = jax.jacfwd(run, has_aux=True)(theta) if tangents else run(theta)
    times, opening = (path.layout.start, path.layout.end), path.layout.first_row[1:]
    states, J = (path.before, path.after), compute_path_cost(model, path, p)
    rows = *states, *(see_all(*at, p) for at in zip(times, states, strict=True))
    late = [k for k, sensor in enumerate(structure.measurements) if sensor.delay is not None]
    seen = [see_all(samples.time, x, p) for samples, x in (see_samples(model, path, k, p) for k in late)]
    if not tangents:
        return J, seen, rows, ()

    def fix_times(values: Array, moving: Array, side: int) -> Array:
        """Subtract dx/dt times the derivative of the time at the rows that begin or end at a transition."""
        for i in range(N):
            row = opening[i] - 1 + side
            piece = jax.tree.map(lambda a, row=row: a[row], path.pieces)
            slope = switch_mode(model, i + side, partial(model.field, piece=piece), tau[i], values[row], p)
            moving = moving.at[row, :, i].add(-slope)
        return moving

    def see_along(t: Array, x: Array, x_d: Array) -> Array:
        in_x, in_p = jax.jacfwd(see, argnums=(1, 2))(t, x, p)
        return in_x @ x_d + jnp.pad(in_p, ((0, 0), (N, 0)))

    derivatives = fix_times(path.before, moving[0], 1), fix_times(path.after, moving[1], 0)
    return J, seen, rows, (*derivatives, *map(jax.vmap(see_along), times, states, derivatives))


@partial(jax.jit, static_argnames=("structure",))
def compute_slopes(
    arguments: Arguments, times: Array, states: Array, pieces: Piece, p: Array, *, structure: Structure
) -> Array:
    """Return the vector fields of all modes at times (L,), with the signals of L cells, and states (L, n)."""
    model = Model(structure, arguments)

    def at_point(t: Array, x: Array, piece: Piece) -> Array:
        return jnp.stack([model.field(mode, piece)(t, x, p) for mode in range(len(structure.modes))])

    return jax.vmap(at_point)(times, states, pieces)
