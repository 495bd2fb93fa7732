"""One step of an explicit or implicit Runge-Kutta method as a function that JAX differentiates.

The stages of an implicit row are found by Newton's method; their derivatives, to any order, follow from the implicit
function theorem (`jax.lax.custom_root`).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from switchfit.discretization import rows
from switchfit.discretization.model import Field
from switchfit.discretization.rows import combine
from switchfit.discretization.runge_kutta import Tableau

Slope = Callable[[Array, Array], Array]
"""``f(t, x) -> (n,)``: a vector field at one p."""

TRACED_NEWTON_ITERATIONS = 12

LARGEST_LAST_CHANGE = 1e-8
"""Largest change in the last iteration of Newton's method, relative to the largest state: a row of which more is left
is NaN. Where the slope jumps within a row, as where friction stops a body, the method may jump from side to side."""


def compute_stages(tableau: Tableau, f: Slope, start: Array, end: Array, x: Array) -> rows.Stages:
    """Compute the stages of a row as arrays (s,), (s, n), (s, n); those of an explicit method in a loop.

    The vector field is then once in the program, not once per stage: with second derivatives, a program compiles in a
    half to a sixth of the time, and runs 0.3 to 1.5 times as long.
    """
    h = end - start
    if tableau.coupled:
        return _solve_stages(tableau, f, start, h, x)

    def stage(slopes: Array, given: tuple[Array, Array, Array]) -> tuple[Array, tuple[Array, Array]]:
        j, row, c = given
        t, X = start + c * h, x + h * (row @ slopes)
        return lax.dynamic_update_index_in_dim(slopes, f(t, X), j, 0), (t, X)

    s = len(tableau.b)
    given = jnp.arange(s), jnp.asarray(tableau.a), jnp.asarray(tableau.c)
    slopes, (times, states) = lax.scan(stage, jnp.zeros((s, *x.shape)), given)
    return rows.Stages(times, states, slopes)


def _solve_stages(tableau: Tableau, f: Slope, start: Array, h: Array, x: Array) -> rows.Stages:
    """Compute the stages of an implicit row by Newton's method in ``Z = X - x``.

    `jax.lax.custom_root` supplies the derivatives of the solution by the implicit function theorem, to any order.
    """
    s, n = tableau.coupled, x.shape[0]
    a, times = tableau.a[:s, :s], start + tableau.c[:s] * h

    # Z_j = h sum_l a_jl f(t_l, x + Z_l): small differences to x keep their digits, as Hairer and Wanner II, section
    # IV.8.
    def residual(Z: Array) -> Array:
        return Z - h * (a @ jax.vmap(f)(times, x[None] + Z))

    # `custom_root` asks for D residual y = right at the solution, which is linear in y: its Jacobian is the matrix.
    def solve(function: Callable[[Array], Array], at: Array, right: Array) -> Array:
        jacobian = jax.jacfwd(function)(at).reshape(s * n, s * n)
        return jnp.linalg.solve(jacobian, right.reshape(-1)).reshape(s, n)

    def newton(function: Callable[[Array], Array], guess: Array) -> Array:
        def correct(_: int, found: tuple[Array, Array]) -> tuple[Array, Array]:
            change = solve(function, found[0], function(found[0]))
            return found[0] - change, jnp.abs(change).max()

        Z, change = lax.fori_loop(0, TRACED_NEWTON_ITERATIONS, correct, (guess, jnp.inf))
        # NaN where the last change is not small: J is then NaN, and the point refused.
        return jnp.where(change <= LARGEST_LAST_CHANGE * (jnp.abs(x).max() + jnp.abs(Z).max()), Z, jnp.nan)

    zeros = jnp.zeros((s, n))
    Z = lax.custom_root(residual, zeros, newton, lambda linear, right: solve(linear, zeros, right))
    X = x[None] + Z
    # Only decides which of two equal slopes is used: it has no derivative.
    f_x = lax.stop_gradient(jax.jacfwd(partial(f, start))(x))
    # Z = a k, so that the increments are k = a^-1 Z.
    K = rows.choose_slopes(h, list(np.linalg.inv(a) @ Z), list(jax.vmap(f)(times, X)), f_x, jnp)
    # Stages behind the coupled ones repeat the last of these, with weight zero: see `Tableau.pad`.
    behind = len(tableau.b) - s
    return rows.Stages(*(jnp.stack([*values, *[values[-1]] * behind]) for values in (times, X, K)))


def step(tableau: Tableau, f: Field, start: Array, end: Array, x: Array, p: Array) -> tuple[Array, rows.Stages]:
    """Return the state after one step, (n,), and its stages."""
    found = compute_stages(tableau, lambda t, x: f(t, x, p), start, end, x)
    return x + (end - start) * combine(tableau.b, found.slopes), found
