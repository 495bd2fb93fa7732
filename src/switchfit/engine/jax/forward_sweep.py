"""The forward sweep: states, derivatives of f and ell at the stages, and the derivative of the state along theta.

theta here is (tau_1 .. tau_N, p_1 .. p_M), D = N + M entries; fixed transition times are among them. f and ell are
differentiated at all stages of a chunk of rows at once; only a linear recursion remains to be done row by row.
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
from switchfit.discretization.mesh import Rows
from switchfit.discretization.model import Model, Piece
from switchfit.discretization.propagation import Path, pick_at_cells, propagate, switch_method, switch_mode
from switchfit.discretization.rows import times_derivative
from switchfit.discretization.steps import row_functions
from switchfit.discretization.tableaus import Tableau

Array = jax.Array


KEPT = 2**25
"""Largest size, in bytes, of stored tangents at the stages; recomputing them takes a fifth of a Hessian's time."""


class StageJacobians(NamedTuple):
    """Derivatives of f and ell at every stage of every row.

    Attributes
    ----------
    f_t, f_x, f_p : (Q, C, s, n), (Q, C, s, n, n), (Q, C, s, n, M)
    l, l_t, l_x, l_p : (Q, C, s), (Q, C, s), (Q, C, s, n), (Q, C, s, M); None if there is no running cost
    """

    f_t: Array
    f_x: Array
    f_p: Array
    l: Any = None  # noqa: E741  # the paper's ell
    l_t: Any = None
    l_x: Any = None
    l_p: Any = None


class ResetJacobians(NamedTuple):
    """Derivatives of the reset map at the start of each segment, by default the identity: (N + 1, ...) arrays."""

    t: Array  # (N + 1, n)
    x: Array  # (N + 1, n, n)
    p: Array  # (N + 1, n, M)


class Tangents(NamedTuple):
    """Derivative of the state in theta.

    Attributes
    ----------
    before, after : (Q, C, n, D), at the start and the end of each row
    stages : (Q, C, s, n, D), at the stages; None where they take more than `KEPT` bytes
    """

    before: Array
    after: Array
    stages: Array | None

    def before_transition(self, layout: Rows, i: int) -> Array:
        """Return the tangent at tau_i-: (n, D)."""
        return self.after[layout.first_chunk[i + 1] - 1, -1]

    def at_samples(self, layout: Rows, cell: Array) -> Array:
        """Return the tangents at the ends of the given cells (K,): (K, n, D)."""
        return pick_at_cells(layout, self.before[0, 0], self.after, cell)


class Forward(NamedTuple):
    """Result of the forward sweep. XLA does not compute fields that a program does not read."""

    path: Path
    jacobians: StageJacobians
    resets: ResetJacobians | None
    tangents: Tangents


def forward_sweep(model: Model, tau: Array, p: Array, side: Array) -> Forward:
    """Integrate the state, and differentiate it along theta."""
    path = propagate(model, tau, p, side)
    jacobians = stage_jacobians(model, path, p)
    resets = reset_jacobians(model, path, p)
    return Forward(path, jacobians, resets, tangents(model, path, jacobians, resets, p))


def parameter_directions(model: Model) -> Array:
    """Return the derivative of p in theta, ``[0 | I]``: (M, D)."""
    N, M = model.structure.N, model.structure.M
    return jnp.concatenate([jnp.zeros((M, N)), jnp.eye(M)], axis=1)


def unit(D: int, i: int) -> Array:
    """Return the derivative of tau_i in theta, i from 0: (D,)."""
    return (jnp.arange(D) == i).astype(float)


def time_directions(model: Model, layout: Rows) -> tuple[Array, Array]:
    """Return the derivatives of the start and the end of each row in theta: two (Q, C, D) arrays of zeros and ones."""
    index = jnp.arange(model.structure.N + model.structure.M)[None, None]
    starts_at, ends_at = layout.starts_at[..., None], layout.ends_at[..., None]
    return (starts_at == index).astype(float), (ends_at == index).astype(float)


def stage_jacobians(model: Model, path: Path, p: Array) -> StageJacobians:
    """Return D_2 f, D_1 f, D_p f at all stages, by forward differentiation, and the gradient of ell."""

    def of_mode(mode: int) -> Callable[..., StageJacobians]:
        def at_stage(piece: Piece, t: Array, x: Array) -> StageJacobians:
            f = model.field(mode, piece)

            f_t, f_x, f_p = jax.jacfwd(f, argnums=(0, 1, 2))(t, x, p)
            if not model.has_running_cost:
                return StageJacobians(f_t, f_x, f_p)
            # ell is a scalar: reverse mode is cheaper.
            l, gradient = jax.value_and_grad(model.density(mode, piece), argnums=(0, 1, 2))(t, x, p)  # noqa: E741
            return StageJacobians(f_t, f_x, f_p, l, *gradient)

        def row(start: Array, end: Array, piece: Piece, X: Array) -> StageJacobians:
            times = start + model.tableaus[mode].c * (end - start)
            return jax.vmap(at_stage, in_axes=(None, 0, 0))(piece, times, X)

        return jax.vmap(row)

    def chunk(given: tuple[Array, Array, Array, Piece, Array]) -> StageJacobians:
        segment, *operands = given
        return switch_mode(model, segment, of_mode, *operands)

    layout = path.layout
    return lax.map(chunk, (layout.segment, layout.start, layout.end, path.pieces, path.stages))


def reset_jacobians(model: Model, path: Path, p: Array) -> ResetJacobians | None:
    """Return the Jacobians of the reset maps; None if no transition has one."""
    structure = model.structure
    if not structure.resets:
        return None
    n, N, M = structure.n, structure.N, structure.M
    t, x, of_p = jnp.zeros((N + 1, n)), jnp.broadcast_to(jnp.eye(n), (N + 1, n, n)), jnp.zeros((N + 1, n, M))
    for i in structure.resets:
        R_t, R_x, R_p = jax.jacfwd(model.reset(i), argnums=(0, 1, 2))(*path.at_transition(i), p)
        t, x, of_p = t.at[i + 1].set(R_t), x.at[i + 1].set(R_x), of_p.at[i + 1].set(R_p)
    return ResetJacobians(t, x, of_p)


def tangents(model: Model, path: Path, jacobians: StageJacobians, resets: ResetJacobians | None, p: Array) -> Tangents:
    """Return ``x_theta`` along the path: a linear recursion over the rows.

    Every row is treated as if both its ends moved with theta, although only rows next to a transition do. Measured,
    this costs no more than treating those rows separately.
    """
    layout, P = path.layout, parameter_directions(model)
    keep = 8 * path.stages.size * P.shape[1] <= KEPT

    def through(tableau: Tableau) -> Callable[..., tuple[Array, tuple[Array, ...]]]:
        def row(X: Array, given: tuple[Any, ...]) -> tuple[Array, tuple[Array, ...]]:
            stages_d, _, after = row_tangents(tableau, X, *given)
            return after, (X, after, stages_d) if keep else (X, after)

        def rows(X: Array, h: Array, slopes: Array, at: StageJacobians, *ends_d: Array) -> Any:
            # For all rows of a chunk at once, outside the loop over them: saves a tenth of an evaluation.
            direct = jax.vmap(partial(direct_derivatives, model, tableau))(at, *ends_d)
            return lax.scan(row, X, (h, slopes, at.f_x, *direct))

        return rows

    def chunk(X: Array, given: Any) -> tuple[Array, tuple[Array, ...]]:
        segment, opens, h, slopes, at, start_d, end_d = given
        if resets is not None:
            behind = resets.x[segment] @ X + resets.p[segment] @ P + resets.t[segment][:, None] * start_d[0][None]
            X = jnp.where(opens, behind, X)
        return switch_method(model, segment, through, X, h, slopes, at, start_d, end_d)

    first = jax.jacfwd(model.initial_state)(p) @ P
    h = layout.end - layout.start
    given = (layout.segment, layout.opens, h, path.slopes, jacobians, *time_directions(model, layout))
    _, (before, after, *kept) = lax.scan(chunk, first, given)
    return Tangents(before, after, kept[0] if keep else None)


def direct_derivatives(
    model: Model, tableau: Tableau, at: StageJacobians, start_d: Array, end_d: Array
) -> tuple[Array, Array | None]:
    """Return the forcing of the tangents of one row (s, n, D), and the derivative of its length (D,)."""
    N = model.structure.N
    forcing = jnp.pad(at.f_p, ((0, 0), (0, 0), (N, 0)))
    if N == 0:
        return forcing, None
    times_d = jnp.stack(times_derivative(tableau, start_d, end_d))
    return forcing + at.f_t[:, :, None] * times_d[:, None], end_d - start_d


def row_tangents(
    tableau: Tableau, x_d: Array, h: Array, slopes: Array, f_x: Array, forcing: Array, h_d: Array | None
) -> tuple[Array, Array, Array]:
    """Differentiate one row along all of theta.

    Parameters
    ----------
    x_d : (n, D), derivative of the state before the row
    h, slopes, f_x : (), (s, n), (s, n, n)
    forcing, h_d : (s, n, D), (D,), what `direct_derivatives` returned

    Returns
    -------
    X_d, K_d, after : (s, n, D), (s, n, D), (n, D); of states and slopes of the stages, and of the state after the row
    """
    function = partial(row_functions(tableau).tangent, tableau, h, list(slopes), list(f_x))
    along = jax.vmap(function, in_axes=(-1, -1, None if h_d is None else -1), out_axes=-1)
    found = along(list(forcing), x_d, h_d)
    return jnp.stack(found.states), jnp.stack(found.slopes), found.after


def stages_along(model: Model, first: Forward) -> tuple[tuple[Any, ...], Callable[..., Array]]:
    """Return arrays (Q, C, ...), and a function of a method and their slices at a row: its tangents of the stages.

    If the tangents are stored (`KEPT`), the arrays are the tangents, (s, n, D) for each row.
    """
    kept = first.tangents.stages
    if kept is not None:
        return (kept,), lambda tableau, stages_d: stages_d
    return row_operands(model, first), lambda tableau, *row: recompute_tangents(model, tableau, *row)[0]


def row_operands(model: Model, first: Forward) -> tuple[Any, ...]:
    """Return the arguments of `recompute_tangents` for all rows: (Q, C, ...)."""
    layout = first.path.layout
    lengths = layout.end - layout.start
    return (first.tangents.before, lengths, first.path.slopes, first.jacobians, *time_directions(model, layout))


def recompute_tangents(
    model: Model, tableau: Tableau, x_d: Array, h: Array, slopes: Array, at: StageJacobians, *ends_d: Array
) -> tuple[Array, Array, Array]:
    """Recompute the result of `row_tangents` for one row; `ends_d` are the derivatives of its start and its end."""
    return row_tangents(tableau, x_d, h, slopes, at.f_x, *direct_derivatives(model, tableau, at, *ends_d))


def sum_running_cost(model: Model, first: Forward) -> Array:
    """Return the integral of the running costs over all rows: ()."""
    layout, densities = first.path.layout, first.jacobians.l
    if densities is None:
        return jnp.zeros(())
    return (weigh_stages(model, layout) * densities).sum()


def weigh_stages(model: Model, layout: Rows) -> Array:
    """Return the weight ``h b_j`` of each stage in an integral over its row: (Q, C, s)."""
    of_modes = jnp.asarray(np.stack([tableau.b for tableau in model.tableaus]))
    b = of_modes[model.mode_of_segment][layout.segment]
    return (layout.end - layout.start)[..., None] * b[:, None]


def sample_gradients(model: Model, path: Path, k: int, samples: Samples, p: Array) -> tuple[Array, tuple[Array, Array]]:
    """Return the cost (K,) of each sample of the k-th Measurements, and its derivatives in x (K, n) and p (K, M)."""
    gradient = jax.value_and_grad(partial(model.sample_cost, k), argnums=(1, 2))
    return jax.vmap(gradient, in_axes=(0, 0, None))(samples, path.at_samples(samples.cell), p)
