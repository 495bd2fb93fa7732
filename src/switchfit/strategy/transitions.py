"""The structure of an experiment with the modes and transitions of a library."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise, product

import numpy as np
from numpy.typing import NDArray

from switchfit.discretization.mesh import Mesh
from switchfit.problem.data import Measurements, TerminalConstraint
from switchfit.problem.experiment import Experiment, drop_jumps
from switchfit.problem.problem import Problem
from switchfit.problem.structure import Structure, select_kind, trace_structure
from switchfit.strategy.library import Library

Integers = NDArray[np.int64]


def refuse_unsupported(problem: Problem, e: int) -> None:
    """Raise ValueError for an experiment that a beam cannot follow."""
    run = problem.experiments[e]
    name = f"experiment {problem.run_names[e]!r}" if len(problem.experiments) > 1 else "the experiment"
    late = [item.delay for item in select_kind(run.data, Measurements) if isinstance(item.delay, str)]
    what = ""
    if run.has_free_tf:
        what = "a free tf: give tf a number"
    elif late:
        what = f"the delay {late[0]!r}, which is a parameter: give the delay a number"
    elif select_kind(run.data, TerminalConstraint):
        what = "terminal constraints: leave them out of the search"
    if what:
        raise ValueError(
            f"a beam follows the data from t0 to a known end, but {name} has {what}, or use method='insertion'."
        )


def trace_library(problem: Problem, e: int, library: Library, births: int) -> tuple[Structure, Integers]:
    """Return the structure of an experiment with the modes and transitions of a library, and the places of the reset
    map, of the cost and of the guard of each of its transitions: (3, K, K), -1 without one.
    """
    modes = tuple(name for name in problem.system.modes if name in library.modes)
    pairs = [pair for pair in product(modes, modes) if pair[0] != pair[1] and library.allows(*pair)]
    path = list(modes[:1])
    for before, after in pairs:  # a sequence with all transitions
        path += [after] if path[-1] == before else [before, after]
    run = replace(problem.experiments[e], mode_sequence=tuple(path), transition_times=None)
    places = {pair: (modes.index(pair[0]), modes.index(pair[1])) for pair in pairs}
    return _trace(problem, run, modes, [places.get(pair) for pair in pairwise(path)], births)


def trace_order(problem: Problem, e: int) -> tuple[Structure, Integers]:
    """Return what `trace_library` does for the given order of modes, whose N + 1 places stand for the modes."""
    run = problem.experiments[e]
    births = len(run.transition_times)
    modes = tuple(name for name in problem.system.modes if name in run.mode_sequence)
    return _trace(problem, run, modes, [(k, k + 1) for k in range(births)], births)


def _trace(
    problem: Problem, run: Experiment, modes: tuple[str, ...], steps: Sequence[tuple[int, int] | None], births: int
) -> tuple[Structure, Integers]:
    """Trace a run with its transitions, each of which is a step between two places, or none that is looked for."""
    structure = trace_structure(problem.system, run, problem._functions, problem.solver, max(births, 1))
    of_all = structure.reset_maps, structure.transition_costs, structure.guards
    columns = [drop_jumps(run, kind) for kind in of_all]
    chosen = [k for k, step in enumerate(steps) if step is not None]
    resets, costs, guards = ([column[k] for k in chosen] for column in columns)
    resets_and_jumps = [*resets, *(structure.reset_maps[i] for i in structure.jumps)]
    libraries = [tuple(dict.fromkeys(filter(None, kind))) for kind in (resets_and_jumps, costs, guards)]
    size = max(len(modes), *(1 + max(step) for step in steps if step is not None), 1)
    tables = np.full((3, size, size), -1, dtype=np.int64)
    for table, column, known in zip(tables, columns, libraries, strict=True):
        for k in chosen:
            if column[k] is not None:
                table[steps[k]] = known.index(column[k])
    reset_maps, transition_costs, found_guards = libraries
    structure = replace(
        structure,
        mode_names=modes,
        modes=tuple(structure.modes[structure.mode_names.index(name)] for name in modes),
        reset_library=reset_maps,
        transition_cost_library=transition_costs,
        guard_library=found_guards,
        known=0,  # jumps act at nodes, and are no transitions here
    )
    return structure, tables


def list_jumps(run: Experiment, structure: Structure, mesh: Mesh) -> list[tuple[int, int]]:
    """Return the node of each jump at a known time, and the place of its map in the library."""
    maps = [structure.reset_library.index(structure.reset_maps[i]) for i in structure.jumps]
    nodes = np.searchsorted(mesh.times, run.jump_times).tolist()
    return list(zip(nodes, maps, strict=True))
