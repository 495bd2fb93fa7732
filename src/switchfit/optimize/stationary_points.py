"""Stationary points: close constraints that nearly hold, and leave saddles along negative curvature.

A collapsed mode whose duration is an ulp above 0 would count as free, with the curvature of J in its duration; and a
KKT point with negative free curvature is no minimum. The SQP comes here before it ends.

References
----------
.. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, section 12.5 (second-order conditions).
"""

from __future__ import annotations

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.optimize import algebra, merit, search_direction
from switchfit.optimize.feasibility import Trial, move, snap_to_rows
from switchfit.optimize.oracle import Oracle
from switchfit.optimize.point import MET
from switchfit.optimize.state import Accepted, State

#: Eigenvalues of the scaled Hessian below this are negative curvature, not rounding.
NEGATIVE_CURVATURE = -1e-8


def close_gaps(oracle: Oracle, state: State) -> State:
    """Return the state with the rows that it misses by less than it is accurate to made to hold, if it stays as good.

    A mode that lasts a part of 1e-13 of the horizon has collapsed. Taken for one that has not, its two ends would be
    free, and the curvature along them, which is that of J in its duration, may be negative. Where the data are met
    exactly, J is so curved in the duration that the optimality of the closed point exceeds the tolerance: it is as good
    all the same if a step from there is negligible.
    """
    problem, point = oracle.problem, state.point
    # A gap of 1e-10 of the horizon: below what the optimizer calls negligible, and far above rounding.
    theta = snap_to_rows(problem, point.theta, np.zeros(point.theta.size, dtype=bool), algebra.NEGLIGIBLE_STEP)
    if np.array_equal(theta, point.theta):
        return state
    closed = oracle.point(Trial.at(problem, theta), state.scale)
    if closed is None or closed.cost > point.cost + algebra.COST_NOISE * state.cost_scale or closed.violation > MET:
        return state
    after = state.advance(Accepted(closed, 1.0), problem.tolerance)
    if closed.optimality <= max(problem.tolerance, point.optimality):
        return after
    if closed.idle is None:
        return state
    ahead = search_direction.find_direction(problem, after).step
    return after if algebra.is_negligible(ahead, np.maximum(state.scale, problem.size)) else state


def escape(oracle: Oracle, state: State) -> Accepted | None:
    """Return a step along negative curvature: on the face of the pressing constraints, then of all active ones."""
    problem = oracle.problem
    # Second-order conditions hold on the critical cone, along which constraints with a force stay active ([1]_).
    pressing = np.flatnonzero(state.point.multipliers > max(problem.tolerance, 1e-10 * state.gradient_scale))
    active = state.point.active
    # A constraint without force may be left along negative curvature: only pressing ones confine the ray at first.
    for rows in (pressing,) if np.array_equal(pressing, active) else (pressing, active):
        curvature = state.curvature_at(problem, rows)
        if not curvature.spectrum.smallest < NEGATIVE_CURVATURE:
            continue
        # To second order J falls alike to both sides; farther on one of them may lead out of the saddle alone.
        for ray in (curvature.spectrum.lowest, -curvature.spectrum.lowest):
            accepted = _descend_along(oracle, state, ray)
            if accepted is not None:
                return accepted
    return None


def _descend_along(oracle: Oracle, state: State, ray: FloatArray) -> Accepted | None:
    """Backtrack on the quadratic decrease ½ t² rayᵀH ray, starting at a tenth of the size of the unknowns."""
    problem, point = oracle.problem, state.point
    _, hessian = point.derivatives(point.reported_sides)
    bending = float(ray @ hessian.dot(ray))
    sized = state.scale > 0.0
    relative = float(np.max(np.abs(ray[sized]) / state.scale[sized], initial=0.0))
    # How far negative curvature reaches is not known: a tenth of the unknowns' size is long enough to leave a saddle
    # for good, and is halved where J rises.
    length = 0.1 / relative if relative > 0.0 else 0.1 / float(np.max(np.abs(ray)))
    # No further than the first inactive constraint that the ray approaches.
    normals = problem.constraints.normals
    slope = normals @ ray
    slack = np.maximum(point.slack, 0.0)
    slack[point.active] = 0.0
    approaching = slope < -1e-12 * np.linalg.norm(normals, axis=1)
    length = min(length, float(np.min(slack[approaching] / -slope[approaching], initial=np.inf)))
    for _ in range(40):
        decrease = -0.5 * bending * length**2
        if decrease <= algebra.COST_NOISE * abs(point.cost) or length == 0.0:
            return None
        there = move(problem, point.theta, length * ray, state.scale)
        first = oracle.first(there)
        if first is not None and problem.equalities:
            # The ray is tangential to the equality constraints, which bend.
            moved = merit.correct(oracle, there, first, state.scale)
            there, first = (there, first) if moved is None else (moved, oracle.first(moved))
        enough = merit.measure_merit(point.plus, state) - algebra.ARMIJO * decrease
        if first is not None and merit.measure_merit(first, state) < enough:
            trial = oracle.complete(there, first, state.scale)
            if trial is not None:
                return Accepted(trial, length)
        length *= 0.5
    return None
