"""Find which function of a problem has no finite value or derivative along the trajectory at a theta, and where."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from switchfit.discretization.model import Model, Piece
from switchfit.engine.protocol import Simulation
from switchfit.fit.evaluator import Evaluator
from switchfit.problem.data import FloatArray
from switchfit.problem.experiment import name_runs
from switchfit.problem.finiteness import find_undefined
from switchfit.problem.functions import Function
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
    runs = name_runs(problem.experiments) if len(problem.experiments) > 1 else [""]
    with np.errstate(all="ignore"):
        simulations = evaluator.simulate(theta)
    for e, (run, simulation) in enumerate(zip(runs, simulations, strict=True)):
        model = Model(evaluator.structures[e], evaluator.arguments[e])
        parameters = model.parameters(problem.vectors(theta, e)[1])  # type: ignore[arg-type]  # of NumPy
        for visit in _list_visits(model, simulation):
            found = find_undefined(visit.function, visit.arguments, parameters)
            if found is not None:
                where = dict(zip(("t", "x"), (argument[found.point] for argument in visit.arguments), strict=False))
                figures = {name: float(v) if v.ndim == 0 else tuple(v.tolist()) for name, v in where.items()}
                subjects = (visit.role, found.operation, found.line, run)
                return Issue("undefined", subjects, figures | {"order": float(found.order)})
    return None


def _list_visits(model: Model, simulation: Simulation) -> Iterator[_Visit]:
    """Yield the functions that J calls, with the times and states of rows; samples whose delay is estimated are left out.

    All modes get as many points, so that a check is compiled once: those of other modes are replaced by one of their own.
    """
    structure, roles = model.structure, model.structure.roles
    names = {id(function): role for role, function in reversed(roles.items())}
    starts, ends = (simulation.start, simulation.before), (simulation.end, simulation.after)

    def visit(function: Function | None, *arguments: Any) -> Iterator[_Visit]:
        if function is not None:
            yield _Visit(names[id(function)], function, arguments)

    yield from visit(structure.initial_state)
    segment = np.repeat(np.arange(len(simulation.segments)), [rows.stop - rows.start for rows in simulation.segments])
    everywhere, cells = np.arange(len(segment)), np.arange(len(segment)) - segment
    modes = np.array(structure.mode_of_segment)[segment]
    for mode in dict.fromkeys(modes.tolist()):
        at = np.where(modes == mode, everywhere, np.argmax(modes == mode))
        for t, x in (starts, ends):
            yield from visit(structure.modes[mode], t[at], x[at], *_list_inputs(model, cells[at], t[at]))
    for k, rows in enumerate(simulation.segments[:-1]):
        for functions in (structure.guards, structure.transition_costs, structure.reset_maps):
            yield from visit(functions[k], *(values[rows.stop - 1 : rows.stop] for values in ends))
    for function in (*structure.running, *(observe for observe, _ in structure.references)):
        yield from visit(function, *starts)
    times, states = np.append(starts[0][:1], ends[0]), np.vstack([starts[1][:1], ends[1]])
    for sensor, samples in zip(structure.measurements, model.arguments.samples, strict=True):
        seen = np.isin(times, samples.time) if sensor.delay is None else np.zeros(len(times), bool)
        if seen.any():
            yield from visit(sensor.observe, times[seen], states[seen])
    for function in (*structure.terminal, *structure.terminal_constraints):
        yield from visit(function, states[-1:])


def _list_inputs(model: Model, cells: Any, times: FloatArray) -> list[FloatArray]:
    """Return the input u of modes at times in some cells, (N, ...), as a list of one; empty without inputs."""
    nodes, signals = np.asarray(model.arguments.nodes), np.asarray(model.arguments.signals)
    if model.structure.input_shape is None:
        return []
    pieces = [Piece(nodes[cell], signals[cell]) for cell in cells]  # type: ignore[arg-type]  # of NumPy
    return [np.stack([np.asarray(model.inputs(t, piece)[0]) for t, piece in zip(times, pieces, strict=True)])]
