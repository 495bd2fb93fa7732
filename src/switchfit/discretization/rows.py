"""Equations of one row, a step of a Runge-Kutta method: its stages, its tangent along one direction, its adjoint.

With the stages ``X_j = x + h sum_l a_jl K_l``, ``K_j = f(t_j, X_j, p)`` at ``t_j = start + c_j h`` a row maps x to
``x+ = x + h sum_j b_j K_j`` and costs ``L = h sum_j b_j ell(t_j, X_j, p)``. Machine code is made of the equations
below; JAX differentiates the stages by itself.

tangent    along a direction in which x, p, start and end change by x', p', start', end', with ``h' = end' - start'``
           and ``t_j' = start' + c_j h'``,

           ``X_j' = x' + h sum_l a_jl K_l' + h' sum_l a_jl K_l``,  ``K_j' = D_1 f X_j' + D_2 f t_j' + D_p f p'``,
           ``x+' = x' + h sum_j b_j K_j' + h' sum_j b_j K_j``;

adjoint    with the derivative psi of the cost to go in x+,

           ``w_j = h b_j psi + h sum_l a_lj mu_l``,  ``mu_j = D_x (w_j . f + h b_j ell)``,
           ``psi_before = psi + sum_j mu_j``;

second     with Z_j the derivative of (t_j, X_j, p) along theta, and V that of the cost to go in h at fixed t_j,

           ``D^2 = sum_j Z_j' D^2 (w_j . f + h b_j ell) Z_j + h' x V' + V' x h'``,
           ``V = sum_j b_j (psi . K_j + ell_j) + sum_j mu_j . sum_l a_jl K_l``.

Only rows that open or close a mode have times that depend on theta. Arrays are NumPy arrays of the nodes of a graph,
whose vectors hold one entry per unknown, so that all directions are treated at once.

The slopes of an implicit method depend on each other. Newton's method finds the *increments* ``k_j = h K_j``, from
which ``X_j = x + sum_l a_jl k_l`` follows,

    ``(I - h a_jl D_1 f_j) dk = h f(t_j, X_j) - k_j``,

and with the matrix of these coupled equations also the tangents, ``(I - h a_jl D_1 f_j) K' = ...``, and, transposed,
the adjoint. A function that factorizes this matrix, or its factors, are passed: machine code eliminates entry by entry,
or calls a routine.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import reduce
from typing import NamedTuple, Protocol, TypeAlias

import numpy as np

from switchfit.arrays import ArrayModule, FloatArray, Traced
from switchfit.discretization.runge_kutta import Tableau

SHORT_ROW = 1e-3
"""Length of a row, in times of the fastest component of f, below which its slopes are f at the stages."""

Pull = Callable[[int, Traced, Traced], tuple[Traced, Traced, Traced]]
"""``pull(j, w, hb)``: derivatives of ``w . f + hb ell`` at stage j in t (), x (n,) and p (M,)."""

Factorize: TypeAlias = "Callable[[Traced, Traced, Sequence[Traced]], Factors]"
"""Factorizes the matrix of the coupled equations: a (s, s), h and f_x (s arrays (n, n)), as in `couple`."""


class Stages(NamedTuple):
    """Time (), state (n,) and slope (n,) of each stage: lists, or arrays with one more axis in front."""

    times: Traced
    states: Traced
    slopes: Traced


def stages(
    tableau: Tableau, f: Callable[..., Traced], start: Traced, end: Traced, x: Traced, increments: Sequence[Traced] = ()
) -> Stages:
    """Compute the stages of a row from the state x (n,); ``f(t, x)`` is the vector field.

    Those of an implicit row follow from its increments (s arrays (n,)), with f at them for the slopes.
    """
    h = end - start
    found = Stages([], [], [])
    for row, c in zip(tableau.a, tableau.c.tolist(), strict=True):
        found.times.append(start + c * h)
        # X_j of an explicit row from the slopes before it: a is strictly lower triangular.
        found.states.append(x + (combine(row, increments) if increments else h * combine(row, found.slopes)))
        found.slopes.append(f(found.times[-1], found.states[-1]))
    return found


class Factors(Protocol):
    """A factorized matrix of s by s blocks (n, n)."""

    def solve(self, right: Sequence[Traced], *, transposed: bool = False) -> list[Traced]:
        """Return the solution for a right-hand side of s vectors (n,): s vectors (n,)."""
        ...


def couple(a: Traced, h: Traced, f_x: Sequence[Traced]) -> list[list[Traced]]:
    """Return the matrix of the coupled equations, ``I - h a_jl D_1 f_j``, in s by s blocks (n, n)."""
    # A zero block is the product of 0 and the unit, whose type is that of the nodes of a graph.
    unit = np.eye(f_x[0].shape[0])
    return [
        [(unit if j == m else 0.0 * unit) - (h * a_jm) * f_x[j] for m, a_jm in enumerate(row)]
        for j, row in enumerate(a.tolist())
    ]


def choose_slopes(h: Traced, k: Sequence[Traced], f_X: Sequence[Traced], f_x: Traced, xp: ArrayModule) -> list[Traced]:
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
    # The row sums bound the largest eigenvalue from above; h times it is how many times of the fastest component the
    # row lasts.
    fastest = reduce(xp.maximum, list(xp.abs(f_x).sum(axis=1)))
    is_long = xp.abs(h) * fastest > SHORT_ROW
    # Both branches of a `where` are evaluated, and differentiated: h must not be 0 in the one that is not taken.
    length = xp.where(xp.equal(h, 0.0), 1.0, h)
    return [xp.where(is_long, own / length, slope) for own, slope in zip(k, f_X, strict=True)]


class Tangent(NamedTuple):
    """Derivatives along one direction: of the states and slopes of the stages, (n,) each, and of x+ (n,)."""

    states: list[Traced]
    slopes: list[Traced]
    after: Traced


def tangent(
    tableau: Tableau,
    h: Traced,
    slopes: Sequence[Traced],
    f_x: Sequence[Traced],
    forcing: Sequence[Traced],
    x_d: Traced,
    h_d: Traced,
    factors: Factors | None = None,
) -> Tangent:
    """Differentiate a row along one direction.

    Parameters
    ----------
    h : step length ()
    slopes : s arrays (n,)
    f_x : s arrays (n, n), D_1 f at each stage
    forcing : s arrays (n,), ``D_2 f t_j' + D_p f p'``
    x_d : (n,), derivative of the state before the row
    h_d : (), derivative of the step length; None where it does not depend on theta
    factors : of the matrix of the coupled equations of an implicit row, with f_x; `adjoint` takes the same ones
    """

    def follow(start: Traced, weights: FloatArray, K_d: Sequence[Traced]) -> Traced:
        """Return ``start + h sum_l weights_l K_l' + h' sum_l weights_l K_l``."""
        moved = start + h * combine(weights, K_d) if K_d else start
        return moved if h_d is None else moved + h_d * combine(weights, slopes)

    # X_j' = x' + h sum_l a_jl K_l' + h' sum_l a_jl K_l: along p this discretizes the linear equation whose solution is
    # (10) of the paper.
    states: list[Traced] = []
    K_d: list[Traced] = []
    if factors is None:
        for J, given, row in zip(f_x, forcing, tableau.a, strict=True):
            states.append(follow(x_d, row, K_d))
            # K_j' = D_1 f X_j' + D_2 f t_j' + D_p f p'.
            K_d.append(times_vector(J, states[-1]) + given)
    else:
        # (I - h a_jl D_1 f_j) K' = D_1 f_j (x' + h' sum_l a_jl K_l) + D_2 f t_j' + D_p f p'.
        known = [follow(x_d, row, ()) for row in tableau.a]
        K_d = factors.solve([given + times_vector(J, X_d) for J, given, X_d in zip(f_x, forcing, known, strict=True)])
        states = [follow(x_d, row, K_d) for row in tableau.a]
    return Tangent(states, K_d, follow(x_d, tableau.b, K_d))


class Adjoint(NamedTuple):
    """Derivatives of the cost to go from the start of a row.

    Attributes
    ----------
    states : s arrays mu_j (n,), in the states of the stages
    before : (n,), in the state before the row
    times : s entries (), of ``w_j . f + h b_j ell`` in t_j
    parameters : (M,), the sum of the same in p
    """

    states: list[Traced]
    before: Traced
    times: list[Traced]
    parameters: Traced


def adjoint(
    tableau: Tableau, h: Traced, psi: Traced, pull: Pull, ell_x: Sequence[Traced] = (), factors: Factors | None = None
) -> Adjoint:
    """Pull the costate psi (n,) after a row back to its start; of an implicit row by its factors, and with D_1 ell at
    each stage, s arrays (n,).
    """
    a, b, s = tableau.a, tableau.b.tolist(), len(tableau.b)
    unknown: list[list[Traced]] = [[None] * s for _ in range(3)]
    w, mu, times = unknown
    parameters: Traced = 0.0
    if factors is not None:
        # mu_l = D_1 f_l' w_l + h b_l D_1 ell_l put into w_j = h b_j psi + h sum_l a_lj mu_l leaves a system in w alone,
        # with the transposed matrix of the tangent:
        #     w_j - h sum_l a_lj D_1 f_l' w_l = h b_j psi + h sum_l a_lj h b_l D_1 ell_l
        costs = [(h * b[j]) * ell_x[j] for j in range(s)]
        right = [h * (b[j] * psi + combine(a[:, j], costs)) for j in range(s)]
        w = factors.solve(right, transposed=True)
    # Explicit: last stage first, since w_j needs mu_l of the stages that use K_j, those behind it. This discretizes (7)
    # of the paper.
    for j in reversed(range(s)) if factors is None else range(s):
        if factors is None:
            later = combine(a[j + 1 :, j], mu[j + 1 :])
            w[j] = h * (b[j] * psi + later)
        # mu_j = D_x (w_j . f + h b_j ell): D_1 f' w_j discretizes psi D_1 f of (7), D_1 ell its source term; in_p sums
        # up (9).
        times[j], mu[j], in_p = pull(j, w[j], h * b[j])
        parameters = parameters + in_p
    return Adjoint(mu, psi + sum(mu[1:], mu[0]), times, parameters)


def length_factor(
    tableau: Tableau, psi: Traced, mu: Sequence[Traced], slopes: Sequence[Traced], densities: Sequence[Traced]
) -> Traced:
    """Return V, the derivative of the cost to go in the length of a row at fixed times of its stages: ().

    V is linear in the slopes K_j (n,) and the densities ell_j (): with K_j' and ell_j' the result is its derivative.
    """
    total: Traced = 0.0
    for j, b in enumerate(tableau.b.tolist()):
        # h stands in x+ and in the cost of the row, h b_j (K_j, ell_j), and in the states of the stages, h a_jl K_l.
        if b:
            total = total + b * ((psi * slopes[j]).sum() + densities[j])
        if tableau.a[j].any():
            total = total + (mu[j] * combine(tableau.a[j], slopes)).sum()
    return total


def invert_stages(tableau: Tableau) -> FloatArray:
    """Return the matrix that makes h times the slopes (s, n) of the states at the stages after the row's start (s, n).

    The states, minus that at the start, are those of all stages; of an explicit method, whose first stage is the start,
    those of the others, then that at the end of the row.
    """
    # X - x = a (h K); of an explicit method the first row of a is zero, and b, the row of x+, takes its place.
    return np.asarray(np.linalg.inv(tableau.a if tableau.coupled else np.vstack([tableau.a[1:], tableau.b])))


def times_derivative(tableau: Tableau, start_d: Traced, end_d: Traced) -> list[Traced]:
    """Return the derivatives of the times of the stages, ``start' + c_j h'``: s entries ()."""
    h_d = end_d - start_d
    return [start_d + c * h_d for c in tableau.c.tolist()]


def combine(weights: Sequence[float] | FloatArray, terms: Sequence[Traced] | FloatArray) -> Traced:
    """Add terms with weights; terms of weight zero are skipped, and the sum of no terms is 0.

    The terms may be one NumPy array, along its first axis.
    """
    if isinstance(terms, np.ndarray) and terms.dtype != object:
        return np.asarray(weights)[: len(terms)] @ terms
    given = weights.tolist() if isinstance(weights, np.ndarray) else weights
    parts = [w * term for w, term in zip(given, terms, strict=False) if w != 0.0]
    return sum(parts[1:], parts[0]) if parts else 0.0


def times_vector(A: Traced, v: Traced) -> Traced:
    """Return ``A v`` for small A (m, n) and v (n,) as products and a sum, without the overhead of a library call."""
    return (A * v[None]).sum(-1)
