"""The first function of a model whose value or derivative is not finite along a trajectory, and where."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.arrays import FloatArray
from switchfit.discretization.model import Model
from switchfit.discretization.rows import stages
from switchfit.discretization.signals import Piece
from switchfit.engine.simulation import Simulation
from switchfit.meshes.evaluator import Evaluator
from switchfit.problem.finiteness import find_undefined
from switchfit.problem.functions import Function, use_float64
from switchfit.runtime.issue import Issue

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
