"""The problem of a search: with the modes of its library alone, and room for the largest number of switches.

Every sequence of the library is then a problem of the same shapes, whose fits share one program of machine code.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from switchfit.modes.schedule import Schedule, keep_off, space_evenly
from switchfit.problem.experiment import Experiment
from switchfit.problem.problem import Problem
from switchfit.strategy.library import Library

SEARCH_RTOL = 1e-6
"""Integration tolerance of the search: J is right to a millionth, and a certified estimate follows on its own mesh."""


def build_library_problem(problem: Problem, library: Library) -> Problem:
    """Return the problem with the modes of a library alone, and room for its largest number of switches.

    Its experiments have any sequence of the library, with free times.
    """
    system = problem.system
    if set(library.modes) != set(system.modes):
        kept = {name: system.modes[name] for name in library.modes}

        def inside(functions: Mapping[tuple[str, str], Any]) -> dict[tuple[str, str], Any]:
            return {pair: function for pair, function in functions.items() if set(pair) <= set(kept)}

        # Functions of transitions that the library cannot make would be traced and compiled for nothing.
        system = replace(system, modes=kept, reset_maps=inside(system.reset_maps), guards=inside(system.guards))
    runs = []
    for run in problem.experiments:
        schedule = _choose_schedule(run, library)
        runs.append(replace(run, mode_sequence=schedule.sequence, transition_times=tuple(schedule.times)))
    # Jumps at known times are transitions of the structure, and need room as well.
    jumps = max(len(run.jump_times) for run in runs)
    most = max(library.max_switches, 1) + jumps
    changes: dict[str, Any] = {"system": system, "experiments": runs, "min_duration": dict(library.durations)}
    return replace(problem, **changes, max_transitions=most, rtol=max(problem.rtol, SEARCH_RTOL))


def _choose_schedule(run: Experiment, library: Library) -> Schedule:
    """Return a schedule of the library, with a switch if there is one: there is then something to estimate."""
    given = tuple(run.mode_sequence)
    sequences = [given] if len(given) > 1 and library.admits(given) else []
    for switches in sorted(library.possible_switches, key=lambda k: (k == 0, k)):
        sequences.append(next(library.list_sequences(switches)))
    for sequence in sequences:
        schedule = space_evenly(sequence, run.t0, run.end, library)
        if schedule is not None:
            return keep_off(schedule, run.jump_times)
    raise ValueError(
        f"min_duration leaves no room for any sequence in a horizon of {run.end - run.t0:g}: lower it, or change "
        "first, last or successions."
    )
