"""One row of an implicit Runge-Kutta method, as `switchfit.discretization.rows` is one row of an explicit method.

Equations, arguments and results are those of `rows`. The slopes of an implicit method depend on each other: Newton's
method finds the *increments* ``k_j = h K_j``, from which ``X_j = x + sum_l a_jl k_l`` follows,

    ``(I - h a_jl D_1 f_j) dk = h f(t_j, X_j) - k_j``,

and with the matrix of these coupled equations also the tangents, ``(I - h a_jl D_1 f_j) K' = ...``, and, transposed,
the adjoint. Only the first `Tableau.coupled` stages are computed: those behind them repeat the last of these, and the
cost does not depend on them.

The factors of this matrix are passed, or a function that factorizes: machine code eliminates entry by entry, or calls a
routine. JAX differentiates `stages` alone.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from switchfit.discretization.rows import (
    STIFF_ERROR,
    Adjoint,
    Array,
    Pull,
    Stages,
    Tableau,
    Tangent,
    combine,
    times_vector,
)

NEWTON_ITERATIONS = 12

CONVERGED = 1e-8
"""Largest change in the last iteration of Newton's method, relative to the largest state: a row of which more is left
is NaN. Where the slope jumps within a row, as where friction stops a body, the method may jump from side to side."""

SHORT = 1e-3
"""Length of a row, in times of the fastest component of f, below which its slopes are f at the stages."""


class Factors(Protocol):
    """A factorized matrix of s by s blocks (n, n)."""

    def solve(self, right: Sequence[Array], *, transposed: bool = False) -> list[Array]:
        """Return the solution for a right-hand side of s vectors (n,): s vectors (n,)."""
        ...


Factorize = Callable[[Array, Array, Sequence[Array]], Factors]
"""Factorizes the matrix of the coupled equations: a (s, s), h and f_x (s arrays (n, n)), as in `couple`."""


def couple(a: Array, h: Array, f_x: Sequence[Array]) -> list[list[Array]]:
    """Return the matrix of the coupled equations, ``I - h a_jl D_1 f_j``, in s by s blocks (n, n)."""
    unit = np.eye(f_x[0].shape[0])
    return [
        [(unit if j == m else 0.0 * unit) - (h * a_jm) * f_x[j] for m, a_jm in enumerate(row)]
        for j, row in enumerate(a.tolist())
    ]


def stages(tableau: Tableau, f: Callable[[Array, Array], Array], start: Array, end: Array, x: Array) -> Stages:
    """Compute the stages of a row by Newton's method in ``Z = X - x``; JAX only.

    `jax.lax.custom_root` supplies the derivatives of the solution by the implicit function theorem, to any order.
    """
    s, n = tableau.coupled, x.shape[0]
    a, h = tableau.a[:s, :s], end - start
    times = start + tableau.c[:s] * h

    # Z_j = h sum_l a_jl f(t_l, x + Z_l): small differences to x keep their digits, as Hairer and Wanner II, section
    # IV.8.
    def residual(Z: Array) -> Array:
        return Z - h * (a @ jax.vmap(f)(times, x[None] + Z))

    def newton(function: Callable[[Array], Array], guess: Array) -> Array:
        def correct(_: int, found: tuple[Array, Array]) -> tuple[Array, Array]:
            Z, _ = found
            jacobian = jax.jacfwd(function)(Z).reshape(s * n, s * n)
            change = jnp.linalg.solve(jacobian, function(Z).reshape(-1)).reshape(s, n)
            return Z - change, jnp.abs(change).max()

        Z, change = lax.fori_loop(0, NEWTON_ITERATIONS, correct, (guess, jnp.inf))
        # NaN where the last change is not small: J is then NaN, and the point refused.
        return jnp.where(change <= CONVERGED * (jnp.abs(x).max() + jnp.abs(Z).max()), Z, jnp.nan)

    # `custom_root` asks for D residual y = right at the solution, which is linear in y: its Jacobian is the matrix.
    def tangent_solve(linear: Callable[[Array], Array], right: Array) -> Array:
        jacobian = jax.jacfwd(linear)(jnp.zeros_like(right)).reshape(s * n, s * n)
        return jnp.linalg.solve(jacobian, right.reshape(-1)).reshape(s, n)

    Z = lax.custom_root(residual, jnp.zeros((s, n)), newton, tangent_solve)
    X = x[None] + Z
    # Only decides which of two equal slopes is used: it has no derivative.
    f_x = lax.stop_gradient(jax.jacfwd(partial(f, start))(x))
    # Z = a k, so that the increments are k = a^-1 Z.
    K = choose_slopes(h, list(np.linalg.inv(a) @ Z), list(jax.vmap(f)(times, X)), f_x, jnp)
    return Stages(*(_pad(tableau, values, values[-1]) for values in (times, X, K)))


def correct_increments(
    tableau: Tableau, h: Array, k: Sequence[Array], slopes: Sequence[Array], f_x: Sequence[Array], factorize: Factorize
) -> list[Array]:
    """Return the increments k (s arrays (n,)) after one iteration of Newton's method.

    Parameters
    ----------
    slopes, f_x : s arrays (n,) and (n, n), f and D_1 f at the stages ``x + sum_l a_jl k_l``
    """
    right = [h * slope - own for slope, own in zip(slopes, k, strict=True)]
    return [own + change for own, change in zip(k, factorize(tableau.a, h, f_x).solve(right), strict=True)]


def choose_slopes(h: Array, k: Sequence[Array], f_X: Sequence[Array], f_x: Array, xp: Any) -> list[Array]:
    """Return the slopes K of the stages, from the increments k, or f at the stages where the row is short.

    The stiff components of f amplify the rounding errors of X, those of k / h do not. But the second derivative of
    k / h in h loses all digits where h is a rounding error of a transition time, and 1 / h fails where it is zero.

    Parameters
    ----------
    k, f_X : s arrays (n,)
    f_x : (n, n), D_1 f at the start of the row
    xp : module
        jax.numpy, or the namespace of a graph.
    """
    fastest = reduce(xp.maximum, list(xp.abs(f_x).sum(axis=1)))
    is_long = xp.abs(h) * fastest > SHORT
    length = xp.where(xp.equal(h, 0.0), 1.0, h)
    return [xp.where(is_long, own / length, slope) for own, slope in zip(k, f_X, strict=True)]


def estimate_error(h: Array, k: Sequence[Array], slope: Array, f_x: Array, factorize: Factorize) -> Array:
    """Return an estimate of the error of a row, (n,): Hairer and Wanner II, equation (IV.8.19).

    ``(I - h g D_1 f)^-1 g (h f + sum_j e_j k_j)``, of order 4, with f (n,) and D_1 f (n, n) at the start of the row.
    """
    damping, *weights = STIFF_ERROR
    right = damping * (h * slope + combine(weights, k))
    (error,) = factorize(np.array([[damping]]), h, [f_x]).solve([right])
    return error


def tangent(
    tableau: Tableau,
    h: Array,
    slopes: Sequence[Array],
    f_x: Sequence[Array],
    forcing: Sequence[Array],
    x_d: Array,
    h_d: Array | None,
    factors: Factors,
) -> Tangent:
    """Differentiate a row along one direction.

    Parameters
    ----------
    factors : of the matrix of the coupled equations, with f_x; `adjoint` takes the same ones
    """
    a, b, s = tableau.a, tableau.b, tableau.coupled

    # X_j' = x' + h' sum_l a_jl K_l + h sum_l a_jl K_l'; without K_l' the part that is known before the solution.
    def at(j: int, K_d: Sequence[Array]) -> Array:
        X_d = x_d if h_d is None else x_d + h_d * combine(a[j], slopes[:s])
        return X_d + h * combine(a[j], K_d) if K_d else X_d

    # (I - h a_jl D_1 f_j) K' = D_1 f_j (x' + h' sum_l a_jl K_l) + D_2 f t_j' + D_p f p'.
    right = [forcing[j] + times_vector(f_x[j], at(j, ())) for j in range(s)]
    K_d = factors.solve(right)
    X_d = [at(j, K_d) for j in range(s)]
    after = x_d + h * combine(b, K_d)
    after = after if h_d is None else after + h_d * combine(b, slopes[:s])
    return Tangent(_pad(tableau, X_d, X_d[-1]), _pad(tableau, K_d, K_d[-1]), after)


def adjoint(tableau: Tableau, h: Array, psi: Array, pull: Pull, ell_x: Sequence[Array], factors: Factors) -> Adjoint:
    """Pull the costate psi (n,) after a row back to its start.

    Parameters
    ----------
    ell_x : s arrays (n,), D_1 ell at each stage
    factors : of the matrix of the coupled equations
    """
    a, b, s = tableau.a, tableau.b.tolist(), tableau.coupled
    # mu_l = D_1 f_l' w_l + h b_l D_1 ell_l put into w_j = h b_j psi + h sum_l a_lj mu_l leaves a system in w alone,
    # with the transposed matrix of the tangent:
    #     w_j - h sum_l a_lj D_1 f_l' w_l = h b_j psi + h sum_l a_lj h b_l D_1 ell_l
    costs = [(h * b[j]) * ell_x[j] for j in range(s)]
    right = [h * (b[j] * psi + combine(a[:s, j], costs)) for j in range(s)]
    w = factors.solve(right, transposed=True)
    times, mu, parameters = zip(*(pull(j, w[j], h * b[j]) for j in range(s)), strict=True)
    of_slopes, of_states, of_times = (_pad(tableau, values, np.zeros(np.shape(values[0]))) for values in (w, mu, times))
    return Adjoint(of_slopes, of_states, psi + sum(mu[1:], mu[0]), of_times, sum(parameters[1:], parameters[0]))


def _pad(tableau: Tableau, values: Sequence[Array], behind: Array) -> list[Array]:
    """Return values at the coupled stages, and `behind` at all stages behind them."""
    return [*values, *[behind] * (len(tableau.b) - tableau.coupled)]
