"""One row of an implicit Runge-Kutta method, as `switchfit.discretization.rows` is one row of an explicit method.

Equations, arguments and results are those of `rows`. The stages of an implicit method depend on each other: they are
computed by Newton's method, and their derivatives from the coupled stage equations ``(I - h a_jl D_1 f_j) K' = ...``,
transposed for the adjoint. Only the first `Tableau.coupled` stages are computed: those behind them repeat the last of
these, and the cost does not depend on them. JAX only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from switchfit.discretization.rows import Adjoint, Pull, Stages, Tangent, times_vector
from switchfit.discretization.tableaus import Tableau

Array = jax.Array

NEWTON_ITERATIONS = 12

SHORT = 1e-3
"""Length of a row, in times of the fastest component of f, below which its slopes are f at the stages."""


def stages(tableau: Tableau, f: Callable[[Array, Array], Array], start: Array, end: Array, x: Array) -> Stages:
    """Compute the stages of a row by Newton's method in the increments ``Z = X - x``.

    `jax.lax.custom_root` supplies the derivatives of the solution by the implicit function theorem, to any order.
    """
    s, n = tableau.coupled, x.shape[0]
    a, h = tableau.a[:s, :s], end - start
    times = start + tableau.c[:s] * h

    def residual(Z: Array) -> Array:
        return Z - h * (a @ jax.vmap(f)(times, x[None] + Z))

    def newton(function: Callable[[Array], Array], guess: Array) -> Array:
        def correct(_: int, Z: Array) -> Array:
            jacobian = jax.jacfwd(function)(Z).reshape(s * n, s * n)
            return Z - jnp.linalg.solve(jacobian, function(Z).reshape(-1)).reshape(s, n)

        return lax.fori_loop(0, NEWTON_ITERATIONS, correct, guess)

    def tangent_solve(linear: Callable[[Array], Array], right: Array) -> Array:
        jacobian = jax.jacfwd(linear)(jnp.zeros_like(right)).reshape(s * n, s * n)
        return jnp.linalg.solve(jacobian, right.reshape(-1)).reshape(s, n)

    Z = lax.custom_root(residual, jnp.zeros((s, n)), newton, tangent_solve)
    X = x[None] + Z
    # K from Z instead of f(X): the stiff components of f amplify the rounding errors of X, A^-1 Z does not. But the
    # second derivative of Z / h in h loses all digits where h is a rounding error of a transition time, and 1 / h fails
    # where it is zero.
    K = (np.linalg.inv(a) @ Z) / jnp.where(h == 0, 1.0, h)
    fastest = jnp.abs(lax.stop_gradient(jax.jacfwd(partial(f, start))(x))).sum(axis=1).max()
    K = jnp.where(jnp.abs(h) * fastest > SHORT, K, jax.vmap(f)(times, X))
    return Stages(*(_pad(tableau, values, values[-1]) for values in (times, X, K)))


def tangent(
    tableau: Tableau,
    h: Array,
    slopes: Sequence[Array],
    f_x: Sequence[Array],
    forcing: Sequence[Array],
    x_d: Array,
    h_d: Array | None,
) -> Tangent:
    """Differentiate a row along one direction."""
    a, b, s = _coefficients(tableau)
    A, K = jnp.stack(f_x[:s]), jnp.stack(slopes[:s])
    base = x_d[None] if h_d is None else x_d[None] + h_d * (a @ K)  # (1, n) or (s, n)
    right = jnp.stack(forcing[:s]) + (A * jnp.expand_dims(base, -2)).sum(-1)
    K_d = times_vector(_inverse(tableau, h, A), right.reshape(-1)).reshape(K.shape)
    X_d = base + h * (a @ K_d)
    after = x_d + h * (b @ K_d)
    after = after if h_d is None else after + h_d * (b @ K)
    return Tangent(_pad(tableau, X_d, X_d[-1]), _pad(tableau, K_d, K_d[-1]), after)


def adjoint(tableau: Tableau, h: Array, psi: Array, pull: Pull) -> Adjoint:
    """Pull the costate psi (n,) after a row back to its start."""
    (a, b, s), n = _coefficients(tableau), psi.shape[0]
    # What pull returns is linear in (w, hb): D_1 f at each stage, row by row, and h b_j D_1 ell.
    f_x = jnp.stack([jax.vmap(lambda w, j=j: pull(j, w, 0.0)[1])(jnp.eye(n)) for j in range(s)])
    costs = jnp.stack([pull(j, jnp.zeros(n), h * b[j])[1] for j in range(s)])
    right = h * (b[:, None] * psi[None] + a.T @ costs)
    w = (right.reshape(-1) @ _inverse(tableau, h, f_x)).reshape(s, n)
    times, mu, parameters = zip(*(pull(j, w[j], h * b[j]) for j in range(s)), strict=True)
    of_slopes, of_states, of_times = (_pad(tableau, values, jnp.zeros_like(values[0])) for values in (w, mu, times))
    return Adjoint(of_slopes, of_states, psi + sum(mu), of_times, sum(parameters))


def _coefficients(tableau: Tableau) -> tuple[Array, Array, int]:
    """Return a (s, s), b (s,) and the number s of the coupled stages."""
    s = tableau.coupled
    return jnp.asarray(tableau.a[:s, :s]), jnp.asarray(tableau.b[:s]), s


def _pad(tableau: Tableau, values: Array | Sequence[Array], behind: Array) -> list[Array]:
    """Return values at the coupled stages, and `behind` at all stages behind them."""
    return [*values, *[behind] * (len(tableau.b) - tableau.coupled)]


def _inverse(tableau: Tableau, h: Array, f_x: Array) -> Array:
    """Return the inverse of the coupled stage equations, ``(I - h a_jl D_1 f_j)^-1``: (s n, s n)."""
    s, n = f_x.shape[:2]
    blocks = h * jnp.asarray(tableau.a[:s, :s])[:, None, :, None] * f_x[:, :, None, :]
    return jnp.linalg.inv(jnp.eye(s * n) - blocks.reshape(s * n, s * n))
