"""State of the minimization between two iterations: the best point so far, and scales, radius and penalty.

A `State` is never changed: one iteration of `sqp` returns the next one, by `State.advance` from an `Accepted` step. The
scales are the largest values seen, by which rounding is measured; a restart forgets them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from switchfit.arrays import BoolArray, FloatArray, IntArray
from switchfit.optimize import algebra
from switchfit.optimize.curvature import FreeCurvature
from switchfit.optimize.minimization_problem import MinimizationProblem
from switchfit.optimize.point import Point
from switchfit.optimize.result import Explain
from switchfit.optimize.status import Status

FIRST_PENALTY = 10.0
"""The first penalty of the equality constraints, in units of the length of their multipliers at the start. With less, J
falls at first at their cost, and modes collapse on the way: of 30 starts of the pendulum 11 end right, not 16."""


class State(NamedTuple):
    """The best point so far, and figures of the iterations before.

    Attributes
    ----------
    point : Point
    scale : array, shape (d,)
        Largest ``|theta_i|`` seen.
    iteration : int
    step_length : float
        Of the last iteration.
    metric : float
        Steepest descent: B = I / metric, the first step length tried: 1, or twice the last one if that was above ½.
    settled : int
        Number of iterations since the optimality fell below the tolerance.
    cost_scale, gradient_scale : float
        Largest ``|J|`` and largest derivative seen.
    lowest_cost : float
    restarts : int
    radius : float
        Half-width of the trust region, in units of `MinimizationProblem.reach`; infinite without a trust region.
    penalty : float
        Of the equality constraints in the merit function.
    steady_violation : float
        Violation of the equality constraints when it last changed by a tenth.
    stagnant : int
        Iterations since then.
    careful : bool
        The next step is taken with the diagonal of the Hessian alone.
    status : Status or None
    explain : callable, or None
        Finds out why the line search failed, if it did.
    """

    point: Point
    scale: FloatArray
    iteration: int = 0
    step_length: float = 0.0
    metric: float = 1.0
    settled: int = 0
    cost_scale: float = 0.0
    gradient_scale: float = 0.0
    lowest_cost: float = np.inf
    restarts: int = 0
    radius: float = np.inf
    penalty: float = 0.0
    steady_violation: float = 0.0
    stagnant: int = 0
    careful: bool = False
    status: Status | None = None
    explain: Explain | None = None

    @classmethod
    def at(cls, point: Point) -> State:
        """Return the state before the first iteration."""
        return cls(
            point=point,
            scale=np.abs(point.theta),
            cost_scale=abs(point.cost),
            gradient_scale=point.largest_derivative,
            lowest_cost=point.cost,
            penalty=FIRST_PENALTY * algebra.norm(point.forces),
            steady_violation=point.violation,
        )

    def advance(self, accepted: Accepted, tolerance: float) -> State:
        """Return the state after an accepted step."""
        point, alpha = accepted.point, accepted.step_length
        # Compared with the value at the last change, not with the one before: a violation that creeps down by 1 % an
        # iteration is not stuck, and leaves the tenth after ten of them.
        steady = abs(point.violation - self.steady_violation) <= 0.1 * self.steady_violation
        return State(
            point=point,
            iteration=self.iteration + 1,
            step_length=alpha,
            # Twice the last length, for the curvature ahead may be smaller; never below 1, the first guess, so that one
            # hard place does not make all steps behind it short.
            metric=max(1.0, 2.0 * alpha * self.metric),
            settled=self.settled + 1 if point.is_stationary(tolerance) else 0,
            scale=np.maximum(self.scale, np.abs(point.theta)),
            cost_scale=max(self.cost_scale, abs(point.cost)),
            gradient_scale=max(self.gradient_scale, point.largest_derivative),
            lowest_cost=min(self.lowest_cost, point.cost),
            restarts=self.restarts,
            radius=accepted.radius,
            penalty=max(self.penalty, accepted.penalty),
            steady_violation=self.steady_violation if steady else point.violation,
            stagnant=self.stagnant + 1 if steady else 0,
        )

    @property
    def genuine_kinks(self) -> BoolArray:
        """Coordinates on a breakpoint that is a kink of J: (d,)."""
        curvature = self.point.plus.hessian.diagonal()
        return self.point.find_jumps(algebra.find_least_jump(curvature, self.gradient_scale, self.point.cost))

    def curvature_at(self, problem: MinimizationProblem, rows: IntArray) -> FreeCurvature:
        """Return the curvature of J, unmodified, in the null space of the constraints at `rows` and off the kinks."""
        known = self.point.curvatures
        key = rows.tobytes()
        if key not in known:
            known[key] = self._curvature_on(problem, rows)
        return known[key]

    def _curvature_on(self, problem: MinimizationProblem, rows: IntArray) -> FreeCurvature:
        point, constraints = self.point, problem.constraints
        hessian = point.derivatives(point.reported_sides)[1]
        flat = algebra.flatness(self.scale, self.cost_scale)  # curvature that is rounding
        # A kink holds its coordinate by the jump of a derivative, whatever the curvature on its sides is.
        held = self.genuine_kinks | ~constraints.movable
        held = held if point.idle is None else held | point.idle
        normals = np.vstack([constraints.normals[rows], point.equalities(point.reported_sides).jacobian])
        found = hessian.curvature(normals, held, flat)
        if problem.idle is not None and problem.rows_hold(point.active):
            bounds = point.active[point.active >= constraints.b.size]
            # Bounds that hold nothing back.
            loose = np.any(point.multipliers[bounds] <= 1e-10 * self.gradient_scale)
            # To ask for all idle coordinates costs an evaluation: only where the curvature does not tell a minimum
            # anyway, or a bound is active without a force, which may be one of a mode that has collapsed.
            if found.spectrum.smallest <= algebra.EIGENVALUE_FLOOR or loose:
                idle = problem.idle(point.theta.copy(), True) & ~held
                if idle.any():
                    found = replace(hessian.curvature(normals, held | idle, flat), idle=idle)
        return found

    def list_idle(self, problem: MinimizationProblem) -> tuple[int, ...]:
        """Return the coordinates on which J does not depend at the point, and those that rows tie to them."""
        point = self.point
        found = self.curvature_at(problem, point.active).idle
        alone = set() if found is None else set(np.flatnonzero(found).tolist())
        if point.idle is None:
            return tuple(sorted(alone))
        idle = set(np.flatnonzero(point.idle).tolist())
        ties = [{i, j} for i, j, _ in problem.constraints.exact_rows(point.active) if j >= 0]
        # Chains of times: each round carries the idle ones a tie further, and there are no more rounds than ties.
        for _ in ties:
            idle |= {k for tie in ties if tie & idle for k in tie}
        return tuple(sorted(idle | alone))


class Accepted(NamedTuple):
    """The point of an accepted step, the fraction of the proposed step that it took, the next radius and penalty."""

    point: Point
    step_length: float
    radius: float = np.inf
    penalty: float = 0.0
