"""One run of the optimizer on a problem with given meshes, for fits, profiles and many fits.

Collapsed modes: modes of zero duration, whose two transition times are equal.

If a collapsed mode lies between two intervals of the same mode, as B in (A, B, A), the cost does not depend on its
position: to the integration error, J is constant as its two transition times move together. Nor does the cost depend on
a parameter that acts in collapsed modes alone. Such unknowns are *idle*: no data determine them, and the curvature of J
along them is that of the integration error, of either sign.

Faults of a problem's functions: where one has no finite value or derivative, and switches hidden inside one.

Switches hidden inside a function: a parameter that changes the cost while its derivative is zero everywhere.

``jnp.where(t < p["t_on"], a, b)`` makes the cost jump each time ``t_on`` passes a stage of the integrator. Between the
jumps the cost is constant, so that its derivative is zero, correctly. An optimizer would leave such a parameter at its
guess without any warning. If the parameter has another effect too, its derivative is that of the other effect alone:
then the line search fails at a jump, and `switchfit.fit.result` says so.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.discretization.model import Model
from switchfit.discretization.rows import stages
from switchfit.discretization.signals import Piece
from switchfit.engine.evaluation import Evaluation, Matrix
from switchfit.engine.native.native_engine import NativeEngine
from switchfit.engine.simulation import Simulation
from switchfit.fit.accuracy import Follower
from switchfit.fit.evaluator import Evaluator
from switchfit.optimize import IterationRecord, LinearConstraints, Result, Status, minimize
from switchfit.optimize.algebra import EPS
from switchfit.optimize.arrow import Arrow
from switchfit.optimize.breakpoints import Breakpoints
from switchfit.optimize.minimization_problem import HessianKind
from switchfit.optimize.minimization_problem import MinimizationProblem as Minimization
from switchfit.optimize.result import LineSearchFailure
from switchfit.optimize.threads import with_own_threads
from switchfit.problem.comparisons import find_comparisons
from switchfit.problem.experiment import Experiment
from switchfit.problem.finiteness import find_undefined
from switchfit.problem.functions import Function, use_float64
from switchfit.problem.problem import Problem, keep_with_problem
from switchfit.problem.reads import find_unread
from switchfit.problem.system import HybridSystem
from switchfit.problem.variables import Variables
from switchfit.runtime.errors import HiddenSwitchError
from switchfit.runtime.issue import Issue

CHANGES = (0.1, -0.1)
"""Relative changes of a parameter to test its effect; if it is 0, relative to the range between its bounds."""

NO_EFFECT = 1e-12
"""Relative change of the cost that may be rounding: a parameter that changes it by less has no effect."""

ROUNDING = 32 * EPS
"""Rounding error of the difference of two times, as a part of their size."""

MANY_RUNS = 16
"""Number of experiments from which the arrow shape of the Hessian is used; with fewer, the algebra of full matrices
takes no longer (the runs part of the benchmarks)."""

REACH, TIME_REACH = 0.1, 0.01
"""Largest change in the first trust-region step: of an unknown as a part of its size, of a transition time as a part of
the horizon."""

BESIDE, NEAR = 2e-9, 1e-6
"""Distance from a sample, as a part of the horizon, at which a time is held, and within which it is looked for. It is
just not at the sample for intervals."""

_Visit = tuple[str, Function, Sequence[FloatArray]]
"""A function's role, the function, and arguments with which it is called: times, states and inputs of N points each."""

HIDDEN_CHANGES = (1e-3, 1e-2, 0.1, 0.5, -1e-3, -1e-2, -0.1, -0.5)
"""Relative changes of a parameter that are tried; if it is 0, relative to the range between its bounds."""

CHANGED = 1e-9
"""Smallest relative change of the cost that is not rounding."""


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
    ends = zip(problem.experiments, problem.ends_of_modes(theta), strict=True)
    collapsed = [times[1:] - times[:-1] <= ROUNDING * run.clock for run, times in ends]
    if not any(map(np.any, collapsed)):  # the usual case: tested at every step
        return idle
    for run, where, own in zip(problem.experiments, problem.unknowns.times, collapsed, strict=True):
        for first, after in np.flatnonzero(np.diff(own, prepend=False, append=False)).reshape(-1, 2).tolist():
            group = where[max(first - 1, 0) : after]
            if first > 0 and after < len(own) and np.all(group >= 0) and _may_move(problem.system, run, first, after):
                idle[group[0]] = True
    if parameters:
        base = evaluator.cost(theta)
        for i in _list_parameters(problem):
            moved = map(evaluator.cost, list_changes(problem, theta, i, CHANGES))
            idle[i] = all(abs(cost - base) <= NO_EFFECT * abs(base) for cost in moved)
    return idle


def _may_move(system: HybridSystem, run: Experiment, first: int, after: int) -> bool:
    """Return whether collapsed modes, from the first to the one before `after`, may move together without effect.

    The modes before and after them are the same, and no reset map, guard or jump lies in between.
    """
    modes = run.mode_sequence[first - 1 : after + 1]
    acts = any(pair in system.reset_maps or pair in system.guards for pair in pairwise(modes))
    jumps = np.isin(run.passed_by_jumps, range(first, after))
    return modes[0] == modes[-1] and not acts and not jumps.any()


def _list_parameters(problem: Problem) -> list[int]:
    """Return the indices in theta of the parameters that a function reads which acts."""
    spans = problem.unknowns.parameters.values()
    without = {name for names in find_unread(problem) for name in names}
    return [i for span in spans for i in range(span.start, span.stop) if problem.theta_names[i] not in without]


def minimize_cost(
    source: Evaluator | Follower,
    theta: Any,
    hessian: HessianKind,
    tolerance: float,
    max_iterations: int,
    callback: Callable[[IterationRecord], object] | None = None,
    constraints: LinearConstraints | None = None,
    multipliers: Sequence[float] | None = None,
) -> Result:
    """Run the optimizer once on the meshes of an evaluator; arguments as in `estimate`.

    With a follower of one in its place, meshes are made anew where they are too coarse: its own are then those of the
    result.

    `constraints` are by default those of the problem. The arrow shape of the Hessian of several runs is used where that
    is faster, and never with guards or terminal constraints, whose `multipliers` may be known from a fit on other
    meshes.
    """
    follower = source if isinstance(source, Follower) else None
    evaluator = source.evaluator if isinstance(source, Follower) else source
    problem = evaluator.problem
    names = problem.constraint_names
    unknowns = problem.unknowns
    matrix: Matrix = hessian if hessian in ("gauss-newton", "none") else "exact"
    many = len(problem.experiments) >= MANY_RUNS and not names
    by_blocks = many and 2 * len(evaluator.layout.shared) < len(theta)
    constraints = problem.constraints if constraints is None else constraints
    change = None if unknowns.variables.identity else _Change.of(evaluator, constraints)
    seen: list[bool] = []
    seen_by: Matrix = "none" if by_blocks else matrix
    arrow = by_blocks and hessian not in ("none", "descent-first")

    def evaluate(z: Any, side: int, multipliers: FloatArray | None = None) -> Any:
        theta = z if change is None else change.to_theta(z)
        if multipliers is not None:
            here = source.constrained(theta, side, multipliers)
        else:
            here = source(theta, side, matrix=matrix, arrow=arrow)
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
        breakpoints=evaluator.sorted_breakpoints if change is None else change.breakpoints,
        hessian="exact" if by_blocks and hessian == "auto" else hessian,  # a trust region's one radius suits no run
        labels=unknowns.is_time.astype(float) if hessian == "block-diagonal" else None,  # of (4)
        tolerance=tolerance,
        max_iterations=max_iterations,
        size=unknowns.variables.sizes_inward(problem.sizes),
        idle=None if names else idle if natively else with_own_threads(idle),
        reach=_compute_reach(problem),
        equalities=names,
        accuracy=None if follower is None else follower.get_accuracy,
    )
    start = unknowns.variables.inward(np.asarray(theta, dtype=float))
    result = minimize(posed, start, None if follower is None and callback is None else report, multipliers)
    if any(structure.has_resets for structure in evaluator.structures):
        result = _hold_at_jumps(posed, result)
    if change is None:
        return result
    converted = change.convert_result(result)
    return converted if not names else _convert_constrained(evaluator, converted)


def _hold_at_jumps(posed: Minimization, result: Result) -> Result:
    """Return the end of a fit with transition times held beside samples: as a time passes one, what is measured is that
    before a reset map and not that behind it, and J jumps. The result itself where that is no minimum.
    """
    again, held = result, dict[int, float]()
    lower, upper = posed.constraints.lower.copy(), posed.constraints.upper.copy()
    while again.status is Status.LINE_SEARCH_FAILED:
        theta, count = again.theta.copy(), len(held)
        for i, nodes in posed.breakpoints.of_coordinates:
            node = min(nodes, key=lambda node: abs(node - theta[i]))
            length, beside = nodes[-1] - nodes[0], np.repeat(theta[None], 2, axis=0)
            if i in held or not nodes[0] < node < nodes[-1] or abs(node - theta[i]) > NEAR * length:
                continue
            beside[:, i] = node + BESIDE * length * np.array([-1.0, 1.0])
            given = [np.zeros(len(posed.equalities))] if posed.equalities else []
            before, after = (posed.evaluate(each, 1, *given).cost for each in beside)
            if abs(after - before) > NEAR * abs(again.cost):
                side = int(after < before)
                (upper, lower)[side][i] = theta[i] = beside[side, i]
                held[i] = (before - after) / (BESIDE * length)
        if len(held) == count:
            return result
        constraints = replace(posed.constraints, lower=lower, upper=upper)
        again = minimize(replace(posed, constraints=constraints), theta)
    if not (held and again.status.successful):
        return result
    multipliers, kinks, rows, d = again.multipliers.copy(), list(again.kinks), len(posed.constraints.b), len(lower)
    at = [(i, steep) for i, steep in held.items() if again.theta[i] in (lower[i], upper[i])]
    bounds = [place + i for i, _ in at for place in (rows, rows + d)]
    for i, steep in at:
        slope = float(multipliers[rows + i] - multipliers[rows + d + i])  # of J, along the guards where there are any
        left, right = sorted((slope, -steep))  # across the sample J rises steeply
        kinks.append((i, left, right))
    multipliers[bounds] = 0.0
    named = [posed.constraints.names[place] for place in bounds]
    return replace(
        again,
        status=Status.CONVERGED_AT_KINK if at else again.status,
        active=tuple(each for each in again.active if each not in named),
        multipliers=multipliers,
        kinks=tuple(sorted(kinks)),
        iterations=result.iterations + again.iterations,
        evaluations=result.evaluations + again.evaluations,
        history=(*result.history, *again.history[1:]),
    )


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


@np.errstate(divide="ignore", over="ignore", invalid="ignore")  # a point whose derivatives are not finite is refused
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
    breakpoints : Breakpoints
        Of the variables.
    nodes : dict of int -> two (K,) arrays
        For times on a logarithmic scale, the breakpoints of z and what these are in theta: a transition is at a node
        where z is at its breakpoint, and not beside it by the rounding of a logarithm.
    log_rows : list of (row, (d,))
        Rows of the constraints that join times on a logarithmic scale, and which.
    """

    variables: Variables
    constraints: LinearConstraints
    breakpoints: Breakpoints
    nodes: dict[int, tuple[FloatArray, FloatArray]]
    log_rows: list[tuple[int, NDArray[np.intp]]]

    @classmethod
    def of(cls, evaluator: Evaluator, constraints: LinearConstraints) -> _Change:
        """Return the change of the variables of an evaluator's problem."""
        variables, log_times = evaluator.problem.unknowns.variables, evaluator.problem.unknowns.log_times
        if not log_times.any():
            return cls(variables, constraints, evaluator.sorted_breakpoints, {}, [])
        points, nodes = evaluator.breakpoints(), {}
        for i in np.flatnonzero(log_times).tolist():
            away = points[i] - variables.origin[i]
            logs, first = np.unique(np.log(away[away > 0]), return_index=True)
            points[i], nodes[i] = logs, (logs, points[i][away > 0][first])
        joined = (constraints.A != 0) & log_times
        rows = [(k, np.flatnonzero(joined[k])) for k in np.flatnonzero(joined.any(axis=1)).tolist()]
        return cls(variables, constraints, Breakpoints.of(points), nodes, rows)

    def to_theta(self, z: FloatArray) -> FloatArray:
        """Return theta at z, inside its bounds whatever the rounding, and on the nodes that z is on."""
        theta = np.asarray(np.clip(self.variables.outward(z), self.constraints.lower, self.constraints.upper))
        for i, (logs, nodes) in self.nodes.items():
            k = int(np.searchsorted(logs, z[i]))
            if k < len(nodes) and logs[k] == z[i]:
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
            explain=find and cache(lambda: self._convert_finding(result.theta, find())),
        )

    def _convert_finding(self, z: FloatArray, found: LineSearchFailure) -> LineSearchFailure:
        """Return why the line search failed, in theta instead of the variables z (d,)."""
        moved = ((i, np.where(np.arange(len(z)) == i, value, z)) for i, value in found.places)
        return found._replace(places=tuple((i, float(self.variables.outward(there)[i])) for i, there in moved))


def _convert_constrained(evaluator: Evaluator, result: Result) -> Result:
    """Return a result of the optimizer's variables with the Hessian and the free directions that it has in theta.

    Both mix what bends the change of variables with what bends the constraints.
    """
    here = evaluator.constrained(result.theta, 1, [multiplier for _, _, multiplier in result.equalities])
    slopes = evaluator.problem.unknowns.variables.slopes(result.theta)[0]
    basis = np.linalg.qr(slopes[:, None] * result.free_basis)[0]
    return replace(result, hessian=here.hessian, curvature=replace(result.curvature, basis=basis))


def explain_nonfinite(evaluator: Evaluator, theta: FloatArray) -> Issue | None:
    """Return the first function whose value or derivatives are not finite along the trajectory, and where.

    The subjects of the issue are its role, the operation, the line, and the name of the run if there are several. None
    if no function is found: a state may grow without bound.

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
    """
    problem = evaluator.problem
    runs = problem.run_names if len(problem.experiments) > 1 else [""]
    with np.errstate(all="ignore"):
        simulations = evaluator.simulate(theta)
    for e, (run, simulation) in enumerate(zip(runs, simulations, strict=True)):
        model = Model(evaluator.structures[e], evaluator.arguments[e])
        p: Any = problem.vectors(theta, e)[1]
        parameters = model.parameters(p)
        for role, function, arguments in _list_visits(model, p, simulation):
            found = find_undefined(function, arguments, parameters)
            if found is not None:
                point = _describe_point([argument[found.point] for argument in arguments])
                figures = point | {"order": float(found.order), "valued": float(found.valued)}
                return Issue("undefined", (role, found.operation, found.line, run), figures)
    return None


def _describe_point(given: list[Any]) -> dict[str, float | tuple[float, ...]]:
    """Return the time and the state among the arguments of a function, as far as it has them."""
    timed = bool(given) and given[0].ndim == 0
    figures: dict[str, float | tuple[float, ...]] = {"t": float(given[0])} if timed else {}
    return figures | ({"x": tuple(given[timed].tolist())} if len(given) > timed else {})


def _list_visits(model: Model, p: Any, simulation: Simulation) -> Iterator[_Visit]:
    """Yield the functions that J calls, with their arguments; samples whose delay is estimated are left out.

    All modes get as many points, so that a check is compiled once: rows of other modes are replaced by one of their
    own.
    """
    structure, roles = model.structure, model.structure.roles
    names = {function: role for role, function in reversed(roles.items())}

    def visit(function: Function | None, *arguments: Any) -> Iterator[_Visit]:
        if function is not None:
            yield names[function], function, arguments

    yield from visit(structure.initial_state)
    rows = simulation.segments
    segment = np.repeat(np.arange(len(rows)), [own.stop - own.start for own in rows])
    modes = np.array(structure.mode_of_segment)[segment]
    for mode in dict.fromkeys(modes.tolist()):
        own = np.where(modes == mode, np.arange(len(modes)), np.argmax(modes == mode))
        stages = _list_stages(model, p, simulation, mode, own)
        yield from visit(structure.modes[mode], *stages)
    for k, row in enumerate(own.stop - 1 for own in rows[:-1]):
        for functions in (structure.guards, structure.transition_costs, structure.reset_maps):
            yield from visit(functions[k], simulation.end[[row]], simulation.after[[row]])
    for function in (*structure.running, *(observe for observe, _ in structure.references)):
        yield from visit(function, simulation.start, simulation.before)
    times = np.append(simulation.start[:1], simulation.end)
    states = np.vstack([simulation.before[:1], simulation.after])
    for sensor, samples in zip(structure.measurements, model.arguments.samples, strict=True):
        if sensor.delay is None and (seen := np.isin(times, samples.time)).any():
            yield from visit(sensor.observe, times[seen], states[seen])
    for function in (*structure.terminal, *structure.terminal_constraints):
        yield from visit(function, states[-1:])


def _list_stages(model: Model, p: Any, simulation: Simulation, mode: int, rows: Any) -> list[FloatArray]:
    """Return times, states and inputs at which some rows evaluate their mode, in the order of time.

    Those of implicit steps are taken to be the start and the end of the row.
    """
    tableau = model.tableaus[mode]

    def evaluate(start: Any, end: Any, before: Any, after: Any, origin: Any, coefficients: Any) -> list[Any]:
        piece, times, states = Piece(origin, coefficients), [start, end], [before, after]
        if not tableau.coupled:
            field = model.field(mode, piece)
            times, states, _ = stages(tableau, lambda t, x: field(t, x, p), start, end, before)
        function = model.structure.modes[mode]
        points = [(t, x, *model.inputs(function, t, piece)) for t, x in zip(times, states, strict=True)]
        return [jnp.stack(each) for each in zip(*points, strict=True)]

    given = (simulation.start, simulation.end, simulation.before, simulation.after)
    nodes, signals = (np.asarray(each) for each in (model.arguments.nodes, model.arguments.signals))
    # Where corners are crossed there are more rows than the mesh has cells.
    cells = np.minimum(np.searchsorted(nodes, simulation.start[rows], "right"), len(signals)) - 1
    with use_float64():
        found = jax.jit(jax.vmap(evaluate))(*(values[rows] for values in given), nodes[cells], signals[cells])
    return [np.asarray(each).reshape(-1, *each.shape[2:]) for each in found]


def refuse_hidden_switches(
    evaluator: Evaluator, theta: FloatArray, gradient: FloatArray, matrix: Matrix = "none"
) -> None:
    """Raise HiddenSwitchError for a parameter whose derivative is exactly 0 although the cost depends on it.

    The message names the place where a function compares with the parameter, if one is found in its trace.

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
    gradient : (d,)
        Gradient at theta. If no entry is 0, nothing is evaluated.
    matrix : {"exact", "gauss-newton", "none"}
        What is evaluated beside the gradient: by what a fit has compiled already.
    """
    unknowns = evaluator.problem.unknowns
    suspects = np.flatnonzero((gradient == 0.0) & ~unknowns.is_time).tolist()
    if not suspects:
        return
    base = evaluator(theta, matrix=matrix).cost
    hidden = [i for i in suspects if _is_hidden(evaluator, theta, i, base, matrix)]
    if hidden:
        shown = ", ".join(unknowns.names[i] for i in hidden)
        seen = f"the cost changes with {shown}, but its derivative is zero at all points tried"
        comparison = next(filter(None, map(find_comparisons(evaluator.problem).get, hidden)), None)
        if comparison is None:
            raise HiddenSwitchError(
                f"{seen}, so that no fit can estimate it: let the model depend on it smoothly, or fix it."
            )
        raise HiddenSwitchError(
            f"{seen}: {comparison}, and derivatives do not include such a switch. If it is a time, make it a "
            "transition time: a mode for each side of it, both in mode_sequence, and its guess in transition_times. If "
            "it is a level that a state passes, give that transition a guard. Otherwise use a smooth function, or fix "
            "it."
        )


def list_changes(problem: Problem, theta: FloatArray, i: int, changes: Sequence[float]) -> Iterator[FloatArray]:
    """Yield theta with unknown i changed by parts of its size, or of the range between its bounds if it is 0."""
    lower, upper = problem.unknowns.lower[i], problem.unknowns.upper[i]
    size = abs(theta[i]) or (upper - lower if np.isfinite(upper - lower) else 1.0)
    for change in changes:
        moved = theta.copy()
        moved[i] = np.clip(theta[i] + change * size, lower, upper)
        yield moved


def _is_hidden(evaluator: Evaluator, theta: FloatArray, i: int, base: float, matrix: Matrix) -> bool:
    """Return whether the cost changes with unknown i while its derivative is 0 at the changed values too."""
    differs = False
    for moved in list_changes(evaluator.problem, theta, i, HIDDEN_CHANGES):
        there = evaluator(moved, matrix=matrix)
        if not np.isfinite(there.cost):
            continue
        if there.gradient[i] != 0.0:
            return False
        differs = differs or abs(there.cost - base) > CHANGED * max(abs(base), abs(there.cost))
    return differs
