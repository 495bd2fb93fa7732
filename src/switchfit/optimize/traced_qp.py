"""Quadratic programmes for the SQP that JAX traces: the search direction, and the KKT residual.

Three things are written anew, since a traced program has arrays of fixed shapes and does not stop early for one fit of
many: nonnegative least squares with masks in place of index sets (`nonnegative_minimum`), the quadratic programme by
its dual, with all rows in place of those that matter, and a Hessian that is made positive definite as a whole, not on
the face of the active constraints.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax

from switchfit.arrays import Traced
from switchfit.optimize import algebra
from switchfit.optimize.traced_constraints import TracedBreakpoints, TracedConstraints, find_active
from switchfit.optimize.traced_state import TracedState

DUAL_RIDGE = 1e-14
"""Added to the diagonal of the dual programme, whose rows are of unit length: constraints may depend on one another."""


def hold_coordinates(held: Traced, hessian: Traced) -> Traced:
    """Return the Hessian (d, d) with rows and columns of the identity for coordinates that are held."""
    either = held[:, None] | held[None]
    return jnp.where(either, jnp.eye(held.shape[0]), hessian)


def measure_kkt_residual(constraints: TracedConstraints, theta: Traced, scale: Traced, gradient: Traced) -> Traced:
    """Return min over lam >= 0, on the active constraints, of ‖g − Nᵀ lam‖."""
    active = find_active(constraints, theta, scale)

    def solve_constrained() -> Traced:
        # ||g - N' lam||^2 / 2 is lam' N N' lam / 2 - (N g)' lam up to a constant. The gradient is scaled to 1, since
        # `nonnegative_minimum` compares slopes with an absolute floor.
        normals, _ = algebra.unit_rows(constraints.normals, jnp)
        size = jnp.maximum(jnp.max(jnp.abs(gradient)), jnp.finfo(float).tiny)
        multipliers = nonnegative_minimum(normals @ normals.T, -normals @ (gradient / size), active)
        return jnp.linalg.norm(gradient - size * multipliers @ normals)

    return lax.cond(jnp.any(active), solve_constrained, lambda: jnp.linalg.norm(gradient))


def nonnegative_minimum(matrix: Traced, vector: Traced, allowed: Traced) -> Traced:
    """Minimize ½ lamᵀ M lam + vᵀ lam over lam >= 0 with zeros outside `allowed`: (k,).

    Lawson and Hanson's active-set method with masks in place of index sets: the set of positive entries grows by the
    steepest one and loses those that a step would make negative.

    Parameters
    ----------
    matrix : (k, k), positive semi-definite with unit diagonal
    vector : (k,)
    allowed : (k,) bool
    """
    k = vector.shape[0]
    index = jnp.arange(k)
    vector = jnp.where(allowed, vector, 0.0)
    # Optimal: M lam + v >= 0 where lam = 0, and = 0 where lam > 0. Slopes above the floor are rounding.
    floor = -1e-13 * jnp.maximum(1.0, jnp.max(jnp.abs(vector), initial=0.0))

    # M_PP lam_P = -v_P on the positive set P, all other rows being those of the identity: one shape for every set.
    def solve_on(positive: Traced) -> Traced:
        both = positive[:, None] & positive[None, :]
        diagonal = jnp.where(positive, DUAL_RIDGE, 1.0)
        return jnp.linalg.solve(jnp.where(both, matrix, 0.0) + jnp.diag(diagonal), jnp.where(positive, -vector, 0.0))

    def body(state: tuple[Traced, Traced, Traced, Traced]) -> tuple[Traced, Traced, Traced, Traced]:
        lam, positive, count, _ = state
        target = solve_on(positive)
        # As far towards the minimum on P as lam stays nonnegative; what reaches zero first leaves P.
        leaving = positive & (target <= 0.0)
        ratio = jnp.where(leaving, lam / jnp.where(leaving, lam - target, 1.0), jnp.inf)
        length = jnp.minimum(jnp.min(ratio, initial=jnp.inf), 1.0)
        lam = jnp.where(positive, lam + length * (target - lam), 0.0)
        # At the minimum on P: the steepest of the others enters. It may enter only if nothing has just left.
        slope = jnp.where(allowed & ~positive, vector + matrix @ lam, jnp.inf)
        entering = jnp.argmin(slope)
        shrunk = positive & ~(leaving & (ratio <= length))
        grown = positive | ((index == entering) & (slope[entering] < floor))
        positive = jnp.where(jnp.any(leaving), shrunk, grown)
        finished = ~jnp.any(leaving) & ~(slope[entering] < floor)
        return jnp.where(positive, jnp.maximum(lam, 0.0), 0.0), positive, count + 1, finished

    # The bound on the iterations ends cycles that rounding makes; the multipliers are nonnegative at any iteration.
    start = jnp.zeros(k), jnp.zeros(k, bool), jnp.zeros((), int), jnp.zeros((), bool)
    return lax.while_loop(lambda state: ~state[3] & (state[2] < 3 * k + 10), body, start)[0]


def compute_scaling(hessian: Traced, floor: Traced) -> Traced:
    """Scale as `switchfit.optimize.symmetric_matrix.diagonal_scaling` does: (d,)."""
    size = jnp.abs(hessian)

    def equilibrate(state: tuple[Traced, Traced, Traced]) -> tuple[Traced, Traced, Traced]:
        rounds, scaling, largest = state
        grown = algebra.equilibrate(scaling, largest, jnp)
        return rounds + 1, grown, find_largest(grown)

    def find_largest(scaling: Traced) -> Traced:
        return jnp.max(size / jnp.outer(scaling, scaling), axis=1)

    def go_on(state: tuple[Traced, Traced, Traced]) -> Traced:
        return (state[0] < algebra.EQUILIBRATIONS) & jnp.any(state[2] > algebra.EQUILIBRATED)

    # Rounds as in `diagonal_scaling`; a positive definite matrix needs none of them.
    start = algebra.jacobi_scaling(jnp.maximum(jnp.diagonal(size), floor), jnp.max(size, axis=1), jnp)
    return lax.while_loop(go_on, equilibrate, (jnp.zeros((), int), start, find_largest(start)))[1]


def find_traced_direction(
    state: TracedState, constraints: TracedConstraints, breakpoints: TracedBreakpoints
) -> tuple[Traced, Traced]:
    """Return the step (d,) of the quadratic programme, with kinks held or confined to one side, and its slope gᵀd."""
    point, theta, sides = state.point, state.point.theta, state.point.sides
    # The Hessian of the piece that the sides lead into; entries between one coordinate on its left and another on its
    # right are those of no piece that was evaluated, and the mean stands for them.
    pair, gradient = sides[:, None] + sides[None], point.gradient
    hessian = hold_coordinates(sides == 0, algebra.mix_sides(point.right.hessian, point.left.hessian, pair, jnp))
    # B = D S D, with S of unit diagonal, so that eigenvalues of S are compared with numbers that have no unit.
    narrowed = breakpoints.piece(theta, constraints)
    lower = jnp.where(state.inside, narrowed[0], constraints.lower)
    upper = jnp.where(state.inside, narrowed[1], constraints.upper)
    floor = algebra.curvature_floor(state.scale, state.cost_scale, point.slopes, jnp)
    scaling = compute_scaling(hessian, floor)
    scaled = hessian / jnp.outer(scaling, scaling)
    identity = jnp.eye(theta.shape[0])
    # Cholesky of S - floor I exists if and only if all eigenvalues are above the floor; JAX returns NaN where it does
    # not.
    definite = jnp.all(jnp.isfinite(jnp.linalg.cholesky(scaled - algebra.EIGENVALUE_FLOOR * identity)))

    # |S| = V |Lambda| V': a step that descends along negative curvature, as long as it would be along positive.
    def absolute() -> Traced:
        values, vectors = jnp.linalg.eigh(scaled)
        return (vectors * algebra.positive_eigenvalues(values, jnp)[None]) @ vectors.T

    matrix = lax.cond(definite, lambda: scaled, absolute)
    factor = jnp.linalg.cholesky(matrix)
    # What a kink holds or confines is bounded by zero on the other side. All bounds c are <= 0: d = 0 is feasible.
    low = jnp.where(point.kink & (sides >= 0), 0.0, jnp.minimum(lower - theta, 0.0))
    high = jnp.where(point.kink & (sides <= 0), 0.0, jnp.maximum(upper - theta, 0.0))
    slack = jnp.maximum(constraints.A @ theta - constraints.b, 0.0)
    offsets = jnp.concatenate([-slack, low, -high])

    def solve(right: Traced) -> Traced:
        return jax.scipy.linalg.cho_solve((factor, True), right / scaling) / scaling

    newton = -solve(gradient)
    # Refined once: the residual is computed with B itself, not with its factor.
    newton = newton - solve(gradient + scaling * (matrix @ (scaling * newton)))

    def solve_constrained() -> Traced:
        # In white variables e = Lᵀ D d: minimize ½‖e − e_0‖² subject to G e >= c with unit rows, by its dual.
        normals = constraints.normals
        rows = jax.scipy.linalg.solve_triangular(factor, (normals / scaling[None]).T, lower=True).T
        unit, norms = algebra.unit_rows(rows, jnp)
        # With lam the multipliers of the unit rows, e = e_0 + G' lam, and the dual is to minimize lam' G G' lam / 2 +
        # (G e_0 - c)' lam over lam >= 0. `length` makes its vector of the order 1, and lam is in its units.
        gap = (normals @ newton - offsets) / norms
        allowed = jnp.isfinite(gap)
        length = jnp.maximum(jnp.max(jnp.where(allowed, jnp.abs(gap), 0.0)), jnp.finfo(float).tiny)
        multipliers = nonnegative_minimum(unit @ unit.T, jnp.where(allowed, gap / length, 0.0), allowed)
        back = jax.scipy.linalg.solve_triangular(factor, length * multipliers @ unit, lower=True, trans=1)
        # Exactly on each bound that has a multiplier: kinks depend on it.
        at_low, at_high = jnp.split(multipliers[-2 * theta.size :] > 0.0, 2)
        step = jnp.where(at_low, low, jnp.where(at_high, high, newton + back / scaling))
        return jnp.clip(step, low, high)

    feasible = jnp.all(constraints.normals @ newton >= offsets)
    step = lax.cond(feasible, lambda: newton, solve_constrained)
    return step, gradient @ step
