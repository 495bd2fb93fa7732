"""Sequential quadratic programming for a piecewise smooth cost under linear constraints.

The problem is to minimise J(theta) subject to A theta >= b and lower <= theta <= upper, where J is continuous and
smooth except where a coordinate passes one of its breakpoints: there its derivatives jump. (A transition time that
passes a sample time is such a coordinate.) All constraints are linear, so every iterate is feasible, and the line
search looks at J alone.

One iteration, `_step`, maps a state to the next state:

1. *direction*: a convex quadratic programme with the exact Hessian, made positive definite only in the subspace where
   it has to be (Newton), with its blocks, with Gauss-Newton's matrix, or with a multiple of the identity (steepest
   descent);
2. *line search*: the full step first, even across breakpoints; if it fails and crosses any, the programme is solved
   again inside the present smooth piece, where J is smooth and backtracking must succeed;
3. *kinks*: a coordinate that sits on a breakpoint has the derivatives g₋ and g₊. To first order J is separable
   there, so such a coordinate is held, or released to the side to which the steepest feasible direction moves it. The
   multipliers of the programme say when a held coordinate is to be released because others move.

Along v, J changes at the rate J'(v) = Σ (g₊ max(v, 0) + g₋ min(v, 0)), with g₋ = g₊ off the kinks. A point is optimal
when no feasible v has J'(v) < 0, and the steepest descent −J'(v) over ‖v‖₂ <= 1, `_first_order`, measures how far it is
from that. The programme starts from the sides of this v, so that its step descends wherever the measure is positive.

References
----------
.. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, chapters 3, 12, 16 and 18.
.. [2] W. W. Hager, H. Zhang, A new conjugate gradient method with guaranteed descent and an efficient line search,
   SIAM J. Optim. 16 (2005) 170-192 (line searches below the rounding error of the cost).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from enum import Enum
from functools import cached_property
from itertools import product
from typing import Literal, Protocol, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.optimize.arrow import Arrow, ArrowFactor, arrow_scaling, convexify_arrow, solve_arrow_qp
from switchfit.optimize.diagnosis import Finding, find_reason, wrong_slope
from switchfit.optimize.qp import (
    EIGENVALUE_FLOOR,
    EPS,
    FloatArray,
    LinearConstraints,
    convexify,
    diagonal_scaling,
    kkt_residual,
    solve_qp,
    split_space,
)

HessianKind = Literal["exact", "descent-first", "block-diagonal", "gauss-newton", "none"]

#: Fraction of the predicted linear decrease that a step must achieve (Armijo).
ARMIJO = 1e-4
#: The same for a step across a breakpoint, where the prediction may be wrong however short the step.
ARMIJO_ACROSS = 0.1
#: Shortened steps across breakpoints are tried while they still cross this many.
MANY_BREAKPOINTS = 3
#: Differences of costs below this part of the cost say nothing: where residuals are small beside what is measured, the
#: rounding of a sum of their squares is a few hundred units, and a search by costs takes many short steps at the end.
NOISE = 4096 * EPS
#: Eigenvalues of the scaled Hessian below this are negative curvature, not rounding.
NEGATIVE_CURVATURE = -1e-8
#: A step below this part of the unknowns' size is negligible.
NEGLIGIBLE_STEP = 1e-10
#: Iterations spent on making the last step negligible once the optimality is below the tolerance.
EXTRA_ITERATIONS = 5
MAX_BACKTRACKS = 60
#: Times a minimisation begins anew from where its line search has failed.
RESTARTS = 3
#: All combinations of sides are compared for up to this many concave kinks that constraints couple.
MANY_CONCAVE_KINKS = 6
#: Newton steps up to this multiple of the unknowns' size are never shortened by changing the Hessian.
LONGEST_STEP = 1e3


class Evaluation(Protocol):
    """What the caller's function returns: cost J, gradient, shape (d,), and Hessian, shape (d, d) or an `Arrow`."""

    @property
    def cost(self) -> float: ...
    @property
    def gradient(self) -> FloatArray: ...
    @property
    def hessian(self) -> FloatArray | Arrow | None: ...


class Status(Enum):
    """How a minimisation ended, and what that means."""

    CONVERGED = "The optimality is below the tolerance, and the curvature on the free directions is positive."
    CONVERGED_PRECISION = (
        "The decrease that is still predicted is below the rounding error of the cost, although the optimality is "
        "above the tolerance."
    )
    CONVERGED_AT_KINK = (
        "The one-sided derivatives have opposite signs at a kink of the cost: a minimiser where no gradient vanishes."
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
        """Whether it converged, to a point near which nothing decreases the cost; `Estimate.success` is the same.

        Also where that point is not the only one: where the cost is flat in some direction (`SINGULAR`), or a mode has
        collapsed (`COLLAPSED`). `is_strict_minimum` leaves these out.
        """
        return self.is_strict_minimum or self in (Status.SINGULAR, Status.COLLAPSED)

    @property
    def is_strict_minimum(self) -> bool:
        """Whether the point is the only minimiser nearby, as far as second-order conditions can tell."""
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

    def counted_on(self, last: IterationRecord | None) -> IterationRecord:
        """This record of a minimisation that was resumed, counted on from the last record before; None: the first."""
        if last is None:
            return self
        return replace(self, iteration=self.iteration + last.iteration, evaluations=self.evaluations + last.evaluations)


Callback = Callable[[IterationRecord], object]
Evaluate = Callable[[FloatArray, int], Evaluation]
Idle = Callable[[FloatArray, bool], NDArray[np.bool_]]
Index = NDArray[np.intp] | slice


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
    free_basis : array, shape (d, k)
        Orthonormal basis of the directions left free by active constraints and kinks.
    free_eigenvalues : array, shape (k,)
        Eigenvalues, ascending, of the diagonally scaled Hessian on the free directions; the smallest alone where the
        Hessian has the shape of an arrow.
    smallest_eigenvalue, smallest_unscaled_eigenvalue : float
        The smallest of these, and that of ``free_basisᵀ H free_basis``; NaN if there are none.
    flat_direction : array, shape (d,)
        Eigenvector, in theta and of unit length, that belongs to `smallest_eigenvalue`.
    tolerance : float
        The tolerance asked for.
    history : tuple of IterationRecord
        The start and every iteration.
    violated : tuple of (str, float)
        Equality constraints that are not met, with their values.
    idle : tuple of int
        Coordinates on which J does not depend at theta, by the word of the caller's `idle`, and those that active rows
        tie to them; they are not in `free_basis`.
    reason : Finding or None
        What was seen where the line search failed; None where it did not.
    earlier : int
        How many of the iterations belong to minimisations before, which this one resumed.
    """

    theta: FloatArray
    cost: float
    gradient: FloatArray
    hessian: FloatArray
    optimality: float
    iterations: int
    evaluations: int
    status: Status
    active: tuple[object, ...]
    multipliers: FloatArray
    kinks: tuple[tuple[int, float, float], ...]
    free_basis: FloatArray
    free_eigenvalues: FloatArray
    smallest_eigenvalue: float
    smallest_unscaled_eigenvalue: float
    flat_direction: FloatArray
    tolerance: float
    history: tuple[IterationRecord, ...]
    violated: tuple[tuple[str, float], ...] = ()
    idle: tuple[int, ...] = ()
    reason: Finding | None = None
    earlier: int = 0


# --- the problem and its points ---------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Problem:
    evaluate: Evaluate
    constraints: LinearConstraints
    breakpoints: tuple[tuple[int, FloatArray], ...]  # of the coordinates that have any
    hessian: HessianKind
    labels: FloatArray | None  # of the blocks, where the Hessian is cut into blocks
    tolerance: float
    max_iterations: int
    size: FloatArray  # typical size of each coordinate, zero where only its values tell
    idle: Idle | None

    @cached_property
    def row_size(self) -> FloatArray:
        """Size of what the rows of the constraints add up, of which rounding is a part: (m,)."""
        return np.asarray(np.abs(self.constraints.A) @ self.size)

    @cached_property
    def row_rounding(self) -> FloatArray:
        """Rounding error of the rows: (m,)."""
        return np.asarray(16 * EPS * self.row_size)

    @property
    def uses_hessian(self) -> bool:
        return self.hessian != "none"


@dataclass(frozen=True, eq=False)
class _Sample:
    """One evaluation: cost, gradient and (symmetrised) Hessian as arrays."""

    cost: float
    gradient: FloatArray
    hessian: FloatArray | Arrow


@dataclass(frozen=True, eq=False)
class _Point:
    """A feasible point with its one-sided derivatives and first-order conditions."""

    theta: FloatArray
    plus: _Sample  # derivatives to the right of breakpoints
    minus: _Sample  # and to the left; the same object away from breakpoints
    kink: NDArray[np.bool_]  # coordinates on a breakpoint with room on both sides
    side: NDArray[np.int_]  # the only side there is, for a coordinate on a breakpoint and a bound; otherwise 0
    active: NDArray[np.intp]
    optimality: float
    multipliers: FloatArray  # shape (m + 2 d,)
    downhill: NDArray[np.int_]  # like side, and for each kink the side to descend to, 0 to hold it
    idle: NDArray[np.bool_] | None  # coordinates that are held because J does not depend on them; None: there are none
    curvatures: dict[bytes, _Curvature] = field(default_factory=dict)  # found already, by the constraints' places

    @property
    def cost(self) -> float:
        return self.plus.cost

    @property
    def largest_derivative(self) -> float:
        return float(self.largest_slopes.max())

    @cached_property
    def largest_slopes(self) -> FloatArray:
        """Larger of the two one-sided derivatives of each unknown, in size: (d,)."""
        right = np.abs(self.plus.gradient)
        return right if self.plus is self.minus else np.maximum(right, np.abs(self.minus.gradient))

    def derivatives(self, sides: NDArray[np.int_]) -> tuple[FloatArray, FloatArray | Arrow]:
        """Gradient and Hessian on the given sides (+1, -1; 0 for their mean).

        An entry of the Hessian that joins a left and a right coordinate is known from neither evaluation: the mean.
        """
        plus, minus = self.plus, self.minus
        if plus is minus:
            return plus.gradient, plus.hessian
        gradient = np.where(sides > 0, plus.gradient, minus.gradient)
        gradient = np.where(sides == 0, 0.5 * (plus.gradient + minus.gradient), gradient)
        return gradient, _mixed(plus.hessian, minus.hessian, sides)


def _mixed(plus: FloatArray | Arrow, minus: FloatArray | Arrow, sides: NDArray[np.int_]) -> FloatArray | Arrow:
    if isinstance(plus, Arrow):
        return plus.mixed(minus, sides.astype(float)) if isinstance(minus, Arrow) else plus
    if isinstance(minus, Arrow):
        return minus
    pair = sides[:, None] + sides[None, :]
    return np.where(pair > 0, plus, np.where(pair < 0, minus, 0.5 * (plus + minus)))


def _first_order(
    plus: _Sample,
    minus: _Sample,
    kink: NDArray[np.bool_],
    side: NDArray[np.int_],
    normals: FloatArray,
    idle: NDArray[np.bool_] | None,
) -> tuple[float, FloatArray, NDArray[np.int_]]:
    """The steepest descent over feasible directions of length one, its multipliers, and the side of each coordinate.

    At a convex kink, g₋ <= g₊, the rate of change is the maximum of g v over [g₋, g₊], at a concave one the minimum of
    g₋ v and g₊ v. With one of the two chosen for every concave kink J' is thus convex and its steepest descent is the
    KKT residual; that of J' itself is the largest over the choices.
    """
    left, right = minus.gradient, plus.gradient
    if idle is not None:
        left, right, normals = left * ~idle, right * ~idle, normals * ~idle
    if plus is minus:
        return *kkt_residual(right, right, normals), side
    alone = np.where((left <= 0.0) & (right >= 0.0), 0, np.where(-right >= left, 1, -1))
    convex = kink & (left < right)
    best = -1.0
    for sides in _choices(np.where(kink, alone, side), kink & (left > right), normals):
        gradient = np.where(sides > 0, right, left)
        low, high = np.where(convex, left, gradient), np.where(convex, right, gradient)
        residual, values = kkt_residual(low, high, normals)
        if residual > best:
            best, multipliers = residual, values
            pull = normals.T @ values
            steepest = pull - np.clip(pull, low, high)
            moving = kink & (np.abs(steepest) > 1e-12 * (np.abs(left) + np.abs(right)))
            downhill = np.where(moving, np.where(steepest > 0.0, 1, -1), sides)
    return best, multipliers, downhill


def _choices(sides: NDArray[np.int_], concave: NDArray[np.bool_], normals: FloatArray) -> Iterator[NDArray[np.int_]]:
    """The given sides, then others for the concave kinks: alone each takes its steeper side, a constraint may differ.

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


class _Oracle:
    """The caller's function with a counter; turns unknowns into points and refuses what is not finite."""

    def __init__(self, problem: _Problem) -> None:
        self.problem = problem
        self.evaluations = 0

    def sample(self, theta: FloatArray, side: int) -> _Sample | None:
        """Evaluate once; None if the cost or a derivative that is needed is not finite."""
        self.evaluations += 1
        value = self.problem.evaluate(theta.copy(), side)
        d = theta.size
        gradient = np.asarray(value.gradient, dtype=float).reshape(d)
        hessian: FloatArray | Arrow = np.full((d, d), np.nan) if value.hessian is None else value.hessian
        if not isinstance(hessian, Arrow):
            hessian = np.asarray(hessian, dtype=float).reshape(d, d)
            hessian = 0.5 * (hessian + hessian.T)
        if not (np.isfinite(value.cost) and np.isfinite(gradient).all()):
            return None
        if self.problem.uses_hessian and not _is_finite(hessian):
            return None
        return _Sample(float(value.cost), gradient, hessian)

    def first(self, theta: FloatArray) -> _Sample | None:
        """The evaluation that suffices to judge the cost."""
        kink, side = self._sides(theta)
        return self.sample(theta, -1 if not kink.any() and (side < 0).any() else 1)

    def complete(self, theta: FloatArray, first: _Sample, scale: FloatArray) -> _Point | None:
        """The point: the other side is evaluated only if some coordinate is on a breakpoint and has room there."""
        kink, side = self._sides(theta)
        constraints = self.problem.constraints
        rounding = constraints.rounding(np.maximum(np.maximum(scale, self.problem.size), np.abs(theta)))
        active = np.flatnonzero(constraints.slack(theta) <= rounding)
        idle = self._idle(theta, active)
        if idle is not None:
            kink &= ~idle
        plus = minus = first
        if kink.any() or ((side < 0).any() and (side > 0).any()):
            other = self.sample(theta, -1)
            if other is None:
                return None
            minus = other
        normals = constraints.rows(active)
        optimality, values, downhill = _first_order(plus, minus, kink, side, normals, idle)
        multipliers = np.zeros(len(constraints.names))
        multipliers[active] = values
        return _Point(theta, plus, minus, kink, side, active, optimality, multipliers, downhill, idle)

    def _idle(self, theta: FloatArray, active: NDArray[np.intp]) -> NDArray[np.bool_] | None:
        """Coordinates on which J does not depend while the active rows stay active: (d,); None if there are none."""
        if self.problem.idle is None or not _rows_hold(self.problem, active):
            return None
        idle = self.problem.idle(theta.copy(), False)
        return idle if idle.any() else None

    def point(self, theta: FloatArray, scale: FloatArray) -> _Point | None:
        first = self.first(theta)
        return None if first is None else self.complete(theta, first, scale)

    def _sides(self, theta: FloatArray) -> tuple[NDArray[np.bool_], NDArray[np.int_]]:
        kink, side = np.zeros(theta.size, dtype=bool), np.zeros(theta.size, dtype=int)
        lower, upper = self.problem.constraints.lower, self.problem.constraints.upper
        for i, points in self.problem.breakpoints:
            x = theta[i]
            if _nearest(points, x) == x:
                room = int(x < upper[i]) - int(x > lower[i])
                kink[i], side[i] = room == 0 and lower[i] < upper[i], room
        return kink, side


def _is_finite(hessian: FloatArray | Arrow) -> bool:
    return hessian.finite if isinstance(hessian, Arrow) else bool(np.isfinite(hessian).all())


def _nearest(points: FloatArray, x: float) -> float:
    """The breakpoint nearest to x."""
    above = int(points.searchsorted(x))
    if above == points.size or (above > 0 and x - points[above - 1] <= points[above] - x):
        above -= 1
    return float(points[above])


# --- the state and one step -------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _State:
    point: _Point
    iteration: int = 0
    step_length: float = 0.0  # of the last iteration
    metric: float = 1.0  # steepest descent: B = I / metric
    settled: int = 0  # iterations since the optimality fell below the tolerance
    scale: FloatArray = field(default_factory=lambda: np.zeros(0))  # largest |theta_i| seen
    cost_scale: float = 0.0  # largest |J| seen
    gradient_scale: float = 0.0  # largest derivative seen
    lowest_cost: float = np.inf
    restarts: int = 0
    careful: bool = False  # the next step is taken with the diagonal of the Hessian alone
    status: Status | None = None
    reason: Finding | None = None  # why it failed, where it did


@dataclass(frozen=True, eq=False)
class _Direction:
    """Step d of the quadratic programme with its slope gᵀd and its predicted reduction −(gᵀd + ½dᵀBd)."""

    step: FloatArray
    slope: float
    reduction: float


@dataclass(frozen=True, eq=False)
class _Accepted:
    point: _Point
    step_length: float


def _step(oracle: _Oracle, state: _State) -> _State:
    """One iteration: the next state, or the same point with a status."""
    problem = oracle.problem
    direction = _direction(problem, state, problem.constraints.lower, problem.constraints.upper)
    if _is_settled(problem, state, direction):
        return _finish(oracle, state, Status.CONVERGED)
    if state.iteration >= problem.max_iterations:
        return replace(state, status=Status.MAX_ITERATIONS)
    accepted = _search(oracle, state, direction)
    if accepted is None:
        return _stalled(oracle, state, direction)
    return _advance(problem, state, accepted)


def _advance(problem: _Problem, state: _State, accepted: _Accepted) -> _State:
    """The state after an accepted step."""
    point, alpha = accepted.point, accepted.step_length
    return replace(
        state,
        point=point,
        iteration=state.iteration + 1,
        step_length=alpha,
        metric=state.metric * (2.0 if alpha >= 1.0 else alpha),
        settled=state.settled + 1 if point.optimality <= problem.tolerance else 0,
        scale=np.maximum(state.scale, np.abs(point.theta)),
        cost_scale=max(state.cost_scale, abs(point.cost)),
        gradient_scale=max(state.gradient_scale, point.largest_derivative),
        lowest_cost=min(state.lowest_cost, point.cost),
        careful=False,
    )


def _is_settled(problem: _Problem, state: _State, direction: _Direction) -> bool:
    """Optimality below the tolerance and, since J may be badly scaled, the next step negligible as well."""
    if state.point.optimality > problem.tolerance:
        return False
    if not problem.uses_hessian or state.settled >= EXTRA_ITERATIONS:
        return True
    return bool(np.all(np.abs(direction.step) <= NEGLIGIBLE_STEP * state.scale))


def _stalled(oracle: _Oracle, state: _State, direction: _Direction) -> _State:
    """The line search found nothing: tell convergence and the limit of precision from failure."""
    if state.point.optimality <= oracle.problem.tolerance:
        return _finish(oracle, state, Status.CONVERGED)
    floor = state.gradient_scale
    if oracle.problem.uses_hessian:
        hessian = state.point.plus.hessian
        size = abs(hessian) if isinstance(hessian, Arrow) else np.abs(hessian)
        floor = max(floor, float(np.max(size @ state.scale)))
    below_rounding = direction.reduction <= 10 * NOISE * state.cost_scale
    if below_rounding and state.point.optimality <= 1e5 * EPS * floor:
        return _finish(oracle, state, Status.CONVERGED_PRECISION)
    # Near a saddle, where slopes are lost in rounding, its negative curvature still leads away.
    escaped = _escape(oracle, state) if oracle.problem.uses_hessian and below_rounding else None
    if escaped is not None:
        return _advance(oracle.problem, state, escaped)
    if state.restarts < RESTARTS and not state.careful:
        point = oracle.point(state.point.theta, np.abs(state.point.theta))
        if point is not None:
            fresh = _initial_state(point)
            return replace(fresh, iteration=state.iteration, restarts=state.restarts + 1, careful=True)
    return replace(state, status=Status.LINE_SEARCH_FAILED, reason=_reason(oracle, state, direction))


def _reason(oracle: _Oracle, state: _State, direction: _Direction) -> Finding:
    """What J is like along the direction that failed, and which coordinates make it so."""
    problem, theta = oracle.problem, state.point.theta
    noise = NOISE * max(abs(state.point.cost), 0.01 * state.cost_scale)

    def line(fraction: float) -> tuple[float, float] | None:
        if fraction == 0.0:
            return state.point.cost, direction.slope
        sample = oracle.sample(theta + fraction * direction.step, 1)
        return None if sample is None else (sample.cost, float(sample.gradient @ direction.step))

    marks = [_next_breakpoint(points, theta[i], direction.step[i]) for i, points in problem.breakpoints]
    found = find_reason(line, noise, min([*marks, 1.0]))
    at = theta + found.at * direction.step
    if found.kind == "wrong slope":
        return replace(found, entries=_wrong_entries(oracle, state, noise))
    if found.kind == "jump":
        return replace(found, places=_who_jumps(oracle, theta, direction.step, found))
    if found.kind == "kink":
        bent = _who_bends(oracle, theta, direction.step, found)
        return replace(found, places=tuple((i, float(at[i])) for i in bent))
    if found.kind == "rounding":
        return replace(found, noise=noise)
    curvature = _curvature(problem, state, state.point.active).eigenvalues
    positive = curvature.size > 0 and curvature[0] > 0.0
    return replace(found, condition=float(curvature[-1] / curvature[0]) if positive else np.inf)


def _next_breakpoint(points: FloatArray, x: float, step: float) -> float:
    """Fraction of a step of one coordinate up to the next breakpoint that it meets; infinite if it meets none."""
    if step == 0.0:
        return np.inf
    ahead = points[points > x] if step > 0.0 else points[points < x]
    return float(np.min((ahead - x) / step, initial=np.inf))


def _wrong_entries(oracle: _Oracle, state: _State, noise: float) -> tuple[tuple[int, float, float], ...]:
    """Up to four coordinates whose derivative is not that of J: (coordinate, derivative, difference quotient)."""
    theta, problem = state.point.theta, oracle.problem
    breakpoints = dict(problem.breakpoints)
    wrong = []
    for i in np.flatnonzero(problem.constraints.movable):
        for sign in (1.0, -1.0):
            unit = np.zeros(theta.size)
            unit[i] = sign * 0.01 * max(abs(theta[i]), problem.size[i], 1e-3)

            def line(fraction: float, unit: FloatArray = unit) -> tuple[float, float] | None:
                sample = oracle.sample(theta + fraction * unit, 1)
                return None if sample is None else (sample.cost, float(sample.gradient @ unit))

            smooth = min(_next_breakpoint(breakpoints.get(int(i), np.zeros(0)), theta[i], unit[i]), 1.0)
            measured = wrong_slope(line, noise, smooth)
            if measured is not None:
                stated = state.point.plus.gradient[i]
                wrong.append((int(i), float(stated), float(measured / unit[i])))
                break
    return tuple(wrong[:4])


def _who_bends(oracle: _Oracle, theta: FloatArray, step: FloatArray, found: Finding) -> list[int]:
    """The coordinates along which the derivative of J jumps at a kink on the line."""
    width = max(2.0**-40 * found.at, 1e-15)
    sides = [oracle.sample(theta + (found.at + w) * step, 1) for w in (-width, width)]
    moving = np.flatnonzero(step).tolist()
    if sides[0] is None or sides[1] is None:
        return moving[:4]
    jumps = np.abs((sides[1].gradient - sides[0].gradient) * step)
    return [i for i in moving if jumps[i] > 0.1 * jumps.max()][:4]


def _who_jumps(oracle: _Oracle, theta: FloatArray, step: FloatArray, found: Finding) -> tuple[tuple[int, float], ...]:
    """The coordinate whose change by a hair across a jump of J makes it jump, with its value there.

    Up to four coordinates that the step moves, where none of them does so alone.
    """
    width = max(2.0**-40 * found.at, 1e-15)
    before, after = theta + (found.at - width) * step, theta + (found.at + width) * step
    base = oracle.sample(before, 1)
    for i in np.flatnonzero(before != after) if base is not None else ():
        moved = before.copy()
        moved[i] = after[i]
        there = oracle.sample(moved, 1)
        if (
            base is not None
            and there is not None
            and abs(there.cost - base.cost) > 0.5 * abs(found.after - found.before)
        ):
            return ((int(i), float(after[i])),)
    return tuple((int(i), float(after[i])) for i in np.flatnonzero(step)[:4])


def _finish(oracle: _Oracle, state: _State, status: Status) -> _State:
    """At a KKT point: leave a saddle if possible, otherwise classify the point by its free curvature."""
    problem = oracle.problem
    if problem.uses_hessian or _is_finite(state.point.plus.hessian):
        state = _close_gaps(oracle, state)
        accepted = _escape(oracle, state) if state.iteration < problem.max_iterations else None
        if accepted is not None:
            return _advance(problem, state, accepted)
        curvature = _curvature(problem, state, state.point.active)
        if curvature.smallest < NEGATIVE_CURVATURE:
            return replace(state, status=Status.SADDLE)
        if curvature.smallest <= EIGENVALUE_FLOOR:
            return replace(state, status=Status.SINGULAR)
        if state.point.idle is not None or curvature.idle is not None:
            return replace(state, status=Status.COLLAPSED)
    return replace(state, status=Status.CONVERGED_AT_KINK if _genuine_kinks(state).any() else status)


# --- direction --------------------------------------------------------------------------------------------------------


def _direction(problem: _Problem, state: _State, low: FloatArray, high: FloatArray) -> _Direction:
    """Step of the quadratic programme between low and high, with the best sides for coordinates on a kink.

    A coordinate on a kink is held (0) or confined to one side (+1, -1). Afterwards the force that holds it follows
    from the programme's multipliers; where it is outside [g₋, g₊] that coordinate, the worst one first, is released
    to the other side, and the programme is solved again, as long as that helps.
    """
    sides = state.point.downhill
    best, force = _solve_on_sides(problem, state, sides, low, high)
    for _ in range(2 * int(state.point.kink.sum())):
        released = _release(state, sides, best.step, force)
        if released is None:
            break
        sides = released
        direction, force = _solve_on_sides(problem, state, sides, low, high)
        if direction.reduction <= best.reduction:
            break
        best = direction
    return best


def _release(state: _State, sides: NDArray[np.int_], step: FloatArray, force: FloatArray) -> NDArray[np.int_] | None:
    """Sides with the coordinate released that a force farthest outside [g₋, g₊] holds at its kink; None if none is."""
    point = state.point
    left, right = point.minus.gradient, point.plus.gradient
    tolerance = 1e-13 * (np.abs(left) + np.abs(right))
    size = np.where(state.scale > 0.0, state.scale, 1.0)
    relative = np.abs(step) / size
    pinned = point.kink & (relative <= 8 * EPS * max(1.0, float(np.max(relative))))
    to_right = np.where(pinned & (sides <= 0), force - right - tolerance, 0.0)
    to_left = np.where(pinned & (sides >= 0), left - force - tolerance, 0.0)
    # In units of J, or unknowns of different units could not be compared.
    worth = np.maximum(to_right, to_left) * size
    worst = int(np.argmax(worth))
    if worth[worst] <= 0.0:
        return None
    changed = sides.copy()
    changed[worst] = 1 if to_right[worst] > to_left[worst] else -1
    return changed


def _solve_on_sides(
    problem: _Problem, state: _State, sides: NDArray[np.int_], low: FloatArray, high: FloatArray
) -> tuple[_Direction, FloatArray]:
    """The quadratic programme with kinks held or confined as `sides` say, and the force on each coordinate.

    The force is Aᵀ lam − B d: at a coordinate that does not move, the derivative that would balance the others.
    """
    point, constraints = state.point, problem.constraints
    gradient, hessian = point.derivatives(sides)
    lower, upper = np.minimum(low - point.theta, 0.0), np.maximum(high - point.theta, 0.0)
    free = constraints.movable if point.idle is None else constraints.movable & ~point.idle
    if point.kink.any():
        lower[point.kink & (sides > 0)] = 0.0
        upper[point.kink & (sides < 0)] = 0.0
        free = ~(point.kink & (sides == 0)) & free
    m, k = constraints.b.size, int(np.count_nonzero(free))
    if isinstance(hessian, Arrow) and problem.uses_hessian:
        return _solve_arrow(problem, state, gradient, hessian, free, lower, upper)
    # What is held is left out of the programme.
    part = slice(None) if k == free.size else np.flatnonzero(free)
    rows = slice(None) if k == free.size else np.concatenate([np.ones(m, dtype=bool), free, free])
    matrix = _model_matrix(problem, state, hessian, part)
    slack = np.maximum(constraints.A @ point.theta - constraints.b, 0.0)
    if point.active.size:
        slack[point.active[point.active < m]] = 0.0
    lower, upper = lower[part], upper[part]
    offsets = np.concatenate([-slack, lower, -upper])
    solution = solve_qp(gradient[part], matrix[part][:, part], constraints.normals[rows][:, part], offsets)
    found = solution.step
    if solution.multipliers.any():
        # A bound that presses is reached exactly, whatever rounding did to the step: kinks depend on it.
        at_lower, at_upper = solution.multipliers[m : m + k] > 0.0, solution.multipliers[m + k :] > 0.0
        found = np.where(at_lower, lower, np.where(at_upper, upper, found))
    step = np.zeros(free.size)
    step[part] = np.minimum(np.maximum(found, lower), upper)
    slope, curved = float(gradient @ step), matrix @ step
    force = constraints.A.T @ solution.multipliers[:m] - curved
    return _Direction(step, slope, -(slope + 0.5 * float(step @ curved))), force


def _solve_arrow(
    problem: _Problem,
    state: _State,
    gradient: FloatArray,
    hessian: Arrow,
    free: NDArray[np.bool_],
    lower: FloatArray,
    upper: FloatArray,
) -> tuple[_Direction, FloatArray]:
    """The same for a Hessian in the shape of an arrow; what is held keeps its place, with a step of zero."""
    point, constraints = state.point, problem.constraints
    m, d = constraints.b.size, free.size
    labels = _labels_of(problem, state)
    matrix = hessian if labels is None else hessian.masked(labels)
    pressed = constraints.rows(np.flatnonzero(point.multipliers > 0.0)) * free
    convex = convexify_arrow(matrix.held(free), pressed[np.any(pressed != 0.0, axis=1)], _floor(state) * free)
    slack = np.maximum(constraints.A @ point.theta - constraints.b, 0.0)
    slack[point.active[point.active < m]] = 0.0
    bounds = np.where(free, lower, -np.inf), np.where(free, -upper, -np.inf)
    solution = solve_arrow_qp(gradient * free, convex, constraints, np.concatenate([-slack, *bounds]))
    at_lower, at_upper = solution.multipliers[m : m + d] > 0.0, solution.multipliers[m + d :] > 0.0
    step = np.clip(np.where(at_lower, lower, np.where(at_upper, upper, solution.step)), lower, upper)
    step = np.where(free, step, 0.0)
    slope, curved = float(gradient @ step), convex @ step
    force = constraints.A.T @ solution.multipliers[:m] - np.where(free, curved, matrix @ step)
    return _Direction(step, slope, -(slope + 0.5 * float(step @ curved))), force


def _model_matrix(problem: _Problem, state: _State, hessian: FloatArray | Arrow, free: Index) -> FloatArray:
    """The matrix B of the quadratic programme: positive definite on the free coordinates, H elsewhere."""
    point = state.point
    if not problem.uses_hessian or isinstance(hessian, Arrow):
        return np.eye(point.theta.size) / state.metric
    if problem.hessian == "descent-first" and not _is_positive_definite(hessian[free][:, free]):
        return np.eye(point.theta.size) / state.metric
    matrix = hessian.copy()
    labels = _labels_of(problem, state)
    if labels is not None:
        matrix *= labels[:, None] == labels[None, :]
    pressed = problem.constraints.rows(np.flatnonzero(point.multipliers > 0.0))[:, free]
    block = free if isinstance(free, slice) else np.ix_(free, free)
    matrix[block] = convexify(matrix[block], pressed, _floor(state)[free])
    return matrix


def _labels_of(problem: _Problem, state: _State) -> FloatArray | None:
    """Labels of the blocks of the Hessian that count: each unknown by itself for a step after a failed line search."""
    return np.arange(state.point.theta.size, dtype=float) if state.careful else problem.labels


def _floor(state: _State) -> FloatArray:
    """Curvature below which an unknown's counts as none: where J is nearly linear in it, its step is limited too."""
    size = np.where(state.scale > 0.0, state.scale, 1.0)
    return np.maximum(_flatness(state), state.point.largest_slopes / (LONGEST_STEP * size))


def _is_positive_definite(matrix: FloatArray) -> bool:
    return bool(np.all(np.linalg.eigvalsh(matrix) > 0.0))


def _flatness(state: _State) -> FloatArray:
    """Diagonal Hessian entries so small that changing the unknown by its own size changes J by rounding only."""
    square = state.scale**2
    return np.where(square > 0.0, EPS * state.cost_scale / np.where(square > 0.0, square, 1.0), 0.0)


# --- line search ------------------------------------------------------------------------------------------------------


def _search(oracle: _Oracle, state: _State, direction: _Direction) -> _Accepted | None:
    """A step that decreases J: across breakpoints if that works, otherwise inside the present smooth piece."""
    problem, theta = oracle.problem, state.point.theta
    alpha = 1.0
    crossed = _crossings(problem, theta, direction.step)
    while crossed > 0:
        accepted = _attempt(oracle, state, direction, alpha, ARMIJO_ACROSS)
        if accepted is not None:
            return accepted
        alpha *= 0.5
        crossed = _crossings(problem, theta, alpha * direction.step)
        if crossed < MANY_BREAKPOINTS:
            direction = _direction(problem, state, *_piece(problem, theta))
            break
    return _backtrack(oracle, state, direction)


def _crossings(problem: _Problem, theta: FloatArray, step: FloatArray) -> int:
    """Largest number of breakpoints that a coordinate passes strictly inside the step."""
    largest = 0
    for i, points in problem.breakpoints:
        a, b = sorted((theta[i], theta[i] + step[i]))
        largest = max(largest, int(points.searchsorted(b, "left") - points.searchsorted(a, "right")))
    return largest


def _piece(problem: _Problem, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The smooth piece around theta: bounds tightened to the next breakpoint on either side."""
    low, high = problem.constraints.lower.copy(), problem.constraints.upper.copy()
    for i, points in problem.breakpoints:
        below, above = points.searchsorted(theta[i], "left"), points.searchsorted(theta[i], "right")
        if below > 0:
            low[i] = max(low[i], points[below - 1])
        if above < points.size:
            high[i] = min(high[i], points[above])
    return low, high


def _backtrack(oracle: _Oracle, state: _State, direction: _Direction) -> _Accepted | None:
    """Armijo backtracking from the full step ([1]_, algorithm 3.1)."""
    alpha = 1.0
    for k in range(MAX_BACKTRACKS):
        accepted = _attempt(oracle, state, direction, alpha, ARMIJO)
        if accepted is not None:
            return accepted
        alpha *= 0.5 if k < 5 else 0.25
        if k > 5 and alpha * -direction.slope < 0.01 * NOISE * abs(state.point.cost):
            break
    return _blind_step(oracle, state, direction)


def _attempt(oracle: _Oracle, state: _State, direction: _Direction, alpha: float, fraction: float) -> _Accepted | None:
    """The point at step length alpha if it is acceptable.

    Where the predicted decrease is below the rounding error of J, comparing costs says nothing ([2]_): then a
    smaller KKT residual counts, or a cost below every earlier one.
    """
    point = state.point
    theta = _move(oracle.problem, point.theta, alpha * direction.step)
    if (theta == point.theta).all():
        return None
    first = oracle.first(theta)
    noise = NOISE * abs(point.cost)
    decrease = -alpha * direction.slope
    if first is None or first.cost > state.lowest_cost + noise:
        return None
    if decrease > noise and first.cost > point.cost - fraction * decrease:
        return None
    trial = oracle.complete(theta, first, state.scale)
    if trial is None:
        return None
    if decrease <= noise and trial.optimality >= point.optimality and trial.cost >= state.lowest_cost:
        return None
    return _Accepted(trial, alpha)


def _blind_step(oracle: _Oracle, state: _State, direction: _Direction) -> _Accepted | None:
    """The full step on the word of the derivatives, where J is a small difference of large terms.

    The rounding error of such a J is that of the largest cost seen, not of J; the KKT residual has to halve.
    """
    noise = NOISE * state.cost_scale
    if direction.reduction > noise:
        return None
    theta = _move(oracle.problem, state.point.theta, direction.step)
    if np.array_equal(theta, state.point.theta):
        return None
    trial = oracle.point(theta, state.scale)
    if trial is None or trial.cost > state.lowest_cost + noise or trial.optimality > 0.5 * state.point.optimality:
        return None
    return _Accepted(trial, 1.0)


def _move(problem: _Problem, theta: FloatArray, step: FloatArray) -> FloatArray:
    """theta + step, feasible, and bit for bit on a bound, breakpoint or row that it reaches up to rounding.

    Rounding is measured by the typical size of an unknown too: a time that is 1e-30 after the start of the horizon is
    at its start, and no step along it could ever be told from none.
    """
    lower, upper = problem.constraints.lower, problem.constraints.upper
    moved = theta + step
    reach = np.maximum(np.maximum(np.abs(theta), np.abs(step)), np.abs(moved))
    near = 8 * EPS * np.maximum((step != 0.0) * reach, problem.size)
    pinned = np.zeros(theta.size, dtype=bool)
    for i, points in problem.breakpoints:
        mark = _nearest(points, moved[i])
        if abs(mark - moved[i]) <= near[i]:
            moved[i], pinned[i] = mark, True
    moved = np.where(moved - near <= lower, lower, np.where(moved + near >= upper, upper, moved))
    if np.all(problem.constraints.A @ moved - problem.constraints.b > problem.row_rounding):
        return moved
    pinned |= (moved == lower) | (moved == upper)
    return _snap_to_rows(problem, _repair(problem.constraints, moved, pinned), pinned)


def _snap_to_rows(
    problem: _Problem, theta: FloatArray, pinned: NDArray[np.bool_], reach: float = 16 * EPS
) -> FloatArray:
    """theta with the slack of each row removed that is at most `reach` of the size of the unknowns that it joins.

    Only of rows that can hold exactly: that bound one coordinate, ``+-theta_i >= b``, or keep two in order,
    ``theta_i - theta_j >= 0``.
    """
    constraints = problem.constraints
    slack = constraints.A @ theta - constraints.b
    close = np.abs(slack) <= reach * problem.row_size
    if not slack[close].any():
        return theta
    snapped, fixed = theta.copy(), pinned.copy()
    rows = sorted(constraints.exact_rows(np.flatnonzero(close)), key=lambda row: row[1] >= 0)
    for _ in rows:  # a coordinate that moves may leave a row that held
        before = snapped.copy()
        for i, j, bound in rows:
            if j < 0:
                snapped[i], fixed[i] = bound, True
            elif fixed[i] and not fixed[j]:
                snapped[j], fixed[j] = snapped[i], True
            elif not fixed[i]:
                snapped[i], fixed[i] = snapped[j], fixed[j]
        if np.array_equal(snapped, before):
            break
    snapped = np.clip(snapped, constraints.lower, constraints.upper)
    return snapped if _violation(constraints, snapped) <= _violation(constraints, theta) else theta


def _repair(constraints: LinearConstraints, theta: FloatArray, pinned: NDArray[np.bool_]) -> FloatArray:
    """Remove violations of the rows that are due to rounding, leaving pinned coordinates where they are.

    Projections onto one violated row after the other, an ulp to its inside. What they cannot remove where many rows
    meet at a vertex is left: it is of the size of rounding too.
    """
    best, least = theta, _violation(constraints, theta)
    repaired = theta.copy()
    for _ in range(6):
        if least <= 0.0:
            break
        for normal, bound in zip(constraints.A, constraints.b, strict=True):
            violation = float(bound - normal @ repaired)
            inside = np.where(pinned, 0.0, normal)
            square = float(inside @ inside)
            if violation > 0.0 and square > 0.0:
                margin = EPS * float(np.abs(normal) @ np.abs(repaired))
                repaired += inside * ((violation + margin) / square)
        repaired = np.clip(repaired, constraints.lower, constraints.upper)
        remaining = _violation(constraints, repaired)
        if remaining < least:
            best, least = repaired.copy(), remaining
    return best


def _violation(constraints: LinearConstraints, theta: FloatArray) -> float:
    """Largest violation of a row."""
    return float(np.max(constraints.b - constraints.A @ theta, initial=0.0))


# --- curvature and classification -------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Curvature:
    """Hessian on the free directions: orthonormal basis, scaled and unscaled eigenvalues, the lowest direction."""

    basis: FloatArray
    eigenvalues: FloatArray
    unscaled: FloatArray
    lowest: FloatArray  # of unit length in theta
    idle: NDArray[np.bool_] | None = None  # coordinates left out as idle, beside those of the point

    @property
    def smallest(self) -> float:
        """Smallest scaled eigenvalue; infinite on no directions, NaN where there is no Hessian."""
        return float(self.eigenvalues[0]) if self.eigenvalues.size else np.inf


def _genuine_kinks(state: _State) -> NDArray[np.bool_]:
    """Coordinates on a breakpoint whose derivative really jumps upwards there."""
    jump = state.point.plus.gradient - state.point.minus.gradient
    return np.asarray(state.point.kink & (jump > 1e-12 * state.gradient_scale))


def _curvature(problem: _Problem, state: _State, rows: NDArray[np.intp]) -> _Curvature:
    """Curvature of J, unmodified, in the null space of the given constraints and off the kinks."""
    known = state.point.curvatures
    key = rows.tobytes()
    if key not in known:
        known[key] = _curvature_on(problem, state, rows)
    return known[key]


def _curvature_on(problem: _Problem, state: _State, rows: NDArray[np.intp]) -> _Curvature:
    point = state.point
    held = _genuine_kinks(state) | ~problem.constraints.movable
    held = held if point.idle is None else held | point.idle
    found = _curvature_without(problem, state, rows, held)
    if problem.idle is not None and _rows_hold(problem, point.active):
        bounds = point.active[point.active >= problem.constraints.b.size]
        loose = np.any(point.multipliers[bounds] <= 1e-10 * state.gradient_scale)  # bounds that hold nothing back
        if found.smallest <= EIGENVALUE_FLOOR or loose:
            idle = problem.idle(point.theta.copy(), True) & ~held
            if idle.any():
                found = replace(_curvature_without(problem, state, rows, held | idle), idle=idle)
    return found


def _rows_hold(problem: _Problem, active: NDArray[np.intp]) -> bool:
    """Whether rows are among the active constraints, and not bounds alone; these are in ascending order."""
    return bool(active.size and active[0] < problem.constraints.b.size)


def _curvature_without(problem: _Problem, state: _State, rows: NDArray[np.intp], held: NDArray[np.bool_]) -> _Curvature:
    """Curvature in the null space of the constraints without the coordinates that are held."""
    point = state.point
    d = point.theta.size
    hessian = point.derivatives(_reported_sides(point))[1]
    if isinstance(hessian, Arrow):
        found = _arrow_curvature(problem, state, rows, hessian, held)
        if found is not None:
            return found
        hessian = hessian.dense()
    free = np.flatnonzero(~held)
    normals = problem.constraints.rows(rows)[:, free]
    basis = np.zeros((d, 0)) if free.size == 0 else np.eye(d)[:, free] @ split_space(normals)[0]
    count = basis.shape[1]
    if count == 0 or not np.isfinite(hessian).all():
        nothing = np.full(count, np.nan)
        return _Curvature(basis, nothing, nothing, np.zeros(d))
    block = hessian[np.ix_(free, free)]
    scaling = diagonal_scaling(block, _flatness(state)[free])
    null = split_space(normals / scaling)[0]
    values, vectors = np.linalg.eigh(null.T @ (block / np.outer(scaling, scaling)) @ null)
    lowest = np.zeros(d)
    lowest[free] = null @ vectors[:, 0] / scaling
    unscaled = np.asarray(np.linalg.eigvalsh(basis.T @ hessian @ basis), dtype=float)
    return _Curvature(basis, np.asarray(values, dtype=float), unscaled, lowest / np.linalg.norm(lowest))


def _idle_names(problem: _Problem, state: _State) -> tuple[int, ...]:
    """Coordinates on which J does not depend at the state's point, and those that active rows tie to them."""
    point = state.point
    found = _curvature(problem, state, point.active).idle
    alone = set() if found is None else set(np.flatnonzero(found).tolist())
    if point.idle is None:
        return tuple(sorted(alone))
    idle = set(np.flatnonzero(point.idle).tolist())
    ties = [{i, j} for i, j, _ in problem.constraints.exact_rows(point.active) if j >= 0]
    for _ in ties:
        idle |= {k for tie in ties if tie & idle for k in tie}
    return tuple(sorted(idle | alone))


def _arrow_curvature(
    problem: _Problem, state: _State, rows: NDArray[np.intp], hessian: Arrow, held: NDArray[np.bool_]
) -> _Curvature | None:
    """The same where only bounds are active and the curvature is positive: its smallest eigenvalue alone.

    None in all other cases, which are rare enough to be left to the algebra of full matrices.
    """
    m, d = problem.constraints.b.size, held.size
    if np.any(rows < m) or not hessian.finite:
        return None
    held = held.copy()
    held[(rows - m) % d] = True
    kept = hessian.held(~held)
    scaling = arrow_scaling(kept, _flatness(state))
    smallest, lowest = _smallest(kept.scaled(scaling), ~held)
    unscaled, _ = _smallest(kept, ~held)
    if lowest is None or held.all():
        return None
    lowest = lowest / scaling
    return _Curvature(np.eye(d)[:, ~held], np.array([smallest]), np.array([unscaled]), lowest / np.linalg.norm(lowest))


def _smallest(matrix: Arrow, free: NDArray[np.bool_]) -> tuple[float, FloatArray | None]:
    """Smallest eigenvalue on the free coordinates, and its eigenvector, by inverse iteration; None if it is not > 0."""
    factor = ArrowFactor.of(matrix)
    if factor is None:
        return np.nan, None
    vector = np.where(free, np.random.default_rng(0).normal(size=free.size), 0.0)
    value = np.inf
    for _ in range(1000):
        vector = vector / np.linalg.norm(vector)
        vector = np.where(free, factor.solve(vector), 0.0)
        before, value = value, 1.0 / float(np.linalg.norm(vector))
        if abs(value - before) <= 1e-8 * value:
            break
    return value, vector / np.linalg.norm(vector)


def _reported_sides(point: _Point) -> NDArray[np.int_]:
    """The right-hand side for every coordinate on a breakpoint that has one."""
    return np.where(point.kink, 1, point.side)


def _close_gaps(oracle: _Oracle, state: _State) -> _State:
    """The state with the rows that it misses by less than it is accurate to made to hold, if it stays as good.

    A mode that lasts a part of 1e-13 of the horizon has collapsed. Taken for one that has not, its two ends would be
    free, and the curvature along them, which is that of J in its duration, may be negative. Where the data are met
    exactly, J is so curved in the duration that the optimality of the closed point exceeds the tolerance: it is as good
    all the same if a step from there is negligible.
    """
    problem, point = oracle.problem, state.point
    theta = _snap_to_rows(problem, point.theta, np.zeros(point.theta.size, dtype=bool), NEGLIGIBLE_STEP)
    if np.array_equal(theta, point.theta):
        return state
    closed = oracle.point(theta, state.scale)
    if closed is None or closed.cost > point.cost + NOISE * state.cost_scale:
        return state
    after = _advance(problem, state, _Accepted(closed, 1.0))
    if closed.optimality <= max(problem.tolerance, point.optimality):
        return after
    if closed.idle is None:
        return state
    step = _direction(problem, after, problem.constraints.lower, problem.constraints.upper).step
    negligible = np.abs(step) <= NEGLIGIBLE_STEP * np.maximum(state.scale, problem.size)
    return after if np.all(negligible) else state


def _escape(oracle: _Oracle, state: _State) -> _Accepted | None:
    """A step along negative curvature: on the face of the pressing constraints first, then of all active ones."""
    problem = oracle.problem
    pressing = np.flatnonzero(state.point.multipliers > max(problem.tolerance, 1e-10 * state.gradient_scale))
    active = state.point.active
    for rows in (pressing,) if np.array_equal(pressing, active) else (pressing, active):
        curvature = _curvature(problem, state, rows)
        if not curvature.smallest < NEGATIVE_CURVATURE:
            continue
        for ray in (curvature.lowest, -curvature.lowest):
            accepted = _descend_along(oracle, state, ray)
            if accepted is not None:
                return accepted
    return None


def _descend_along(oracle: _Oracle, state: _State, ray: FloatArray) -> _Accepted | None:
    """Backtracking on the quadratic decrease ½ t² rayᵀH ray, starting at a tenth of the size of the unknowns."""
    problem, point = oracle.problem, state.point
    _, hessian = point.derivatives(_reported_sides(point))
    bending = float(ray @ (hessian @ ray))
    sized = state.scale > 0.0
    relative = float(np.max(np.abs(ray[sized]) / state.scale[sized], initial=0.0))
    length = 0.1 / relative if relative > 0.0 else 0.1 / float(np.max(np.abs(ray)))
    slope = problem.constraints.slopes(ray)
    slack = np.maximum(problem.constraints.slack(point.theta), 0.0)
    slack[point.active] = 0.0
    approaching = slope < -1e-12 * problem.constraints.row_norms
    length = min(length, float(np.min(slack[approaching] / -slope[approaching], initial=np.inf)))
    for _ in range(40):
        decrease = -0.5 * bending * length**2
        if decrease <= NOISE * abs(point.cost) or length == 0.0:
            return None
        theta = _move(problem, point.theta, length * ray)
        first = oracle.first(theta)
        if first is not None and first.cost < point.cost - ARMIJO * decrease:
            trial = oracle.complete(theta, first, state.scale)
            if trial is not None:
                return _Accepted(trial, length)
        length *= 0.5
    return None


# --- the driver -------------------------------------------------------------------------------------------------------


def minimize(
    evaluate: Evaluate,
    theta0: ArrayLike,
    *,
    constraints: LinearConstraints,
    breakpoints: Sequence[ArrayLike] | None = None,
    hessian: HessianKind = "exact",
    blocks: ArrayLike | None = None,
    tolerance: float = 1e-7,
    max_iterations: int = 200,
    callback: Callback | None = None,
    size: ArrayLike | None = None,
    idle: Idle | None = None,
) -> Result:
    """Minimise a piecewise smooth cost under linear constraints; every iterate is feasible.

    Parameters
    ----------
    evaluate : callable
        ``evaluate(theta, side)`` returns cost, gradient, shape (d,), and Hessian, shape (d, d), or a
        `switchfit.optimize.arrow.Arrow`, with which the cost of an iteration is linear in d. `side` is +1 or -1: which
        one-sided derivatives to return for coordinates that sit exactly on a breakpoint. A cost or derivative that is
        not finite marks a point as unacceptable.
    theta0 : array, shape (d,)
        Start, feasible up to rounding.
    constraints : LinearConstraints
        ``A theta >= b`` and bounds.
    breakpoints : sequence of d arrays, optional
        Sorted values of each coordinate where the derivatives of J may jump. None: J is smooth.
    hessian : {"exact", "descent-first", "block-diagonal", "gauss-newton", "none"}
        What stands in the quadratic programme: the Hessian as evaluated, made positive definite where needed; the
        Hessian where it is positive definite and steepest descent until then (the paper's scheme, Section II-A); the
        first without the entries between different `blocks`; the same again, for a caller whose `evaluate` returns
        Gauss-Newton's matrix; or nothing (steepest descent in the metric of theta, as in the paper).
    blocks : array of int, shape (d,), optional
        Label of each coordinate, for "block-diagonal".
    tolerance : float
        Bound on the KKT residual. Unless `hessian` is "none", the next step has to be negligible too: a predicted
        reduction of at most 1e-10 of the cost, or at most 1e-8 of each unknown.
    max_iterations : int
    callback : callable, optional
        Gets an `IterationRecord` after every iteration; a true return value stops with ``INTERRUPTED``.
    size : array, shape (d,), optional
        Typical size of each unknown, of which rounding is a part: for a time, the length of the horizon, however
        small the time itself. Left out, the unknown's own values say it.
    idle : callable, optional
        ``idle(theta, everything)`` says which coordinates, (d,) of bool, may be held at a theta with active rows,
        because J depends on none of them while these rows are active, whatever derivatives say, which have the error
        of its evaluation. Where `everything` is false, those that are found at no cost are enough.

    Returns
    -------
    Result
        Also after a KeyboardInterrupt, raised anywhere but in the evaluation of the start: the best point so far.

    Raises
    ------
    ValueError
        If shapes or settings are wrong, or the start is infeasible.

    Notes
    -----
    One iteration costs one evaluation and a quadratic programme, and one more evaluation if a coordinate is on a
    breakpoint. The rate is quadratic with the exact Hessian if the second-order sufficient conditions hold.
    """
    start = np.atleast_1d(np.asarray(theta0, dtype=float)).copy()
    problem = _make_problem(
        evaluate, start, constraints, breakpoints, hessian, blocks, tolerance, max_iterations, size, idle
    )
    theta = _feasible_start(problem, start)
    oracle = _Oracle(problem)
    point = oracle.point(theta, np.abs(theta))
    if point is None:
        return _nonfinite_start(oracle, theta)
    state = _initial_state(point)
    history = [_record(oracle, state)]
    try:
        while state.status is None:
            before = state.iteration
            state = _step(oracle, state)
            if state.iteration > before:
                history.append(_record(oracle, state))
                if callback is not None and callback(history[-1]):
                    state = replace(state, status=Status.INTERRUPTED)
    except KeyboardInterrupt:
        state = replace(state, status=Status.INTERRUPTED)
    return _result(oracle, state, state.status or Status.INTERRUPTED, tuple(history))


def _make_problem(
    evaluate: Evaluate,
    theta: FloatArray,
    constraints: LinearConstraints,
    breakpoints: Sequence[ArrayLike] | None,
    hessian: HessianKind,
    blocks: ArrayLike | None,
    tolerance: float,
    max_iterations: int,
    size: ArrayLike | None,
    idle: Idle | None,
) -> _Problem:
    """The problem with all settings checked."""
    d = constraints.size
    if theta.shape != (d,):
        raise ValueError(f"theta0 has shape {theta.shape}, the constraints expect ({d},)")
    if d == 0:
        raise ValueError("there is nothing to minimise over: theta0 is empty")
    if hessian not in get_args(HessianKind):
        raise ValueError(f"hessian is {hessian!r}; choose one of {', '.join(get_args(HessianKind))}")
    if not tolerance >= 0.0 or max_iterations < 0:
        raise ValueError(f"tolerance {tolerance} and max_iterations {max_iterations} must not be negative")
    return _Problem(
        evaluate=evaluate,
        constraints=constraints,
        breakpoints=_checked_breakpoints(breakpoints, d),
        hessian=hessian,
        labels=_labels(hessian, blocks, d),
        tolerance=tolerance,
        max_iterations=max_iterations,
        size=np.zeros(d) if size is None else np.broadcast_to(np.asarray(size, dtype=float), (d,)),
        idle=idle,
    )


def _checked_breakpoints(breakpoints: Sequence[ArrayLike] | None, d: int) -> tuple[tuple[int, FloatArray], ...]:
    given: Sequence[ArrayLike] = [()] * d if breakpoints is None else breakpoints
    if len(given) != d:
        raise ValueError(f"got breakpoints for {len(given)} coordinates, expected {d}; give an empty array for none")
    arrays = tuple(np.asarray(points, dtype=float).reshape(-1) for points in given)
    for i, points in enumerate(arrays):
        if not (np.isfinite(points).all() and np.all(np.diff(points) > 0.0)):
            raise ValueError(f"the breakpoints of coordinate {i} must be finite and strictly increasing; use np.unique")
    return tuple((i, points) for i, points in enumerate(arrays) if points.size)


def _labels(hessian: HessianKind, blocks: ArrayLike | None, d: int) -> FloatArray | None:
    """Labels of the blocks; None unless the Hessian is to be cut into blocks."""
    if hessian != "block-diagonal":
        return None
    labels = np.asarray(blocks)
    if blocks is None or labels.shape != (d,):
        raise ValueError(f"hessian='block-diagonal' needs blocks, an integer label for each of the {d} coordinates")
    return labels.astype(float)


def _feasible_start(problem: _Problem, theta: FloatArray) -> FloatArray:
    """The start with violations of the size of rounding removed."""
    constraints = problem.constraints
    if not np.isfinite(theta).all():
        raise ValueError(f"theta0 is not finite: {theta}")
    slack = constraints.slack(theta)
    bounds = np.abs(np.concatenate([constraints.lower, constraints.upper]))
    rows = np.abs(constraints.b) + np.abs(constraints.A) @ np.maximum(np.abs(theta), problem.size)
    size = np.concatenate([rows, np.where(np.isfinite(bounds), bounds, 0.0)])
    violated = np.flatnonzero(slack < -1e-12 * (size + np.finfo(float).tiny))
    if violated.size:
        worst = [f"{constraints.names[i]} (by {-slack[i]:.3g})" for i in violated[:5]]
        raise ValueError(f"The start violates {', '.join(worst)}; start at a feasible point.")
    return _move(problem, theta, np.zeros_like(theta))


def _initial_state(point: _Point) -> _State:
    return _State(
        point=point,
        metric=1.0 / max(1.0, point.optimality),
        scale=np.abs(point.theta),
        cost_scale=abs(point.cost),
        gradient_scale=point.largest_derivative,
        lowest_cost=point.cost,
    )


def _record(oracle: _Oracle, state: _State) -> IterationRecord:
    point = state.point
    return IterationRecord(
        iteration=state.iteration,
        cost=point.cost,
        optimality=point.optimality,
        step=state.step_length,
        theta=point.theta.copy(),
        evaluations=oracle.evaluations,
    )


def _result(oracle: _Oracle, state: _State, status: Status, history: tuple[IterationRecord, ...]) -> Result:
    """The result at the state's point."""
    problem, point = oracle.problem, state.point
    gradient, hessian = point.derivatives(_reported_sides(point))
    curvature = _curvature(problem, state, point.active)
    held = np.flatnonzero(_genuine_kinks(state))
    return Result(
        theta=point.theta,
        cost=point.cost,
        gradient=gradient,
        hessian=hessian.dense() if isinstance(hessian, Arrow) else hessian,
        optimality=point.optimality,
        iterations=state.iteration,
        evaluations=oracle.evaluations,
        status=status,
        active=tuple(problem.constraints.names[i] for i in point.active),
        multipliers=point.multipliers,
        kinks=tuple((int(i), float(point.minus.gradient[i]), float(point.plus.gradient[i])) for i in held),
        free_basis=curvature.basis,
        free_eigenvalues=curvature.eigenvalues,
        smallest_eigenvalue=float(curvature.eigenvalues[0]) if curvature.eigenvalues.size else np.nan,
        smallest_unscaled_eigenvalue=float(curvature.unscaled[0]) if curvature.unscaled.size else np.nan,
        flat_direction=curvature.lowest,
        tolerance=problem.tolerance,
        history=history,
        idle=_idle_names(problem, state),
        reason=state.reason,
    )


def _nonfinite_start(oracle: _Oracle, theta: FloatArray) -> Result:
    """A result without numbers."""
    d = theta.size
    return Result(
        theta=theta,
        cost=np.nan,
        gradient=np.full(d, np.nan),
        hessian=np.full((d, d), np.nan),
        optimality=np.nan,
        iterations=0,
        evaluations=oracle.evaluations,
        status=Status.NONFINITE_START,
        active=(),
        multipliers=np.zeros(len(oracle.problem.constraints.names)),
        kinks=(),
        free_basis=np.zeros((d, 0)),
        free_eigenvalues=np.zeros(0),
        smallest_eigenvalue=np.nan,
        smallest_unscaled_eigenvalue=np.nan,
        flat_direction=np.zeros(d),
        tolerance=oracle.problem.tolerance,
        history=(),
    )
