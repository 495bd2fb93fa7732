"""One step of a Runge-Kutta method, and the linear equations that its derivatives obey.

With stages ``X_j = x + h sum_l a_jl K_l``, ``K_j = f(t + c_j h, X_j)`` a step is ``x+ = x + h sum_j b_j K_j`` and
its running cost ``L = h sum_j b_j ell(t + c_j h, X_j)``. A step is a function of its start and end time, of x and of
p. Its derivatives are taken stage by stage: f is differentiated at each stage by itself, and what links the stages
is linear algebra. All of it is exact for the *discretised* system, whatever the step length.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from switchfit.problem.data import FloatArray

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


def butcher() -> Tableau:
    """Butcher (1964), order 5 with six stages.

    All weights are positive or zero, so that the integral of a positive running cost is positive whatever the step;
    those of Dormand and Prince are not.
    """
    a = np.zeros((6, 6))
    a[1, :1] = [1 / 4]
    a[2, :2] = [1 / 8, 1 / 8]
    a[3, :3] = [0, -1 / 2, 1]
    a[4, :4] = [3 / 16, 0, 0, 9 / 16]
    a[5, :5] = [-3 / 7, 2 / 7, 12 / 7, -12 / 7, 8 / 7]
    return Tableau(a, np.array([7, 0, 32, 12, 32, 7]) / 90, a.sum(1), 5)


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


EXPLICIT, STIFF = butcher(), radau_iia()


def tableau_of(solver: str) -> Tableau:
    """The method behind `Problem.solver`."""
    return EXPLICIT if solver == "explicit" else STIFF


def stages(tableau: Tableau, f: Field, start: Array, end: Array, x: Array, p: Array) -> tuple[list[Array], list[Array]]:
    """Stage states X_j and slopes K_j of one step, s arrays ``(n,)`` each."""
    return (
        _implicit_stages(tableau, f, start, end, x, p)
        if tableau is STIFF
        else _explicit_stages(tableau, f, start, end, x, p)
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


def stage_tangents(tableau: Tableau, h: Array, A: Array, S: Array, x_d: Array) -> tuple[Array, Array]:
    """Derivatives of the stages along D directions at fixed step length: the stage equations, differentiated.

        X_j' = x_j' + h sum_l a_jl K_l',      K_j' = A_j X_j' + S_j

    Parameters
    ----------
    h : step length ()
    A : (s, n, n), D_1 f at each stage
    S : (s, n, D), what else K_j depends on
    x_d : (n, D), derivative of the state before the step; or (s, n, D) where it differs from stage to stage

    Returns
    -------
    X_d, K_d : (s, n, D) each; the state after the step has derivative ``x' + h sum_j b_j K_j'``
    """
    s = len(tableau.c)
    base = [x_d] * s if x_d.ndim == 2 else list(x_d)
    if tableau is STIFF:
        right = jnp.stack([product(A[j], base[j]) + S[j] for j in range(s)])
        K_d = list((_stage_inverse(tableau, h, A) @ right.reshape(-1, right.shape[-1])).reshape(right.shape))
        X_d = [base[j] + h * combine(tableau.a[j], K_d) for j in range(s)]
    else:
        X_d, K_d = [], []
        for j in range(s):
            X_d.append(base[j] + h * combine(tableau.a[j], K_d) if j else base[0])
            K_d.append(product(A[j], X_d[j]) + S[j])
    return jnp.stack(X_d), jnp.stack(K_d)


def end_tangents(
    tableau: Tableau, h: Array, A: Array, f_t: Array, K: Array, t_d: Array, h_d: Array
) -> tuple[Array, Array]:
    """Derivatives of a step in its start (``t' = 1 - c, h' = -1``) or in its end (``t' = c, h' = 1``).

        X_j' = h sum_l a_jl K_l' + h' sum_l a_jl K_l,      K_j' = A_j X_j' + D_2 f_j t_j'

    Parameters
    ----------
    h : step length ()
    A, f_t : (s, n, n) and (s, n), D_1 f and D_2 f at each stage
    K : (s, n), slopes
    t_d : (s,), derivative of the stage times
    h_d : (), derivative of the step length

    Returns
    -------
    X_d : (s, n)
    after_d : (n,), derivative of the state after the step
    """
    b = jnp.asarray(tableau.b)
    base = h_d * (jnp.asarray(tableau.a) @ K)[:, :, None]
    X_d, K_d = stage_tangents(tableau, h, A, (f_t * t_d[:, None])[:, :, None], base)
    return X_d[..., 0], h * b @ K_d[..., 0] + h_d * b @ K


def stage_adjoints(tableau: Tableau, h: Array, A: Array, l_x: Array, psi: Array) -> tuple[Array, Array, Array]:
    """Derivatives of ``psi . x+ + L`` in the stages: the transposed stage equations, backward.

        w_j = h b_j psi + h sum_l a_lj mu_l,      mu_j = w_j A_j + h b_j l_x,j,      psi_before = psi + sum_j mu_j

    Parameters
    ----------
    h : step length ()
    A : (s, n, n), D_1 f at each stage
    l_x : (s, n), D ell at each stage
    psi : (n,), costate after the step

    Returns
    -------
    w, mu : (s, n), derivatives in the slopes K_j and in the stage states X_j
    before : (n,), costate before the step
    """
    s = len(tableau.c)
    a, b = tableau.a, tableau.b
    if tableau is STIFF:
        right = jnp.stack(
            [h * (b[j] * psi + combine(a[:, j], [h * b[m] * l_x[m] for m in range(s)])) for j in range(s)]
        )
        w = list((right.reshape(-1) @ _stage_inverse(tableau, h, A)).reshape(s, -1))
        mu = [(w[j][:, None] * A[j]).sum(0) + h * b[j] * l_x[j] for j in range(s)]
    else:
        w, mu = [psi] * s, [psi] * s
        for j in reversed(range(s)):
            w[j] = h * (b[j] * psi + combine(a[j + 1 :, j], mu[j + 1 :])) if j + 1 < s else h * b[j] * psi
            mu[j] = (w[j][:, None] * A[j]).sum(0) + h * b[j] * l_x[j]
    return jnp.stack(w), jnp.stack(mu), psi + sum(mu)


def _stage_inverse(tableau: Tableau, h: Array, A: Array) -> Array:
    """Inverse of the coupled stage equations, ``(I - h a_jl A_j)^-1``: (s n, s n)."""
    s, n = A.shape[:2]
    blocks = h * jnp.asarray(tableau.a)[:, None, :, None] * A[:, :, None, :]
    return jnp.linalg.inv(jnp.eye(s * n) - blocks.reshape(s * n, s * n))


def product(A: Array, B: Array) -> Array:
    """``A @ B`` of small matrices, (n, n) and (n, D), without the overhead of a call to BLAS where that dominates."""
    if A.shape[0] * A.shape[1] * B.shape[1] > 1000:
        return A @ B
    return (A[:, :, None] * B[None]).sum(1)
