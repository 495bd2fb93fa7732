"""Problem, points, state and outcome of the SQP that JAX traces: tuples of arrays of fixed shapes, for one fit."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from switchfit.arrays import ArrayModule, Traced
from switchfit.optimize import algebra
from switchfit.optimize.traced_constraints import TracedBreakpoints, TracedConstraints

TracedEvaluate = Callable[[Traced, Traced], tuple[Traced, Traced, Traced]]
"""``evaluate(theta, side)`` returns cost, gradient (d,) and Hessian (d, d); `side` is +1.0 or -1.0: the right or left
derivatives by coordinates on a breakpoint."""


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

    theta: Traced
    cost: Traced
    gradient: Traced
    hessian: Traced
    optimality: Traced
    iterations: Traced
    evaluations: Traced
    settled: Traced
    left: Traced
    held: Traced

    @classmethod
    def at_starts(cls, starts: Traced, xp: ArrayModule = jnp) -> Outcome:
        """Return the outcomes, in arrays of `xp`, of fits that are all left to `minimize` at their starts (R, d)."""
        count, d = starts.shape
        nothing, none, no = xp.full(count, xp.nan), xp.zeros(count, int), xp.zeros(count, bool)
        slopes, held = xp.full((count, d), xp.nan), xp.zeros((count, d), bool)
        hessians = xp.full((count, d, d), xp.nan)
        return cls(starts, nothing, slopes, hessians, nothing, none, none, no, slopes, held)


class TracedSample(NamedTuple):
    """J and its derivatives on one side of the breakpoints: (), (d,), (d, d)."""

    cost: Traced
    gradient: Traced
    hessian: Traced


class TracedProblem(NamedTuple):
    """What is minimized, and when that ends; `tolerance` and `max_iterations` as of `minimize`."""

    evaluate: TracedEvaluate
    constraints: TracedConstraints
    breakpoints: TracedBreakpoints
    tolerance: Traced | float
    max_iterations: Traced | int


class TracedPoint(NamedTuple):
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

    theta: Traced
    right: TracedSample
    left: TracedSample
    kink: Traced
    crossed: Traced = 0
    optimality: Traced = jnp.inf

    @property
    def cost(self) -> Traced:
        """J, which is the same on both sides; infinite where J or a derivative is not finite."""
        return self.right.cost

    @property
    def sides(self) -> Traced:
        """The side to which each coordinate may move, +1 or -1, and 0 where a kink holds it: (d,).

        Chosen as `switchfit.optimize.first_order.steepest_descent` does where no constraint is active.
        """
        return jnp.where(self.kink, algebra.choose_sides(self.left.gradient, self.right.gradient, jnp), 1)

    @property
    def gradient(self) -> Traced:
        """The derivative on the side to which each coordinate descends, 0 where a kink holds it: (d,)."""
        sides = self.sides
        return jnp.where(sides == 0, 0.0, jnp.where(sides > 0, self.right.gradient, self.left.gradient))

    @property
    def slopes(self) -> Traced:
        """The larger one-sided derivative of each coordinate, in size: (d,)."""
        return jnp.maximum(jnp.abs(self.right.gradient), jnp.abs(self.left.gradient))


class TracedState(NamedTuple):
    """The point that was accepted last, the step tried from it, and what has been seen.

    By default what they are before the first evaluation, which is accepted whatever it gives, if it is finite.
    """

    point: TracedPoint
    right_there: TracedSample  # what was found on the right of the point to be judged
    step: Traced
    scale: Traced  # largest |theta_i| seen
    iterations: Traced = 0
    evaluations: Traced = 0
    slope: Traced = 0.0
    length: Traced = 1.0  # fraction of the step that is to be judged next
    trials: Traced = 0  # of this step, so far
    refused: Traced = 0  # of all steps
    inside: Traced = False  # whether the step is one inside the present smooth piece
    undirected: Traced = False  # whether a step has to be found
    halfway: Traced = False  # whether the point to be judged has been evaluated on its right
    below: Traced = 0  # iterations since the optimality fell below the tolerance
    cost_scale: Traced = 0.0  # largest |J| seen
    gradient_scale: Traced = 0.0  # largest one-sided derivative seen
    lowest: Traced = jnp.inf
    done: Traced = False
    stationary: Traced = False  # the optimality is below the tolerance and the next step negligible

    @classmethod
    def at(cls, start: Traced) -> TracedState:
        """Return the state before the first evaluation."""
        d = start.shape[0]
        unknown = TracedSample(jnp.inf, jnp.full(d, jnp.nan), jnp.full((d, d), jnp.nan))
        point = TracedPoint(start, unknown, unknown, jnp.zeros(d, bool))
        return jax.tree.map(jnp.array, cls(point, unknown, jnp.zeros(d), jnp.abs(start)))
