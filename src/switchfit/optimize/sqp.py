"""Sequential quadratic programming for a piecewise smooth cost under linear constraints and equalities.

The problem is to minimize J(theta) subject to A theta >= b and lower <= theta <= upper, where J is continuous and
smooth except where a coordinate passes one of its breakpoints: there its derivatives jump. (A transition time that
passes a sample time is such a coordinate.) These constraints are linear, so every iterate satisfies them, and the line
search compares J alone. There may also be nonlinear equality constraints c(theta) = 0, which are met at the end.

One iteration, `_step`, maps a state at a point (`state`) to the next state:

1. *direction* (`step`): a convex quadratic programme (`qp`, with the Hessians of `matrix`), or with equality
   constraints a step composed of the solutions of two;
2. *line search* (`step`): the full step first, even across breakpoints, then inside the present smooth piece; by
   default in a trust region that shrinks; with equality constraints it compares a merit function; every trial is made
   feasible (`problem`);
3. *kinks* (`state`): coordinates that sit on a breakpoint are held, or released to one side.

At a stationary point the curvature distinguishes a minimum from a saddle, which is left along negative curvature
(`escape`). If no step decreases J, `explain_failure` finds the reason.

Stationary points: make rows hold that nearly do, and leave saddles along negative curvature.

References
----------
.. [1] J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed., Springer 2006, chapters 3, 12, 16 and 18.
"""

from __future__ import annotations

from functools import cache, partial

import numpy as np
from numpy.typing import ArrayLike

from switchfit.optimize import algebra, step
from switchfit.optimize.algebra import FloatArray
from switchfit.optimize.matrix import Curvature, Spectrum
from switchfit.optimize.problem import Problem, Trial, feasible_start, move, snap_to_rows
from switchfit.optimize.state import MET, Accepted, Callback, IterationRecord, Oracle, Point, Result, State, Status
from switchfit.optimize.threads import one_thread

#: Eigenvalues of the scaled Hessian below this are negative curvature, not rounding.
NEGATIVE_CURVATURE = -1e-8


def close_gaps(oracle: Oracle, state: State) -> State:
    """Return the state with the rows that it misses by less than it is accurate to made to hold, if it stays as good.

    A mode that lasts a part of 1e-13 of the horizon has collapsed. Taken for one that has not, its two ends would be
    free, and the curvature along them, which is that of J in its duration, may be negative. Where the data are met
    exactly, J is so curved in the duration that the optimality of the closed point exceeds the tolerance: it is as good
    all the same if a step from there is negligible.
    """
    problem, point = oracle.problem, state.point
    theta = snap_to_rows(problem, point.theta, np.zeros(point.theta.size, dtype=bool), algebra.NEGLIGIBLE_STEP)
    if np.array_equal(theta, point.theta):
        return state
    closed = oracle.point(Trial.at(problem, theta), state.scale)
    if closed is None or closed.cost > point.cost + algebra.NOISE * state.cost_scale or closed.violation > MET:
        return state
    after = state.advance(Accepted(closed, 1.0), problem.tolerance)
    if closed.optimality <= max(problem.tolerance, point.optimality):
        return after
    if closed.idle is None:
        return state
    ahead = step.find_direction(problem, after).step
    return after if algebra.is_negligible(ahead, np.maximum(state.scale, problem.size)) else state


def escape(oracle: Oracle, state: State) -> Accepted | None:
    """Return a step along negative curvature: on the face of the pressing constraints, then of all active ones."""
    problem = oracle.problem
    pressing = np.flatnonzero(state.point.multipliers > max(problem.tolerance, 1e-10 * state.gradient_scale))
    active = state.point.active
    # A constraint without force may be left along negative curvature: only pressing ones confine the ray at first.
    for rows in (pressing,) if np.array_equal(pressing, active) else (pressing, active):
        curvature = state.curvature_at(problem, rows)
        if not curvature.spectrum.smallest < NEGATIVE_CURVATURE:
            continue
        for ray in (curvature.spectrum.lowest, -curvature.spectrum.lowest):
            accepted = _descend_along(oracle, state, ray)
            if accepted is not None:
                return accepted
    return None


def _descend_along(oracle: Oracle, state: State, ray: FloatArray) -> Accepted | None:
    """Backtrack on the quadratic decrease ½ t² rayᵀH ray, starting at a tenth of the size of the unknowns."""
    problem, point = oracle.problem, state.point
    _, hessian = point.derivatives(point.reported_sides)
    bending = float(ray @ hessian.dot(ray))
    sized = state.scale > 0.0
    relative = float(np.max(np.abs(ray[sized]) / state.scale[sized], initial=0.0))
    length = 0.1 / relative if relative > 0.0 else 0.1 / float(np.max(np.abs(ray)))
    # No further than the first inactive constraint that the ray approaches.
    normals = problem.constraints.normals
    slope = normals @ ray
    slack = np.maximum(point.slack, 0.0)
    slack[point.active] = 0.0
    approaching = slope < -1e-12 * np.linalg.norm(normals, axis=1)
    length = min(length, float(np.min(slack[approaching] / -slope[approaching], initial=np.inf)))
    for _ in range(40):
        decrease = -0.5 * bending * length**2
        if decrease <= algebra.NOISE * abs(point.cost) or length == 0.0:
            return None
        there = move(problem, point.theta, length * ray, state.scale)
        first = oracle.first(there)
        if first is not None and problem.equalities:
            # The ray is tangential to the equality constraints, which bend.
            moved = step.correct(oracle, there, first, state.scale)
            there, first = (there, first) if moved is None else (moved, oracle.first(moved))
        enough = step.measure_merit(point.plus, state) - algebra.ARMIJO * decrease
        if first is not None and step.measure_merit(first, state) < enough:
            trial = oracle.complete(there, first, state.scale)
            if trial is not None:
                return Accepted(trial, length)
        length *= 0.5
    return None


#: Number of restarts of a minimization from a point at which its line search has failed.
RESTARTS = 3

#: Statuses of minimizations that might have gone on.
UNFINISHED = (Status.MAX_ITERATIONS, Status.LINE_SEARCH_FAILED)


@one_thread()
def minimize(
    problem: Problem, start: FloatArray, callback: Callback | None = None, multipliers: ArrayLike | None = None
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


def _find_unbounded(problem: Problem, state: State) -> step.Direction:
    """Return the step of the quadratic programme outside any trust region."""
    return step.find_direction(problem, state._replace(radius=np.inf))


def _step(oracle: Oracle, state: State) -> State:
    """Do one iteration: return the next state, or the same point with a status."""
    problem = oracle.problem
    direction = step.find_direction(problem, state)
    if _is_settled(problem, state, direction):
        return _finish(oracle, state, direction, Status.CONVERGED)
    if state.iteration >= problem.max_iterations:
        return state._replace(status=Status.MAX_ITERATIONS)
    if problem.equalities and step.is_stuck(oracle, state):
        return state._replace(status=Status.INFEASIBLE)
    # Before the line search: it would accept steps that change J by rounding alone.
    if _is_held_back(problem, state, direction):
        return _handle_stall(oracle, state, _find_unbounded(problem, state))
    # Where J itself is accurate to `accuracy` only, a model that promises less than that is at its minimum.
    accuracy = 0.0 if problem.accuracy is None else problem.accuracy()
    if accuracy and direction.reduction <= accuracy * abs(state.point.cost) and state.point.violation <= MET:
        return _finish(oracle, state, direction, Status.CONVERGED_PRECISION)
    accepted = step.search(oracle, state, direction)
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


def _is_settled(problem: Problem, state: State, direction: step.Direction) -> bool:
    """Return whether the optimality is below the tolerance and the next step negligible, for J may be badly scaled."""
    if not state.point.is_stationary(problem.tolerance):
        return False
    # Without a Hessian the step says nothing about the distance to the minimum.
    if not problem.uses_hessian or state.settled >= algebra.EXTRA_ITERATIONS:
        return True
    return bool(algebra.is_negligible(direction.step, state.scale))


def _is_held_back(problem: Problem, state: State, direction: step.Direction) -> bool:
    """Return whether J can only fall by rounding in a trust region, and the quadratic model promises more outside.

    The region shrinks to that size beside a kink or a jump of J that is no breakpoint. Steps in it would be accepted,
    as J stays the same, and go on for ever.
    """
    noise = algebra.NOISE * abs(state.point.cost)
    if problem.hessian != "auto" or problem.equalities or direction.reduction > noise:
        return False
    # A step that ends inside the region is not held back by it.
    if step.measure_in_box(problem, direction.step) < 0.9 * state.radius:
        return False
    return _find_unbounded(problem, state).reduction > 10 * noise


def _handle_stall(oracle: Oracle, state: State, direction: step.Direction) -> State:
    """Distinguish convergence and the limit of precision from failure after a line search that found no step."""
    if state.point.is_stationary(oracle.problem.tolerance):
        return _finish(oracle, state, direction, Status.CONVERGED)
    if state.point.violation > MET:
        return state._replace(status=Status.INFEASIBLE)
    # The derivatives are rounded relative to their largest terms: those seen so far, and |H| |theta|.
    floor = state.gradient_scale
    if oracle.problem.uses_hessian:
        floor = max(floor, float(np.max(state.point.plus.hessian.absolute().dot(state.scale))))
    below_rounding = step.is_below_rounding(oracle, state, direction)
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
    explain = cache(partial(step.explain_failure, oracle, state, direction))
    return state._replace(status=Status.LINE_SEARCH_FAILED, explain=explain)


def _finish(oracle: Oracle, state: State, direction: step.Direction, status: Status) -> State:
    """Leave a saddle at a KKT point if possible, otherwise classify the point by its free curvature."""
    problem = oracle.problem
    if problem.uses_hessian or state.point.plus.hessian.finite:
        closed = close_gaps(oracle, state)
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
    no_directions = Curvature(np.zeros((d, 0)), lambda: Spectrum(np.nan, np.zeros(d)))
    of_point = theta, np.nan, nothing[0], nothing, np.nan
    status = Status.NONFINITE_START
    return Result(*of_point, oracle.evaluations, status, no_multipliers, no_directions, problem.tolerance)
