"""State of a minimization between two iterations, its status, history and result."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from typing import Literal, NamedTuple

import numpy as np

from switchfit.optimize import algebra
from switchfit.optimize.algebra import EIGENVALUE_FLOOR, SMALLEST_JUMP, BoolArray, FloatArray, IntArray, norm
from switchfit.optimize.matrix import Curvature
from switchfit.optimize.point import Point
from switchfit.optimize.problem import Problem


class Finding(NamedTuple):
    """Why no fraction of a step decreases J although its slope is negative.

    Attributes
    ----------
    kind : {"wrong slope", "jump", "kink", "not finite", "rounding", "valley"}
    figures : mapping of str to float
        "before" and "after": J on both sides of a jump; the slope on both sides of a kink; the slope and the difference
        quotient where the slope is wrong. "noise": the rounding error of J, where that is the reason.
    places : tuple of (int, float)
        Coordinates of the jump or the kink, or of the point from which on J is not finite, and where each of them is
        there.
    entries : tuple of (int, float, float)
        Coordinates whose derivative is wrong: the derivative, and the difference quotient.
    """

    kind: Literal["wrong slope", "jump", "kink", "not finite", "rounding", "valley"]
    figures: Mapping[str, float]
    places: tuple[tuple[int, float], ...] = ()
    entries: tuple[tuple[int, float, float], ...] = ()


Explain = Callable[[], Finding]
"""Finds out why a line search failed, when that is asked for."""


class Status(Enum):
    """How a minimization ended, and what that means.

    See Also
    --------
    Estimate.status, Termination

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> fit = sf.estimate(heater_problem())

    >>> fit.status is sf.Status.CONVERGED
    True
    >>> fit.status.successful
    True
    """

    CONVERGED = "The optimality is below the tolerance, and the curvature on the free directions is positive."
    CONVERGED_PRECISION = (
        "The decrease that is still predicted is below the error of the cost, by rounding or by integration, or would "
        "move no unknown by a quarter of its standard error, although the optimality is above the tolerance."
    )
    CONVERGED_AT_KINK = (
        "The one-sided derivatives have opposite signs at a kink of the cost: a minimizer where no gradient vanishes."
    )
    MAX_ITERATIONS = "All iterations were done before the optimality was below the tolerance."
    LINE_SEARCH_FAILED = (
        "The line search found no decrease along a descent direction, nor did it after a fresh start from there."
    )
    INTERRUPTED = "The callback, or Ctrl-C, stopped it; the result is the best point so far."
    NONFINITE_START = "The cost or its derivatives are not finite at the starting point."
    SADDLE = "A stationary point with negative curvature from which no step decreased the cost: no minimum."
    SINGULAR = "Converged to a point from which the cost is flat to second order in some direction."
    COLLAPSED = (
        "Converged with a mode of no duration: the cost depends neither on where it would stand nor on what acts in "
        "it alone."
    )
    INFEASIBLE = "A guard or a terminal constraint is not met."
    ERROR = "The fit ended with an error, and was left where it was."

    @property
    def successful(self) -> bool:
        """Whether it converged, to a point near which nothing decreases the cost.

        It says nothing about how well the model fits: `Estimate.success` asks that the verdict is not bad as well.

        Also where that point is not the only one: where the cost is flat in some direction (`SINGULAR`), or a mode has
        collapsed (`COLLAPSED`). `is_strict_minimum` leaves these out.
        """
        return self.is_strict_minimum or self in (Status.SINGULAR, Status.COLLAPSED)

    @property
    def is_strict_minimum(self) -> bool:
        """Whether the point is the only minimizer nearby, as far as second-order conditions can tell."""
        return self in (Status.CONVERGED, Status.CONVERGED_PRECISION, Status.CONVERGED_AT_KINK)


@dataclass(frozen=True, eq=False)
class IterationRecord:
    """One line of the history.

    Attributes
    ----------
    iteration : int, 0 for the start
    cost, optimality : float
    step : float
        The fraction of the proposed step that was taken.
    theta : array, shape (d,)
    evaluations : int, all calls up to then
    """

    iteration: int
    cost: float
    optimality: float
    step: float
    theta: FloatArray
    evaluations: int

    def continue_from(self, last: IterationRecord | None) -> IterationRecord:
        """Return this record of a resumed minimization, counted on from the last one before (None: the first)."""
        if last is None:
            return self
        return replace(self, iteration=self.iteration + last.iteration, evaluations=self.evaluations + last.evaluations)


Callback = Callable[[IterationRecord], object]
"""Gets each `IterationRecord`; a true return value stops the minimization."""


@dataclass(frozen=True, eq=False)
class Result:
    """Outcome of `minimize`.

    Attributes
    ----------
    theta : array, shape (d,)
        The best point found; feasible.
    cost : float
    gradient : array, shape (d,)
        Right-hand derivatives at a coordinate that is on a breakpoint (left-hand at an upper bound).
    hessian : array, shape (d, d)
        As evaluated there, not modified; NaN if the caller gives none.
    optimality : float
        KKT residual, min over multipliers of ‖g − Aᵀ lam‖₂: the steepest descent along feasible directions of length
        one, the norm of the gradient if nothing is active.
    iterations, evaluations : int
    status : Status
    active : tuple
        Those of `LinearConstraints.names` whose constraints hold with equality.
    multipliers : array, shape (m + 2 d,)
        Of rows, lower and upper bounds, in the order of `LinearConstraints.names`.
    kinks : tuple of (int, float, float)
        Coordinate, left and right derivative, where the solution sits at a kink.
    curvature : Curvature
        The Hessian on the directions left free by active constraints and kinks.
    tolerance : float
        The given tolerance on the KKT residual.
    history : tuple of IterationRecord
        The start and every iteration.
    violated : tuple of (str, float)
        Equality constraints that are not met, with their values.
    idle : tuple of int
        Coordinates on which J does not depend at theta, as the caller's `idle` finds, and those that active rows tie to
        them; they are not in `free_basis`.
    explain : callable, or None
        Finds out why the line search failed, by some dozens of evaluations; None if it did not fail.
    equalities : tuple of (str, float, float)
        Name, value and multiplier of each equality constraint; the Hessian is that of ``J + multipliers . c``.
    predicted : float
        Decrease of the cost that the quadratic model still predicts, if the status is MAX_ITERATIONS or
        LINE_SEARCH_FAILED; else NaN.
    """

    theta: FloatArray
    cost: float
    gradient: FloatArray
    hessian: FloatArray
    optimality: float
    evaluations: int
    status: Status
    multipliers: FloatArray
    curvature: Curvature
    tolerance: float
    iterations: int = 0
    active: tuple[object, ...] = ()
    kinks: tuple[tuple[int, float, float], ...] = ()
    history: tuple[IterationRecord, ...] = ()
    violated: tuple[tuple[str, float], ...] = ()
    idle: tuple[int, ...] = ()
    explain: Explain | None = None
    equalities: tuple[tuple[str, float, float], ...] = ()
    predicted: float = np.nan

    @property
    def reason(self) -> Finding | None:
        """Why the line search failed; None if it did not."""
        return None if self.explain is None else self.explain()

    @property
    def free_basis(self) -> FloatArray:
        """Orthonormal basis of the directions left free by active constraints and kinks, shape (d, k)."""
        return self.curvature.basis

    @property
    def smallest_eigenvalue(self) -> float:
        """Smallest eigenvalue of the diagonally scaled Hessian on the free directions; NaN if there are none."""
        values = self.curvature.spectrum.eigenvalues
        return float(values[0]) if values.size else np.nan

    @property
    def flat_direction(self) -> FloatArray:
        """Eigenvector, in theta and of unit length, that belongs to `smallest_eigenvalue`, shape (d,)."""
        return self.curvature.spectrum.lowest


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
        Half-width of the trust region, in units of `Problem.reach`; infinite without a trust region.
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
            penalty=FIRST_PENALTY * norm(point.forces),
            steady_violation=point.violation,
        )

    def advance(self, accepted: Accepted, tolerance: float) -> State:
        """Return the state after an accepted step."""
        point, alpha = accepted.point, accepted.step_length
        steady = abs(point.violation - self.steady_violation) <= 0.1 * self.steady_violation
        return State(
            point=point,
            iteration=self.iteration + 1,
            step_length=alpha,
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
        """Coordinates on a breakpoint at which the derivative jumps upwards by more than rounding: (d,)."""
        point = self.point
        if point.kink is None:
            return np.zeros(point.theta.size, dtype=bool)
        jump = point.plus.gradient - point.minus.gradient
        return np.asarray(point.kink & (jump > SMALLEST_JUMP * self.gradient_scale))


class Accepted(NamedTuple):
    """The point of an accepted step, the fraction of the proposed step that it took, the next radius and penalty."""

    point: Point
    step_length: float
    radius: float = np.inf
    penalty: float = 0.0


def curvature_at(problem: Problem, state: State, rows: IntArray) -> Curvature:
    """Return the curvature of J, unmodified, in the null space of the constraints at `rows` and off the kinks."""
    known = state.point.curvatures
    key = rows.tobytes()
    if key not in known:
        known[key] = _curvature_on(problem, state, rows)
    return known[key]


def _curvature_on(problem: Problem, state: State, rows: IntArray) -> Curvature:
    point, constraints = state.point, problem.constraints
    hessian = point.derivatives(point.reported_sides)[1]
    flat = algebra.flatness(state.scale, state.cost_scale)  # curvature that is rounding
    held = state.genuine_kinks | ~constraints.movable
    held = held if point.idle is None else held | point.idle
    normals = np.vstack([constraints.normals[rows], point.equalities(point.reported_sides).jacobian])
    found = hessian.curvature(normals, held, flat)
    if problem.idle is not None and problem.rows_hold(point.active):
        bounds = point.active[point.active >= constraints.b.size]
        loose = np.any(point.multipliers[bounds] <= 1e-10 * state.gradient_scale)  # bounds that hold nothing back
        if found.smallest <= EIGENVALUE_FLOOR or loose:
            idle = problem.idle(point.theta.copy(), True) & ~held
            if idle.any():
                found = replace(hessian.curvature(normals, held | idle, flat), idle=idle)
    return found


def idle_coordinates(problem: Problem, state: State) -> tuple[int, ...]:
    """Return the coordinates on which J does not depend at the state's point, and those that rows tie to them."""
    point = state.point
    found = curvature_at(problem, state, point.active).idle
    alone = set() if found is None else set(np.flatnonzero(found).tolist())
    if point.idle is None:
        return tuple(sorted(alone))
    idle = set(np.flatnonzero(point.idle).tolist())
    ties = [{i, j} for i, j, _ in problem.constraints.exact_rows(point.active) if j >= 0]
    for _ in ties:
        idle |= {k for tie in ties if tie & idle for k in tie}
    return tuple(sorted(idle | alone))
