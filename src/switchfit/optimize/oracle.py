"""The oracle: evaluates points by the caller's function, counts evaluations, and rejects infinite values.

It chooses the side of the derivatives at breakpoints, the units of the equality constraints and the multipliers of the
Lagrangian whose Hessian is evaluated next.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import BoolArray, FloatArray, IntArray
from switchfit.optimize import algebra
from switchfit.optimize.arrow import Arrow, Hessian
from switchfit.optimize.dense import Dense
from switchfit.optimize.equalities import Equalities, JacobianSVD
from switchfit.optimize.feasibility import Trial
from switchfit.optimize.first_order import kkt_residual, steepest_descent
from switchfit.optimize.linear_constraints import NO_PLACES
from switchfit.optimize.minimization_problem import MinimizationProblem
from switchfit.optimize.point import Point, Sample

#: Growth of the gradient of a constraint that changes its unit.
GROWN = 100.0


class Oracle:
    """Evaluates points by the caller's function, counts evaluations, and rejects values that are not finite.

    Attributes
    ----------
    evaluations : int
    multipliers : array, shape (k,)
        Of the equality constraints, with which the Hessian of the Lagrangian is evaluated next.
    units : array, shape (k,), or None
        Units of the equality constraints: the lengths of their gradients over `MinimizationProblem.reach` at the first
        point, or later if these have grown by a factor of `GROWN`. Constraints and multipliers are in these units
        everywhere except in the caller's function.
    """

    def __init__(self, problem: MinimizationProblem, multipliers: ArrayLike | None = None) -> None:
        self.problem = problem
        self.evaluations = 0
        first = np.zeros(len(problem.equalities)) if multipliers is None else multipliers
        self.multipliers: FloatArray = np.asarray(first, dtype=float)
        self.units: FloatArray | None = None
        d = len(problem.size)
        self._no_side: IntArray = np.zeros(d, dtype=int)
        self._no_multipliers = np.zeros(len(problem.constraints.names))
        self._no_equalities = Equalities(np.zeros(0), np.zeros((0, d)))

    def sample(self, theta: FloatArray, side: int) -> Sample | None:
        """Evaluate once; None if the cost or a derivative that is needed is not finite."""
        self.evaluations += 1
        d = theta.size
        equalities, violation = self._no_equalities, 0.0
        if not self.problem.equalities:
            # Copies: a caller that keeps theta, or writes to it, must not reach into the state.
            value = self.problem.evaluate(theta.copy(), side)
        else:
            units = 1.0 if self.units is None else self.units
            # c / units, lam * units inside; the caller has c and lam in its own units, with the same product.
            value = self.problem.evaluate(theta.copy(), side, self.multipliers / units)
            c, A = np.asarray(value.constraints, dtype=float), np.asarray(value.jacobian, dtype=float)
            if not (algebra.is_finite(c) and algebra.is_finite(A)):
                return None
            if self.units is None:  # those of the first point
                self.units = algebra.unit_rows(A * self.problem.reach)[1]
                self.multipliers = self.multipliers * self.units
            equalities = Equalities(c / self.units, A / self.units[:, None])
            violation = algebra.norm(equalities.values)
        # J, and what the step will need: a point where any of it is not finite is refused like one outside of the
        # constraints.
        cost, gradient = float(value.cost), np.asarray(value.gradient, dtype=float).reshape(d)
        # Without a Hessian the result has one of NaN; nothing but steepest descent goes on with it.
        given = np.full((d, d), np.nan) if value.hessian is None else value.hessian
        hessian: Hessian = given if isinstance(given, Arrow) else Dense.of(given, d)
        if not (math.isfinite(cost) and algebra.is_finite(gradient)):
            return None
        if self.problem.uses_hessian and not hessian.finite:
            return None
        return Sample(cost, gradient, hessian, equalities, violation)

    def rescale(self, point: Point) -> bool:
        """Take new units where the gradient of a constraint has grown by far; return whether one has.

        A constraint that hardly depends on the unknowns at the start would else be measured by rounding: its violation
        would never count as met, and its penalty would make every step along it short.
        """
        if self.units is None:
            return False
        rows = point.plus.equalities.jacobian * self.problem.reach
        lengths = np.sqrt((rows * rows).sum(1))
        grown = np.where(lengths > GROWN, lengths, 1.0)
        self.units, self.multipliers = self.units * grown, self.multipliers * grown
        return bool((grown > 1.0).any())

    def first(self, trial: Trial) -> Sample | None:
        """Do the evaluation that suffices to judge the cost."""
        kink, side = self._sides(trial)
        # The side of the first evaluation is the one that a point off all kinks needs: right, but for coordinates on a
        # breakpoint and an upper bound, which have a left side alone. A trial that is refused has cost one evaluation
        # then, and one that is accepted is complete unless a coordinate has both sides.
        only_left = kink is None and side is not self._no_side and (side < 0).any() and not (side > 0).any()
        return self.sample(trial.theta, -1 if only_left else 1)

    def complete(self, trial: Trial, first: Sample, scale: FloatArray) -> Point | None:
        """Complete the point: the other side is evaluated only if a coordinate is on a breakpoint with room there.

        `scale` (d,) is the size of the unknowns so far. None if the other side is not finite.
        """
        theta, slack = trial.theta, trial.slack
        kink, side = self._sides(trial)
        problem, constraints = self.problem, self.problem.constraints
        # `far` trials have no constraint near: nothing is active.
        active = NO_PLACES
        if not trial.far:
            active = constraints.active(slack, np.maximum(np.maximum(scale, problem.size), np.abs(theta)))
        idle = None if active.size == 0 else self._idle(theta, active)
        if idle is not None and kink is not None:
            # J does not depend on an idle coordinate, whose breakpoints are none then.
            kink &= ~idle
            kink = kink if kink.any() else None
        plus = minus = first
        # A second evaluation only where some coordinate needs the other side.
        if kink is not None or (side is not self._no_side and (side < 0).any() and (side > 0).any()):
            other = self.sample(theta, -1)
            if other is None:
                return None
            minus = other
        forces = self.multipliers
        if problem.equalities:
            optimality, values, downhill, forces = self._weigh_constraints(plus, minus, kink, side, active)
        elif active.size == 0 and plus is minus:
            optimality, values, downhill = algebra.norm(plus.gradient), forces, side
        else:
            movable = np.ones(theta.size) if idle is None else ~idle
            right, normals = plus.gradient * movable, constraints.normals[active] * movable
            left = right if minus is plus else minus.gradient * movable
            optimality, values, downhill = steepest_descent(left, right, kink, side, normals)
        multipliers = self._no_multipliers
        if active.size:
            multipliers = multipliers.copy()
            multipliers[active] = values
        return Point(theta, plus, minus, kink, side, slack, active, optimality, multipliers, downhill, idle, forces)

    def _weigh_constraints(
        self, plus: Sample, minus: Sample, kink: BoolArray | None, side: IntArray, active: IntArray
    ) -> tuple[float, FloatArray, IntArray, FloatArray]:
        """Return what `steepest_descent` does, and the multipliers of equality constraints, which have either sign."""
        A, normals = plus.equalities.jacobian, self.problem.constraints.normals[active]
        count, k = len(normals), len(A)
        if plus is not minus:
            # Equality constraints as two inequalities each, whose multipliers of opposite sign are one.
            stacked = np.vstack([normals, A, -A])
            optimality, values, downhill = steepest_descent(minus.gradient, plus.gradient, kink, side, stacked)
            return optimality, values[:count], downhill, values[count + k :] - values[count : count + k]
        # The distance from the cone of the inequalities and the span of A is one within the null space of A.
        rows = JacobianSVD.of(A)
        # ‖g − N'mu + A'lam‖ over lam of either sign is the length of what is left in the null space of A.
        reduced = rows.null.T.dot(plus.gradient)
        optimality, values = kkt_residual(reduced, reduced, normals.dot(rows.null))
        return optimality, values, side, rows.multipliers(plus.gradient - normals.T.dot(values))

    def point(self, trial: Trial, scale: FloatArray) -> Point | None:
        """Return the point at a trial, evaluated; None if J is not finite there."""
        first = self.first(trial)
        return None if first is None else self.complete(trial, first, scale)

    def _idle(self, theta: FloatArray, active: IntArray) -> BoolArray | None:
        """Return the coordinates on which J does not depend while the active rows stay active: (d,) bool, or None."""
        if self.problem.idle is None or not self.problem.rows_hold(active):
            return None
        idle = self.problem.idle(theta.copy(), False)
        return idle if idle.any() else None

    def _sides(self, trial: Trial) -> tuple[BoolArray | None, IntArray]:
        """Return `Point.kink` and `Point.side` of a trial."""
        if not trial.on_breakpoint:
            return None, self._no_side
        theta = trial.theta
        kink, side = np.zeros(theta.size, dtype=bool), np.zeros(theta.size, dtype=int)
        lower, upper = self.problem.constraints.lower, self.problem.constraints.upper
        for i in trial.on_breakpoint:
            # +1: room to the right alone, -1: to the left alone, 0: on both sides, a kink; or on none, where the bounds
            # fix the coordinate.
            room = int(theta[i] < upper[i]) - int(theta[i] > lower[i])
            kink[i], side[i] = room == 0 and lower[i] < upper[i], room
        return kink if kink.any() else None, side
