"""One step of a Runge-Kutta method, and the exact second derivative of that step.

With stages ``X_j = x + h sum_l a_jl K_l``, ``K_j = f(t + c_j h, X_j)`` a step is ``x+ = x + h sum_j b_j K_j`` and
its running cost ``L = h sum_j b_j ell(t + c_j h, X_j)``. A step is a function of its start and end time, of x and of
p; everything is exact for the *discretised* system, whatever the step length.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from switchfit.data import FloatArray

Array = jax.Array
Field = Callable[[Array, Array, Array], Array]
"""``f(t, x, p) -> (n,)`` of one mode, p being the flat vector of free parameters."""

Density = Callable[[Array, Array, Array], Array]
"""``ell(t, x, p) -> scalar``: the sum of all running costs."""


class Tableau(NamedTuple):
    """Coefficients of a Runge-Kutta method: a (s, s), b (s,), c (s,), and its order."""

    a: FloatArray
    b: FloatArray
    c: FloatArray
    order: int


def dormand_prince() -> Tableau:
    """Dormand and Prince (1980), order 5 with six stages (the seventh only serves their error estimate)."""
    a = np.zeros((6, 6))
    a[1, :1] = [1 / 5]
    a[2, :2] = [3 / 40, 9 / 40]
    a[3, :3] = [44 / 45, -56 / 15, 32 / 9]
    a[4, :4] = [19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729]
    a[5, :5] = [9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656]
    b = np.array([35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84])
    return Tableau(a, b, a.sum(1), 5)


def radau_iia() -> Tableau:
    """Radau IIA of order 5 with three stages (Hairer and Wanner II, table IV.5.6): L-stable, stiffly accurate."""
    r = np.sqrt(6.0)
    a = np.array(
        [
            [(88 - 7 * r) / 360, (296 - 169 * r) / 1800, (-2 + 3 * r) / 225],
            [(296 + 169 * r) / 1800, (88 + 7 * r) / 360, (-2 - 3 * r) / 225],
            [(16 - r) / 36, (16 + r) / 36, 1 / 9],
        ]
    )
    return Tableau(a, a[2].copy(), np.array([(4 - r) / 10, (4 + r) / 10, 1.0]), 5)


EXPLICIT, STIFF = dormand_prince(), radau_iia()


def tableau_of(solver: str) -> Tableau:
    """The method behind `Problem.solver`."""
    return EXPLICIT if solver == "explicit" else STIFF


def stages(tableau: Tableau, f: Field, start: Array, end: Array, x: Array, p: Array) -> tuple[list[Array], list[Array]]:
    """Stage states X_j and slopes K_j of one step, s arrays ``(n,)`` each."""
    return _implicit_stages(tableau, f, start, end, x, p) if tableau is STIFF else _explicit_stages(
        tableau, f, start, end, x, p
    )


def step(
    tableau: Tableau, f: Field, ell: Density | None, start: Array, end: Array, x: Array, p: Array
) -> tuple[Array, Array]:
    """State after one step and the running cost it adds: ``(n,)`` and a scalar (0 where ell is None)."""
    h = end - start
    X, K = stages(tableau, f, start, end, x, p)
    after = x + h * combine(tableau.b, K)
    if ell is None:
        return after, jnp.zeros(())
    values = [ell(start + c * h, X_j, p) for c, X_j in zip(tableau.c, X, strict=True)]
    return after, h * combine(tableau.b, values)


def combine(weights: FloatArray, terms: list[Array]) -> Array:
    """Weighted sum that leaves out zero weights, so that they cost nothing."""
    parts = [w * term for w, term in zip(weights.tolist(), terms, strict=False) if w != 0.0]
    return sum(parts[1:], parts[0]) if parts else jnp.zeros_like(terms[0])


def _explicit_stages(
    tableau: Tableau, f: Field, start: Array, end: Array, x: Array, p: Array
) -> tuple[list[Array], list[Array]]:
    h = end - start
    X: list[Array] = []
    K: list[Array] = []
    for row, c in zip(tableau.a, tableau.c.tolist(), strict=True):
        X.append(x + h * combine(row, K) if K else x)
        K.append(f(start + c * h, X[-1], p))
    return X, K


NEWTON_ITERATIONS = 12


def _implicit_stages(
    tableau: Tableau, f: Field, start: Array, end: Array, x: Array, p: Array
) -> tuple[list[Array], list[Array]]:
    """Solve the coupled stage equations by Newton's method in the increments ``Z = X - x``.

    `jax.lax.custom_root` supplies the derivatives of the solution by the implicit function theorem, to any order.
    """
    s, n = len(tableau.c), x.shape[0]
    h = end - start
    times = start + tableau.c * h

    def residual(Z: Array) -> Array:
        F = jax.vmap(f, in_axes=(0, 0, None))(times, x + Z, p)
        return Z - h * (tableau.a @ F)

    def newton(function: Callable[[Array], Array], guess: Array) -> Array:
        def correct(_: int, Z: Array) -> Array:
            jacobian = jax.jacfwd(function)(Z).reshape(s * n, s * n)
            return Z - jnp.linalg.solve(jacobian, function(Z).reshape(-1)).reshape(s, n)

        return lax.fori_loop(0, NEWTON_ITERATIONS, correct, guess)

    def tangent_solve(linear: Callable[[Array], Array], right: Array) -> Array:
        jacobian = jax.jacfwd(linear)(jnp.zeros_like(right)).reshape(s * n, s * n)
        return jnp.linalg.solve(jacobian, right.reshape(-1)).reshape(s, n)

    Z = lax.custom_root(residual, jnp.zeros((s, n)), newton, tangent_solve)
    X = x + Z
    # K from Z instead of f(X): the stiff components of f amplify the rounding of X, A^-1 Z does not.
    K = (np.linalg.inv(tableau.a) @ Z) / jnp.where(h == 0, 1.0, h)
    K = jnp.where(h == 0, jax.vmap(f, in_axes=(0, 0, None))(times, X, p), K)
    return list(X), list(K)


class Directions(NamedTuple):
    """Derivatives of a step's arguments in D directions: start (D,), end (D,), x (n, D), p (M, D)."""

    start: Array
    end: Array
    x: Array
    p: Array


def curvature(
    tableau: Tableau,
    f: Field,
    ell: Density | None,
    start: Array,
    end: Array,
    x: Array,
    p: Array,
    psi: Array,
    along: Directions,
) -> Array:
    """Second derivative of ``psi . x+ + L`` of one step along D directions: a symmetric ``(D, D)`` array.

    The term ``psi . F_xx + L_xx`` (and its mixed forms) of the general discrete sweep.
    """
    if tableau is STIFF:
        return _curvature_of_whole_step(tableau, f, ell, start, end, x, p, psi, along)
    return _curvature_by_stages(tableau, f, ell, start, end, x, p, psi, along)


def _curvature_of_whole_step(
    tableau: Tableau, f: Field, ell: Density | None, start: Array, end: Array, x: Array, p: Array, psi: Array,
    along: Directions,
) -> Array:
    """By differentiating the step as a whole, forward over forward (which passes through `custom_root`)."""

    def value(start: Array, end: Array, x: Array, p: Array) -> Array:
        after, cost = step(tableau, f, ell, start, end, x, p)
        return psi @ after + cost

    at = (start, end, x, p)

    def pair(u: Directions, v: Directions) -> Array:
        return jax.jvp(lambda *z: jax.jvp(value, z, tuple(u))[1], at, tuple(v))[1]

    columns = Directions(*(jnp.moveaxis(a, -1, 0) for a in along))
    return jax.vmap(lambda u: jax.vmap(lambda v: pair(u, v))(columns))(columns)


def _curvature_by_stages(
    tableau: Tableau, f: Field, ell: Density | None, start: Array, end: Array, x: Array, p: Array, psi: Array,
    along: Directions,
) -> Array:
    """By the adjoint of the stages: only second derivatives of f itself are taken, never of a composition.

    With w_j the derivative of ``psi . x+`` with respect to K_j and mu_j that of everything with respect to X_j,

        H = sum_j Z_j' D^2 (w_j . f + h b_j ell) Z_j  +  the products of h with K and ell, whose second
            derivative is  h' x (mu_j sum_l a_jl K_l' + ...) and its transpose,

    where ``'`` is the derivative along the directions and Z_j that of (t_j, X_j, p).
    """
    a, b, c = tableau.a, tableau.b, tableau.c
    s = len(c)
    h, h_d = end - start, along.end - along.start
    X, K, T_d, X_d, K_d, aK_d = [], [], [], [], [], []
    for j in range(s):
        T_d.append(along.start + float(c[j]) * h_d)
        if j == 0:
            X.append(x)
            X_d.append(along.x)
            aK_d.append(jnp.zeros_like(along.x))
        else:
            aK, aK_j_d = combine(a[j], K), combine(a[j], K_d)
            X.append(x + h * aK)
            X_d.append(along.x + h * aK_j_d + aK[:, None] * h_d)
            aK_d.append(aK_j_d)
        k, k_d = _jvp_columns(f, start + float(c[j]) * h, X[j], p, T_d[j], X_d[j], along.p)
        K.append(k)
        K_d.append(k_d)

    def weighted(w: Array, hb: Array, t: Array, x: Array, p: Array) -> Array:
        """``w . f + h b ell``, whose derivatives are those of the adjoint and of the cost at a stage."""
        value = w @ f(t, x, p)
        return value if ell is None else value + hb * ell(t, x, p)

    w: list[Array] = [psi] * s
    mu: list[Array] = [psi] * s
    for j in reversed(range(s)):
        w[j] = h * (float(b[j]) * psi + sum(float(a[m, j]) * mu[m] for m in range(j + 1, s) if a[m, j] != 0.0))
        mu[j] = jax.grad(weighted, argnums=3)(w[j], h * float(b[j]), start + float(c[j]) * h, X[j], p)

    def second(w: Array, hb: Array, t: Array, X: Array, T_d: Array, X_d: Array) -> Array:
        gradient = jax.grad(weighted, argnums=(2, 3, 4))

        def column(t_d: Array, x_d: Array, p_d: Array) -> tuple[Array, Array, Array]:
            return jax.jvp(lambda t, x, p: gradient(w, hb, t, x, p), (t, X, p), (t_d, x_d, p_d))[1]

        gt, gx, gp = jax.vmap(column, in_axes=(0, -1, -1), out_axes=-1)(T_d, X_d, along.p)
        return T_d[:, None] * gt[None] + X_d.T @ gx + along.p.T @ gp

    times = start + c * h
    stack = jnp.stack
    H = jax.vmap(second)(stack(w), h * jnp.asarray(b), times, stack(X), stack(T_d), stack(X_d)).sum(0)
    # products of the step length with slopes: D = derivative of everything they multiply
    D = psi @ combine(b, K_d) + sum(mu[j] @ aK_d[j] for j in range(1, s))
    if ell is not None:
        D = D + combine(b, [_jvp_columns(ell, times[j], X[j], p, T_d[j], X_d[j], along.p)[1] for j in range(s)])
    return H + h_d[:, None] * D[None] + D[:, None] * h_d[None]


def _jvp_columns(
    function: Callable[..., Array], t: Array, x: Array, p: Array, t_d: Array, x_d: Array, p_d: Array
) -> tuple[Array, Array]:
    """Value and derivatives along D directions (last axis) of ``function(t, x, p)``."""
    value, linear = jax.linearize(function, t, x, p)
    return value, jax.vmap(linear, in_axes=(0, -1, -1), out_axes=-1)(t_d, x_d, p_d)


def stage_directions(
    tableau: Tableau, f: Field, start: Array, end: Array, x: Array, p: Array, along: Directions
) -> tuple[Array, Array, Array]:
    """Stage times (s,), states (s, n) and the derivatives (s, n, D) of the states along D directions."""

    def stacked(start: Array, end: Array, x: Array, p: Array) -> Array:
        return jnp.stack(stages(tableau, f, start, end, x, p)[0])

    X, linear = jax.linearize(stacked, start, end, x, p)
    X_d = jax.vmap(linear, in_axes=-1, out_axes=-1)(*along)
    return start + tableau.c * (end - start), X, X_d
