"""One run of the optimizer on a problem with given meshes, for fits, profiles and many fits.

Collapsed modes: modes of zero duration, whose two transition times are equal.

If a collapsed mode lies between two intervals of the same mode, as B in (A, B, A), the cost does not depend on its
position: to the integration error, J is constant as its two transition times move together. Nor does the cost depend on
a parameter that acts in collapsed modes alone. Such unknowns are *idle*: no data determine them, and the curvature of J
along them is that of the integration error, of either sign.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.engine.native.engine import NativeEngine
from switchfit.engine.protocol import Evaluation, Matrix
from switchfit.fit.accuracy import Follower
from switchfit.fit.evaluator import Evaluator
from switchfit.fit.faults import list_changes, refuse_hidden_switches
from switchfit.optimize import IterationRecord, LinearConstraints, Result, minimize
from switchfit.optimize.algebra import EPS
from switchfit.optimize.matrix import Arrow
from switchfit.optimize.problem import Breakpoints, HessianKind
from switchfit.optimize.problem import Problem as Minimization
from switchfit.optimize.state import Finding
from switchfit.optimize.threads import with_own_threads
from switchfit.problem.data import FloatArray
from switchfit.problem.experiment import Experiment, drop_jumps
from switchfit.problem.inspection import find_unread
from switchfit.problem.problem import Problem, keep_with_problem
from switchfit.problem.unknowns import Variables

CHANGES = (0.1, -0.1)
"""Relative changes of a parameter to test its effect; if it is 0, relative to the range between its bounds."""

NO_EFFECT = 1e-12
"""Relative change of the cost that may be rounding: a parameter that changes it by less has no effect."""


def idle_unknowns(evaluator: Evaluator, theta: FloatArray, parameters: bool) -> NDArray[np.bool_]:
    """Return which unknowns may be fixed, as J does not depend on them while collapsed modes remain collapsed: (d,).

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
    parameters : bool
        Whether to test parameters too, with a few evaluations of J for each. Of transition times that coincide, only
        the first is returned, which leaves the others free to move away from it.
    """
    problem = evaluator.problem
    idle = np.zeros(len(theta), dtype=bool)
    for group in _list_idle_groups(problem, theta):
        idle[group[0]] = True
    if parameters and any(_has_collapsed(problem, theta, e) for e in range(len(problem.experiments))):
        for i in _list_parameters(problem):
            idle[i] = not _has_effect(evaluator, theta, i)
    return idle


def _list_idle_groups(problem: Problem, theta: FloatArray) -> Iterator[NDArray[np.intp]]:
    """Yield the indices in theta of transitions that coincide and may move together without effect.

    No transition among them is fixed or at an end of the horizon, the modes before and after them are the same, and no
    reset map, guard or jump lies in between.
    """
    system = problem.system
    for e, experiment in enumerate(problem.experiments):
        sequence, where = experiment.mode_sequence, problem.unknowns.times[e]
        for first, last in _list_coincident(problem, theta, e):
            passed = [*zip(sequence[first : last + 1], sequence[first + 1 : last + 2], strict=True)]
            smooth = not any(pair in system.reset_maps or pair in system.guards for pair in passed)
            smooth = smooth and not np.any((experiment.passed_by_jumps > first) & (experiment.passed_by_jumps <= last))
            if smooth and sequence[first] == sequence[last + 1] and np.all(where[first : last + 1] >= 0):
                yield where[first : last + 1]


def _list_coincident(problem: Problem, theta: FloatArray, e: int) -> Iterator[tuple[int, int]]:
    """Yield the first and last of two or more transitions that coincide strictly inside the horizon.

    A free tf counts as a transition at the end.
    """
    experiment, times = problem.experiments[e], _get_times(problem, theta, e)
    rounding = _estimate_rounding(experiment)
    lasting = np.flatnonzero(times[1:] - times[:-1] > rounding).tolist()
    if len(lasting) >= len(times) - 1:  # the usual case: tested at every step
        return
    end = experiment.ends_of_modes(times)[-1]
    for first, last in zip([0, *(i + 1 for i in lasting)], [*lasting, len(times) - 1], strict=True):
        if first < last and times[first] - experiment.t0 > rounding and end - times[last] > rounding:
            yield first, last


def _has_collapsed(problem: Problem, theta: FloatArray, e: int) -> bool:
    """Return whether a mode of experiment e has no duration."""
    experiment = problem.experiments[e]
    lengths = np.diff(experiment.ends_of_modes(_get_times(problem, theta, e)))
    return bool(np.any(lengths <= _estimate_rounding(experiment)))


def _get_times(problem: Problem, theta: FloatArray, e: int) -> FloatArray:
    """Return the transition times of experiment e, and a free tf behind them: (N,), without jumps."""
    experiment, times = problem.experiments[e], problem.vectors(theta, e)[0]
    return np.array(drop_jumps(experiment, times)) if len(experiment.jump_times) else times


def _estimate_rounding(experiment: Experiment) -> float:
    """Return the rounding error of the difference of two times of an experiment."""
    return 32 * EPS * max(experiment.end - experiment.t0, abs(experiment.t0), abs(experiment.end))


def _list_parameters(problem: Problem) -> list[int]:
    """Return the indices in theta of the parameters that a function reads which acts."""
    spans = problem.unknowns.parameters.values()
    without = {name for names in find_unread(problem) for name in names}
    return [i for span in spans for i in range(span.start, span.stop) if problem.theta_names[i] not in without]


def _has_effect(evaluator: Evaluator, theta: FloatArray, i: int) -> bool:
    """Return whether J changes with unknown i."""
    base = evaluator.cost(theta)
    moved = map(evaluator.cost, list_changes(evaluator.problem, theta, i, CHANGES))
    return any(not abs(cost - base) <= NO_EFFECT * abs(base) for cost in moved)


MANY_RUNS = 16
"""Number of experiments from which the arrow shape of the Hessian is used; with fewer, the algebra of full matrices
takes no longer (the runs part of the benchmarks)."""

REACH, TIME_REACH = 0.1, 0.01
"""Largest change in the first trust-region step: of an unknown as a part of its size, of a transition time as a part of
the horizon."""


def minimize_cost(
    evaluator: Evaluator,
    theta: Any,
    hessian: HessianKind,
    tolerance: float,
    max_iterations: int,
    callback: Callable[[IterationRecord], object] | None = None,
    constraints: LinearConstraints | None = None,
    multipliers: Sequence[float] | None = None,
    follower: Follower | None = None,
) -> Result:
    """Run the optimizer once on the evaluator's meshes; arguments as in `estimate`.

    With a `follower` of the evaluator, meshes are made anew where they are too coarse: its own are then those of the
    result.

    `constraints` are by default those of the problem. The arrow shape of the Hessian of several runs is used where that
    is faster, and never with guards or terminal constraints, whose `multipliers` may be known from a fit on other
    meshes.
    """
    problem = evaluator.problem
    names = problem.constraint_names
    unknowns = problem.unknowns
    matrix: Matrix = hessian if hessian in ("gauss-newton", "none") else "exact"
    many = len(problem.experiments) >= MANY_RUNS and not names
    by_blocks = many and 2 * len(evaluator.layout.shared) < len(theta)
    constraints = problem.constraints if constraints is None else constraints
    change = None if unknowns.variables.identity else _Change.of(problem, constraints, evaluator.breakpoints())
    seen: list[bool] = []
    seen_by: Matrix = "none" if by_blocks else matrix

    source = evaluator if follower is None else follower
    evaluate_theta: Callable[..., Evaluation[Any]] = source
    if by_blocks and hessian not in ("none", "descent-first"):
        evaluate_theta = source.arrow

    def evaluate(z: Any, side: int, multipliers: FloatArray | None = None) -> Any:
        theta = z if change is None else change.to_theta(z)
        if multipliers is not None:
            here = source.constrained(theta, side, multipliers)
        else:
            here = evaluate_theta(theta, side, matrix=matrix)
            if not seen:
                seen.append(True)
                # Unknowns that their bounds hold are not estimated: a search holds what acts in no mode.
                refuse_hidden_switches(evaluator, theta, np.where(constraints.movable, here.gradient, 1.0), seen_by)
        return here if change is None else _to_variables(change.variables, theta, here, multipliers)

    def idle(z: FloatArray, everything: bool) -> NDArray[np.bool_]:
        return idle_unknowns(evaluator, z if change is None else change.to_theta(z), everything)

    def report(record: IterationRecord) -> object:
        record = record if change is None else change.convert_record(record)
        if follower is not None:
            follower.accept(record.theta, record.cost)
        return None if callback is None else with_own_threads(callback)(record)

    natively = all(isinstance(engine, NativeEngine) for engine in evaluator.engines)  # calls no functions of the user
    posed = Minimization(
        evaluate=evaluate if natively else with_own_threads(evaluate),
        constraints=constraints if change is None else change.convert_constraints(problem.sizes),
        breakpoints=evaluator.sorted_breakpoints if change is None else Breakpoints.of(change.points),
        hessian="exact" if by_blocks and hessian == "auto" else hessian,  # a trust region's one radius suits no run
        labels=unknowns.is_time.astype(float) if hessian == "block-diagonal" else None,  # of (4)
        tolerance=tolerance,
        max_iterations=max_iterations,
        size=problem.sizes if change is None else change.variables.sizes_inward(problem.sizes),
        idle=None if names else idle if natively else with_own_threads(idle),
        reach=_compute_reach(problem),
        equalities=names,
        accuracy=None if follower is None else follower.get_accuracy,
    )
    start = np.array(theta, dtype=float) if change is None else change.variables.inward(np.asarray(theta))
    result = minimize(posed, start, None if follower is None and callback is None else report, multipliers)
    if change is None:
        return result
    converted = change.convert_result(result)
    return converted if not names else _convert_constrained(evaluator, converted)


@keep_with_problem
def _compute_reach(problem: Problem) -> FloatArray:
    """Return how far each variable may move in the optimizer's first trust-region step, (d,).

    This is a part of the horizon for a transition time, and a part of the first guess for any other unknown; if the
    guess is zero, of the range between its bounds.
    """
    unknowns = problem.unknowns
    width = unknowns.upper - unknowns.lower
    guess = np.abs(unknowns.initial)
    reach = REACH * np.where(guess > 0, guess, np.where(np.isfinite(width) & (width > 0), width, 1.0))
    reach = unknowns.put_at_times(reach, [TIME_REACH * run.initial_length for run in problem.experiments])
    return np.where(unknowns.variables.log, REACH, reach / unknowns.variables.size)


def _to_variables(variables: Variables, theta: FloatArray, here: Any, multipliers: FloatArray | None) -> Any:
    """Convert an evaluation at theta, of constraints too if there are multipliers, to the optimizer's variables."""
    D, E = variables.slopes(theta)
    if isinstance(here.hessian, Arrow):
        hessian = here.hessian.scale(1.0 / D).plus_diagonal(E * here.gradient)
        return replace(here, gradient=D * here.gradient, hessian=hessian)
    if multipliers is None:
        return Evaluation(here.cost, *variables.derivatives_inward(theta, here.gradient, here.hessian))
    slope = here.gradient + multipliers @ here.jacobian
    hessian = variables.derivatives_inward(theta, slope, here.hessian)[1]
    return replace(here, gradient=D * here.gradient, hessian=hessian, jacobian=here.jacobian * D)


class _Change(NamedTuple):
    """The change between theta and the optimizer's variables z in one problem.

    Attributes
    ----------
    variables : Variables
    constraints : LinearConstraints
        Of theta.
    points : list of (K,) arrays
        Breakpoints of each variable.
    nodes : dict of int -> (K,) array
        What these are in theta, for times on a logarithmic scale: a transition is at a node where z is at its
        breakpoint, and not beside it by the rounding of a logarithm.
    log_rows : list of (row, (d,))
        Rows of the constraints that join times on a logarithmic scale, and which.
    """

    variables: Variables
    constraints: LinearConstraints
    points: list[FloatArray]
    nodes: dict[int, FloatArray]
    log_rows: list[tuple[int, NDArray[np.intp]]]

    @classmethod
    def of(cls, problem: Problem, constraints: LinearConstraints, points: Sequence[FloatArray]) -> _Change:
        """Return the change of a problem's variables, given the breakpoints of each unknown."""
        variables, log_times = problem.unknowns.variables, problem.unknowns.log_times
        points, nodes, rows = list(points), {}, []
        if log_times.any():
            for i in np.flatnonzero(log_times).tolist():
                away = points[i] - variables.origin[i]
                logs, first = np.unique(np.log(away[away > 0]), return_index=True)
                points[i], nodes[i] = logs, points[i][away > 0][first]
            for k, row in enumerate(constraints.A):
                where = np.flatnonzero((row != 0) & log_times)
                if where.size:
                    rows.append((k, where))
        return cls(variables, constraints, points, nodes, rows)

    def to_theta(self, z: FloatArray) -> FloatArray:
        """Return theta at z, inside its bounds whatever the rounding, and on the nodes that z is on."""
        theta = np.asarray(np.clip(self.variables.outward(z), self.constraints.lower, self.constraints.upper))
        for i, nodes in self.nodes.items():
            k = int(np.searchsorted(self.points[i], z[i]))
            if k < len(nodes) and self.points[i][k] == z[i]:
                theta[i] = nodes[k]
        return theta

    def convert_constraints(self, sizes: FloatArray) -> LinearConstraints:
        """Return the constraints on z, which are linear too.

        The order of two times is that of their logarithms. A time that comes after or before a fixed one has a bound;
        behind t0, whose logarithm is minus infinity, it is at least what rounding leaves of the clock, a part of its
        size (d,).
        """
        given = self.constraints
        lower, upper = self.variables.inward(given.lower), self.variables.inward(given.upper)
        b = given.b.copy()
        for k, where in self.log_rows:
            if len(where) == 1:
                i, sign = int(where[0]), float(given.A[k, where[0]])
                rounding = float(np.finfo(float).eps * sizes[i])
                b[k] = sign * np.log(max(sign * given.b[k] - self.variables.origin[i], rounding))
        return replace(given, b=b, lower=lower, upper=upper)

    def convert_record(self, record: IterationRecord) -> IterationRecord:
        """Return a record of the optimizer's with theta in place of its own variables."""
        return replace(record, theta=self.to_theta(record.theta))

    def convert_result(self, result: Result) -> Result:
        """Return the optimizer's result in theta; its optimality and its eigenvalues stay those of its own variables.

        Of times that are joined by a row that holds with equality, all are equal, and so are their slopes.
        """
        theta = self.to_theta(result.theta)
        slopes = self.variables.slopes(theta)[0]
        rows = np.ones(len(self.constraints.b))
        for k, where in self.log_rows:
            rows[k] = slopes[where[0]]
        gradient, hessian = self.variables.derivatives_outward(theta, result.gradient, result.hessian)
        history = tuple(self.convert_record(record) for record in result.history)
        find = result.explain
        return replace(
            result,
            theta=theta,
            gradient=gradient,
            hessian=hessian,
            history=history,
            multipliers=result.multipliers / np.concatenate([rows, slopes, slopes]),
            kinks=tuple((i, left / float(slopes[i]), right / float(slopes[i])) for i, left, right in result.kinks),
            explain=find and cache(lambda: self._convert_finding(result.theta, slopes, find())),
        )

    def _convert_finding(self, z: FloatArray, slopes: FloatArray, found: Finding) -> Finding:
        """Return why the line search failed, in theta instead of the variables z (d,); `slopes`: dtheta/dz (d,)."""
        places = []
        for i, value in found.places:
            there = z.copy()
            there[i] = value
            places.append((i, float(self.variables.outward(there)[i])))
        entries = [(i, stated / float(slopes[i]), measured / float(slopes[i])) for i, stated, measured in found.entries]
        return found._replace(places=tuple(places), entries=tuple(entries))


def _convert_constrained(evaluator: Evaluator, result: Result) -> Result:
    """Return a result of the optimizer's variables with the Hessian and the free directions that it has in theta.

    Both mix what bends the change of variables with what bends the constraints.
    """
    here = evaluator.constrained(result.theta, 1, [multiplier for _, _, multiplier in result.equalities])
    slopes = evaluator.problem.unknowns.variables.slopes(result.theta)[0]
    basis = np.linalg.qr(slopes[:, None] * result.free_basis)[0]
    return replace(result, hessian=here.hessian, curvature=replace(result.curvature, basis=basis))
