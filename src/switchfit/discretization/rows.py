"""One row: one step of an explicit Runge-Kutta method, its derivatives along one direction, and its adjoint.

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
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from switchfit.discretization.tableaus import Tableau
from switchfit.problem.data import FloatArray

Array = Any
"""A JAX array, or a NumPy array of nodes."""


LARGEST_BEND = 0.3
"""Difference of the slopes of a row, relative to their range, above which f jumps in it: of a sine it is above where a
row is longer than half a period; of a jump it is 1 to 3 in an explicit row, and 0.4 to 0.6 in an implicit one."""


SMALLEST_BEND = 1e-4
"""Difference of the slopes, relative to the slope at the start of the row, below which it may be rounding."""


class Stages(NamedTuple):
    """Time (), state (n,) and slope (n,) of each stage: lists, or arrays with one more axis in front."""

    times: Any
    states: Any
    slopes: Any


def stages(tableau: Tableau, f: Callable[[Array, Array], Array], start: Array, end: Array, x: Array) -> Stages:
    """Compute the stages of a row from the state x (n,); ``f(t, x)`` is the vector field."""
    h = end - start
    found = Stages([], [], [])
    for row, c in zip(tableau.a, tableau.c.tolist(), strict=True):
        found.times.append(start + c * h)
        # X_j from the slopes before it: a is strictly lower triangular.
        found.states.append(stage_state(row, h, x, found.slopes))
        found.slopes.append(f(found.times[-1], found.states[-1]))
    return found


def stage_state(row: FloatArray, h: Array, x: Array, slopes: Sequence[Array] | FloatArray) -> Array:
    """Return the state (n,) of a stage from the slopes of those before it; `row` is its row of a."""
    return _plus(x, h, combine(row, slopes))


def end_of_row(tableau: Tableau, h: Array, x: Array, slopes: Sequence[Array] | FloatArray) -> Array:
    """Return the state after a row: (n,)."""
    return _plus(x, h, combine(tableau.b, slopes))


def cost_of_row(tableau: Tableau, h: Array, densities: Sequence[Array]) -> Array:
    """Return the running cost of a row, ``h sum_j b_j ell_j``: ()."""
    return h * combine(tableau.b, densities)


class Tangent(NamedTuple):
    """Derivatives along one direction: of the states and slopes of the stages, (n,) each, and of x+ (n,)."""

    states: list[Array]
    slopes: list[Array]
    after: Array


def tangent(
    tableau: Tableau,
    h: Array,
    slopes: Sequence[Array],
    f_x: Sequence[Array],
    forcing: Sequence[Array],
    x_d: Array,
    h_d: Array,
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
    """
    found = Tangent([], [], None)
    for j in range(len(tableau.b)):
        # X_j' = x' + h sum_l a_jl K_l' + h' sum_l a_jl K_l: along p this discretizes the linear equation whose solution
        # is (10) of the paper.
        X_d = _plus(x_d, h, combine(tableau.a[j], found.slopes))
        X_d = X_d if h_d is None else _plus(X_d, h_d, combine(tableau.a[j], slopes))
        found.states.append(X_d)
        found.slopes.append(times_vector(f_x[j], X_d) + forcing[j])
    after = _plus(x_d, h, combine(tableau.b, found.slopes))
    return found._replace(after=after if h_d is None else _plus(after, h_d, combine(tableau.b, slopes)))


class Adjoint(NamedTuple):
    """Derivatives of the cost to go from the start of a row.

    Attributes
    ----------
    slopes : s arrays w_j (n,), in the slopes of the stages
    states : s arrays mu_j (n,), in the states of the stages
    before : (n,), in the state before the row
    times : s entries (), of ``w_j . f + h b_j ell`` in t_j
    parameters : (M,), the sum of the same in p
    """

    slopes: list[Array]
    states: list[Array]
    before: Array
    times: list[Array]
    parameters: Array


Pull = Callable[[int, Array, Array], tuple[Array, Array, Array]]
"""``pull(j, w, hb)``: derivatives of ``w . f + hb ell`` at stage j in t (), x (n,) and p (M,)."""


def adjoint(tableau: Tableau, h: Array, psi: Array, pull: Pull) -> Adjoint:
    """Pull the costate psi (n,) after a row back to its start."""
    a, b = tableau.a.tolist(), tableau.b.tolist()
    s = len(b)
    w: list[Array] = [None] * s
    mu: list[Array] = [None] * s
    times: list[Array] = [None] * s
    parameters: Array = 0.0
    # Last stage first: w_j needs mu_l of the stages that use K_j, those behind it. This discretizes (7) of the paper.
    for j in reversed(range(s)):
        later = combine([a[m][j] for m in range(j + 1, s)], mu[j + 1 :])
        w[j] = h * (_sum(b[j] * psi if b[j] else None, later))
        times[j], mu[j], in_p = pull(j, w[j], h * b[j])
        parameters = parameters + in_p
    return Adjoint(w, mu, psi + sum(mu[1:], mu[0]), times, parameters)


def length_factor(
    tableau: Tableau, psi: Array, mu: Sequence[Array], slopes: Sequence[Array], densities: Sequence[Array]
) -> Array:
    """Return V, the derivative of the cost to go in the length of a row at fixed times of its stages: ().

    V is linear in the slopes K_j (n,) and the densities ell_j (): with K_j' and ell_j' the result is its derivative.
    """
    total: Array = 0.0
    for j, b in enumerate(tableau.b.tolist()):
        # h stands in x+ and in the cost of the row, h b_j (K_j, ell_j), and in the states of the stages, h a_jl K_l.
        if b:
            total = total + b * ((psi * slopes[j]).sum() + densities[j])
        inside = combine(tableau.a[j], slopes)
        if inside is not None:
            total = total + (mu[j] * inside).sum()
    return total


class Judged(NamedTuple):
    """What `measure_jump` reads of a row.

    Attributes
    ----------
    first, middle, last : (n,), h times the slopes of three stages
    bend : (n,), a difference of high order of all of them
    times, states : (), (n,), from the first to the last stage
    f_t, f_x : (n,), (n, n), sum of those of the first and the last stage
    """

    first: Array
    middle: Array
    last: Array
    bend: Array
    times: Array
    states: Array
    f_t: Array
    f_x: Array


def measure_jump(h: Array, row: Judged, xp: Any) -> Array:
    """Return h times the jump of f inside a row, (n,); 0 where f seems smooth.

    Where f is smooth, a difference of high order of the slopes is small beside their range, and the derivatives at the
    first and the last stage explain how the slope changes. Where f jumps, neither holds. The state after such a row may
    be accurate, if it is short, but its derivatives have nothing of how the place of the jump moves.
    """
    change, bend = row.last - row.first, xp.abs(row.bend)
    rest = xp.abs(change - 0.5 * h * (times_vector(row.f_x, row.states) + row.f_t * row.times))
    # A jump is what neither the smoothness of f nor its derivatives explain: the smaller of bend and rest counts.
    span = xp.maximum(xp.abs(change), xp.abs(row.middle - row.first))
    least = LARGEST_BEND * span + SMALLEST_BEND * xp.abs(row.first)
    return xp.where(xp.less(least, xp.minimum(bend, rest)), bend, 0.0)


def invert_stages(tableau: Tableau) -> FloatArray:
    """Return the matrix that makes h times the slopes (s, n) of the states at the stages after the row's start (s, n).

    The states, minus that at the start, are those of all stages; of an explicit method, whose first stage is the start,
    those of the others, then that at the end of the row.
    """
    # X - x = a (h K); of an explicit method the first row of a is zero, and b, the row of x+, takes its place.
    return np.asarray(np.linalg.inv(tableau.a if tableau.coupled else np.vstack([tableau.a[1:], tableau.b])))


def times_derivative(tableau: Tableau, start_d: Array, end_d: Array) -> list[Array]:
    """Return the derivatives of the times of the stages, ``start' + c_j h'``: s entries ()."""
    h_d = end_d - start_d
    return [start_d + c * h_d for c in tableau.c.tolist()]


def combine(weights: Sequence[float] | FloatArray, terms: Sequence[Array] | FloatArray) -> Array | None:
    """Add terms with weights; terms of weight zero are skipped, and the sum of no terms is None.

    The terms may be one NumPy array, along its first axis.
    """
    if isinstance(terms, np.ndarray) and terms.dtype != object:
        return np.asarray(weights)[: len(terms)] @ terms
    given = weights.tolist() if isinstance(weights, np.ndarray) else weights
    parts = [w * term for w, term in zip(given, terms, strict=False) if w != 0.0]
    return sum(parts[1:], parts[0]) if parts else None


def times_vector(A: Array, v: Array) -> Array:
    """Return ``A v`` for small A (m, n) and v (n,) as products and a sum, without the overhead of a library call."""
    return (A * v[None]).sum(-1)


def _plus(x: Array, h: Array, slope: Array | None) -> Array:
    return x if slope is None else x + h * slope


def _sum(one: Array | None, other: Array | None) -> Array:
    if one is None or other is None:
        return other if one is None else one
    return one + other
