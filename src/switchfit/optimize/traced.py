"""The SQP as one function that JAX can trace, for thousands of fits at once.

It takes the steps of `switchfit.optimize.sqp` wherever these are of the ordinary kind: Newton steps on the exact
Hessian, made positive definite by the absolute values of its eigenvalues, a quadratic programme where constraints are
in the way, coordinates held at a kink or released to one side, and Armijo backtracking with the same constants. What
is rare it leaves alone: the escape from a saddle, a face on which the Hessian is indefinite; where it makes no headway
it stops. It has no trust region (`switchfit.optimize.step`): where the Hessian is indefinite, its steps may go
further than those of `minimize`, into the basin of another minimum. `Outcome.settled` is True only for a regular
minimum: no constraint is active, the Hessian of the coordinates that no kink holds is positive definite, and the next
step is negligible. Everything else is to be finished by `minimize`, from `Outcome.theta` on.

Every function here is for one fit; `jax.lax.map` or `jax.vmap` make many of it. The loop evaluates J once a turn, at
the point that is to be judged: fits in lockstep then never wait for another one's line search, and the program, which
consists of little else than J, is compiled once. A point on a breakpoint takes two turns, one for each side.

The formulas are those of `switchfit.optimize.algebra`. Three things are written anew, since a traced program has arrays
of fixed shapes and does not stop early for one fit of many: nonnegative least squares with masks in place of index sets
(`nonnegative_minimum`), the quadratic programme by its dual, with all rows in place of those that matter, and a Hessian
that is made positive definite as a whole, not on the face of the active constraints.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax

from switchfit.optimize import algebra
from switchfit.optimize.algebra import Array, IntArray

MAX_TRIALS = 30
"""Fractions of a step that are tried."""

CRAWLING = (12, 1)
"""A fit that has refused more fractions of steps than this, plus this many an iteration, makes no headway and is left
to `minimize`. Fits that settle refuse a dozen at most; others would go on by hundreds, to no end."""

RIDGE = 1e-14
"""Added to the diagonal of the dual programme, whose rows are of unit length: constraints may depend on one another."""

TracedEvaluate = Callable[[Array, Array], tuple[Array, Array, Array]]
"""``evaluate(theta, side)`` returns cost, gradient (d,) and Hessian (d, d); `side` is +1.0 or -1.0: the right or left
derivatives by coordinates on a breakpoint."""


class Constraints(NamedTuple):
    """``A theta >= b`` and bounds, infinite where there is none: (m, d), (m,), (d,), (d,).

    `size` (d,) is the typical size of each unknown, of which rounding is a part, as of `minimize`.
    """

    A: Array
    b: Array
    lower: Array
    upper: Array
    size: Array | float = 0.0

    @property
    def normals(self) -> Array:
        """Inward normals of rows, lower and upper bounds: (m + 2 d, d)."""
        identity = jnp.eye(self.lower.shape[0])
        return jnp.concatenate([self.A, identity, -identity])


class Breakpoints(NamedTuple):
    """Values of coordinates where the derivatives of J may jump.

    Attributes
    ----------
    coordinates : (k,) int
        Places in theta.
    points : (k, n)
        Ascending; infinite, or the last one again, where a coordinate has fewer than others.
    """

    coordinates: IntArray
    points: Array

    def rank(self, theta: Array) -> tuple[Array, Array]:
        """Return how many breakpoints lie below each of the coordinates, and how many below or on it: (k,), (k,)."""
        x = theta[self.coordinates, None]
        return jnp.sum(self.points < x, axis=1), jnp.sum(self.points <= x, axis=1)

    def on_one(self, theta: Array) -> Array:
        """Return which coordinates sit exactly on a breakpoint: (d,) of bool."""
        below, up_to = self.rank(theta)
        return jnp.zeros(theta.shape, bool).at[self.coordinates].set(up_to > below)

    def count_crossed(self, theta: Array, to: Array) -> Array:
        """Return the largest number of breakpoints strictly between two points in one coordinate."""
        below, up_to = self.rank(theta)
        below_to, up_to_to = self.rank(to)
        return jnp.max(jnp.maximum(below_to - up_to, below - up_to_to), initial=0)

    def piece(self, theta: Array, constraints: Constraints) -> tuple[Array, Array]:
        """Return the bounds (d,), (d,) narrowed to the next breakpoint on either side of theta."""
        where, x = self.coordinates, theta[self.coordinates, None]
        below = jnp.max(jnp.where(self.points < x, self.points, -jnp.inf), axis=1, initial=-jnp.inf)
        above = jnp.min(jnp.where(self.points > x, self.points, jnp.inf), axis=1, initial=jnp.inf)
        return constraints.lower.at[where].max(below), constraints.upper.at[where].min(above)

    def snap(self, moved: Array, theta: Array, step: Array, size: Array) -> Array:
        """Return ``moved = theta + step``, exactly on the breakpoints that it reaches up to rounding: (d,)."""
        where, x = self.coordinates, moved[self.coordinates]
        # A sum of floats that should be a breakpoint misses it by an ulp or two, and would count as beside it for ever:
        # within 8 EPS of the largest number that was rounded on the way, it is put on it.
        nearest = jnp.argmin(jnp.abs(self.points - x[:, None]), axis=1)
        mark = self.points[jnp.arange(len(where)), nearest]
        reach = jnp.maximum(jnp.maximum(jnp.abs(theta), jnp.abs(step)), jnp.abs(moved))
        rounding = 8 * algebra.EPS * jnp.maximum(jnp.where(step != 0.0, reach, 0.0), size)
        return moved.at[where].set(jnp.where(jnp.abs(mark - x) <= rounding[where], mark, x))


class Outcome(NamedTuple):
    """Where one fit ended.

    Attributes
    ----------
    theta, cost, gradient, hessian : (d,), (), (d,), (d, d)
        With the right derivatives of coordinates on a breakpoint.
    optimality : ()
        KKT residual.
    iterations, evaluations : () int
    settled : () bool
        Whether this is a regular minimum; if not, `minimize` has to go on from here.
    left : (d,)
        The gradient with the left derivatives.
    held : (d,) bool
        Coordinates at a kink that holds them.
    """

    theta: Array
    cost: Array
    gradient: Array
    hessian: Array
    optimality: Array
    iterations: Array
    evaluations: Array
    settled: Array
    left: Array
    held: Array

    @classmethod
    def at_starts(cls, starts: Any, xp: Any = jnp) -> Outcome:
        """Return the outcomes, in arrays of `xp`, of fits that are all left to `minimize` at their starts (R, d)."""
        count, d = starts.shape
        nothing, none, no = xp.full(count, xp.nan), xp.zeros(count, int), xp.zeros(count, bool)
        slopes, held = xp.full((count, d), xp.nan), xp.zeros((count, d), bool)
        hessians = xp.full((count, d, d), xp.nan)
        return cls(starts, nothing, slopes, hessians, nothing, none, none, no, slopes, held)


class Sample(NamedTuple):
    """J and its derivatives on one side of the breakpoints: (), (d,), (d, d)."""

    cost: Array
    gradient: Array
    hessian: Array


class Task(NamedTuple):
    """What is minimized, and when that ends; `tolerance` and `max_iterations` as of `minimize`."""

    evaluate: TracedEvaluate
    constraints: Constraints
    breakpoints: Breakpoints
    tolerance: Array | float
    max_iterations: Array | int


class Point(NamedTuple):
    """A point that has been evaluated.

    Attributes
    ----------
    theta : (d,)
    right, left : Sample
        The same, and those of one side alone, where no coordinate is at a kink or the left is still unknown.
    kink : (d,) bool
        Coordinates on a breakpoint with room on both sides.
    crossed : () int
        Breakpoints strictly between it and the point that was accepted before.
    optimality : ()
    """

    theta: Array
    right: Sample
    left: Sample
    kink: Array
    crossed: Array = 0
    optimality: Array = jnp.inf

    @property
    def cost(self) -> Array:
        """J, which is the same on both sides; infinite where J or a derivative is not finite."""
        return self.right.cost

    @property
    def sides(self) -> Array:
        """The side to which each coordinate may move, +1 or -1, and 0 where a kink holds it: (d,).

        Chosen as `switchfit.optimize.state.steepest_descent` does where no constraint is active.
        """
        return jnp.where(self.kink, algebra.choose_sides(self.left.gradient, self.right.gradient, jnp), 1)

    @property
    def gradient(self) -> Array:
        """The derivative on the side to which each coordinate descends, 0 where a kink holds it: (d,)."""
        sides = self.sides
        return jnp.where(sides == 0, 0.0, jnp.where(sides > 0, self.right.gradient, self.left.gradient))

    @property
    def slopes(self) -> Array:
        """The larger one-sided derivative of each coordinate, in size: (d,)."""
        return jnp.maximum(jnp.abs(self.right.gradient), jnp.abs(self.left.gradient))


class State(NamedTuple):
    """The point that was accepted last, the step tried from it, and what has been seen.

    By default what they are before the first evaluation, which is accepted whatever it gives, if it is finite.
    """

    point: Point
    right_there: Sample  # what was found on the right of the point to be judged
    step: Array
    scale: Array  # largest |theta_i| seen
    iterations: Array = 0
    evaluations: Array = 0
    slope: Array = 0.0
    length: Array = 1.0  # fraction of the step that is to be judged next
    trials: Array = 0  # of this step, so far
    refused: Array = 0  # of all steps
    inside: Array = False  # whether the step is one inside the present smooth piece
    undirected: Array = False  # whether a step has to be found
    halfway: Array = False  # whether the point to be judged has been evaluated on its right
    below: Array = 0  # iterations since the optimality fell below the tolerance
    cost_scale: Array = 0.0  # largest |J| seen
    gradient_scale: Array = 0.0  # largest one-sided derivative seen
    lowest: Array = jnp.inf
    done: Array = False
    stationary: Array = False  # the optimality is below the tolerance and the next step negligible

    @classmethod
    def at(cls, start: Array) -> State:
        """Return the state before the first evaluation."""
        d = start.shape[0]
        unknown = Sample(jnp.inf, jnp.full(d, jnp.nan), jnp.full((d, d), jnp.nan))
        point = Point(start, unknown, unknown, jnp.zeros(d, bool))
        return jax.tree.map(jnp.array, cls(point, unknown, jnp.zeros(d), jnp.abs(start)))


def minimize_traced(task: Task, start: Array) -> Outcome:
    """Minimize J subject to linear constraints from a feasible start (d,), inside a JAX program."""

    # One J a turn, then one step where the point was accepted: fits that run in lockstep never wait for a line search.
    def turn(state: State) -> State:
        after = take_turn(state, task)
        return lax.cond(after.undirected & ~after.done, partial(_find_step, task=task), lambda state: state, after)

    return build_outcome(lax.while_loop(lambda state: ~state.done, turn, State.at(start)), task.constraints)


def take_turn(state: State, task: Task) -> State:
    """Evaluate J once, at the point that is to be judged, and judge it."""
    point = state.point
    trial = _evaluate(state, task)
    # Before the start J is infinite: the start is accepted whatever its J, as long as it is finite.
    first = jnp.isinf(point.cost)
    noise, decrease = algebra.NOISE * jnp.abs(point.cost), -state.length * state.slope
    # A step across a breakpoint has to achieve a larger part of the decrease: its slope is that of this side alone.
    fraction = jnp.where(state.inside | (trial.crossed == 0), algebra.ARMIJO, algebra.ARMIJO_ACROSS)
    lower = algebra.cost_allows(trial.cost, point.cost, state.lowest, decrease, noise, fraction)
    # A point that rounding put back where the step began is no progress.
    lower = lower & jnp.isfinite(trial.cost) & (first | jnp.any(trial.theta != point.theta))
    better = algebra.optimality_allows(trial.optimality, point.optimality, trial.cost, state.lowest, decrease, noise)
    # At a kink the optimality needs both one-sided derivatives: the next turn evaluates the same point on its left.
    incomplete = jnp.any(trial.kink) & ~state.halfway

    def go_left(state: State) -> State:
        return state._replace(halfway=jnp.asarray(True), right_there=trial.right)

    return lax.cond(
        lower & (incomplete | better),
        lambda state: lax.cond(incomplete, go_left, lambda state: _accept(state, trial, task.tolerance), state),
        lambda state: _refuse(state, trial, task),
        state._replace(evaluations=state.evaluations + 1),
    )


def _evaluate(state: State, task: Task) -> Point:
    """Evaluate J at the point that is to be judged, on its right; on its left if that has been done."""
    constraints, breakpoints = task.constraints, task.breakpoints
    theta = _move(constraints, breakpoints, state.point.theta, state.length * state.step)
    cost, gradient, hessian = task.evaluate(theta, jnp.where(state.halfway, -1.0, 1.0))
    # On the first visit both sides are the sample at hand; on the second this is the left, and the right is in the
    # state.
    finite = jnp.isfinite(cost) & jnp.all(jnp.isfinite(gradient)) & jnp.all(jnp.isfinite(hessian))
    left = Sample(jnp.where(finite, cost, jnp.inf), gradient, 0.5 * (hessian + hessian.T))
    right = jax.tree.map(lambda known, new: jnp.where(state.halfway, known, new), state.right_there, left)
    # On a bound there is one side only, which is no kink.
    kink = breakpoints.on_one(theta) & (theta > constraints.lower) & (theta < constraints.upper)
    trial = Point(theta, right, left, kink, breakpoints.count_crossed(state.point.theta, theta))
    return trial._replace(optimality=_kkt_residual(constraints, theta, state.scale, trial.gradient))


def _accept(state: State, trial: Point, tolerance: Array | float) -> State:
    """Return the state at a trial that decreases J; the next step is still to be found."""
    first = jnp.isinf(state.point.cost)
    return state._replace(
        point=trial,
        iterations=jnp.where(first, 0, state.iterations + 1),
        length=jnp.ones(()),
        trials=jnp.zeros((), int),
        inside=jnp.zeros((), bool),
        undirected=jnp.ones((), bool),
        halfway=jnp.zeros((), bool),
        below=jnp.where(first | (trial.optimality > tolerance), 0, state.below + 1),
        scale=jnp.maximum(state.scale, jnp.abs(trial.theta)),
        cost_scale=jnp.maximum(state.cost_scale, jnp.abs(trial.cost)),
        gradient_scale=jnp.maximum(state.gradient_scale, jnp.max(trial.slopes)),
        lowest=jnp.minimum(state.lowest, trial.cost),
    )


def _refuse(state: State, trial: Point, task: Task) -> State:
    """Shorten the step; where it still crosses a few breakpoints, look for one inside the present smooth piece."""
    point = state.point
    trials, refused = state.trials + 1, state.refused + 1
    # The fractions of `step.search`: halves, then quarters.
    length = state.length * jnp.where(trials <= 5, 0.5, 0.25)
    # Once the step crosses few breakpoints, the programme is solved again with the present piece for bounds: there J is
    # smooth, and short enough steps have to decrease it. `undirected` asks for that step.
    few = task.breakpoints.count_crossed(point.theta, point.theta + length * state.step) < algebra.MANY_BREAKPOINTS
    inside = ~state.inside & (trial.crossed > 0) & few
    below_noise = (-state.length * state.slope <= algebra.NOISE * jnp.abs(point.cost)) & ~inside
    hopeless = below_noise | (trials >= MAX_TRIALS)
    crawling = refused > CRAWLING[0] + CRAWLING[1] * state.iterations
    # What is left of the predicted decrease cannot be seen in J any more, or too much has been tried.
    return state._replace(
        length=jnp.where(inside, 1.0, length),
        trials=trials,
        refused=refused,
        inside=state.inside | inside,
        undirected=inside,
        halfway=jnp.zeros((), bool),
        done=hopeless | crawling | jnp.isinf(point.cost),
        # A search that finds nothing below the tolerance has met rounding: that too is the end.
        stationary=hopeless & (point.optimality <= task.tolerance),
    )


def _find_step(state: State, task: Task) -> State:
    """Solve the quadratic programme; a negligible step where the optimality is below the tolerance is the end."""
    step, slope = _direction(state, task.constraints, task.breakpoints)
    negligible = algebra.is_negligible(step, state.scale, jnp)
    # A step inside the piece follows a refusal: the point is the old one, which has been judged already.
    fresh, low = ~state.inside, state.point.optimality <= task.tolerance
    stationary = fresh & low & (negligible | (state.below >= algebra.EXTRA_ITERATIONS))
    done = stationary | (fresh & (state.iterations >= task.max_iterations))
    return state._replace(step=step, slope=slope, undirected=jnp.zeros((), bool), stationary=stationary, done=done)


def build_outcome(state: State, constraints: Constraints) -> Outcome:
    """Return what was found where a fit is done."""
    point = state.point
    interior = ~jnp.any(_active(constraints, point.theta, state.scale))
    # A convex kink, g- < g+, may hold its coordinate; where the derivatives are equal the breakpoint is none of J.
    jump = point.right.gradient - point.left.gradient
    curvature = jnp.diag(point.right.hessian)
    held = point.kink & (jump > algebra.find_least_jump(curvature, state.gradient_scale, point.right.cost, jnp))
    hessian = _without(held, point.right.hessian)
    scaling = _compute_scaling(hessian, algebra.flatness(state.scale, state.cost_scale, jnp))
    # The second-order condition on what is free: positive eigenvalues of the scaled Hessian, held rows being those of
    # I.
    smallest = jnp.linalg.eigvalsh(jnp.nan_to_num(hessian / jnp.outer(scaling, scaling)))[0]
    settled = state.stationary & interior & (smallest > algebra.EIGENVALUE_FLOOR)
    spent = state.iterations, state.evaluations
    return Outcome(point.theta, *point.right, point.optimality, *spent, settled, point.left.gradient, held)


def _without(held: Array, hessian: Array) -> Array:
    """Return the Hessian (d, d) with rows and columns of the identity for coordinates that are held."""
    either = held[:, None] | held[None]
    return jnp.where(either, jnp.eye(held.shape[0]), hessian)


def _active(constraints: Constraints, theta: Array, scale: Array) -> Array:
    """Return which constraints hold with equality up to rounding: (m + 2 d,) bool."""
    size = jnp.maximum(jnp.maximum(scale, constraints.size), jnp.abs(theta))
    slack = algebra.slack(constraints, theta, jnp)
    return algebra.is_active(slack, size, jnp.abs(constraints.A), jnp.abs(constraints.b), jnp)


def _kkt_residual(constraints: Constraints, theta: Array, scale: Array, gradient: Array) -> Array:
    """Return min over lam >= 0, on the active constraints, of ‖g − Nᵀ lam‖."""
    active = _active(constraints, theta, scale)

    def solve_constrained() -> Array:
        # ||g - N' lam||^2 / 2 is lam' N N' lam / 2 - (N g)' lam up to a constant. The gradient is scaled to 1, since
        # `nonnegative_minimum` compares slopes with an absolute floor.
        normals, _ = algebra.unit_rows(constraints.normals, jnp)
        size = jnp.maximum(jnp.max(jnp.abs(gradient)), jnp.finfo(float).tiny)
        multipliers = nonnegative_minimum(normals @ normals.T, -normals @ (gradient / size), active)
        return jnp.linalg.norm(gradient - size * multipliers @ normals)

    return lax.cond(jnp.any(active), solve_constrained, lambda: jnp.linalg.norm(gradient))


def nonnegative_minimum(matrix: Array, vector: Array, allowed: Array) -> Array:
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
    def solve_on(positive: Array) -> Array:
        both = positive[:, None] & positive[None, :]
        diagonal = jnp.where(positive, RIDGE, 1.0)
        return jnp.linalg.solve(jnp.where(both, matrix, 0.0) + jnp.diag(diagonal), jnp.where(positive, -vector, 0.0))

    def body(state: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
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


def _compute_scaling(hessian: Array, floor: Array) -> Array:
    """Scale as `switchfit.optimize.matrix.diagonal_scaling` does: (d,)."""
    size = jnp.abs(hessian)

    def equilibrate(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        rounds, scaling, largest = state
        grown = algebra.equilibrate(scaling, largest, jnp)
        return rounds + 1, grown, find_largest(grown)

    def find_largest(scaling: Array) -> Array:
        return jnp.max(size / jnp.outer(scaling, scaling), axis=1)

    def go_on(state: tuple[Array, Array, Array]) -> Array:
        return (state[0] < algebra.EQUILIBRATIONS) & jnp.any(state[2] > algebra.EQUILIBRATED)

    # Rounds as in `diagonal_scaling`; a positive definite matrix needs none of them.
    start = algebra.jacobi_scaling(jnp.maximum(jnp.diagonal(size), floor), jnp.max(size, axis=1), jnp)
    return lax.while_loop(go_on, equilibrate, (jnp.zeros((), int), start, find_largest(start)))[1]


def _direction(state: State, constraints: Constraints, breakpoints: Breakpoints) -> tuple[Array, Array]:
    """Return the step (d,) of the quadratic programme, with kinks held or confined to one side, and its slope gᵀd."""
    point, theta, sides = state.point, state.point.theta, state.point.sides
    # The Hessian of the piece that the sides lead into; entries between one coordinate on its left and another on its
    # right are those of no piece that was evaluated, and the mean stands for them.
    pair, gradient = sides[:, None] + sides[None], point.gradient
    hessian = _without(sides == 0, algebra.mix_sides(point.right.hessian, point.left.hessian, pair, jnp))
    # B = D S D, with S of unit diagonal, so that eigenvalues of S are compared with numbers that have no unit.
    narrowed = breakpoints.piece(theta, constraints)
    lower = jnp.where(state.inside, narrowed[0], constraints.lower)
    upper = jnp.where(state.inside, narrowed[1], constraints.upper)
    floor = algebra.curvature_floor(state.scale, state.cost_scale, point.slopes, jnp)
    scaling = _compute_scaling(hessian, floor)
    scaled = hessian / jnp.outer(scaling, scaling)
    identity = jnp.eye(theta.shape[0])
    # Cholesky of S - floor I exists if and only if all eigenvalues are above the floor; JAX returns NaN where it does
    # not.
    definite = jnp.all(jnp.isfinite(jnp.linalg.cholesky(scaled - algebra.EIGENVALUE_FLOOR * identity)))

    # |S| = V |Lambda| V': a step that descends along negative curvature, as long as it would be along positive.
    def absolute() -> Array:
        values, vectors = jnp.linalg.eigh(scaled)
        return (vectors * algebra.positive_eigenvalues(values, jnp)[None]) @ vectors.T

    matrix = lax.cond(definite, lambda: scaled, absolute)
    factor = jnp.linalg.cholesky(matrix)
    # What a kink holds or confines is bounded by zero on the other side. All bounds c are <= 0: d = 0 is feasible.
    low = jnp.where(point.kink & (sides >= 0), 0.0, jnp.minimum(lower - theta, 0.0))
    high = jnp.where(point.kink & (sides <= 0), 0.0, jnp.maximum(upper - theta, 0.0))
    slack = jnp.maximum(constraints.A @ theta - constraints.b, 0.0)
    offsets = jnp.concatenate([-slack, low, -high])

    def solve(right: Array) -> Array:
        return jax.scipy.linalg.cho_solve((factor, True), right / scaling) / scaling

    newton = -solve(gradient)
    # Refined once: the residual is computed with B itself, not with its factor.
    newton = newton - solve(gradient + scaling * (matrix @ (scaling * newton)))

    def solve_constrained() -> Array:
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


def _move(constraints: Constraints, breakpoints: Breakpoints, theta: Array, step: Array) -> Array:
    """Return theta + step, on the breakpoints that it reaches, with violations of the size of rounding removed."""

    def project(i: int, moved: Array) -> Array:
        normal, bound = constraints.A[i], constraints.b[i]
        # A step of the programme ends on a row up to rounding: what is outside by that much is moved onto it, row by
        # row.
        violation, projected = algebra.project_on_row(moved, normal, bound, normal, jnp)
        return jnp.where(violation > 0.0, projected, moved)

    moved = breakpoints.snap(theta + step, theta, step, jnp.broadcast_to(constraints.size, theta.shape))
    moved = jnp.clip(moved, constraints.lower, constraints.upper)
    rows = constraints.b.shape[0]
    if not rows:
        return moved
    violated = jnp.any(constraints.A @ moved < constraints.b)
    moved = lax.cond(violated, lambda: lax.fori_loop(0, rows, project, moved), lambda: moved)
    return jnp.clip(moved, constraints.lower, constraints.upper)
