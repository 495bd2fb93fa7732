"""Elimination of the other unknowns (o) from J, by a Newton step inside their bounds: the Schur complement.

    J_p = J − ½ g_o' H_oo⁻¹ g_o,   s = g_k − H_ko H_oo⁻¹ g_o,   c = H_kk − H_ko H_oo⁻¹ H_ok

are the value, the slope and the curvature of the profile of J over unknown k; the others follow it by -H_oo⁻¹ H_ok.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.uncertainty.walks import Derivatives, Walks

CONCAVE = 1e-9
"""Curvature, scaled by those of the unknowns alone, below minus which J has no minimum in the others."""


class Eliminated(NamedTuple):
    """The profiles of n ways where they are: slope and curvature in the transition time (n,); the step of the others at
    once and how they follow by length, outwards, (n, d); by how much the step lowers J; how far it is until another
    unknown meets a bound or leaves it; and whether J has no minimum in the others: (n,).
    """

    slope: FloatArray
    curvature: FloatArray
    step: FloatArray
    follow: FloatArray
    decrement: FloatArray
    meets: FloatArray
    concave: NDArray[np.bool_]


def eliminate_inside(at: Derivatives, own: Walks, theta: FloatArray, part: FloatArray, stop: FloatArray) -> Eliminated:
    """Eliminate the other unknowns (n, d) inside their bounds, by a part (n,) of a Newton step.

    One that the step leads out of its bounds, or that would leave one before its way is at its stop (n,), is put at the
    bound, in the quadratic model of J, and held. Where J has no minimum, negative curvatures change their signs.
    """
    g = at.gradient
    each, inside = np.arange(len(g)), (theta > own.lower) & (theta < own.upper)
    free, step = own.free & (inside | at.hessian.any(axis=2)), np.zeros_like(g)
    # How far the transition time moves until its stop: what would leave its bound on the way there is held.
    length = (stop - theta[each, own.place])[:, None]
    while True:
        both = free[:, :, None] & free[:, None, :]
        size = np.sqrt(np.abs(np.diagonal(at.hessian, axis1=1, axis2=2)))
        size = np.where(free & (size > 0), size, 1.0)
        scale = size[:, :, None] * size[:, None, :]
        scaled, H, concave = np.where(both, at.hessian / scale, np.eye(g.shape[1])), at.hessian, np.zeros(len(g), bool)
        try:
            np.linalg.cholesky(scaled)  # in a tenth of the time, where all have a minimum
        except np.linalg.LinAlgError:
            values, vectors = np.linalg.eigh(scaled)
            concave = values[:, 0] < -CONCAVE
            # H with its negative eigenvalues turned round, as the optimizer does: the Newton step leads downhill, and
            # not to the saddle.
            turned = (np.abs(values)[:, None, :] * vectors) @ vectors.transpose(0, 2, 1) * scale
            H = np.where(concave[:, None, None] & both, turned, H)
        curvature, newton, follow = eliminate_others(g + _multiply(H, step), H, own.place, free)
        there, leaves = theta + step - newton, newton + follow * length
        low = free & ((there < own.lower) | ((theta <= own.lower) & (leaves > 0)))
        high = free & ((there > own.upper) | ((theta >= own.upper) & (leaves < 0)))
        to_bound = np.where(low, own.lower, own.upper) - theta
        # That which meets its bound first, as the others may turn round then.
        with np.errstate(divide="ignore", invalid="ignore"):
            reached = np.where(low | high, np.nan_to_num(np.abs(to_bound / (there - theta))), np.inf)
        first = np.argmin(reached, axis=1)
        out = np.flatnonzero((low | high).any(axis=1))
        if not out.size:
            break
        step[out, first[out]] = to_bound[out, first[out]]
        free[out, first[out]] = False
    step, follow = part[:, None] * (step - newton), -follow * own.side[:, None]
    # The slope of J in an unknown that is held, and how it changes: it leaves its bound where that is 0.
    slope, column = g + _multiply(H, step), H[each, own.place]
    change = column * own.side[:, None] + _multiply(H, follow)
    after = theta + step
    with np.errstate(divide="ignore", over="ignore", invalid="ignore"):  # what hardly changes has all room
        room = np.where(follow > 0, own.upper - after, after - own.lower) / np.abs(follow)
        room = np.where(free, room, -slope / change)
    meets = np.fmin.reduce(room, axis=1, where=own.free & (room > 0), initial=np.inf)
    # J(theta + s) = J + g's + s'H s / 2 falls by -(g + g_after)'s / 2, with the slope g_after = g + H s.
    decrement = -0.5 * np.sum(step * (g + slope), axis=1)
    return Eliminated(slope[each, own.place], curvature, step, follow, decrement, meets, concave)


def _multiply(matrices: FloatArray, vectors: FloatArray) -> FloatArray:
    """Return the products of matrices (n, d, d) and vectors (n, d)."""
    return np.asarray((matrices @ vectors[:, :, None])[:, :, 0])


def eliminate_others(
    g: FloatArray, H: FloatArray, place: NDArray[np.intp], free: NDArray[np.bool_]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the curvatures H_kk - H_ko H_oo^-1 H_ok of profiles (n,), the Newton steps H_oo^-1 g_o, and how the others
    follow, H_oo^-1 H_ok, (n, d), from gradients (n, d) and Hessians (n, d, d). NaN where H_oo is singular.
    """
    each = np.arange(len(g))
    column = H[each, :, place]
    rest = np.stack([np.where(free, g, 0.0), np.where(free, column, 0.0)], axis=2)
    # Rows and columns of the identity for what is held: its solution is zero.
    both = free[:, :, None] & free[:, None, :]
    solved = _solve_each(np.where(both, H, np.eye(g.shape[1])), rest)
    newton, follow = solved[:, :, 0], solved[:, :, 1]
    return H[each, place, place] - np.sum(column * follow, axis=1), newton, follow


def _solve_each(matrices: FloatArray, right: FloatArray) -> FloatArray:
    """Return the solutions (n, d, 2) of n systems, NaN of those that are singular."""
    try:
        return np.asarray(np.linalg.solve(matrices, right))
    except np.linalg.LinAlgError:  # of one of them; nothing is returned of the others
        if len(matrices) == 1:
            return np.full_like(right, np.nan)
        return np.concatenate([_solve_each(matrices[k : k + 1], right[k : k + 1]) for k in range(len(matrices))])
