"""Exact Hessian of the *discretized* cost by a backward sweep, after the forward sweep.

With z = (x_k, theta) the arguments of node map k, Z_k their derivative in theta and psi_{k+1} the derivative of the
cost to go,

    D^2 J = sum_k Z_k' D^2 (psi_{k+1} . F_k + L_k) Z_k,

where steps, samples, reset maps, the initial state and terminal costs are all such maps. The sum equals the result of
the sweep over (psi_k, Omega_k, Theta_k, H_k) of the general discrete form. Its terms are independent of each other, so
that they are evaluated for a chunk of rows at once; only psi and x_theta are computed row by row. The stages inside a
step are treated in the same way: only f itself is differentiated twice, never a composition.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax

from switchfit.discretization.arguments import Samples
from switchfit.discretization.model import Model, Piece, apply_weights
from switchfit.discretization.propagation import Path, flatten_rows, switch_method, switch_mode
from switchfit.discretization.rows import length_factor, times_derivative
from switchfit.discretization.tableaus import Tableau
from switchfit.engine.jax.backward_sweep import Backward, Costates, rows_at_transitions
from switchfit.engine.jax.constraints import terms_at_end, terms_at_transitions
from switchfit.engine.jax.forward_sweep import (
    Forward,
    Tangents,
    parameter_directions,
    recompute_tangents,
    row_operands,
    stages_along,
    time_directions,
    unit,
)
from switchfit.engine.jax.late_samples import anchors, late_curvature, late_gauss_newton

Array = jax.Array

SAMPLES_AT_ONCE = 1024
"""Samples whose second derivatives are evaluated together: bounds the memory of long logs."""


def adjoint_hessian(model: Model, first: Forward, back: Backward, p: Array, weights: Array | None = None) -> Array:
    """Return the Hessian (D, D) of the discretized cost, with ``weights . c`` of the constraints (m,) if given.

    `back` is the backward sweep of the same sum.
    """
    path, X, psi = first.path, first.tangents, back.costates
    H = stage_curvature(model, first, psi, p) + step_length_curvature(model, first, psi)
    H = H + curvature_of_terms(model, first, p, weights)
    P = parameter_directions(model)
    for i in model.structure.resets:
        along = unit(P.shape[1], i), X.before_transition(path.layout, i), P
        value = _weigh(model.reset(i), psi.opened[path.layout.first_chunk[i + 1]])
        H = H + _second(value, (*path.at_transition(i), p), along)
    for k, samples in enumerate(model.arguments.samples):
        H = H + sample_curvature(model, path, X, k, samples, p, gauss_newton=False)
    if model.structure.initial_state is not None:
        H = H + _second(_weigh(model.initial_state, psi.start), (p,), (P,))
    return H


def gauss_newton_hessian(model: Model, first: Forward, p: Array) -> Array:
    """Return the Hessian without the second derivatives of the trajectory and of the observations: (D, D).

    For Measurements and ReferenceSignal this is the Gauss-Newton matrix, a robust loss weighing each residual by rho',
    which is never negative; a sigma that is a parameter contributes its Fisher information. Any other cost contributes
    its own second derivative in what it depends on.
    """
    H = stage_gauss_newton(model, first, p) + curvature_of_terms(model, first, p, None)
    for k, samples in enumerate(model.arguments.samples):
        H = H + sample_curvature(model, first.path, first.tangents, k, samples, p, gauss_newton=True)
    return H


def curvature_of_terms(model: Model, first: Forward, p: Array, weights: Array | None) -> Array:
    """Return the second derivative of the terms of ``J + weights . c`` at transitions and at the end: (D, D)."""
    path, X = first.path, first.tangents
    P = parameter_directions(model)
    H = jnp.zeros((P.shape[1], P.shape[1]))
    for i, term in terms_at_transitions(model, weights):
        along = unit(P.shape[1], i), X.before_transition(path.layout, i), P
        H = H + _second(term, (*path.at_transition(i), p), along)
    t, x = path.at_end()
    for term in terms_at_end(model, weights):
        H = H + _second(partial(term, t), (x, p), (X.after[-1, -1], P))
    return H


def stage_curvature(model: Model, first: Forward, psi: Costates, p: Array) -> Array:
    """Return ``sum Z_j' D^2 (w_j . f + h b_j ell) Z_j`` over all stages, Z_j the tangent of (t_j, X_j, p): (D, D).

    Along theta directly, or along (t, x, p) where these are fewer.
    """
    n, M = model.structure.n, model.structure.M
    path = first.path
    P = parameter_directions(model)
    kept, along_row = stages_along(model, first)
    local = 1 + n + M < P.shape[1]
    basis = jnp.eye(1 + n + M)

    def of_mode(mode: int) -> Callable[..., Array]:
        tableau = model.tableaus[mode]

        def at_stage(piece: Piece, t: Array, x: Array, w: Array, hb: Array, t_d: Array, x_d: Array) -> Array:
            f, ell = model.field(mode, piece), model.density(mode, piece)

            def value(t: Array, x: Array, p: Array) -> Array:
                return w @ f(t, x, p) + (hb * ell(t, x, p) if model.has_running_cost else 0.0)

            if not local:
                return _second(value, (t, x, p), (t_d, x_d, P), P_last=True)
            Z = jnp.concatenate([t_d[None], x_d, P])
            return Z.T @ _second(value, (t, x, p), (basis[0], basis[1 : 1 + n], basis[1 + n :])) @ Z

        def row(
            start: Array,
            end: Array,
            piece: Piece,
            states: Array,
            w: Array,
            s_d: Array,
            e_d: Array,
            *at_stages: Any,
        ) -> Array:
            h = end - start
            times, times_d = start + tableau.c * h, jnp.stack(times_derivative(tableau, s_d, e_d))
            over_stages = jax.vmap(at_stage, in_axes=(None, 0, 0, 0, 0, 0, 0))
            hb = h * jnp.asarray(tableau.b)
            return over_stages(piece, times, states, w, hb, times_d, along_row(tableau, *at_stages)).sum(0)

        return lambda *operands: jax.vmap(row)(*operands).sum(0)

    layout = path.layout
    operands = (layout.start, layout.end, path.pieces, path.stages, psi.w, *time_directions(model, layout), *kept)
    return _sum_over_chunks(model, of_mode, layout.segment, operands)


def step_length_curvature(model: Model, first: Forward, psi: Costates) -> Array:
    """Return the second derivative of the products of row lengths with slopes: ``h' x V' + V' x h'``, (D, D).

    Only the first and the last row of a segment have a length that depends on theta.
    """
    N = model.structure.N
    P = parameter_directions(model)
    if N == 0:
        return jnp.zeros((P.shape[1], P.shape[1]))

    def of_method(tableau: Tableau) -> Callable[[Array], Array]:
        def of_row(row: Array) -> Array:
            """Return V' of one row: (D,)."""
            all_rows = row_operands(model, first), psi.after, psi.mu
            given, after, mu = jax.tree.map(lambda values: flatten_rows(values)[row], all_rows)
            _, _, _, at, start_d, end_d = given
            X_d, K_d, _ = recompute_tangents(model, tableau, *given)
            ell_d = jnp.zeros((len(tableau.b), P.shape[1]))
            if at.l is not None:
                times_d = jnp.stack(times_derivative(tableau, start_d, end_d))
                ell_d = at.l_t[:, None] * times_d + jnp.einsum("sn,snd->sd", at.l_x, X_d) + at.l_p @ P
            return jax.vmap(partial(length_factor, tableau, after, mu), in_axes=-1)(list(K_d), list(ell_d))

        return of_row

    def one(row: Array, segment: Array) -> Array:
        return switch_method(model, segment, of_method, row)

    by_opening, by_closing = jax.vmap(jax.vmap(one))(*rows_at_transitions(first))
    half = jnp.zeros((P.shape[1], P.shape[1])).at[:N].set(by_closing - by_opening)
    return half + half.T


def stage_gauss_newton(model: Model, first: Forward, p: Array) -> Array:
    """Return the Gauss-Newton part of the running costs: (D, D)."""
    path = first.path
    P = parameter_directions(model)
    if not model.has_running_cost:
        return jnp.zeros((P.shape[1], P.shape[1]))

    def at_stage(mode: int, piece: Piece, t: Array, x: Array, t_d: Array, x_d: Array) -> Array:
        H = jnp.zeros((P.shape[1], P.shape[1]))
        if model.structure.is_rest(mode):
            return H
        for residual, W in zip(model.reference_residuals(piece), model.arguments.weights, strict=True):
            r_d = _columns(residual, (t, x, p), (t_d, x_d, P))
            H = H + r_d.T @ apply_weights(W, r_d)
        for ell in model.structure.running:

            def value(x: Array, p: Array, ell: Callable[..., Any] = ell) -> Array:
                return jnp.asarray(ell(t, x, model.parameters(p))).reshape(())

            H = H + _second(value, (x, p), (x_d, P))
        return H

    def row(
        mode: int,
        start: Array,
        end: Array,
        piece: Piece,
        states: Array,
        s_d: Array,
        e_d: Array,
        *at_stages: Any,
    ) -> Array:
        h, tableau = end - start, model.tableaus[mode]
        times, times_d = start + tableau.c * h, jnp.stack(times_derivative(tableau, s_d, e_d))
        over_stages = jax.vmap(partial(at_stage, mode), in_axes=(None, 0, 0, 0, 0))
        parts = over_stages(piece, times, states, times_d, along_row(tableau, *at_stages))
        return h * jnp.tensordot(jnp.asarray(tableau.b), parts, axes=1)

    layout = path.layout
    kept, along_row = stages_along(model, first)
    operands = (layout.start, layout.end, path.pieces, path.stages, *time_directions(model, layout), *kept)

    def of_mode(mode: int) -> Callable[..., Array]:
        return lambda *rows: jax.vmap(partial(row, mode))(*rows).sum(0)

    return _sum_over_chunks(model, of_mode, layout.segment, operands)


def _sum_over_chunks(
    model: Model, of_mode: Callable[[int], Callable[..., Array]], segment: Array, operands: tuple[Any, ...]
) -> Array:
    """Sum (D, D) matrices over all chunks, each evaluated with the functions of its mode."""
    D = model.structure.N + model.structure.M

    def chunk(H: Array, given: Any) -> tuple[Array, None]:
        segment, rows = given
        return H + switch_mode(model, segment, of_mode, *rows), None

    return lax.scan(chunk, jnp.zeros((D, D)), (segment, operands))[0]


def sample_curvature(
    model: Model, path: Path, X: Tangents, k: int, samples: Samples, p: Array, *, gauss_newton: bool
) -> Array:
    """Return the second derivative of the costs of the k-th Measurements: (D, D)."""
    P = parameter_directions(model)
    if model.structure.measurements[k].delay is not None:
        of_late, at = late_gauss_newton if gauss_newton else late_curvature, anchors(model, path, k, p)
        return of_late(model, at, flatten_rows(X.before)[at.row], k, samples, p)

    def one(given: tuple[Samples, Array, Array]) -> Array:
        sample, x, x_d = given
        if not gauss_newton:
            return _second(lambda x, p: model.sample_cost(k, sample, x, p), (x, p), (x_d, P))
        r_d = _columns(lambda x, p: model.sample_residual(k, sample, x, p), (x, p), (x_d, P))
        H = r_d.T @ (model.sample_information(k, sample, x, p)[:, None] * r_d)
        if model.structure.measurements[k].sigma:
            # Fisher information of normal noise: 2 for log sigma, 0 between sigma and the rest.
            s_d = _columns(lambda p: model.log_sigma(k, sample, p), (p,), (P,))
            H = H + 2.0 * s_d.T @ s_d
        return H

    def block(H: Array, given: Any) -> tuple[Array, None]:
        return H + jax.vmap(one)(given).sum(0), None

    given = (samples, path.at_samples(samples.cell), X.at_samples(path.layout, samples.cell))
    K = samples.cell.shape[0]
    whole = K - K % SAMPLES_AT_ONCE
    H = jnp.zeros((P.shape[1], P.shape[1]))
    if whole:
        split = jax.tree.map(lambda a: a[:whole].reshape((-1, SAMPLES_AT_ONCE, *a.shape[1:])), given)
        H = lax.scan(block, H, split)[0]
    return block(H, jax.tree.map(lambda a: a[whole:], given))[0] if whole < K else H


def _weigh(function: Callable[..., Array], psi: Array) -> Callable[..., Array]:
    return lambda *z: psi @ function(*z)


def _second(
    value: Callable[..., Array], at: tuple[Array, ...], along: tuple[Array, ...], P_last: bool = False
) -> Array:
    """Return the second derivative of a scalar function along D directions (last axes of `along`): (D, D).

    With `P_last`, the last of `along` is that of p, [0 | I], whose product need not be computed.
    """
    D = along[0].shape[-1]
    if D == 0:
        return jnp.zeros((0, 0))
    gradient = jax.grad(value, argnums=tuple(range(len(at))))

    def column(*direction: Array) -> tuple[Array, ...]:
        return jax.jvp(gradient, at, direction)[1]

    columns = jax.vmap(column, in_axes=-1, out_axes=-1)(*along)
    pairs = [(a.reshape(a.size // D, D), c.reshape(a.size // D, D)) for a, c in zip(along, columns, strict=True)]
    of_p = jnp.zeros((D, D))
    if P_last:
        _, c = pairs.pop()
        of_p = jnp.pad(c, ((D - c.shape[0], 0), (0, 0)))
    return sum((a.T @ c for a, c in pairs), of_p)


def _columns(function: Callable[..., Array], at: tuple[Array, ...], along: tuple[Array, ...]) -> Array:
    """Return the derivatives (..., D) of a function along D directions (last axes of `along`)."""
    linear = jax.linearize(function, *at)[1]
    return jax.vmap(linear, in_axes=-1, out_axes=-1)(*along)
