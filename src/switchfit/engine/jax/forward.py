"""Gradient and exact Hessian of the *discretized* cost in forward mode, for few unknowns and as a check of the adjoint.

With z = (x_k, theta) the arguments of node map k and Z_k their derivative in theta,

    D J       = sum_k D L_k Z_k,

and the second derivative of the state obeys

    x_tt, k+1 = F_x x_tt, k + S_k,      S_k = D^2 F_k (Z_k, Z_k),
    D^2 J     = sum_k L_x x_tt, k + D^2 L_k (Z_k, Z_k),

where steps, samples, reset maps, the initial state and the terminal cost are all such maps. The sources S_k are
evaluated for a chunk of rows at once, for the D (D + 1) / 2 pairs i <= j of unknowns; only products of small matrices
are computed row by row. No adjoint is used, so that an error in one method is not repeated in the other.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from switchfit.discretization.arguments import Samples
from switchfit.discretization.model import Model, Piece
from switchfit.discretization.nodes import get_end_cost, list_costs_at_transitions
from switchfit.discretization.propagation import (
    add_point_costs,
    flatten_rows,
    pick_at_cells,
    switch_method,
    switch_mode,
)
from switchfit.discretization.rows import times_derivative
from switchfit.discretization.steps import step
from switchfit.discretization.tableaus import Tableau
from switchfit.engine.jax.forward_sweep import (
    Forward,
    parameter_directions,
    sample_gradients,
    stages_along,
    sum_running_cost,
    time_directions,
    unit,
    weigh_stages,
)
from switchfit.engine.jax.late_samples import anchors, late_curvature, late_gradients

Array = jax.Array


class Second(NamedTuple):
    """Second derivative of the state along pairs of unknowns, B = D (D + 1) / 2: (Q, C, n, B) arrays.

    Attributes
    ----------
    before, after : at the start and at the end of each row
    """

    before: Array
    after: Array


def forward_hessian(model: Model, first: Forward, p: Array) -> Array:
    """Return the Hessian (D, D) of the discretized cost, D = N + M, without an adjoint.

    Parameters
    ----------
    model : Model
    first : Forward
        What `switchfit.engine.jax.forward_sweep.forward_sweep` returned at the same p.
    p : (M,)

    Notes
    -----
    The cost is that of D (D + 1) / 2 second derivatives of each step; `adjoint_hessian` gives the same matrix.
    """
    P = parameter_directions(model)
    H, second = second_tangents(model, first, p)
    for k in range(len(model.arguments.samples)):
        H = H + sample_second(model, first, second, k, p)
    path, X = first.path, first.tangents
    for i, cost in list_costs_at_transitions(model):
        at = *path.at_transition(i), p
        along = unit(P.shape[1], i), X.before_transition(path.layout, i), P
        x_tt = second.after[path.layout.first_chunk[i + 1] - 1, -1]
        H = H + jax.grad(cost, argnums=1)(*at) @ x_tt + along_pairs(cost, at, along)
    cost_at_end = get_end_cost(model)
    if cost_at_end is not None:
        at_end = partial(cost_at_end, path.at_end()[0])
        x = path.after[-1, -1]
        H = H + jax.grad(at_end)(x, p) @ second.after[-1, -1] + along_pairs(at_end, (x, p), (X.after[-1, -1], P))
    return symmetric(H, P.shape[1])


def forward_gradient(model: Model, first: Forward, p: Array) -> tuple[Array, Array]:
    """Return the discretized cost () and its gradient (D,), without an adjoint.

    The derivatives of all running costs, samples, transitions and terminal costs, along the tangents of the forward
    sweep. The Gauss-Newton matrix needs these tangents too, and no adjoint.
    """
    P, path, X = parameter_directions(model), first.path, first.tangents
    N = model.structure.N
    cost = sum_running_cost(model, first) + add_point_costs(model, path, p)
    gradient = differentiate_running_cost(model, first)
    for k, samples in enumerate(model.arguments.samples):
        if model.structure.measurements[k].delay is None:
            values, (g_x, g_p) = sample_gradients(model, path, k, samples, p)
            x_d = X.at_samples(path.layout, samples.cell)
        else:
            at = anchors(model, path, k, p)
            values, (g_start, g_x, g_p) = late_gradients(model, at, k, samples, p)
            x_d = flatten_rows(X.before)[at.row]
            # Entry 0 collects the rows that start at a node of the mesh, whose time is fixed.
            gradient = gradient.at[:N].add(jnp.zeros(N + 1).at[at.starts_at + 1].add(g_start)[1:])
        cost = cost + values.sum()
        gradient = gradient + jnp.einsum("kn,knd->d", g_x, x_d) + g_p.sum(0) @ P
    for i, function in list_costs_at_transitions(model):
        g_t, g_x, g_p = jax.grad(function, argnums=(0, 1, 2))(*path.at_transition(i), p)
        gradient = (gradient + g_x @ X.before_transition(path.layout, i) + g_p @ P).at[i].add(g_t)
    cost_at_end = get_end_cost(model)
    if cost_at_end is not None:
        g_x, g_p = jax.grad(cost_at_end, argnums=(1, 2))(*path.at_end(), p)
        gradient = gradient + g_x @ X.after[-1, -1] + g_p @ P
    return cost, gradient


def differentiate_running_cost(model: Model, first: Forward) -> Array:
    """Return the gradient of the running costs, ``sum_j h b_j ell_j' + h' sum_j b_j ell_j`` over all rows: (D,)."""
    P = parameter_directions(model)
    at = first.jacobians
    if at.l is None:
        return jnp.zeros(P.shape[1])
    layout = first.path.layout
    kept, along_row = stages_along(model, first)

    def of_method(tableau: Tableau) -> Callable[..., Array]:
        def row(start_d: Array, end_d: Array, at: tuple[Array, ...], *at_stages: Any) -> Array:
            ell, l_t, l_x, l_p = at
            times_d = jnp.stack(times_derivative(tableau, start_d, end_d))
            ell_d = l_t @ times_d + jnp.einsum("sn,snd->d", l_x, along_row(tableau, *at_stages)) + l_p.sum(0) @ P
            return ell_d + (end_d - start_d) * (jnp.asarray(tableau.b) @ ell)

        return lambda *rows: jax.vmap(row)(*rows).sum(0)

    def chunk(total: Array, given: Any) -> tuple[Array, None]:
        segment, rows = given
        return total + switch_method(model, segment, of_method, *rows), None

    hb = weigh_stages(model, layout)
    of_stages = at.l, hb * at.l_t, hb[..., None] * at.l_x, hb[..., None] * at.l_p
    given = layout.segment, (*time_directions(model, layout), of_stages, *kept)
    return lax.scan(chunk, jnp.zeros(P.shape[1]), given)[0]


def second_tangents(model: Model, first: Forward, p: Array) -> tuple[Array, Second]:
    """Return the Hessian of the running costs (B,), and ``x_tt`` along the path."""
    P = parameter_directions(model)

    def of_mode(mode: int) -> Callable[..., tuple[Array, ...]]:
        def row(start: Array, end: Array, piece: Piece, x: Array, *directions: Array) -> tuple[Array, ...]:
            f, ell = model.field(mode, piece), model.density(mode, piece)

            def function(start: Array, end: Array, x: Array, p: Array) -> tuple[Array, Array]:
                density = ell if model.has_running_cost else None
                return step(model.tableaus[mode], f, density, start, end, x, p, in_loop=model.stages_in_loop)

            at = (start, end, x, p)
            return *jax.jacfwd(function, argnums=2)(*at), *along_pairs(function, at, (*directions, P))

        return jax.vmap(row)

    def row(now: tuple[Array, Array], given: tuple[Array, ...]) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        H, x_tt = now
        F_x, L_x, S, S_cost = given
        after = F_x @ x_tt + S
        return (H + L_x @ x_tt + S_cost, after), (x_tt, after)

    def chunk(now: tuple[Array, Array], given: Any) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        H, x_tt = now
        segment, opens, *operands = given
        if resets is not None:
            R_x, S_reset = resets
            x_tt = jnp.where(opens, R_x[segment] @ x_tt + S_reset[segment], x_tt)
        return lax.scan(row, (H, x_tt), switch_mode(model, segment, of_mode, *operands))

    resets = reset_sources(model, first, p)
    path, layout = first.path, first.path.layout
    start = along_pairs(model.initial_state, (p,), (P,))
    directions = (*time_directions(model, layout), first.tangents.before)
    given = (layout.segment, layout.opens, layout.start, layout.end, path.pieces, path.before, *directions)
    (H, _), second = lax.scan(chunk, (jnp.zeros(start.shape[-1]), start), given)
    return H, Second(*second)


def reset_sources(model: Model, first: Forward, p: Array) -> tuple[Array, Array] | None:
    """Return ``D_x R`` (N + 1, n, n) and ``D^2 R (Z, Z)`` (N + 1, n, B) by segments; None without reset maps."""
    if first.resets is None:
        return None
    P = parameter_directions(model)
    D = P.shape[1]
    S = jnp.zeros((model.structure.N + 1, model.structure.n, D * (D + 1) // 2))
    for i in model.structure.resets:
        at = *first.path.at_transition(i), p
        along = (unit(D, i), first.tangents.before_transition(first.path.layout, i), P)
        S = S.at[i + 1].set(along_pairs(model.reset(i), at, along))
    return first.resets.x, S


def sample_second(model: Model, first: Forward, second: Second, k: int, p: Array) -> Array:
    """Return the second derivative of the costs of the k-th Measurements: (B,)."""
    P = parameter_directions(model)
    samples = model.arguments.samples[k]
    if model.structure.measurements[k].delay is not None:
        at = anchors(model, first.path, k, p)
        i, j = pairs(P.shape[1])
        _, (_, g_x, _) = late_gradients(model, at, k, samples, p)
        through_state = jnp.einsum("kn,knb->b", g_x, flatten_rows(second.before)[at.row])
        return (
            through_state + late_curvature(model, at, flatten_rows(first.tangents.before)[at.row], k, samples, p)[i, j]
        )

    def one(sample: Samples, x: Array, x_d: Array, x_tt: Array) -> Array:
        def cost(x: Array, p: Array) -> Array:
            return model.sample_cost(k, sample, x, p)

        return jax.grad(cost)(x, p) @ x_tt + along_pairs(cost, (x, p), (x_d, P))

    path, X = first.path, first.tangents
    x_d = pick_at_cells(path.layout, X.before[0, 0], X.after, samples.cell)
    x_tt = pick_at_cells(path.layout, second.before[0, 0], second.after, samples.cell)
    return jax.vmap(one)(samples, path.at_samples(samples.cell), x_d, x_tt).sum(0)


def pairs(D: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the B = D (D + 1) / 2 pairs i <= j: two (B,) int arrays."""
    return np.triu_indices(D)


def along_pairs(function: Callable[..., Any], at: tuple[Array, ...], directions: tuple[Array, ...]) -> Any:
    """Return the second derivative of `function` along all pairs of the D `directions` (last axes): (..., B)."""
    i, j = pairs(directions[-1].shape[-1])

    def one(u: tuple[Array, ...], v: tuple[Array, ...]) -> Any:
        return jax.jvp(lambda *z: jax.jvp(function, z, u)[1], at, v)[1]

    u, v = (tuple(d[..., index] for d in directions) for index in (i, j))
    return jax.vmap(one, in_axes=-1, out_axes=-1)(u, v)


def symmetric(values: Array, D: int) -> Array:
    """Return the symmetric (D, D) matrix with `values` (B,) on and above its diagonal."""
    i, j = pairs(D)
    return jnp.zeros((D, D)).at[i, j].set(values).at[j, i].set(values)
