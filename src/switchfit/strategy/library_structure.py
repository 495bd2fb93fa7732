"""The structure of an experiment with the modes and transitions of a library, as a beam evaluates it."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise, product
from typing import Any

import numpy as np

from switchfit.discretization.mesh import Mesh
from switchfit.problem.costs import TerminalConstraint, TransitionCost
from switchfit.problem.experiment import Experiment
from switchfit.problem.problem import Problem
from switchfit.problem.structure import Function, Structure
from switchfit.problem.tracing import trace_structure
from switchfit.strategy.library import Library
from switchfit.strategy.sequences import Integers


def _refuse_unsupported(problem: Problem, e: int) -> None:
    """Raise ValueError for an experiment that a beam cannot follow."""
    run = problem.experiments[e]
    name = f"experiment {problem.run_names[e]!r}" if len(problem.experiments) > 1 else "the experiment"
    wrong = {
        "a free tf: give tf a number": run.has_free_tf,
        "a delay that is a parameter: give it a number": problem.estimates_delays,
        "terminal constraints: leave them out of the search": any(
            isinstance(item, TerminalConstraint) for item in run.data
        ),
    }
    for what, is_there in wrong.items():
        if is_there:
            raise ValueError(
                f"a beam follows the data from t0 to a known end, but {name} has {what}, or use method='insertion'."
            )


def trace_transition(problem: Problem, run: Experiment, pair: tuple[str, str]) -> tuple[Function | None, ...]:
    """Return the reset map, the cost and the guard of the transition from one mode to another in a run."""
    has_cost = any(isinstance(item, TransitionCost) for item in run.data)
    if not (has_cost or pair in problem.system.reset_maps or pair in problem.system.guards):
        return None, None, None
    # Each transition is traced in an experiment of its two modes alone, whatever the sequence of the run is.
    alone = replace(run, mode_sequence=pair, transition_times=None, jumps=())
    found = trace_structure(problem._sources, alone, 1)
    return found.reset_maps[0], found.transition_costs[0], found.guards[0]


def trace_library(
    problem: Problem, e: int, library: Library | None, births: int, mesh: Mesh
) -> tuple[Structure, Integers, list[tuple[int, int]]]:
    """Return the structure of an experiment with the modes and transitions of a library; the places of the reset map,
    of the cost and of the guard of each of its transitions: (3, K, K), -1 without one; and for each jump at a known
    time its node on a mesh and the place of its map.

    Without a library, those of the given order of modes, whose N + 1 places stand for the modes.

    Raises
    ------
    ValueError
        For an experiment that a beam cannot follow.
    """
    _refuse_unsupported(problem, e)
    run = problem.experiments[e]
    sequence = run.mode_sequence
    modes = tuple(m for m in problem.system.modes if m in (sequence if library is None else library.modes))
    if library is None:
        steps = [(pair, (k, k + 1)) for k, pair in enumerate(pairwise(sequence))]
    else:
        pairs = [pair for pair in product(modes, modes) if pair[0] != pair[1] and library.allows(*pair)]
        steps = [(pair, (modes.index(pair[0]), modes.index(pair[1]))) for pair in pairs]
    traced = [(place, trace_transition(problem, run, pair)) for pair, place in steps]
    structure = trace_structure(problem._sources, run, births)
    known: list[list[Any]] = [list(dict.fromkeys(structure.reset_maps[i] for i in structure.jumps)), [], []]
    size = max(len(modes), *(1 + max(place) for _, place in steps), 1)
    tables = np.full((3, size, size), -1, dtype=np.int64)
    for place, here in traced:
        for table, functions, function in zip(tables, known, here, strict=True):
            if function is not None:
                # Equal functions are compiled once: a reset that all transitions share has one place.
                functions += [] if function in functions else [function]
                table[place] = functions.index(function)
    reset_maps, transition_costs, guards = map(tuple, known)
    structure = replace(
        structure,
        mode_names=modes,
        modes=tuple(structure.modes[structure.mode_names.index(name)] for name in modes),
        reset_library=reset_maps,
        transition_cost_library=transition_costs,
        guard_library=guards,
        known=0,  # jumps act at nodes, and are no transitions here
    )
    maps = [structure.reset_library.index(structure.reset_maps[i]) for i in structure.jumps]
    nodes = np.searchsorted(mesh.times, run.jump_times).tolist()
    return structure, tables, list(zip(nodes, maps, strict=True))
