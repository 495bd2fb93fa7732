"""The SQP as one function that JAX can trace, for thousands of fits at once.

It takes the steps of `switchfit.optimize.sqp` wherever these are of the ordinary kind: Newton steps on the exact
Hessian, made positive definite by the absolute values of its eigenvalues, a quadratic programme where constraints are
in the way, coordinates held at a kink or released to one side, and Armijo backtracking with the same constants. What
is rare it leaves alone: the escape from a saddle, a face on which the Hessian is indefinite; where it makes no headway
it stops. It has no trust region (`switchfit.optimize.trust_region`): where the Hessian is indefinite, its steps may go
further than those of `minimize`, into the basin of another minimum. `Outcome.settled` is True only for a regular
minimum: no constraint is active, the Hessian of the coordinates that no kink holds is positive definite, and the next
step is negligible. Everything else is to be finished by `minimize`, from `Outcome.theta` on.

Every function here is for one fit; `jax.lax.map` or `jax.vmap` make many of it. The loop evaluates J once a turn, at
the point that is to be judged: fits in lockstep then never wait for another one's line search, and the program, which
consists of little else than J, is compiled once. A point on a breakpoint takes two turns, one for each side.

The formulas are those of `switchfit.optimize.algebra`.
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import lax

from switchfit.arrays import Traced
from switchfit.optimize import algebra
from switchfit.optimize.traced_constraints import TracedConstraints, find_active, move_traced
from switchfit.optimize.traced_qp import compute_scaling, find_traced_direction, hold_coordinates, measure_kkt_residual
from switchfit.optimize.traced_state import Outcome, TracedPoint, TracedProblem, TracedSample, TracedState

MAX_TRIALS = 30
"""Fractions of a step that are tried."""

CRAWLING = (12, 1)
"""A fit that has refused more fractions of steps than this, plus this many an iteration, makes no headway and is left
to `minimize`. Fits that settle refuse a dozen at most; others would go on by hundreds, to no end."""


def minimize_traced(task: TracedProblem, start: Traced) -> Outcome:
    """Minimize J subject to linear constraints from a feasible start (d,), inside a JAX program."""

    # One J a turn, then one step where the point was accepted: fits that run in lockstep never wait for a line search.
    def turn(state: TracedState) -> TracedState:
        after = _take_turn(state, task)
        return lax.cond(after.undirected & ~after.done, partial(_find_step, task=task), lambda state: state, after)

    return _build_outcome(lax.while_loop(lambda state: ~state.done, turn, TracedState.at(start)), task.constraints)


def _take_turn(state: TracedState, task: TracedProblem) -> TracedState:
    """Evaluate J once, at the point that is to be judged, and judge it."""
    point = state.point
    trial = _evaluate(state, task)
    # Before the start J is infinite: the start is accepted whatever its J, as long as it is finite.
    first = jnp.isinf(point.cost)
    noise, decrease = algebra.COST_NOISE * jnp.abs(point.cost), -state.length * state.slope
    # A step across a breakpoint has to achieve a larger part of the decrease: its slope is that of this side alone.
    fraction = jnp.where(state.inside | (trial.crossed == 0), algebra.ARMIJO, algebra.ARMIJO_ACROSS)
    lower = algebra.cost_allows(trial.cost, point.cost, state.lowest, decrease, noise, fraction)
    # A point that rounding put back where the step began is no progress.
    lower = lower & jnp.isfinite(trial.cost) & (first | jnp.any(trial.theta != point.theta))
    better = algebra.optimality_allows(trial.optimality, point.optimality, trial.cost, state.lowest, decrease, noise)
    # At a kink the optimality needs both one-sided derivatives: the next turn evaluates the same point on its left.
    incomplete = jnp.any(trial.kink) & ~state.halfway

    def go_left(state: TracedState) -> TracedState:
        return state._replace(halfway=jnp.asarray(True), right_there=trial.right)

    return lax.cond(
        lower & (incomplete | better),
        lambda state: lax.cond(incomplete, go_left, lambda state: _accept(state, trial, task.tolerance), state),
        lambda state: _refuse(state, trial, task),
        state._replace(evaluations=state.evaluations + 1),
    )


def _evaluate(state: TracedState, task: TracedProblem) -> TracedPoint:
    """Evaluate J at the point that is to be judged, on its right; on its left if that has been done."""
    constraints, breakpoints = task.constraints, task.breakpoints
    theta = move_traced(constraints, breakpoints, state.point.theta, state.length * state.step)
    cost, gradient, hessian = task.evaluate(theta, jnp.where(state.halfway, -1.0, 1.0))
    # On the first visit both sides are the sample at hand; on the second this is the left, and the right is in the
    # state.
    finite = jnp.isfinite(cost) & jnp.all(jnp.isfinite(gradient)) & jnp.all(jnp.isfinite(hessian))
    left = TracedSample(jnp.where(finite, cost, jnp.inf), gradient, 0.5 * (hessian + hessian.T))
    right = jax.tree.map(lambda known, new: jnp.where(state.halfway, known, new), state.right_there, left)
    # On a bound there is one side only, which is no kink.
    kink = breakpoints.on_one(theta) & (theta > constraints.lower) & (theta < constraints.upper)
    trial = TracedPoint(theta, right, left, kink, breakpoints.count_crossed(state.point.theta, theta))
    return trial._replace(optimality=measure_kkt_residual(constraints, theta, state.scale, trial.gradient))


def _accept(state: TracedState, trial: TracedPoint, tolerance: Traced | float) -> TracedState:
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


def _refuse(state: TracedState, trial: TracedPoint, task: TracedProblem) -> TracedState:
    """Shorten the step; where it still crosses a few breakpoints, look for one inside the present smooth piece."""
    point = state.point
    trials, refused = state.trials + 1, state.refused + 1
    # The fractions of `line_search.search`: halves, then quarters.
    length = state.length * jnp.where(trials <= 5, 0.5, 0.25)
    # Once the step crosses few breakpoints, the programme is solved again with the present piece for bounds: there J is
    # smooth, and short enough steps have to decrease it. `undirected` asks for that step.
    few = task.breakpoints.count_crossed(point.theta, point.theta + length * state.step) < algebra.MANY_BREAKPOINTS
    inside = ~state.inside & (trial.crossed > 0) & few
    below_noise = (-state.length * state.slope <= algebra.COST_NOISE * jnp.abs(point.cost)) & ~inside
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


def _find_step(state: TracedState, task: TracedProblem) -> TracedState:
    """Solve the quadratic programme; a negligible step where the optimality is below the tolerance is the end."""
    step, slope = find_traced_direction(state, task.constraints, task.breakpoints)
    negligible = algebra.is_negligible(step, state.scale, jnp)
    # A step inside the piece follows a refusal: the point is the old one, which has been judged already.
    fresh, low = ~state.inside, state.point.optimality <= task.tolerance
    stationary = fresh & low & (negligible | (state.below >= algebra.EXTRA_ITERATIONS))
    done = stationary | (fresh & (state.iterations >= task.max_iterations))
    return state._replace(step=step, slope=slope, undirected=jnp.zeros((), bool), stationary=stationary, done=done)


def _build_outcome(state: TracedState, constraints: TracedConstraints) -> Outcome:
    """Return what was found where a fit is done."""
    point = state.point
    interior = ~jnp.any(find_active(constraints, point.theta, state.scale))
    # A convex kink, g- < g+, may hold its coordinate; where the derivatives are equal the breakpoint is none of J.
    jump = point.right.gradient - point.left.gradient
    curvature = jnp.diag(point.right.hessian)
    held = point.kink & (jump > algebra.find_least_jump(curvature, state.gradient_scale, point.right.cost, jnp))
    hessian = hold_coordinates(held, point.right.hessian)
    scaling = compute_scaling(hessian, algebra.flatness(state.scale, state.cost_scale, jnp))
    # The second-order condition on what is free: positive eigenvalues of the scaled Hessian, held rows being those of
    # I.
    smallest = jnp.linalg.eigvalsh(jnp.nan_to_num(hessian / jnp.outer(scaling, scaling)))[0]
    settled = state.stationary & interior & (smallest > algebra.EIGENVALUE_FLOOR)
    spent = state.iterations, state.evaluations
    return Outcome(point.theta, *point.right, point.optimality, *spent, settled, point.left.gradient, held)
