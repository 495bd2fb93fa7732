"""The structure of an experiment with the modes and transitions of a library."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from switchfit.discretization.mesh import Mesh
from switchfit.problem.data import Measurements, TerminalConstraint
from switchfit.problem.experiment import Experiment, drop_jumps, name_runs
from switchfit.problem.problem import Problem
from switchfit.problem.structure import Functions, Structure, select_kind, trace_structure

Integers = NDArray[np.int64]


class Library(Protocol):
    """What the beam reads of a library of modes."""

    modes: tuple[str, ...]
    first: tuple[str, ...]
    last: tuple[str, ...]
    max_switches: int

    def allows(self, before: str, after: str) -> bool:
        """Return whether one mode may follow another."""
        ...

    def min_duration(self, mode: str) -> float:
        """Return the shortest time that a mode lasts."""
        ...


def refuse_unsupported(problem: Problem, e: int) -> None:
    """Raise ValueError for an experiment that a beam cannot follow."""
    run = problem.experiments[e]
    name = f"experiment {name_runs(problem.experiments)[e]!r}" if len(problem.experiments) > 1 else "the experiment"
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
    run, system = problem.experiments[e], problem.system
    modes = tuple(name for name in system.modes if name in library.modes)
    pairs = [pair for pair in product(modes, modes) if pair[0] != pair[1] and library.allows(*pair)]
    path = list(modes[:1])
    for before, after in pairs:  # a sequence with all transitions
        path += [after] if path[-1] == before else [before, after]
    whole = replace(run, mode_sequence=tuple(path), transition_times=None)
    targets = frozenset(name for each in problem.experiments for name in each.parameter_map.values())
    functions = Functions(problem.parameters, targets)
    structure = trace_structure(system, whole, functions, problem.solver, births)
    of_pairs = zip(
        pairwise(path),
        drop_jumps(whole, list(structure.reset_maps)),
        drop_jumps(whole, list(structure.transition_costs)),
        drop_jumps(whole, list(structure.guards)),
        strict=True,
    )
    found = {pair: functions for pair, *functions in of_pairs if pair in pairs}
    jumps = [structure.reset_maps[i] for i in structure.jumps]
    each = [[functions[k] for functions in found.values()] for k in range(3)]
    libraries = [tuple(dict.fromkeys(f for f in kind if f is not None)) for kind in (each[0] + jumps, *each[1:])]
    tables = np.full((3, len(modes), len(modes)), -1, dtype=np.int64)
    for (before, after), functions_of_pair in found.items():
        for table, function, known in zip(tables, functions_of_pair, libraries, strict=True):
            if function is not None:
                table[modes.index(before), modes.index(after)] = known.index(function)
    kept = tuple(structure.modes[structure.mode_names.index(name)] for name in modes)
    reset_maps, costs, guards = libraries
    structure = replace(
        structure,
        mode_names=modes,
        modes=kept,
        reset_library=reset_maps,
        transition_cost_library=costs,
        guard_library=guards,
        known=0,  # jumps act at nodes, and are no transitions here
    )
    return structure, tables


def list_jumps(run: Experiment, structure: Structure, mesh: Mesh) -> list[tuple[int, int]]:
    """Return the node of each jump at a known time, and the place of its map in the library."""
    maps = [structure.reset_library.index(structure.reset_maps[i]) for i in structure.jumps]
    nodes = np.searchsorted(mesh.times, run.jump_times).tolist()
    return list(zip(nodes, maps, strict=True))
