"""Find which function of a problem has no finite value or derivative along the trajectory at a theta, and where."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.discretization.model import Model, Piece
from switchfit.engine.protocol import Simulation
from switchfit.fit.evaluator import Evaluator
from switchfit.problem.data import FloatArray
from switchfit.problem.finiteness import find_undefined
from switchfit.problem.functions import Function, use_float64
from switchfit.runtime.issue import Issue


class _Visit(NamedTuple):
    """A function, its role, and arguments with which it is called: times, states and inputs of N points each."""

    role: str
    function: Function
    arguments: Sequence[FloatArray]


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
        parameters = model.parameters(problem.vectors(theta, e)[1])  # type: ignore[arg-type]  # of NumPy
        for visit in _list_visits(model, parameters, simulation):
            found = find_undefined(visit.function, visit.arguments, parameters)
            if found is not None:
                point = _describe_point([argument[found.point] for argument in visit.arguments])
                figures = point | {"order": float(found.order), "valued": float(found.valued)}
                return Issue("undefined", (visit.role, found.operation, found.line, run), figures)
    return None


def _describe_point(given: list[Any]) -> dict[str, float | tuple[float, ...]]:
    """Return the time and the state among the arguments of a function, as far as it has them."""
    timed = bool(given) and given[0].ndim == 0
    figures: dict[str, float | tuple[float, ...]] = {"t": float(given[0])} if timed else {}
    return figures | ({"x": tuple(given[timed].tolist())} if len(given) > timed else {})


def _list_visits(model: Model, parameters: Mapping[str, Any], simulation: Simulation) -> Iterator[_Visit]:
    """Yield the functions that J calls, with their arguments; samples whose delay is estimated are left out.

    All modes get as many points, so that a check is compiled once: rows of other modes are replaced by one of their
    own.
    """
    structure, roles = model.structure, model.structure.roles
    names = {id(function): role for role, function in reversed(roles.items())}

    def visit(function: Function | None, *arguments: Any) -> Iterator[_Visit]:
        if function is not None:
            yield _Visit(names[id(function)], function, arguments)

    yield from visit(structure.initial_state)
    rows = simulation.segments
    segment = np.repeat(np.arange(len(rows)), [own.stop - own.start for own in rows])
    modes = np.array(structure.mode_of_segment)[segment]
    for mode in dict.fromkeys(modes.tolist()):
        own = np.where(modes == mode, np.arange(len(modes)), np.argmax(modes == mode))
        stages = _list_stages(model, parameters, simulation, mode, own, own - segment[own])
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


def _list_stages(
    model: Model, parameters: Mapping[str, Any], simulation: Simulation, mode: int, rows: Any, cells: Any
) -> list[FloatArray]:
    """Return times, states and inputs at which some rows, in some cells, evaluate their mode, in the order of time.

    Those of implicit steps are taken to be the ends of the row.
    """
    tableau, function = model.tableaus[mode], model.structure.modes[mode]

    def evaluate(start: Any, end: Any, before: Any, after: Any, origin: Any, coefficients: Any) -> list[Any]:
        points: list[tuple[Any, ...]] = []
        slopes: list[Any] = []
        for c, a in zip(tableau.c.tolist(), tableau.a.tolist(), strict=True):
            t = start + c * (end - start)
            x = before + (end - start) * sum(a_k * slope for a_k, slope in zip(a, slopes, strict=False))
            if tableau.coupled:
                t, x = (start, before) if not points else (end, after)
            points.append((t, x, *model.inputs(t, Piece(origin, coefficients))))
            slopes.append(function(t, x, parameters, *points[-1][2:]))
        return [jnp.stack(each) for each in zip(*points, strict=True)]

    given = (simulation.start, simulation.end, simulation.before, simulation.after)
    signals = np.asarray(model.arguments.nodes)[cells], np.asarray(model.arguments.signals)[cells]
    with use_float64():
        found = jax.jit(jax.vmap(evaluate))(*(values[rows] for values in given), *signals)
    return [np.asarray(each).reshape(-1, *each.shape[2:]) for each in found]
