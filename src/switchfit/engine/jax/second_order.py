"""Exact Hessian of the *discretised* cost by a backward sweep, after the forward sweep of `first_order`.

With z = (x_k, theta) the arguments of node map k, Z_k their derivative in theta and psi_{k+1} the derivative of the
cost to go,

    D^2 J = sum_k Z_k' D^2 (psi_{k+1} . F_k + L_k) Z_k,

where steps, samples, reset maps, the initial state and terminal costs are all such maps. The sum is what the sweep
over (psi_k, Omega_k, Theta_k, H_k) of the general discrete form adds up to; written like this its terms are
independent of each other, so that they are evaluated for a chunk of rows at once. Only psi and x_theta are found one
row after another. Inside a step the same is done once more, for its stages: only f itself is ever differentiated
twice, never a composition.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from switchfit.discretization.arguments import Samples
from switchfit.discretization.mesh import row_ending_cell
from switchfit.discretization.model import Model, Piece, weighted
from switchfit.discretization.propagation import Path, by_mode, by_row
from switchfit.discretization.tableaus import stage_adjoints
from switchfit.engine.jax.first_order import (
    FirstOrder,
    Tangents,
    parameter_directions,
    sample_gradients,
    stage_time_directions,
    stages_along,
    time_directions,
)
from switchfit.engine.jax.late_samples import anchors, late_costates, late_curvature, late_gauss_newton

Array = jax.Array

SAMPLES_AT_ONCE = 1024
"""Samples whose second derivatives are evaluated together: bounds the memory of long logs."""


class Costates(NamedTuple):
    """Derivatives of the cost to go.

    Attributes
    ----------
    start : (n,), at t0
    opened : (Q, n), at the start of each chunk, after a reset map that acts there
    after : (Q, C, n), at the end of each row
    w, mu : (Q, C, s, n), in the slopes K_j and in the stage states X_j of each row
    """

    start: Array
    opened: Array
    after: Array
    w: Array
    mu: Array


def adjoint_hessian(model: Model, first: FirstOrder, tau: Array, p: Array, weights: Array | None = None) -> Array:
    """Hessian (D, D) of the discretised cost, with ``weights . c`` of the constraints (m,) added where given."""
    path, X = first.path, first.tangents
    guards, final = weighted_constraints(model, weights)
    psi = costates(model, first, p, tau, guards, final)
    H = stage_curvature(model, first, psi, p) + step_length_curvature(model, first, psi)
    P = parameter_directions(model)
    for i in model.structure.resets:
        along = (jnp.arange(P.shape[1]) == i) * 1.0, X.before_transition(path.layout, i), P
        value = _weighted(model.reset(i), psi.opened[path.layout.first_chunk[i + 1]])
        H = H + _second(value, (tau[i], path.before_transition(i), p), along)
    for i, guard in guards.items():
        along = (jnp.arange(P.shape[1]) == i) * 1.0, X.before_transition(path.layout, i), P
        H = H + _second(guard, (tau[i], path.before_transition(i), p), along)
    if final is not None:
        H = H + _second(final, (path.after[-1, -1], p), (X.after[-1, -1], P))
    for k, samples in enumerate(model.arguments.samples):
        H = H + sample_curvature(model, path, X, k, samples, p, gauss_newton=False)
    if model.structure.terminal:
        H = H + _second(model.terminal, (path.after[-1, -1], p), (X.after[-1, -1], P))
    if model.structure.initial_state is not None:
        H = H + _second(_weighted(model.initial_state, psi.start), (p,), (P,))
    return H


def gauss_newton_hessian(model: Model, first: FirstOrder, p: Array) -> Array:
    """Hessian without the second derivatives of the trajectory and of the observations: (D, D).

    For Measurements and ReferenceSignal this is the Gauss-Newton matrix, a robust loss weighing each residual by rho',
    which is never negative; a sigma that is a parameter contributes its Fisher information. A RunningCost or
    TerminalCost contributes its own second derivative in (x, p).
    """
    path, X = first.path, first.tangents
    P = parameter_directions(model)
    H = stage_gauss_newton(model, first, p)
    for k, samples in enumerate(model.arguments.samples):
        H = H + sample_curvature(model, path, X, k, samples, p, gauss_newton=True)
    if model.structure.terminal:
        H = H + _second(model.terminal, (path.after[-1, -1], p), (X.after[-1, -1], P))
    return H


Scalar = Callable[..., Array]


def weighted_constraints(model: Model, weights: Array | None) -> tuple[dict[int, Scalar], Scalar | None]:
    """Each guard g_i(t, x, p) by its transition and all terminal constraints (x, p), times their weights."""
    if weights is None:
        return {}, None
    guarded = model.structure.guarded
    guards = {i: (lambda t, x, p, i=i, w=weights[k]: w * model.guard(i)(t, x, p)) for k, i in enumerate(guarded)}
    if not model.structure.terminal_constraints:
        return guards, None
    rest = weights[len(guarded) :]
    return guards, lambda x, p: rest @ model.terminal_constraint(x, p)


def costates(
    model: Model,
    first: FirstOrder,
    p: Array,
    tau: Array,
    guards: dict[int, Scalar],
    final_constraint: Scalar | None,
) -> Costates:
    """The costate psi, backward.

    It jumps at the samples, ``psi(t_k-) = psi(t_k+) + D ell_k``, at reset maps, ``psi(tau-) = psi(tau+) D_x R``, and at
    guards that have a weight, by its product with D_x g.
    """
    path, jacobians, resets = first.path, first.jacobians, first.resets
    Q, C, n = path.after.shape
    jumps = jnp.zeros((Q * C + 1, n))  # the first entry is that of samples at t0
    late = jnp.zeros((Q * C, n))  # at the starts of rows
    any_late = any(sensor.delay is not None for sensor in model.structure.measurements)
    for k, samples in enumerate(model.arguments.samples):
        if model.structure.measurements[k].delay is not None:
            at = anchors(model, path, first.tangents.before, k, p)
            late = late.at[at.row].add(late_costates(model, at, k, samples, p))
            continue
        where = row_ending_cell(path.layout, samples.cell) + 1
        jumps = jumps.at[where].add(sample_gradients(model, path, k, samples, p)[1])

    def row(psi: Array, given: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        h, f_x, jump, *more = given
        psi = psi + jump
        l_x = more[0] if model.has_running_cost else jnp.zeros(f_x.shape[:2])
        w, mu, before = stage_adjoints(model.tableau, h, f_x, l_x, psi)
        return before + more[-1] if any_late else before, (psi, w, mu)

    def chunk(psi: Array, given: tuple[Array, Array, tuple[Array, ...]]) -> tuple[Array, tuple[Array, ...]]:
        segment, opens, operands = given
        opened, columns = lax.scan(row, psi, operands, reverse=True)
        psi = opened if resets is None else jnp.where(opens, opened @ resets.x[segment], opened)
        if guards:
            psi = psi + jnp.where(opens, at_guards[segment], 0.0)
        return psi, (opened, *columns)

    layout = path.layout
    at_guards = jnp.zeros((model.structure.N + 1, n))
    for i, guard in guards.items():
        at_guards = at_guards.at[i + 1].set(jax.grad(guard, argnums=1)(tau[i], path.before_transition(i), p))
    final = jax.grad(model.terminal)(path.after[-1, -1], p) if model.structure.terminal else jnp.zeros(n)
    if final_constraint is not None:
        final = final + jax.grad(final_constraint)(path.after[-1, -1], p)
    of_ell = (jacobians.l_x,) if model.has_running_cost else ()
    of_late = (late.reshape(Q, C, n),) if any_late else ()
    operands = (layout.end - layout.start, jacobians.f_x, jumps[1:].reshape(Q, C, n), *of_ell, *of_late)
    psi, columns = lax.scan(chunk, final, (layout.segment, layout.opens, operands), reverse=True)
    return Costates(psi + jumps[0], *columns)


def stage_curvature(model: Model, first: FirstOrder, psi: Costates, p: Array) -> Array:
    """``sum Z_j' D^2 (w_j . f + h b_j ell) Z_j`` over the stages of all rows, Z_j that of (t_j, X_j, p): (D, D).

    Along theta directly, or along (t, x, p) where these are fewer.
    """
    n, M = model.structure.n, model.structure.M
    path, X = first.path, first.tangents
    P = parameter_directions(model)
    local = 1 + n + M < P.shape[1]
    basis = jnp.eye(1 + n + M)

    def of_mode(mode: int) -> Callable[..., Array]:
        def at_stage(piece: Piece, t: Array, x: Array, w: Array, hb: Array, t_d: Array, x_d: Array) -> Array:
            f, ell = model.field(mode, piece), model.density(piece)

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
            *at_stages: Array,
        ) -> Array:
            h = end - start
            X_d = stages_along(model, X.ends, h, s_d, e_d, *at_stages)
            times, times_d = start + model.tableau.c * h, stage_time_directions(model, s_d, e_d)
            over_stages = jax.vmap(at_stage, in_axes=(None, 0, 0, 0, 0, 0, 0))
            return over_stages(piece, times, states, w, h * jnp.asarray(model.tableau.b), times_d, X_d).sum(0)

        return lambda *operands: jax.vmap(row)(*operands).sum(0)

    layout = path.layout
    along = (*time_directions(model, layout), *X.at_stages)
    operands = (layout.start, layout.end, path.pieces, path.stages, psi.w, *along)
    return _sum_over_chunks(model, of_mode, layout.segment, operands)


def step_length_curvature(model: Model, first: FirstOrder, psi: Costates) -> Array:
    """Second derivative of the products of step lengths with slopes: ``h' x (...)' `` and its transpose, (D, D).

    ``h sum a_jl K_l`` contributes ``h' x mu_j sum a_jl K_l'``, ``h sum b_j K_j`` and ``h sum b_j ell_j`` likewise.
    Only the first and the last row of a segment have a length that depends on theta.
    """
    N = model.structure.N
    P = parameter_directions(model)
    if N == 0:
        return jnp.zeros((P.shape[1], P.shape[1]))
    a, b = jnp.asarray(model.tableau.a), jnp.asarray(model.tableau.b)
    layout, X = first.path.layout, first.tangents
    starts, ends = time_directions(model, layout)

    def of_row(row: Array) -> Array:
        """Derivative along theta of what the step length of a row multiplies: (D,)."""

        def at(values: Array) -> Array:
            return by_row(values)[row]

        J, start_d, end_d = jax.tree.map(at, first.jacobians), at(starts), at(ends)
        X_d = stages_along(model, X.ends, at(layout.end - layout.start), start_d, end_d, *map(at, X.at_stages))
        times_d = stage_time_directions(model, start_d, end_d)
        K_d = J.f_x @ X_d + J.f_t[:, :, None] * times_d[:, None] + J.f_p @ P
        total = jnp.einsum("n,s,snd->d", at(psi.after), b, K_d) + jnp.einsum("jn,js,snd->d", at(psi.mu), a, K_d)
        if model.has_running_cost:
            total = total + b @ (J.l_t[:, None] * times_d + jnp.einsum("sn,snd->sd", J.l_x, X_d) + J.l_p @ P)
        return total

    opening, closing = layout.first_chunk[1:] * layout.start.shape[1], layout.last_row[:-1]
    by_opening, by_closing = jax.vmap(jax.vmap(of_row))(jnp.stack([opening, closing]))
    half = jnp.zeros((P.shape[1], P.shape[1])).at[:N].set(by_closing - by_opening)
    return half + half.T


def stage_gauss_newton(model: Model, first: FirstOrder, p: Array) -> Array:
    """Gauss-Newton part of the running costs: (D, D)."""
    path, X = first.path, first.tangents
    P = parameter_directions(model)
    if not model.has_running_cost:
        return jnp.zeros((P.shape[1], P.shape[1]))

    def at_stage(piece: Piece, t: Array, x: Array, t_d: Array, x_d: Array) -> Array:
        H = jnp.zeros((P.shape[1], P.shape[1]))
        for residual, W in zip(model.reference_residuals(piece), model.arguments.weights, strict=True):
            r_d = _columns(residual, (t, x, p), (t_d, x_d, P))
            H = H + r_d.T @ weighted(W, r_d)
        for ell in model.structure.running:

            def value(x: Array, p: Array, ell: Callable[..., Any] = ell) -> Array:
                return jnp.asarray(ell(t, x, model.parameters(p))).reshape(())

            H = H + _second(value, (x, p), (x_d, P))
        return H

    def row(
        start: Array,
        end: Array,
        piece: Piece,
        states: Array,
        s_d: Array,
        e_d: Array,
        *at_stages: Array,
    ) -> Array:
        X_d = stages_along(model, X.ends, end - start, s_d, e_d, *at_stages)
        times, times_d = start + model.tableau.c * (end - start), stage_time_directions(model, s_d, e_d)
        parts = jax.vmap(at_stage, in_axes=(None, 0, 0, 0, 0))(piece, times, states, times_d, X_d)
        return (end - start) * jnp.tensordot(jnp.asarray(model.tableau.b), parts, axes=1)

    layout = path.layout
    along = (*time_directions(model, layout), *X.at_stages)
    operands = (layout.start, layout.end, path.pieces, path.stages, *along)
    return _sum_over_chunks(model, lambda _: lambda *rows: jax.vmap(row)(*rows).sum(0), layout.segment, operands)


def _sum_over_chunks(
    model: Model, of_mode: Callable[[int], Callable[..., Array]], segment: Array, operands: tuple[Any, ...]
) -> Array:
    """Sum of (D, D) matrices over all chunks, each evaluated with the functions of its mode."""
    D = model.structure.N + model.structure.M

    def chunk(H: Array, given: Any) -> tuple[Array, None]:
        segment, rows = given
        return H + by_mode(model, segment, of_mode, *rows), None

    return lax.scan(chunk, jnp.zeros((D, D)), (segment, operands))[0]


def sample_curvature(
    model: Model, path: Path, X: Tangents, k: int, samples: Samples, p: Array, *, gauss_newton: bool
) -> Array:
    """Second derivative of the costs of the k-th Measurements: (D, D)."""
    P = parameter_directions(model)
    if model.structure.measurements[k].delay is not None:
        of_late = late_gauss_newton if gauss_newton else late_curvature
        return of_late(model, anchors(model, path, X.before, k, p), k, samples, p, P)

    def one(given: tuple[Samples, Array, Array]) -> Array:
        sample, x, x_d = given
        if not gauss_newton:
            return _second(lambda x, p: model.sample_cost(k, sample, x, p), (x, p), (x_d, P))
        r_d = _columns(lambda x, p: model.sample_residual(k, sample, x, p), (x, p), (x_d, P))
        H = r_d.T @ (model.sample_information(k, sample, x, p)[:, None] * r_d)
        if model.structure.measurements[k].sigma:
            # Fisher's information of normal noise: 2 of log sigma, none between sigma and the rest.
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


def _weighted(function: Callable[..., Array], psi: Array) -> Callable[..., Array]:
    return lambda *z: psi @ function(*z)


def _second(
    value: Callable[..., Array], at: tuple[Array, ...], along: tuple[Array, ...], P_last: bool = False
) -> Array:
    """Second derivative of a scalar function along D directions (last axes of `along`): (D, D).

    With `P_last` the last of `along` is that of p, [0 | I], whose product need not be computed.
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
    """Derivatives (..., D) of a function along D directions (last axes of `along`)."""
    linear = jax.linearize(function, *at)[1]
    return jax.vmap(linear, in_axes=-1, out_axes=-1)(*along)
