"""Sequential quadratic programming for a piecewise smooth cost under linear constraints and equalities.

The problem is to minimize J(theta) subject to A theta >= b and lower <= theta <= upper, where J is continuous and
smooth except where a coordinate passes one of its breakpoints: there its derivatives jump. (A transition time that
passes a sample time is such a coordinate.) These constraints are linear, so every iterate satisfies them, and the line
search compares J alone. There may also be nonlinear equality constraints c(theta) = 0, which are met at the end.

One iteration, `_step`, maps a `state` at a `point` to the next state:

1. *direction* (`search_direction`): a convex quadratic programme (`qp`, with Hessians that are `dense` or an `arrow`),
   or with equality constraints a step composed of the solutions of two (`composite_step`);
2. *line search* (`line_search`): the full step first, even across breakpoints, then inside the present smooth piece; by
   default in a region that shrinks (`trust_region`); with equality constraints it compares a merit function (`merit`);
   every trial is made feasible (`feasibility`) and evaluated (`oracle`);
3. *kinks* (`first_order`): coordinates that sit on a breakpoint are held, or released to one side.

At a stationary point the curvature distinguishes a minimum from a saddle, which is left along negative curvature
(`stationary_points`). If no step decreases J, `failure` finds the reason.

References
----------
.. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, chapters 3, 12, 16 and 18.
"""

from __future__ import annotations

from functools import cache, partial

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray
from switchfit.optimize import algebra, failure, line_search, merit, search_direction, trust_region
from switchfit.optimize.curvature import FreeCurvature, Spectrum
from switchfit.optimize.feasibility import Trial, feasible_start
from switchfit.optimize.minimization_problem import MinimizationProblem
from switchfit.optimize.oracle import Oracle
from switchfit.optimize.point import MET, Point
from switchfit.optimize.result import Callback, IterationRecord, Result
from switchfit.optimize.state import State
from switchfit.optimize.stationary_points import NEGATIVE_CURVATURE, close_gaps, escape
from switchfit.optimize.status import Status
from switchfit.optimize.threads import one_thread

#: Number of restarts of a minimization from a point at which its line search has failed.
RESTARTS = 3

#: Statuses of minimizations that might have gone on.
UNFINISHED = (Status.MAX_ITERATIONS, Status.LINE_SEARCH_FAILED)


@one_thread()
def minimize(
    problem: MinimizationProblem,
    start: FloatArray,
    callback: Callback | None = None,
    multipliers: ArrayLike | None = None,
) -> Result:
    """Minimize a piecewise smooth cost under linear constraints, which all iterates satisfy, and equality constraints.

    Parameters
    ----------
    problem : Problem
    start : array, shape (d,)
        Feasible up to rounding; it need not satisfy the equality constraints.
    callback : callable, optional
        Called with an `IterationRecord` after every iteration; a true return value stops with ``INTERRUPTED``.
    multipliers : array, shape (k,), optional
        Of the equality constraints at the start, where they are known. Otherwise they are found there by least squares,
        and where constraints are fewer than unknowns, the start is evaluated once more for the Lagrangian's Hessian.

    Returns
    -------
    Result
        The best point found, also after a KeyboardInterrupt during any evaluation but the first.

    Raises
    ------
    ValueError
        If the start is infeasible.

    Notes
    -----
    One iteration costs one evaluation and a quadratic program, and one more evaluation if a coordinate is on a
    breakpoint. The rate is quadratic with the exact Hessian if the second-order sufficient conditions hold.

    Linear algebra has one thread, also in the functions that are called, unless these are `with_own_threads`.
    """
    trial, oracle = feasible_start(problem, start), Oracle(problem, multipliers)
    # The Hessian of the Lagrangian needs multipliers, and these need derivatives: the start is evaluated with zero
    # ones.
    point = oracle.point(trial, np.abs(trial.theta))
    if point is not None and multipliers is None and 0 < len(problem.equalities) < start.size:
        # As many constraints as unknowns leave no direction in which curvature counts.
        oracle.multipliers = point.forces
        point = oracle.point(trial, np.abs(trial.theta))
    if point is None:
        return _nonfinite_start(oracle, trial.theta)
    return _iterate(oracle, State.at(point), callback)


def _iterate(oracle: Oracle, state: State, callback: Callback | None) -> Result:
    """Do iterations until one ends with a status, and return the result."""
    history = [_record(oracle, state)]
    try:
        while state.status is None:
            before = state.iteration
            state = _step(oracle, state)
            if state.iteration > before:
                history.append(_record(oracle, state))
                if callback is not None and callback(history[-1]):
                    state = state._replace(status=Status.INTERRUPTED)
    except KeyboardInterrupt:
        state = state._replace(status=Status.INTERRUPTED)
    return _result(oracle, state, state.status or Status.INTERRUPTED, tuple(history))


def _find_unbounded(problem: MinimizationProblem, state: State) -> search_direction.SearchDirection:
    """Return the step of the quadratic programme outside any trust region."""
    return search_direction.find_direction(problem, state._replace(radius=np.inf))


def _step(oracle: Oracle, state: State) -> State:
    """Do one iteration: return the next state, or the same point with a status."""
    problem = oracle.problem
    # Direction: [1]_, sections 18.1 and 18.5. It comes before the test of convergence, which asks for its length.
    direction = search_direction.find_direction(problem, state)
    if _is_settled(problem, state, direction):
        return _finish(oracle, state, direction, Status.CONVERGED)
    if state.iteration >= problem.max_iterations:
        return state._replace(status=Status.MAX_ITERATIONS)
    # A local minimum of the violation: linearized constraints that contradict one another, as guards that a trajectory
    # no longer reaches. The line search would make ever smaller steps there ([1]_, section 17.2).
    if problem.equalities and merit.is_stuck(oracle, state):
        return state._replace(status=Status.INFEASIBLE)
    # Before the line search: it would accept steps that change J by rounding alone.
    if _is_held_back(problem, state, direction):
        return _handle_stall(oracle, state, _find_unbounded(problem, state))
    # Where J itself is accurate to `accuracy` only, a model that promises less than that is at its minimum.
    accuracy = 0.0 if problem.accuracy is None else problem.accuracy()
    if accuracy and direction.reduction <= accuracy * abs(state.point.cost) and state.point.violation <= MET:
        return _finish(oracle, state, direction, Status.CONVERGED_PRECISION)
    # Line search: across breakpoints, then inside the piece; see `line_search`.
    accepted = line_search.search(oracle, state, direction)
    if accepted is None:
        return _handle_stall(oracle, state, direction)
    following = state.advance(accepted, problem.tolerance)
    return _measure_anew(oracle, following) if oracle.rescale(following.point) else following


def _measure_anew(oracle: Oracle, state: State) -> State:
    """Return the state with constraints in new units; penalty and violation are reset."""
    point = oracle.point(Trial.at(oracle.problem, state.point.theta), state.scale)
    if point is None:
        return state
    penalty = State.at(point).penalty
    return state._replace(point=point, penalty=penalty, steady_violation=point.violation, stagnant=0)


def _is_settled(problem: MinimizationProblem, state: State, direction: search_direction.SearchDirection) -> bool:
    """Return whether the optimality is below the tolerance and the next step negligible, for J may be badly scaled."""
    if not state.point.is_stationary(problem.tolerance):
        return False
    # Without a Hessian the step says nothing about the distance to the minimum. With one, a small gradient alone is no
    # end: along an unknown of the size 1e6 a gradient of 1e-7 may be a step of its whole size away. A few iterations
    # later it is, for a step need not become negligible where J is flat.
    if not problem.uses_hessian or state.settled >= algebra.EXTRA_ITERATIONS:
        return True
    return bool(algebra.is_negligible(direction.step, state.scale))


def _is_held_back(problem: MinimizationProblem, state: State, direction: search_direction.SearchDirection) -> bool:
    """Return whether J can only fall by rounding in a trust region, and the quadratic model promises more outside.

    The region shrinks to that size beside a kink or a jump of J that is no breakpoint. Steps in it would be accepted,
    as J stays the same, and go on for ever.
    """
    noise = algebra.COST_NOISE * abs(state.point.cost)
    if problem.hessian != "auto" or problem.equalities or direction.reduction > noise:
        return False
    # A step that ends inside the region is not held back by it.
    if trust_region.measure_in_box(problem, direction.step) < 0.9 * state.radius:
        return False
    return _find_unbounded(problem, state).reduction > 10 * noise


def _handle_stall(oracle: Oracle, state: State, direction: search_direction.SearchDirection) -> State:
    """Distinguish convergence and the limit of precision from failure after a line search that found no step."""
    if state.point.is_stationary(oracle.problem.tolerance):
        return _finish(oracle, state, direction, Status.CONVERGED)
    if state.point.violation > MET:
        return state._replace(status=Status.INFEASIBLE)
    # The derivatives are rounded relative to their largest terms: those seen so far, and |H| |theta|.
    # A gradient is the difference of terms that may each be large: at the end of a fit with a far start, or with
    # unknowns of unlike size, what is left of it cannot be below their rounding.
    floor = state.gradient_scale
    if oracle.problem.uses_hessian:
        floor = max(floor, float(np.max(state.point.plus.hessian.absolute().dot(state.scale))))
    below_rounding = failure.is_below_rounding(oracle, state, direction)
    if below_rounding and state.point.optimality <= 1e5 * algebra.EPS * floor:
        return _finish(oracle, state, direction, Status.CONVERGED_PRECISION)
    # Near a saddle slopes are below rounding, but negative curvature still gives a direction.
    escaped = escape(oracle, state) if oracle.problem.uses_hessian and below_rounding else None
    if escaped is not None:
        return state.advance(escaped, oracle.problem.tolerance)
    # Scales that a far start has left, or a Hessian that couples unknowns wrongly: once more with fresh ones, and a
    # first step by the diagonal alone (`careful`).
    if state.restarts < RESTARTS and not state.careful:
        theta = state.point.theta
        point = oracle.point(Trial.at(oracle.problem, theta), np.abs(theta))
        if point is not None:
            fresh = State.at(point)
            return fresh._replace(iteration=state.iteration, restarts=state.restarts + 1, careful=True)
    explain = cache(partial(failure.explain_failure, oracle, state, direction))
    return state._replace(status=Status.LINE_SEARCH_FAILED, explain=explain)


def _finish(oracle: Oracle, state: State, direction: search_direction.SearchDirection, status: Status) -> State:
    """Leave a saddle at a KKT point if possible, otherwise classify the point by its free curvature."""
    problem = oracle.problem
    if problem.uses_hessian or state.point.plus.hessian.finite:
        closed = close_gaps(oracle, state)
        # The usual end of a fit needs no eigenvalues.
        if closed is state and direction.regular:
            # The matrix of the programme was H itself: its scaled eigenvalues are above EIGENVALUE_FLOOR.
            return state._replace(status=status)
        state = closed
        # A KKT point with negative free curvature is no minimum: the iteration goes on from below it.
        accepted = escape(oracle, state) if state.iteration < problem.max_iterations else None
        if accepted is not None:
            return state.advance(accepted, problem.tolerance)
        curvature = state.curvature_at(problem, state.point.active)
        if curvature.spectrum.smallest < NEGATIVE_CURVATURE:
            return state._replace(status=Status.SADDLE)
        if curvature.spectrum.smallest <= algebra.EIGENVALUE_FLOOR:
            return state._replace(status=Status.SINGULAR)
        if state.point.idle is not None or curvature.idle is not None:
            return state._replace(status=Status.COLLAPSED)
    return state._replace(status=Status.CONVERGED_AT_KINK if state.genuine_kinks.any() else status)


def _record(oracle: Oracle, state: State) -> IterationRecord:
    point = state.point
    reached = point.cost, point.optimality, state.step_length, point.theta.copy()
    return IterationRecord(state.iteration, *reached, oracle.evaluations)


def _result(oracle: Oracle, state: State, status: Status, history: tuple[IterationRecord, ...]) -> Result:
    """Return the result at the state's point."""
    problem = oracle.problem
    point = state.point
    gradient, hessian = point.derivatives(point.reported_sides)
    curvature = state.curvature_at(problem, point.active)
    # What kinks and constraints do at the point, for reports: a breakpoint at which no derivative jumps is none.
    held = np.flatnonzero(state.genuine_kinks)
    equalities = _list_equalities(oracle, point)
    missed = np.abs(point.plus.equalities.values) > MET / np.sqrt(max(len(equalities), 1))
    return Result(
        theta=point.theta,
        cost=point.cost,
        gradient=gradient,
        hessian=hessian.dense(),
        optimality=point.optimality,
        iterations=state.iteration,
        evaluations=oracle.evaluations,
        status=status,
        active=tuple(problem.constraints.names[i] for i in point.active.tolist()),
        multipliers=point.multipliers,
        kinks=tuple((int(i), float(point.minus.gradient[i]), float(point.plus.gradient[i])) for i in held),
        curvature=curvature,
        tolerance=problem.tolerance,
        history=history,
        violated=tuple(equalities[k][:2] for k in np.flatnonzero(missed) if point.violation > MET),
        idle=state.list_idle(problem),
        explain=state.explain,
        predicted=_find_unbounded(problem, state).reduction if status in UNFINISHED else np.nan,
        equalities=equalities,
    )


def _list_equalities(oracle: Oracle, point: Point) -> tuple[tuple[str, float, float], ...]:
    """Return the name, value and multiplier of each equality constraint, in the caller's units."""
    units = 1.0 if oracle.units is None else oracle.units
    values, multipliers = point.plus.equalities.values * units, point.forces / units
    return tuple(zip(oracle.problem.equalities, values.tolist(), multipliers.tolist(), strict=True))


def _nonfinite_start(oracle: Oracle, theta: FloatArray) -> Result:
    """Return a result without numbers."""
    d, problem = theta.size, oracle.problem
    nothing, no_multipliers = np.full((d, d), np.nan), np.zeros(len(problem.constraints.names))
    no_directions = FreeCurvature(np.zeros((d, 0)), lambda: Spectrum(np.nan, np.zeros(d)))
    of_point = theta, np.nan, nothing[0], nothing, np.nan
    status = Status.NONFINITE_START
    return Result(*of_point, oracle.evaluations, status, no_multipliers, no_directions, problem.tolerance)
