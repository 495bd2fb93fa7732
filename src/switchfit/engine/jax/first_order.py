"""First derivatives of the discretised system along theta, shared by its forward and its adjoint second order.

theta here is (tau_1 .. tau_N, p_1 .. p_M), D = N + M entries; fixed transition times are among them. f and ell are
differentiated at all stages of a chunk of rows at once; what remains to be done one row after another is linear.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from switchfit.discretization.arguments import Samples
from switchfit.discretization.mesh import Rows
from switchfit.discretization.model import Model, Piece
from switchfit.discretization.propagation import Path, at_cells, by_mode, by_row, propagate
from switchfit.discretization.tableaus import combine, end_tangents, stage_adjoints, stage_tangents
from switchfit.engine.jax.late_samples import anchors, late_gradient

Array = jax.Array


KEPT = 2**25
"""Bytes up to which the derivatives at the stages are kept: finding them again takes a fifth of a Hessian's time."""


class StageJacobians(NamedTuple):
    """Derivatives of f and ell at every stage of every row.

    Attributes
    ----------
    f_t, f_x, f_p : (Q, C, s, n), (Q, C, s, n, n), (Q, C, s, n, M)
    l, l_t, l_x, l_p : (Q, C, s), (Q, C, s), (Q, C, s, n), (Q, C, s, M); no arrays where there is no running cost
    """

    f_t: Array
    f_x: Array
    f_p: Array
    l: Any = None  # noqa: E741  # the paper's ell
    l_t: Any = None
    l_x: Any = None
    l_p: Any = None


class ResetJacobians(NamedTuple):
    """Derivatives of the map at the opening of each segment, identity where there is none: (N + 1, ...) arrays."""

    x: Array  # (N + 1, n, n)
    theta: Array  # (N + 1, n, D)


class Tangents(NamedTuple):
    """Derivative of the state in theta.

    Attributes
    ----------
    before, after : (Q, C, n, D), at the start and the end of each row
    ends : RowEnds
    at_stages : tuple of arrays
        From which `stages_along` has the derivatives at the stages: these themselves, (Q, C, s, n, D), where they take
        up to `KEPT` bytes; otherwise what they follow from, since they need as much memory as all the rest.
    """

    before: Array
    after: Array
    ends: RowEnds
    at_stages: tuple[Array, ...]

    def before_transition(self, layout: Rows, i: int) -> Array:
        """At tau_i-: (n, D)."""
        return self.after[layout.first_chunk[i + 1] - 1, -1]

    def at_samples(self, layout: Rows, cell: Array) -> Array:
        """At the ends of the given cells (K,): (K, n, D)."""
        return at_cells(layout, self.before[0, 0], self.after, cell)


class FirstOrder(NamedTuple):
    """The forward sweep: path, Jacobians, x_theta, cost and gradient."""

    path: Path
    jacobians: StageJacobians
    resets: ResetJacobians | None
    tangents: Tangents
    cost: Array
    gradient: Array


def first_order(model: Model, tau: Array, p: Array, side: Array) -> FirstOrder:
    """Cost and gradient (D,) of the discretised system, in forward mode."""
    path = propagate(model, tau, p, side)
    jacobians = stage_jacobians(model, path, p)
    resets = reset_jacobians(model, path, tau, p)
    X = tangents(model, path, jacobians, resets, p)
    P = parameter_directions(model)
    cost, gradient = running_cost_gradient(model, path, jacobians, X)
    for k, samples in enumerate(model.arguments.samples):
        if model.structure.measurements[k].delay is not None:
            at = anchors(model, path, X.before, k, p)
            value, g = late_gradient(model, at, k, samples, p, P)
            cost, gradient = cost + value, gradient + g
            continue
        value, g_x, g_p = sample_gradients(model, path, k, samples, p)
        cost = cost + value.sum()
        gradient = gradient + jnp.einsum("kn,knd->d", g_x, X.at_samples(path.layout, samples.cell)) + g_p.sum(0) @ P
    if model.structure.terminal:
        value, (phi_x, phi_p) = jax.value_and_grad(model.terminal, argnums=(0, 1))(path.after[-1, -1], p)
        cost = cost + value
        gradient = gradient + phi_x @ X.after[-1, -1] + phi_p @ P
    return FirstOrder(path, jacobians, resets, X, cost, gradient)


def parameter_directions(model: Model) -> Array:
    """Derivative of p in theta, ``[0 | I]``: (M, D)."""
    N, M = model.structure.N, model.structure.M
    return jnp.concatenate([jnp.zeros((M, N)), jnp.eye(M)], axis=1)


def time_directions(model: Model, layout: Rows) -> tuple[Array, Array]:
    """Derivatives of the start and the end of each row in theta: two (Q, C, D) arrays of zeros and ones."""
    index = jnp.arange(model.structure.N + model.structure.M)
    return (layout.starts_at[..., None] == index) * 1.0, (layout.ends_at[..., None] == index) * 1.0


def stage_time_directions(model: Model, start_d: Array, end_d: Array) -> Array:
    """Derivatives of the times of the stages of one row, ``start' + c_j h'``: (s, D)."""
    return start_d + model.tableau.c[:, None] * (end_d - start_d)


def stage_jacobians(model: Model, path: Path, p: Array) -> StageJacobians:
    """D_2 f, D_1 f, D_p f at all stages, by forward differentiation, and the gradient of ell."""

    def of_mode(mode: int) -> Callable[..., StageJacobians]:
        def at_stage(piece: Piece, t: Array, x: Array) -> StageJacobians:
            f = model.field(mode, piece)

            f_t, f_x, f_p = jax.jacfwd(f, argnums=(0, 1, 2))(t, x, p)
            if not model.has_running_cost:
                return StageJacobians(f_t, f_x, f_p)
            # A scalar: backward is cheaper.
            l, gradient = jax.value_and_grad(model.density(piece), argnums=(0, 1, 2))(t, x, p)  # noqa: E741
            return StageJacobians(f_t, f_x, f_p, l, *gradient)

        def row(start: Array, end: Array, piece: Piece, X: Array) -> StageJacobians:
            times = start + model.tableau.c * (end - start)
            return jax.vmap(at_stage, in_axes=(None, 0, 0))(piece, times, X)

        return jax.vmap(row)

    def chunk(given: tuple[Array, Array, Array, Piece, Array]) -> StageJacobians:
        segment, *operands = given
        return by_mode(model, segment, of_mode, *operands)

    layout = path.layout
    return lax.map(chunk, (layout.segment, layout.start, layout.end, path.pieces, path.stages))


def reset_jacobians(model: Model, path: Path, tau: Array, p: Array) -> ResetJacobians | None:
    """Jacobians of the reset maps; None where no transition has one."""
    structure = model.structure
    if not structure.resets:
        return None
    n, N, M = structure.n, structure.N, structure.M
    x = jnp.broadcast_to(jnp.eye(n), (N + 1, n, n))
    theta = jnp.zeros((N + 1, n, N + M))
    for i in structure.resets:
        R_t, R_x, R_p = jax.jacfwd(model.reset(i), argnums=(0, 1, 2))(tau[i], path.before_transition(i), p)
        x = x.at[i + 1].set(R_x)
        theta = theta.at[i + 1, :, i].set(R_t).at[i + 1, :, N:].set(R_p)
    return ResetJacobians(x, theta)


def tangents(model: Model, path: Path, jacobians: StageJacobians, resets: ResetJacobians | None, p: Array) -> Tangents:
    """``x_theta`` along the path: forward, linear, one row after another.

    Only the first and the last row of a segment depend on a transition time directly: what that adds to the state after
    the row is found before.
    """
    layout, tableau = path.layout, model.tableau
    b = tableau.b
    N, M = model.structure.N, model.structure.M
    ends = row_end_tangents(model, path, jacobians)
    index = jnp.arange(N)
    keep = 8 * path.stages.size * (N + M) <= KEPT

    def row(X: Array, given: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        h, f_x, f_p, extra = given
        S = jnp.pad(f_p, ((0, 0), (0, 0), (N, 0)))
        stages_d, slopes_d = stage_tangents(tableau, h, f_x, S, X)
        after = X + h * combine(b, list(slopes_d)) + extra
        return after, (X, after, stages_d) if keep else (X, after)

    def chunk(X: Array, given: Any) -> tuple[Array, tuple[Array, ...]]:
        segment, opens, starts_at, ends_at, operands = given
        if resets is not None:
            X = jnp.where(opens, resets.x[segment] @ X + resets.theta[segment], X)
        direct = (starts_at[:, None] == index)[..., None] * ends.after[0]  # (C, N, n)
        direct = direct + (ends_at[:, None] == index)[..., None] * ends.after[1]
        extra = jnp.pad(jnp.moveaxis(direct, 1, 2), ((0, 0), (0, 0), (0, M)))
        return lax.scan(row, X, (*operands, extra))

    first = jax.jacfwd(model.initial_state)(p) @ parameter_directions(model)
    operands = (layout.end - layout.start, jacobians.f_x, jacobians.f_p)
    given = (layout.segment, layout.opens, layout.starts_at, layout.ends_at, operands)
    _, (before, after, *kept) = lax.scan(chunk, first, given)
    if not keep:
        return Tangents(before, after, ends, (jacobians.f_x, jacobians.f_p, before))
    stages = by_row(kept[0]).at[ends.rows, :, :, index].add(ends.stages)
    return Tangents(before, after, ends, (stages.reshape(kept[0].shape),))


def stages_along(model: Model, ends: RowEnds, h: Array, start_d: Array, end_d: Array, *given: Array) -> Array:
    """Derivative (s, n, D) of the stage states of one row, given its `Tangents.at_stages`."""
    if len(given) == 1:
        return given[0]
    f_x, f_p, x_d = given
    N, M = model.structure.N, model.structure.M
    S = jnp.pad(f_p, ((0, 0), (0, 0), (N, 0)))
    X_d, _ = stage_tangents(model.tableau, h, f_x, S, x_d)
    if N == 0:
        return X_d
    direct = start_d[:N, None, None] * ends.stages[0] + end_d[:N, None, None] * ends.stages[1]
    return X_d + jnp.pad(jnp.moveaxis(direct, 0, -1), ((0, 0), (0, 0), (0, M)))


class RowEnds(NamedTuple):
    """The 2 x N rows that open or close a segment at a transition, and their derivatives in that time.

    Attributes
    ----------
    rows : (2, N) int, flat index of the rows that start (first line) and that end (second line) at tau_i
    stages : (2, N, s, n), derivative of the stage states at fixed state before the row
    after : (2, N, n), derivative of the state after the row
    """

    rows: Array
    stages: Array
    after: Array


def row_end_tangents(model: Model, path: Path, jacobians: StageJacobians) -> RowEnds:
    """Direct derivatives of the rows beside a transition in its time."""
    layout, tableau = path.layout, model.tableau
    rows = jnp.stack([layout.first_chunk[1:] * layout.start.shape[1], layout.last_row[:-1]])
    h, f_x, f_t, K = (by_row(a)[rows] for a in (layout.end - layout.start, jacobians.f_x, jacobians.f_t, path.slopes))
    t_d, h_d = jnp.stack([1 - tableau.c, jnp.asarray(tableau.c)]), jnp.array([-1.0, 1.0])  # in the start, in the end
    of_line = jax.vmap(partial(end_tangents, tableau), in_axes=(0, 0, 0, 0, None, None))
    stages, after = jax.vmap(of_line)(h, f_x, f_t, K, t_d, h_d)
    return RowEnds(rows, stages, after)


def running_cost_gradient(model: Model, path: Path, jacobians: StageJacobians, X: Tangents) -> tuple[Array, Array]:
    """Integral of the running costs and its derivative in theta (D,)."""
    P = parameter_directions(model)
    if not model.has_running_cost:
        return jnp.zeros(()), jnp.zeros(P.shape[1])
    layout, N = path.layout, model.structure.N
    b, c = jnp.asarray(model.tableau.b), jnp.asarray(model.tableau.c)
    h = layout.end - layout.start

    def row(h: Array, J: StageJacobians, x_d: Array) -> Array:
        """Through the state before the row, by the adjoint of its cost alone, and through the parameters."""
        w, _, l_before = stage_adjoints(model.tableau, h, J.f_x, J.l_x, jnp.zeros(x_d.shape[0]))
        by_p = jnp.einsum("sn,snm->m", w, J.f_p) + h * b @ J.l_p
        return l_before @ x_d + by_p @ P

    def beside(k: Array, stages_d: Array, t_d: Array, h_d: Array) -> Array:
        """Through the time at which a row starts or ends: directly, and through its stages."""
        J = jax.tree.map(lambda a: by_row(a)[k], jacobians)
        rate = jnp.einsum("sn,sn->s", J.l_x, stages_d) + J.l_t * t_d
        return by_row(h)[k] * (b @ rate) + h_d * (b @ J.l)

    def chunk(gradient: Array, rows: tuple[Array, StageJacobians, Array]) -> tuple[Array, None]:
        return gradient + jax.vmap(row)(*rows).sum(0), None

    gradient, _ = lax.scan(chunk, jnp.zeros(P.shape[1]), (h, jacobians, X.before))
    if N:
        over = jax.vmap(jax.vmap(beside, in_axes=(0, 0, None, None)), in_axes=(0, 0, 0, 0))
        direct = over(X.ends.rows, X.ends.stages, jnp.stack([1 - c, c]), jnp.array([-1.0, 1.0]))
        gradient = gradient.at[:N].add(direct.sum(0))
    return jnp.sum(h[..., None] * b * jacobians.l), gradient


def sample_gradients(model: Model, path: Path, k: int, samples: Samples, p: Array) -> tuple[Array, Array, Array]:
    """Cost (K,) of each sample of the k-th Measurements and its derivatives in x (K, n) and p (K, M)."""

    def one(sample: Samples, x: Array) -> tuple[Array, Array, Array]:
        value, (g_x, g_p) = jax.value_and_grad(model.sample_cost, argnums=(2, 3))(k, sample, x, p)
        return value, g_x, g_p

    return jax.vmap(one)(samples, path.at_samples(samples.cell))
