"""Exact gradient and Hessian of the *discretised* cost, by one forward and one backward sweep.

With z = (x_k, theta) the arguments of node map k, Z_k their derivative in theta and psi_{k+1} the derivative of the
cost to go,

    D^2 J = sum_k Z_k' D^2 (psi_{k+1} . F_k + L_k) Z_k,

where steps, samples, reset maps, the initial state and terminal costs are all such maps. The sum is what the sweep
over (psi_k, Omega_k, Theta_k, H_k) of the general discrete form adds up to; written like this its terms are
independent of each other, so that a chunk of rows is evaluated at once. Only psi and x_theta are found one row after
another.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from switchfit.derivatives.rows import (
    ResetJacobians,
    RowJacobians,
    Tangents,
    parameter_directions,
    reset_jacobians,
    row_jacobians,
    tangents,
    time_directions,
)
from switchfit.mesh import row_ending_cell
from switchfit.model import Model, Piece, Samples
from switchfit.propagate import Path, at_cells, by_mode, propagate
from switchfit.rungekutta import Directions, curvature, stage_directions

Array = jax.Array

SAMPLES_AT_ONCE = 1024
"""Samples whose second derivatives are evaluated together: bounds the memory of long logs."""


class FirstOrder(NamedTuple):
    """The forward sweep: path, Jacobians, x_theta, cost and gradient."""

    path: Path
    jacobians: RowJacobians
    resets: ResetJacobians | None
    tangents: Tangents
    cost: Array
    gradient: Array


def first_order(model: Model, tau: Array, p: Array, side: Array) -> FirstOrder:
    """Cost and gradient (D,) of the discretised system, in forward mode."""
    path = propagate(model, tau, p, side)
    jacobians = row_jacobians(model, path, p)
    resets = reset_jacobians(model, path, tau, p)
    X = tangents(model, path, jacobians, resets, p)
    P = parameter_directions(model)
    cost = jacobians.cost.sum()
    gradient = jnp.einsum("qcn,qcnd->d", jacobians.cost_x, X.before) + jacobians.cost_theta.sum((0, 1))
    for k, samples in enumerate(model.arguments.samples):
        value, g_x, g_p = sample_gradients(model, path, k, samples, p)
        cost = cost + value.sum()
        gradient = gradient + jnp.einsum("kn,knd->d", g_x, tangents_at(path, X, samples.cell)) + g_p.sum(0) @ P
    if model.structure.terminal:
        end = path.after[-1, -1]
        value, (phi_x, phi_p) = jax.value_and_grad(model.terminal, argnums=(0, 1))(end, p)
        cost = cost + value
        gradient = gradient + phi_x @ X.after[-1, -1] + phi_p @ P
    return FirstOrder(path, jacobians, resets, X, cost, gradient)


def sample_gradients(model: Model, path: Path, k: int, samples: Samples, p: Array) -> tuple[Array, Array, Array]:
    """Cost (K,) of each sample of the k-th Measurements and its derivatives in x (K, n) and p (K, M)."""

    def one(sample: Samples, x: Array) -> tuple[Array, Array, Array]:
        value, (g_x, g_p) = jax.value_and_grad(model.sample_cost, argnums=(2, 3))(k, sample, x, p)
        return value, g_x, g_p

    return jax.vmap(one)(samples, path.at_samples(samples.cell))


def tangents_at(path: Path, X: Tangents, cell: Array) -> Array:
    """x_theta at the ends of the given cells (K,): (K, n, D)."""
    return at_cells(path.layout, X.before[0, 0], X.after, cell)


def adjoint_hessian(model: Model, first: FirstOrder, tau: Array, p: Array) -> Array:
    """Hessian (D, D) of the discretised cost by the backward sweep."""
    path, X = first.path, first.tangents
    psi_start, psi_after, psi_resets = costates(model, first, p)
    H = row_curvature(model, path, X, psi_after, p)
    P = parameter_directions(model)
    for i in model.structure.resets:
        along = (jnp.arange(P.shape[1]) == i) * 1.0, X.before_transition(path.layout, i), P
        value = _weighted(model.reset(i), psi_resets[path.layout.first_chunk[i + 1]])
        H = H + _second(value, (tau[i], path.before_transition(i), p), along)
    for k, samples in enumerate(model.arguments.samples):
        H = H + sample_curvature(model, path, X, k, samples, p, gauss_newton=False)
    if model.structure.terminal:
        H = H + _second(model.terminal, (path.after[-1, -1], p), (X.after[-1, -1], P))
    if model.structure.initial_state is not None:
        H = H + _second(lambda p: psi_start @ model.initial_state(p), (p,), (P,))
    return H


def gauss_newton_hessian(model: Model, first: FirstOrder, p: Array) -> Array:
    """Hessian without the second derivatives of the trajectory and of the observations: (D, D).

    For Measurements and ReferenceSignal this is the Gauss-Newton matrix; a RunningCost or TerminalCost
    contributes its own second derivative in (x, p).
    """
    path, X = first.path, first.tangents
    P = parameter_directions(model)
    H = row_gauss_newton(model, path, X, p)
    for k, samples in enumerate(model.arguments.samples):
        H = H + sample_curvature(model, path, X, k, samples, p, gauss_newton=True)
    if model.structure.terminal:
        H = H + _second(model.terminal, (path.after[-1, -1], p), (X.after[-1, -1], P))
    return H


def costates(model: Model, first: FirstOrder, p: Array) -> tuple[Array, Array, Array]:
    """The costate psi, backward: at t0 (n,), at the end of each row (Q, C, n), and after each reset map (Q, n).

    It jumps at the samples, ``psi(t_k-) = psi(t_k+) + D ell_k``, and at reset maps, ``psi(tau-) = psi(tau+) D_x R``.
    """
    path, jacobians, resets = first.path, first.jacobians, first.resets
    Q, C, n = path.after.shape
    jumps = jnp.zeros((Q * C + 1, n))  # the first entry is that of samples at t0
    for k, samples in enumerate(model.arguments.samples):
        where = row_ending_cell(path.layout, samples.cell) + 1
        jumps = jumps.at[where].add(sample_gradients(model, path, k, samples, p)[1])

    def row(psi: Array, given: tuple[Array, Array, Array]) -> tuple[Array, Array]:
        F_x, L_x, jump = given
        psi = psi + jump
        return (psi[:, None] * F_x).sum(0) + L_x, psi

    def chunk(psi: Array, given: tuple[Array, Array, Array, Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        segment, opens, F_x, L_x, jump = given
        opened, after = lax.scan(row, psi, (F_x, L_x, jump), reverse=True)
        psi = opened if resets is None else jnp.where(opens, opened @ resets.x[segment], opened)
        return psi, (after, opened)

    final = jax.grad(model.terminal)(path.after[-1, -1], p) if model.structure.terminal else jnp.zeros(n)
    given = (path.layout.segment, path.layout.opens, jacobians.x, jacobians.cost_x, jumps[1:].reshape(Q, C, n))
    psi, (after, opened) = lax.scan(chunk, final, given, reverse=True)
    return psi + jumps[0], after, opened


def row_curvature(model: Model, path: Path, X: Tangents, psi_after: Array, p: Array) -> Array:
    """``sum_k Z_k' D^2 (psi . F_k + L_k) Z_k`` over all rows: (D, D).

    Along theta directly, or along the arguments (x, start, end, p) of a row where these are fewer.
    """
    n, M = model.structure.n, model.structure.M
    P = parameter_directions(model)
    local = n + 2 + M < P.shape[1]
    basis = jnp.eye(n + 2 + M)

    def of_mode(mode: int) -> Callable[..., Array]:
        def row(start: Array, end: Array, piece: Piece, x: Array, psi: Array, s_d: Array, e_d: Array, X: Array) -> Array:
            f, ell = model.field(mode, piece), model.density(piece)
            if not local:
                return curvature(model.tableau, f, ell, start, end, x, p, psi, Directions(s_d, e_d, X, P))
            along = Directions(basis[n], basis[n + 1], basis[:n], basis[n + 2 :])
            Z = jnp.concatenate([X, s_d[None], e_d[None], P])
            return Z.T @ curvature(model.tableau, f, ell, start, end, x, p, psi, along) @ Z

        return lambda *operands: jax.vmap(row)(*operands).sum(0)

    def chunk(H: Array, given: Any) -> tuple[Array, None]:
        segment, *operands = given
        return H + by_mode(model, segment, of_mode, *operands), None

    layout = path.layout
    given = (layout.segment, layout.start, layout.end, path.pieces, path.before, psi_after)
    given += (*time_directions(model, layout), X.before)
    return lax.scan(chunk, jnp.zeros((P.shape[1], P.shape[1])), given)[0]


def row_gauss_newton(model: Model, path: Path, X: Tangents, p: Array) -> Array:
    """Gauss-Newton part of the running costs: (D, D)."""
    P = parameter_directions(model)
    D = P.shape[1]
    structure = model.structure
    if not structure.running and not structure.references:
        return jnp.zeros((D, D))

    def at_stage(piece: Piece, t: Array, x: Array, t_d: Array, x_d: Array) -> Array:
        H = jnp.zeros((D, D))
        for residual, W in zip(model.reference_residuals(piece), model.arguments.weights, strict=True):
            linear = jax.linearize(residual, t, x, p)[1]
            r_d = jax.vmap(linear, in_axes=-1, out_axes=-1)(t_d, x_d, P)
            H = H + r_d.T @ W @ r_d
        for ell in structure.running:
            value = lambda x, p, ell=ell: jnp.asarray(ell(t, x, model.parameters(p))).reshape(())  # noqa: E731
            H = H + _second(value, (x, p), (x_d, P))
        return H

    def of_mode(mode: int) -> Callable[..., Array]:
        def row(start: Array, end: Array, piece: Piece, x: Array, s_d: Array, e_d: Array, X: Array) -> Array:
            along = Directions(s_d, e_d, X, P)
            times, states, states_d = stage_directions(
                model.tableau, model.field(mode, piece), start, end, x, p, along
            )
            times_d = s_d + model.tableau.c[:, None] * (e_d - s_d)
            parts = jax.vmap(lambda t, x, t_d, x_d: at_stage(piece, t, x, t_d, x_d))(times, states, times_d, states_d)
            return (end - start) * jnp.einsum("s,sde->de", jnp.asarray(model.tableau.b), parts)

        return lambda *operands: jax.vmap(row)(*operands).sum(0)

    def chunk(H: Array, given: Any) -> tuple[Array, None]:
        segment, *operands = given
        return H + by_mode(model, segment, of_mode, *operands), None

    layout = path.layout
    given = (layout.segment, layout.start, layout.end, path.pieces, path.before)
    given += (*time_directions(model, layout), X.before)
    return lax.scan(chunk, jnp.zeros((D, D)), given)[0]


def sample_curvature(
    model: Model, path: Path, X: Tangents, k: int, samples: Samples, p: Array, *, gauss_newton: bool
) -> Array:
    """Second derivative of the costs of the k-th Measurements: (D, D)."""
    P = parameter_directions(model)

    def one(given: tuple[Samples, Array, Array]) -> Array:
        sample, x, x_d = given
        if not gauss_newton:
            return _second(lambda x, p: model.sample_cost(k, sample, x, p), (x, p), (x_d, P))
        linear = jax.linearize(lambda x, p: model.sample_residual(k, sample, x, p), x, p)[1]
        r_d = jax.vmap(linear, in_axes=-1, out_axes=-1)(x_d, P)
        return r_d.T @ (sample.weight[:, None] * r_d)

    def block(H: Array, given: Any) -> tuple[Array, None]:
        return H + jax.vmap(one)(given).sum(0), None

    given = (samples, path.at_samples(samples.cell), tangents_at(path, X, samples.cell))
    K = samples.cell.shape[0]
    whole = K - K % SAMPLES_AT_ONCE
    H = jnp.zeros((P.shape[1], P.shape[1]))
    if whole:
        split = jax.tree.map(lambda a: a[:whole].reshape((-1, SAMPLES_AT_ONCE) + a.shape[1:]), given)
        H = lax.scan(block, H, split)[0]
    return block(H, jax.tree.map(lambda a: a[whole:], given))[0] if whole < K else H


def _weighted(function: Callable[..., Array], psi: Array) -> Callable[..., Array]:
    return lambda *z: psi @ function(*z)


def _second(value: Callable[..., Array], at: tuple[Array, ...], along: tuple[Array, ...]) -> Array:
    """Second derivative of a scalar function along D directions (last axes of `along`): (D, D)."""
    gradient = jax.grad(value, argnums=tuple(range(len(at))))

    def column(*direction: Array) -> tuple[Array, ...]:
        return jax.jvp(gradient, at, direction)[1]

    columns = jax.vmap(column, in_axes=-1, out_axes=-1)(*along)
    flat = [a.reshape(-1, a.shape[-1]) for a in along]
    return sum((a.T @ c.reshape(a.shape[0], -1) for a, c in zip(flat, columns, strict=True)), jnp.zeros(()))
