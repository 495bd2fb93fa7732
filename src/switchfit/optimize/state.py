"""Points of the minimization, and its state between two iterations, its status, history and result.

A point is one or two evaluations of J, and the first-order conditions there.

Along v, J changes at the rate J'(v) = Σ (g₊ max(v, 0) + g₋ min(v, 0)), with g₋ = g₊ off the kinks. A point is optimal
when no feasible v has J'(v) < 0, and the steepest descent −J'(v) over ‖v‖₂ <= 1 measures how far it is from that.

First-order optimality: how far a gradient is from the cone of the active constraints, and the multipliers there.

Kinks: coordinates that sit on a breakpoint, with a left derivative g₋ and a right derivative g₊.

To first order J is separable there, so such a coordinate is held, or released to the side to which the steepest
feasible direction moves it. The multipliers of the quadratic programme say when a held coordinate is to be released
because others move.

A side is +1 or -1 for a coordinate that moves, or may move, to the right or left, and 0 for one that is held.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from enum import Enum
from itertools import product
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from switchfit.optimize import algebra
from switchfit.optimize.algebra import BoolArray, FloatArray, IntArray
from switchfit.optimize.matrix import Arrow, Curvature, Dense, Hessian
from switchfit.optimize.problem import Problem, Trial
from switchfit.optimize.qp import NONE, Equalities, Rows, find_least_distance


def kkt_residual(low: FloatArray, high: FloatArray, normals: FloatArray) -> tuple[float, FloatArray]:
    """Return the distance of the gradient from the cone of the active constraints, and the multipliers that attain it.

    min over lam >= 0 and low <= g <= high of ‖g − Nᵀ lam‖₂, where low = high except at coordinates held at a kink.

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
        nearest = low if low is high else np.clip(0.0, low, high)
        return math.sqrt(nearest.dot(nearest)), np.zeros(0)
    size = float(max(np.max(np.abs(low), initial=0.0), np.max(np.abs(high), initial=0.0)))
    if size == 0.0:
        return 0.0, np.zeros(normals.shape[0])
    # The steepest descent v = N' lam - g minimizes g v + v² / 2 subject to N v >= 0. At kinks, where g v is
    # max(low v, high v), it has two parts, v = v₊ - v₋: of both being positive the cost is larger than of one.
    unit, lengths = algebra.unit_rows(normals)
    low, high, slope, rows = low / size, high / size, high / size, unit
    if (low < high).any():
        slope, rows = np.concatenate([high, -low]), np.vstack([np.hstack([unit, -unit]), np.eye(2 * low.size)])
    found = find_least_distance(slope, rows, np.zeros(len(rows)), np.full(len(rows), np.inf))
    multipliers = np.zeros(len(unit)) if found is None else np.maximum(found[1][: len(unit)], 0.0)
    pull = unit.T @ multipliers
    return size * algebra.norm(np.clip(pull, low, high) - pull), size * multipliers / lengths


#: All combinations of sides are compared for up to this many concave kinks that constraints couple.
MANY_CONCAVE_KINKS = 6


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
    coupled = np.flatnonzero(concave & np.any(normals != 0.0, axis=0))
    few = coupled.size <= MANY_CONCAVE_KINKS
    for choice in product((1, -1), repeat=coupled.size) if few else [(1,), (-1,)]:
        changed = sides.copy()
        changed[coupled] = choice
        if not np.array_equal(changed, sides):
            yield changed


#: Growth of the gradient of a constraint that changes its unit.
GROWN = 100.0
#: Equality constraints below this value, in their units, count as met.
MET = 1e-8


class Sample(NamedTuple):
    """One evaluation: cost, gradient, shape (d,), and Hessian, symmetric.

    The k >= 0 equality constraints c are in the units of `Oracle.units`, `violation` is ‖c‖₂, and the Hessian is that
    of the Lagrangian with the multipliers of the oracle.
    """

    cost: float
    gradient: FloatArray
    hessian: Hessian
    equalities: Equalities
    violation: float

    def lagrangian(self, multipliers: FloatArray) -> tuple[float, FloatArray]:
        """Return ``J + lam . c`` and its gradient (d,)."""
        c, A = self.equalities
        return self.cost + float(multipliers @ c), self.gradient + A.T @ multipliers


@dataclass(eq=False)  # frozen, one takes five times longer to make
class Point:
    """A feasible point with its one-sided derivatives and first-order conditions.

    Attributes
    ----------
    theta : array, shape (d,)
    plus, minus : Sample
        Derivatives to the right of breakpoints and to the left; the same object away from breakpoints.
    kink : array of bool, shape (d,), or None
        Coordinates on a breakpoint with room on both sides; None if there are none.
    side : array of int, shape (d,)
        The only side there is, for a coordinate on a breakpoint and a bound; otherwise 0.
    slack : array, shape (m + 2 d,)
        Of rows, lower and upper bounds.
    active : array of int
        Places of the constraints that hold with equality.
    optimality : float
    multipliers : array, shape (m + 2 d,)
    downhill : array of int, shape (d,)
        Like side, and for each kink the side to descend to, 0 to hold it.
    idle : array of bool, shape (d,), or None
        Coordinates that are held because J does not depend on them; None if there are none.
    forces : array, shape (k,)
        Multipliers of the equality constraints, by least squares.
    curvatures : dict
        Curvatures found already, by the constraints' places.
    """

    theta: FloatArray
    plus: Sample
    minus: Sample
    kink: BoolArray | None
    side: IntArray
    slack: FloatArray
    active: IntArray
    optimality: float
    multipliers: FloatArray
    downhill: IntArray
    idle: BoolArray | None
    forces: FloatArray
    curvatures: dict[bytes, Curvature] = field(default_factory=dict)

    @property
    def cost(self) -> float:
        """J, which is the same on all sides."""
        return self.plus.cost

    @property
    def violation(self) -> float:
        """‖c‖₂ of the equality constraints in the units of `Oracle.units`; 0 where there are none."""
        return self.plus.violation

    def is_stationary(self, tolerance: float) -> bool:
        """Return whether the optimality is below a tolerance, and the equality constraints are met."""
        return self.optimality <= tolerance and self.violation <= MET

    @property
    def is_interior(self) -> bool:
        """Whether no constraint is active and no coordinate at a kink."""
        return self.active.size == 0 and self.kink is None

    def find_jumps(self, least: FloatArray | float) -> BoolArray:
        """Return which derivatives jump upwards at a breakpoint here by more than this: (d,)."""
        kink = np.zeros(self.theta.size, dtype=bool) if self.kink is None else self.kink
        return np.asarray(kink & (self.plus.gradient - self.minus.gradient > least))

    @property
    def largest_derivative(self) -> float:
        """Largest one-sided derivative of all unknowns, in size."""
        return algebra.largest(self.largest_slopes)

    @property
    def largest_slopes(self) -> FloatArray:
        """Larger of the two one-sided derivatives of each unknown, in size: (d,)."""
        right = np.abs(self.plus.gradient)
        return right if self.plus is self.minus else np.maximum(right, np.abs(self.minus.gradient))

    @property
    def reported_sides(self) -> IntArray:
        """The right-hand side for every coordinate on a breakpoint that has one: (d,)."""
        return self.side if self.kink is None else np.where(self.kink, 1, self.side)

    def derivatives(self, sides: IntArray) -> tuple[FloatArray, Hessian]:
        """Return the gradient and Hessian on the given sides (+1, -1; 0 for their mean).

        An entry of the Hessian that joins a left and a right coordinate is known from neither evaluation: the mean.
        """
        plus, minus = self.plus, self.minus
        if plus is minus:
            return plus.gradient, plus.hessian
        gradient = algebra.mix_sides(plus.gradient, minus.gradient, sides)
        return gradient, plus.hessian.mix_sides(minus.hessian, sides.astype(float))

    def equalities(self, sides: IntArray) -> Equalities:
        """Return the equality constraints with their derivatives on the given sides."""
        (c, right), left = self.plus.equalities, self.minus.equalities.jacobian
        return self.plus.equalities if right is left else Equalities(c, algebra.mix_sides(right, left, sides))


class Oracle:
    """Evaluates points by the caller's function, counts evaluations, and rejects values that are not finite.

    Attributes
    ----------
    evaluations : int
    multipliers : array, shape (k,)
        Of the equality constraints, with which the Hessian of the Lagrangian is evaluated next.
    units : array, shape (k,), or None
        Units of the equality constraints: the lengths of their gradients over `Problem.reach` at the first point, or
        later if these have grown by a factor of `GROWN`. Constraints and multipliers are in these units everywhere
        except in the caller's function.
    """

    def __init__(self, problem: Problem, multipliers: ArrayLike | None = None) -> None:
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
        cost, gradient = float(value.cost), np.asarray(value.gradient, dtype=float).reshape(d)
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
        active = NONE
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
        rows = Rows.of(A)
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
            room = int(theta[i] < upper[i]) - int(theta[i] > lower[i])
            kink[i], side[i] = room == 0 and lower[i] < upper[i], room
        return kink if kink.any() else None, side


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
    """

    kind: Literal["wrong slope", "jump", "kink", "not finite", "rounding", "valley"]
    figures: Mapping[str, float]
    places: tuple[tuple[int, float], ...] = ()


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
        return self.curvature.spectrum.smallest


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
            penalty=FIRST_PENALTY * algebra.norm(point.forces),
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
        """Coordinates on a breakpoint that is a kink of J: (d,)."""
        curvature = self.point.plus.hessian.diagonal()
        return self.point.find_jumps(algebra.find_least_jump(curvature, self.gradient_scale, self.point.cost))

    def curvature_at(self, problem: Problem, rows: IntArray) -> Curvature:
        """Return the curvature of J, unmodified, in the null space of the constraints at `rows` and off the kinks."""
        known = self.point.curvatures
        key = rows.tobytes()
        if key not in known:
            known[key] = self._curvature_on(problem, rows)
        return known[key]

    def _curvature_on(self, problem: Problem, rows: IntArray) -> Curvature:
        point, constraints = self.point, problem.constraints
        hessian = point.derivatives(point.reported_sides)[1]
        flat = algebra.flatness(self.scale, self.cost_scale)  # curvature that is rounding
        held = self.genuine_kinks | ~constraints.movable
        held = held if point.idle is None else held | point.idle
        normals = np.vstack([constraints.normals[rows], point.equalities(point.reported_sides).jacobian])
        found = hessian.curvature(normals, held, flat)
        if problem.idle is not None and problem.rows_hold(point.active):
            bounds = point.active[point.active >= constraints.b.size]
            # Bounds that hold nothing back.
            loose = np.any(point.multipliers[bounds] <= 1e-10 * self.gradient_scale)
            if found.spectrum.smallest <= algebra.EIGENVALUE_FLOOR or loose:
                idle = problem.idle(point.theta.copy(), True) & ~held
                if idle.any():
                    found = replace(hessian.curvature(normals, held | idle, flat), idle=idle)
        return found

    def list_idle(self, problem: Problem) -> tuple[int, ...]:
        """Return the coordinates on which J does not depend at the point, and those that rows tie to them."""
        point = self.point
        found = self.curvature_at(problem, point.active).idle
        alone = set() if found is None else set(np.flatnonzero(found).tolist())
        if point.idle is None:
            return tuple(sorted(alone))
        idle = set(np.flatnonzero(point.idle).tolist())
        ties = [{i, j} for i, j, _ in problem.constraints.exact_rows(point.active) if j >= 0]
        for _ in ties:
            idle |= {k for tie in ties if tie & idle for k in tie}
        return tuple(sorted(idle | alone))


class Accepted(NamedTuple):
    """The point of an accepted step, the fraction of the proposed step that it took, the next radius and penalty."""

    point: Point
    step_length: float
    radius: float = np.inf
    penalty: float = 0.0
