"""First-order conditions: the KKT residual and multipliers, and the steepest descent at kinks of the cost.

Along v, J changes at the rate J'(v) = Σ (g₊ max(v, 0) + g₋ min(v, 0)), with g₋ = g₊ off the kinks. A point is optimal
when no feasible v has J'(v) < 0, and the steepest descent −J'(v) over ‖v‖₂ <= 1 measures how far it is from that.

A kink is a coordinate on a breakpoint, with a left derivative g₋ and a right derivative g₊. To first order J is
separable there, so such a coordinate is held, or released to the side to which the steepest feasible direction moves
it. The multipliers of the quadratic programme say when a held coordinate is to be released because others move.

A side is +1 or -1 for a coordinate that moves, or may move, to the right or left, and 0 for one that is held.

References
----------
.. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, section 12.3 (first-order conditions).
.. [2] R. T. Rockafellar, R. J.-B. Wets, Variational Analysis, Springer 1998, chapters 8 and 10 (subderivatives and
   subgradients of what is not smooth).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product

import numpy as np

from switchfit.arrays import BoolArray, FloatArray, IntArray
from switchfit.optimize import algebra
from switchfit.optimize.least_distance import find_least_distance

#: All combinations of sides are compared for up to this many concave kinks that constraints couple.
MANY_CONCAVE_KINKS = 6


def kkt_residual(low: FloatArray, high: FloatArray, normals: FloatArray) -> tuple[float, FloatArray]:
    """Return the distance of the gradient from the cone of the active constraints, and the multipliers that attain it.

    min over lam >= 0 and low <= g <= high of ‖g − Nᵀ lam‖₂, where low = high except at coordinates held at a kink. It
    is zero where the first-order conditions hold ([1]_, theorem 12.1), with the interval for the subgradients at a
    kink ([2]_).

    Parameters
    ----------
    low, high : array, shape (d,)
        The interval of one-sided derivatives.
    normals : array, shape (k, d)
        Inward normals N of the active constraints.

    Returns
    -------
    residual : float
    multipliers : array, shape (k,)
    """
    if normals.shape[0] == 0:
        # Without constraints each coordinate is by itself; `low is high`, the usual case, needs no clipping.
        nearest = low if low is high else np.clip(0.0, low, high)
        return math.sqrt(nearest.dot(nearest)), np.zeros(0)
    size = float(max(np.max(np.abs(low), initial=0.0), np.max(np.abs(high), initial=0.0)))
    if size == 0.0:
        return 0.0, np.zeros(normals.shape[0])
    # The steepest descent v = N' lam - g minimizes g v + v² / 2 subject to N v >= 0. At kinks, where g v is
    # max(low v, high v), it has two parts, v = v₊ - v₋: of both being positive the cost is larger than of one.
    # Scaled to 1 by the largest derivative: daqp's tolerances are absolute.
    unit, lengths = algebra.unit_rows(normals)
    low, high, slope, rows = low / size, high / size, high / size, unit
    if (low < high).any():
        slope, rows = np.concatenate([high, -low]), np.vstack([np.hstack([unit, -unit]), np.eye(2 * low.size)])
    found = find_least_distance(slope, rows, np.zeros(len(rows)), np.full(len(rows), np.inf))
    multipliers = np.zeros(len(unit)) if found is None else np.maximum(found[1][: len(unit)], 0.0)
    pull = unit.T @ multipliers
    return size * algebra.norm(np.clip(pull, low, high) - pull), size * multipliers / lengths


def steepest_descent(
    left: FloatArray, right: FloatArray, kink: BoolArray | None, side: IntArray, normals: FloatArray
) -> tuple[float, FloatArray, IntArray]:
    """Return the steepest descent over feasible directions of length one, its multipliers, and each coordinate's side.

    At a convex kink, g₋ <= g₊, the rate of change is the maximum of g v over [g₋, g₊], at a concave one the minimum of
    g₋ v and g₊ v. With one of the two chosen for every concave kink J' is thus convex and its steepest descent is the
    KKT residual; that of J' itself is the largest over the choices.

    Parameters
    ----------
    left, right : array, shape (d,)
        One-sided derivatives; the same object where there is only one of them.
    kink : array of bool, shape (d,), or None
        Coordinates at a kink; None if there are none.
    side : array of int, shape (d,)
        The only side there is of other coordinates on a breakpoint, 0 elsewhere.
    normals : array, shape (k, d)
        Of the active constraints.

    Returns
    -------
    residual : float
    multipliers : array, shape (k,)
    sides : array of int, shape (d,)
    """
    # Off all breakpoints, as at most points.
    if left is right:
        return *kkt_residual(right, right, normals), side
    kink = np.zeros(left.size, dtype=bool) if kink is None else kink
    alone = algebra.choose_sides(left, right)
    convex = kink & (left < right)
    best, force, rounding = -np.inf, np.inf, 1e-12 * float(np.abs(left).sum() + np.abs(right).sum())
    for sides in _choices(np.where(kink, alone, side), kink & (left > right), normals):
        gradient = np.where(sides > 0, right, left)
        low, high = np.where(convex, left, gradient), np.where(convex, right, gradient)
        residual, values = kkt_residual(low, high, normals)
        # Where a constraint blocks the steeper side of a concave kink, both leave the same residual, up to rounding:
        # the smaller multipliers are those of the side to which the coordinate can move.
        if residual > best + rounding or (residual > best - rounding and values.sum() < force - rounding):
            best, multipliers, force = residual, values, float(values.sum())
            pull = normals.T @ values
            steepest = pull - np.clip(pull, low, high)
            moving = kink & (np.abs(steepest) > 1e-12 * (np.abs(left) + np.abs(right)))
            downhill = np.where(moving, np.where(steepest > 0.0, 1, -1), sides)
    return best, multipliers, downhill


def _choices(sides: IntArray, concave: BoolArray, normals: FloatArray) -> Iterator[IntArray]:
    """Yield the given sides, then others for the concave kinks: a constraint may make a less steep side the better one.

    All to the right and all to the left suffice to find a descent where constraints keep coordinates in order: the
    extreme directions move a group of them, all to one side.
    """
    yield sides
    # At a concave kink J falls to both sides. The rate J' is not convex then, and a descent may exist for one
    # combination of sides alone: two times in order, one of which would go right and the other left, are blocked by
    # their order, and descend together to the right.
    coupled = np.flatnonzero(concave & np.any(normals != 0.0, axis=0))
    few = coupled.size <= MANY_CONCAVE_KINKS
    for choice in product((1, -1), repeat=coupled.size) if few else [(1,), (-1,)]:
        changed = sides.copy()
        changed[coupled] = choice
        if not np.array_equal(changed, sides):
            yield changed
