"""First derivatives of the discretised system along theta, shared by its forward and its adjoint second order.

theta here is (tau_1 .. tau_N, p_1 .. p_M), D = N + M entries; fixed transition times are among them.
Each row of the mesh is a map of z = (x, start, end, p). Its Jacobian is evaluated for a whole chunk of rows at once;
what remains to be done one row after another is a product of small matrices.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from switchfit.mesh import Rows
from switchfit.model import Model, Piece
from switchfit.propagate import Path, by_mode
from switchfit.rungekutta import Directions, step

Array = jax.Array


class RowJacobians(NamedTuple):
    """Derivatives of every row's map: (Q, C, ...) arrays.

    Attributes
    ----------
    x : (Q, C, n, n), derivative of the state after the row in the state before it
    theta : (Q, C, n, D), explicit derivative in theta (through start, end and p)
    cost : (Q, C), running cost of the row
    cost_x : (Q, C, n)
    cost_theta : (Q, C, D)
    """

    x: Array
    theta: Array
    cost: Array
    cost_x: Array
    cost_theta: Array


class ResetJacobians(NamedTuple):
    """Derivatives of the map at the opening of each segment, identity where there is none: (N + 1, ...) arrays."""

    x: Array  # (N + 1, n, n)
    theta: Array  # (N + 1, n, D)


def parameter_directions(model: Model) -> Array:
    """Derivative of p in theta, ``[0 | I]``: (M, D)."""
    N, M = model.structure.N, model.structure.M
    return jnp.concatenate([jnp.zeros((M, N)), jnp.eye(M)], axis=1)


def time_directions(model: Model, layout: Rows) -> tuple[Array, Array]:
    """Derivatives of the start and the end of each row in theta: two (Q, C, D) arrays of zeros and ones."""
    index = jnp.arange(model.structure.N + model.structure.M)
    return (layout.starts_at[..., None] == index) * 1.0, (layout.ends_at[..., None] == index) * 1.0


def row_jacobians(model: Model, path: Path, p: Array) -> RowJacobians:
    """Jacobians of all rows, by forward differentiation along x, start, end and p."""
    n, M = model.structure.n, model.structure.M
    basis = jnp.eye(n + 2 + M)
    along = Directions(basis[n], basis[n + 1], basis[:n], basis[n + 2 :])

    def of_mode(mode: int) -> Callable[..., tuple[Array, Array, Array]]:
        def row(start: Array, end: Array, piece: Piece, x: Array) -> tuple[Array, Array, Array]:
            f, ell = model.field(mode, piece), model.density(piece)

            def function(start: Array, end: Array, x: Array, p: Array) -> tuple[Array, Array]:
                return step(model.tableau, f, ell, start, end, x, p)

            (_, cost), linear = jax.linearize(function, start, end, x, p)
            F_z, L_z = jax.vmap(linear, in_axes=-1, out_axes=-1)(*along)
            return cost, F_z, L_z

        return jax.vmap(row)

    def chunk(given: tuple[Array, Array, Array, Piece, Array]) -> tuple[Array, Array, Array]:
        segment, start, end, piece, x = given
        return by_mode(model, segment, of_mode, start, end, piece, x)

    layout = path.layout
    cost, F_z, L_z = lax.map(chunk, (layout.segment, layout.start, layout.end, path.pieces, path.before))
    starts, ends = time_directions(model, layout)
    P = parameter_directions(model)
    F_theta = F_z[..., n, None] * starts[:, :, None] + F_z[..., n + 1, None] * ends[:, :, None] + F_z[..., n + 2 :] @ P
    L_theta = L_z[..., n, None] * starts + L_z[..., n + 1, None] * ends + L_z[..., n + 2 :] @ P
    return RowJacobians(F_z[..., :n], F_theta, cost, L_z[..., :n], L_theta)


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


def product(A: Array, B: Array) -> Array:
    """``A @ B`` of small matrices, (n, n) and (n, D), without the overhead of a call to BLAS where that dominates."""
    if A.shape[0] * A.shape[1] * B.shape[1] > 1000:
        return A @ B
    return (A[:, :, None] * B[None]).sum(1)


class Tangents(NamedTuple):
    """Derivative of the state in theta.

    Attributes
    ----------
    before, after : (Q, C, n, D), at the start and the end of each row
    """

    before: Array
    after: Array

    def before_transition(self, layout: Rows, i: int) -> Array:
        """At tau_i-: (n, D)."""
        return self.after[layout.first_chunk[i + 1] - 1, -1]


def tangents(model: Model, path: Path, jacobians: RowJacobians, resets: ResetJacobians | None, p: Array) -> Tangents:
    """``x_theta`` along the path: forward, one product of matrices a row."""

    def row(X: Array, given: tuple[Array, Array]) -> tuple[Array, Array]:
        F_x, F_theta = given
        return product(F_x, X) + F_theta, X

    def chunk(X: Array, given: tuple[Array, Array, Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        segment, opens, F_x, F_theta = given
        if resets is not None:
            X = jnp.where(opens, resets.x[segment] @ X + resets.theta[segment], X)
        X, before = lax.scan(row, X, (F_x, F_theta))
        return X, (before, jnp.concatenate([before[1:], X[None]]))

    first = jax.jacfwd(model.initial_state)(p) @ parameter_directions(model)
    given = (path.layout.segment, path.layout.opens, jacobians.x, jacobians.theta)
    return Tangents(*lax.scan(chunk, first, given)[1])
