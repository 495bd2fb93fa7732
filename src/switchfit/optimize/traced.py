"""The SQP as one function that JAX can trace, for thousands of fits at once.

It takes the steps of `switchfit.optimize.sqp` wherever these are of the ordinary kind: Newton steps on the exact
Hessian, made positive definite by the absolute values of its eigenvalues, a quadratic programme where constraints are
in the way, and Armijo backtracking with the same constants. What is rare it leaves alone: a coordinate held at a kink,
the escape from a saddle, a face on which the Hessian is indefinite; where it makes no headway it stops.
`Outcome.settled` is True only for a regular minimum, an interior point with a positive definite Hessian and a
negligible next step; everything else is to be finished by `minimize`, from `Outcome.theta` on.

Every function here is for one fit; `jax.lax.map` or `jax.vmap` make many of it. The loop evaluates J once a turn, at
the point that is to be judged: fits in lockstep then never wait for another one's line search, and the program, which
consists of little else than J, is compiled once.

The formulas are those of `switchfit.optimize.algebra`. Three things are written anew, since a traced program has arrays
of fixed shapes and does not stop early for one fit of many: nonnegative least squares with masks in place of index sets
(`nonnegative_minimum`), the quadratic programme by its dual, with all rows in place of those that matter, and a Hessian
that is made positive definite as a whole, not on the face of the active constraints.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from switchfit.optimize import algebra
from switchfit.optimize.algebra import (
    ARMIJO,
    ARMIJO_ACROSS,
    EIGENVALUE_FLOOR,
    EQUILIBRATIONS,
    EXTRA_ITERATIONS,
    NOISE,
)

Array = jax.Array

MAX_TRIALS = 30
"""Fractions of a step that are tried."""

CRAWLING = (12, 1)
"""A fit that has refused more fractions of steps than this, plus this many an iteration, has met a kink and is left to
`minimize`. Fits that settle refuse a dozen at most; at a kink they would go on by hundreds, to no end."""

RIDGE = 1e-14
"""Added to the diagonal of the dual programme, whose rows are of unit length: constraints may depend on one another."""

TracedEvaluate = Callable[[Array], tuple[Array, Array, Array]]
"""``evaluate(theta)`` returns cost, gradient (d,) and Hessian (d, d)."""


class Constraints(NamedTuple):
    """``A theta >= b`` and bounds, infinite where there is none: (m, d), (m,), (d,), (d,).

    `size` (d,) is the typical size of each unknown, of which rounding is a part, as of `minimize`.
    """

    A: Array
    b: Array
    lower: Array
    upper: Array
    size: Array | float = 0.0

    def slack(self, theta: Array) -> Array:
        """Of rows, lower and upper bounds: (m + 2 d,)."""
        return algebra.slack(self, theta, jnp)

    @property
    def normals(self) -> Array:
        """Inward normals in the same order: (m + 2 d, d)."""
        identity = jnp.eye(self.lower.shape[0])
        return jnp.concatenate([self.A, identity, -identity])


class Outcome(NamedTuple):
    """Where one fit ended.

    Attributes
    ----------
    theta, cost, gradient, hessian : (d,), (), (d,), (d, d)
    optimality : ()
        KKT residual.
    iterations, evaluations : () int
    settled : () bool
        Whether this is a regular minimum; if not, `minimize` has to go on from here.
    """

    theta: Array
    cost: Array
    gradient: Array
    hessian: Array
    optimality: Array
    iterations: Array
    evaluations: Array
    settled: Array


class State(NamedTuple):
    """The point that was accepted last, the step tried from it, and what has been seen."""

    theta: Array
    cost: Array
    gradient: Array
    hessian: Array
    optimality: Array
    iterations: Array
    evaluations: Array
    step: Array
    slope: Array
    length: Array  # fraction of the step that is to be judged next
    trials: Array  # of this step, so far
    below: Array  # iterations since the optimality fell below the tolerance
    scale: Array  # largest |theta_i| seen
    cost_scale: Array  # largest |J| seen
    lowest: Array
    done: Array
    stationary: Array  # the optimality is below the tolerance and the next step negligible


def minimize_traced(
    evaluate: TracedEvaluate,
    start: Array,
    constraints: Constraints,
    piece: Callable[[Array], Array],
    *,
    tolerance: float,
    max_iterations: int,
) -> Outcome:
    """Minimise J subject to linear constraints from a feasible start, inside a JAX program.

    Parameters
    ----------
    evaluate : callable
        ``evaluate(theta)`` returns cost, gradient (d,) and Hessian (d, d).
    start : (d,)
    constraints : Constraints
    piece : callable
        ``piece(theta)`` returns integers that change where a coordinate passes a breakpoint of J's derivatives.
    tolerance, max_iterations : as of `minimize`

    Returns
    -------
    Outcome
    """

    def turn(state: State) -> State:
        return take_turn(state, evaluate, constraints, piece, tolerance=tolerance, max_iterations=max_iterations)

    return outcome_of(lax.while_loop(lambda state: ~state.done, turn, begin(start)), constraints)


def take_turn(
    state: State,
    evaluate: TracedEvaluate,
    constraints: Constraints,
    piece: Callable[[Array], Array],
    *,
    tolerance: float,
    max_iterations: int,
) -> State:
    """Evaluate J once, at the point that is to be judged, and judge it; arguments as of `minimize_traced`."""

    def accept(state: State, cost: Array, gradient: Array, hessian: Array, theta: Array, optimality: Array) -> State:
        first = state.evaluations == 1
        below = jnp.where(first | (optimality > tolerance), 0, state.below + 1)
        moved = state._replace(
            theta=theta,
            cost=cost,
            gradient=gradient,
            hessian=hessian,
            optimality=optimality,
            iterations=jnp.where(first, 0, state.iterations + 1),
            length=jnp.ones(()),
            trials=jnp.zeros((), int),
            below=below,
            scale=jnp.maximum(state.scale, jnp.abs(theta)),
            cost_scale=jnp.maximum(state.cost_scale, jnp.abs(cost)),
            lowest=jnp.minimum(state.lowest, cost),
        )
        step, slope = _direction(moved, constraints)
        negligible = algebra.is_negligible(step, moved.scale, jnp)
        stationary = (optimality <= tolerance) & (negligible | (below >= EXTRA_ITERATIONS))
        done = stationary | (moved.iterations >= max_iterations)
        return moved._replace(step=step, slope=slope, stationary=stationary, done=done)

    def refuse(state: State, *_: Array) -> State:
        trials = state.trials + 1
        length = state.length * jnp.where(trials <= 5, 0.5, 0.25)
        unsaid = state.length * -state.slope <= NOISE * jnp.abs(state.cost)
        hopeless = unsaid | (trials >= MAX_TRIALS)
        # A search that finds nothing below the tolerance has met rounding: that too is the end.
        stationary = hopeless & (state.optimality <= tolerance)
        refused = state.evaluations - state.iterations - 1
        crawling = refused > CRAWLING[0] + CRAWLING[1] * state.iterations
        return state._replace(length=length, trials=trials, done=hopeless | crawling, stationary=stationary)

    def judged(state: State) -> State:
        theta = _moved(constraints, state.theta, state.length * state.step)
        cost, gradient, hessian = evaluate(theta)
        hessian = 0.5 * (hessian + hessian.T)
        optimality = _kkt_residual(constraints, theta, state.scale, gradient)
        noise = NOISE * jnp.abs(state.cost)
        decrease = -state.length * state.slope
        fraction = jnp.where(jnp.any(piece(theta) != piece(state.theta)), ARMIJO_ACROSS, ARMIJO)
        lower = (
            algebra.cost_allows(cost, state.cost, state.lowest, decrease, noise, fraction)
            & algebra.optimality_allows(optimality, state.optimality, cost, state.lowest, decrease, noise)
            & jnp.any(theta != state.theta)
        )
        finite = jnp.isfinite(cost) & jnp.all(jnp.isfinite(gradient)) & jnp.all(jnp.isfinite(hessian))
        first = state.evaluations == 0
        state = state._replace(evaluations=state.evaluations + 1)
        after = lax.cond(finite & (first | lower), accept, refuse, state, cost, gradient, hessian, theta, optimality)
        return after._replace(done=after.done | (first & ~finite))

    return judged(state)


def outcome_of(state: State, constraints: Constraints) -> Outcome:
    """Return what was found where a fit is done."""
    interior = ~jnp.any(_active(constraints, state.theta, state.scale))
    scaling = _scaling(state.hessian, algebra.flatness(state.scale, state.cost_scale, jnp))
    smallest = jnp.linalg.eigvalsh(jnp.nan_to_num(state.hessian / jnp.outer(scaling, scaling)))[0]
    settled = state.stationary & interior & (smallest > EIGENVALUE_FLOOR)
    return Outcome(*state[:7], settled)


def begin(start: Array) -> State:
    """The state before the first evaluation, which is accepted whatever it gives, if it is finite."""
    d = start.shape[0]
    infinite, none = jnp.full((), jnp.inf), jnp.zeros((), int)
    return State(
        theta=start,
        cost=infinite,
        gradient=jnp.full(d, jnp.nan),
        hessian=jnp.full((d, d), jnp.nan),
        optimality=infinite,
        iterations=none,
        evaluations=none,
        step=jnp.zeros(d),
        slope=jnp.zeros(()),
        length=jnp.ones(()),
        trials=none,
        below=none,
        scale=jnp.abs(start),
        cost_scale=jnp.zeros(()),
        lowest=infinite,
        done=jnp.zeros((), bool),
        stationary=jnp.zeros((), bool),
    )


def _active(constraints: Constraints, theta: Array, scale: Array) -> Array:
    """Which constraints hold with equality up to rounding: (m + 2 d,) bool."""
    size = jnp.maximum(jnp.maximum(scale, constraints.size), jnp.abs(theta))
    return algebra.is_active(constraints.slack(theta), size, jnp.abs(constraints.A), jnp.abs(constraints.b), jnp)


def _kkt_residual(constraints: Constraints, theta: Array, scale: Array, gradient: Array) -> Array:
    """min over lam >= 0, on the active constraints, of ‖g − Nᵀ lam‖."""
    active = _active(constraints, theta, scale)

    def constrained() -> Array:
        normals, _ = algebra.unit_rows(constraints.normals, jnp)
        size = jnp.maximum(jnp.max(jnp.abs(gradient)), jnp.finfo(float).tiny)
        multipliers = nonnegative_minimum(normals @ normals.T, -normals @ (gradient / size), active)
        return jnp.linalg.norm(gradient - size * multipliers @ normals)

    return lax.cond(jnp.any(active), constrained, lambda: jnp.linalg.norm(gradient))


def nonnegative_minimum(matrix: Array, vector: Array, allowed: Array) -> Array:
    """Minimise ½ lamᵀ M lam + vᵀ lam over lam >= 0 with zeros outside `allowed`: (k,).

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
    floor = -1e-13 * jnp.maximum(1.0, jnp.max(jnp.abs(vector), initial=0.0))

    def solved(positive: Array) -> Array:
        both = positive[:, None] & positive[None, :]
        diagonal = jnp.where(positive, RIDGE, 1.0)
        return jnp.linalg.solve(jnp.where(both, matrix, 0.0) + jnp.diag(diagonal), jnp.where(positive, -vector, 0.0))

    def body(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        lam, positive, count, _ = state
        target = solved(positive)
        leaving = positive & (target <= 0.0)
        ratio = jnp.where(leaving, lam / jnp.where(leaving, lam - target, 1.0), jnp.inf)
        length = jnp.minimum(jnp.min(ratio, initial=jnp.inf), 1.0)
        lam = jnp.where(positive, lam + length * (target - lam), 0.0)
        slope = jnp.where(allowed & ~positive, vector + matrix @ lam, jnp.inf)
        entering = jnp.argmin(slope)
        shrunk = positive & ~(leaving & (ratio <= length))
        grown = positive | ((index == entering) & (slope[entering] < floor))
        positive = jnp.where(jnp.any(leaving), shrunk, grown)
        finished = ~jnp.any(leaving) & ~(slope[entering] < floor)
        return jnp.where(positive, jnp.maximum(lam, 0.0), 0.0), positive, count + 1, finished

    start = jnp.zeros(k), jnp.zeros(k, bool), jnp.zeros((), int), jnp.zeros((), bool)
    return lax.while_loop(lambda state: ~state[3] & (state[2] < 3 * k + 10), body, start)[0]


def _scaling(hessian: Array, floor: Array) -> Array:
    """As `switchfit.optimize.matrix.diagonal_scaling`, all rounds of it: (d,)."""
    size = jnp.abs(hessian)

    def equilibrate(_: int, scaling: Array) -> Array:
        return algebra.equilibrate(scaling, jnp.max(size / jnp.outer(scaling, scaling), axis=1), jnp)

    start = algebra.jacobi_scaling(jnp.maximum(jnp.diagonal(size), floor), jnp.max(size, axis=1), jnp)
    return lax.fori_loop(0, EQUILIBRATIONS, equilibrate, start)


def _direction(state: State, constraints: Constraints) -> tuple[Array, Array]:
    """Step (d,) of the quadratic programme, and its slope gᵀd."""
    theta, gradient = state.theta, state.gradient
    floor = algebra.curvature_floor(state.scale, state.cost_scale, jnp.abs(gradient), jnp)
    scaling = _scaling(state.hessian, floor)
    scaled = state.hessian / jnp.outer(scaling, scaling)
    identity = jnp.eye(theta.shape[0])
    definite = jnp.all(jnp.isfinite(jnp.linalg.cholesky(scaled - EIGENVALUE_FLOOR * identity)))

    def absolute() -> Array:
        values, vectors = jnp.linalg.eigh(scaled)
        return (vectors * algebra.positive_eigenvalues(values, jnp)[None]) @ vectors.T

    matrix = lax.cond(definite, lambda: scaled, absolute)
    factor = jnp.linalg.cholesky(matrix)
    low, high = jnp.minimum(constraints.lower - theta, 0.0), jnp.maximum(constraints.upper - theta, 0.0)
    slack = jnp.maximum(constraints.A @ theta - constraints.b, 0.0)
    offsets = jnp.concatenate([-slack, low, -high])

    def solve(right: Array) -> Array:
        return jax.scipy.linalg.cho_solve((factor, True), right / scaling) / scaling

    newton = -solve(gradient)
    newton = newton - solve(gradient + scaling * (matrix @ (scaling * newton)))

    def constrained() -> Array:
        # In white variables e = Lᵀ D d: minimise ½‖e − e_0‖² subject to G e >= c with unit rows, by its dual.
        normals = constraints.normals
        rows = jax.scipy.linalg.solve_triangular(factor, (normals / scaling[None]).T, lower=True).T
        unit, norms = algebra.unit_rows(rows, jnp)
        gap = (normals @ newton - offsets) / norms
        allowed = jnp.isfinite(gap)
        length = jnp.maximum(jnp.max(jnp.where(allowed, jnp.abs(gap), 0.0)), jnp.finfo(float).tiny)
        multipliers = nonnegative_minimum(unit @ unit.T, jnp.where(allowed, gap / length, 0.0), allowed)
        back = jax.scipy.linalg.solve_triangular(factor, length * multipliers @ unit, lower=True, trans=1)
        return algebra.press_on_bounds(newton + back / scaling, low, high, multipliers, jnp)

    feasible = jnp.all(constraints.normals @ newton >= offsets)
    step = lax.cond(feasible, lambda: newton, constrained)
    return step, gradient @ step


def _moved(constraints: Constraints, theta: Array, step: Array) -> Array:
    """theta + step with violations of the size of rounding removed."""

    def project(i: int, moved: Array) -> Array:
        normal, bound = constraints.A[i], constraints.b[i]
        violation, projected = algebra.project_on_row(moved, normal, bound, normal, jnp)
        return jnp.where(violation > 0.0, projected, moved)

    moved = jnp.clip(theta + step, constraints.lower, constraints.upper)
    rows = constraints.b.shape[0]
    return jnp.clip(lax.fori_loop(0, rows, project, moved), constraints.lower, constraints.upper) if rows else moved
