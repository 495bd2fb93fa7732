"""Faults of a problem's functions: where one has no finite value or derivative, and switches hidden inside one.

Switches hidden inside a function: a parameter that changes the cost while its derivative is zero everywhere.

``jnp.where(t < p["t_on"], a, b)`` makes the cost jump each time ``t_on`` passes a stage of the integrator. Between the
jumps the cost is constant, so that its derivative is zero, correctly. An optimizer would leave such a parameter at its
guess without any warning. If the parameter has another effect too, its derivative is that of the other effect alone:
then the line search fails at a jump, and `switchfit.fit.result` says so.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.discretization.model import Model, Piece
from switchfit.discretization.rows import stages
from switchfit.engine.protocol import Matrix, Simulation
from switchfit.fit.evaluator import Evaluator
from switchfit.problem.data import FloatArray
from switchfit.problem.functions import Function, use_float64
from switchfit.problem.inspection import find_comparisons, find_undefined
from switchfit.problem.problem import Problem
from switchfit.runtime.errors import HiddenSwitchError, Issue

_Visit = tuple[str, Function, Sequence[FloatArray]]
"""A function's role, the function, and arguments with which it is called: times, states and inputs of N points each."""


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
        stages = _list_stages(model, p, simulation, mode, own, own - segment[own])
        yield from visit(structure.modes[mode], *stages)
    for k, row in enumerate(own.stop - 1 for own in rows[:-1]):
        for functions in (structure.guards, structure.transition_costs, structure.reset_maps):
            yield from visit(functions[k], simulation.end[[row]], simulation.after[[row]])
    for function in (*structure.running, *(observe for observe, _ in structure.references)):
        yield from visit(function, simulation.start, simulation.before)
    times = np.append(simulation.start[:1], simulation.end)
    states = np.vstack([simulation.before[:1], simulation.after])
    for sensor, samples in zip(structure.measurements, model.arguments.samples, strict=True):
        seen = np.isin(times, samples.time) if sensor.delay is None else np.zeros(len(times), bool)
        if seen.any():
            yield from visit(sensor.observe, times[seen], states[seen])
    for function in (*structure.terminal, *structure.terminal_constraints):
        yield from visit(function, states[-1:])


def _list_stages(model: Model, p: Any, simulation: Simulation, mode: int, rows: Any, cells: Any) -> list[FloatArray]:
    """Return times, states and inputs at which some rows, in some cells, evaluate their mode, in the order of time.

    Those of implicit steps are taken to be the start and the end of the row.
    """
    tableau = model.tableaus[mode]

    def evaluate(start: Any, end: Any, before: Any, after: Any, origin: Any, coefficients: Any) -> list[Any]:
        piece, times, states = Piece(origin, coefficients), [start, end], [before, after]
        if not tableau.coupled:
            field = model.field(mode, piece)
            times, states, _ = stages(tableau, lambda t, x: field(t, x, p), start, end, before)
        points = [(t, x, *model.inputs(t, piece)) for t, x in zip(times, states, strict=True)]
        return [jnp.stack(each) for each in zip(*points, strict=True)]

    given = (simulation.start, simulation.end, simulation.before, simulation.after)
    signals = np.asarray(model.arguments.nodes)[cells], np.asarray(model.arguments.signals)[cells]
    with use_float64():
        found = jax.jit(jax.vmap(evaluate))(*(values[rows] for values in given), *signals)
    return [np.asarray(each).reshape(-1, *each.shape[2:]) for each in found]


CHANGES = (1e-3, 1e-2, 0.1, 0.5, -1e-3, -1e-2, -0.1, -0.5)
"""Relative changes of a parameter that are tried; if it is 0, relative to the range between its bounds."""

CHANGED = 1e-9
"""Smallest relative change of the cost that is not rounding."""


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
    if gradient.all():
        return
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
    for moved in list_changes(evaluator.problem, theta, i, CHANGES):
        there = evaluator(moved, matrix=matrix)
        if not np.isfinite(there.cost):
            continue
        if there.gradient[i] != 0.0:
            return False
        differs = differs or abs(there.cost - base) > CHANGED * max(abs(base), abs(there.cost))
    return differs
