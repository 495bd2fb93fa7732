"""Evaluators of sequences that share one experiment of machine code, its data and its meshes.

Sequences with as many transitions and the same shortest durations differ in nothing but their modes: the second of them
takes a few microseconds, where a problem and an experiment of its own take a millisecond.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import Mesh
from switchfit.engine.jax.engine import JaxEngine
from switchfit.engine.native.engine import NativeEngine
from switchfit.engine.native.experiment import NativeExperiment
from switchfit.engine.native.templates import Order
from switchfit.fit.evaluator import Evaluator
from switchfit.fit.solution import constraints_of
from switchfit.problem.data import FloatArray
from switchfit.problem.parameter import as_parameter
from switchfit.problem.problem import GIVEN, Problem
from switchfit.problem.structure import Structure
from switchfit.problem.unknowns import list_unknowns

Experiments = dict[Order, NativeExperiment | None]

SHARED = ("constraint_names", "constraint_counts", "sample_lengths", "arguments_of_any_mesh")
"""What problems share whose sequences have no guards, whatever their number of transitions."""

OF_TIMES = ("unknowns", "places", "own_places", "one_to_one", "sizes", "constraints_of_fit", "first_reach")
"""What they also share with as many transitions and the same shortest durations."""

OF_ONE_GUESS = ("times", "initial_times_with_jumps", "passed_by_jumps")
"""Cached properties of an experiment that depend on its transition times."""


class SharedEngine(NativeEngine):
    """Evaluates one sequence of a library in an experiment that other sequences use too.

    Parameters
    ----------
    structure : Structure
        Of the sequence, without jumps.
    arguments : Arguments
    mesh : Mesh
    experiments : dict of Order to NativeExperiment
        That all of them share; filled as needed.
    """

    def __init__(self, structure: Structure, arguments: Arguments, mesh: Mesh, experiments: Experiments) -> None:
        super().__init__(structure, arguments, mesh, JaxEngine(structure, arguments, mesh))
        self._experiments = experiments

    def at(self, order: Order) -> NativeExperiment | None:
        """Return the experiment with derivatives of an order, set to this sequence."""
        found = super().at(order)
        if found is not None and found.structure is not self._structure:
            found.assign_sequence(self._structure)
        return found


def share_evaluator(
    first: Evaluator,
    sequences: Sequence[tuple[str, ...]],
    times: Sequence[FloatArray],
    structures: Sequence[Structure],
    experiments: Sequence[Experiments],
) -> Evaluator:
    """Return the evaluator of other sequences.

    Parameters
    ----------
    first : Evaluator
        Of a problem without guards, terminal constraints and jumps, in machine code for all sequences of its library.
    sequences, times, structures : sequences, one for each experiment
    experiments : sequence of dict
        For `SharedEngine`, one for each experiment.
    """
    given, runs = first.problem, []
    for run, sequence, own in zip(given.experiments, sequences, times, strict=True):
        changed = copy.copy(run)
        for name in OF_ONE_GUESS:
            vars(changed).pop(name, None)
        free = tuple(as_parameter(time, "a transition time") for time in own.tolist())
        object.__setattr__(changed, "mode_sequence", sequence)
        object.__setattr__(changed, "transition_times", free)
        runs.append(changed)
    problem = _change(given, SHARED, runs, structures)
    unknowns = list_unknowns(given.system, tuple(runs), dict(given.parameters), given.min_duration)
    object.__setattr__(problem, "unknowns", unknowns)
    found = copy.copy(first)
    for name in set(vars(found)) - {"meshes", "arguments", "_priors"}:
        del vars(found)[name]
    found.problem = problem
    _set_engines(found, structures, experiments)
    found._priors = unknowns.priors if unknowns.priors.any else None
    return found


def change_modes(
    first: Evaluator,
    sequences: Sequence[tuple[str, ...]],
    structures: Sequence[Structure],
    experiments: Sequence[Experiments],
) -> Evaluator:
    """Return the evaluator of other sequences with as many transitions and the same shortest durations.

    Parameters
    ----------
    first : Evaluator
        From `share_evaluator`.
    sequences, structures, experiments
        As in `share_evaluator`.
    """
    runs = [copy.copy(run) for run in first.problem.experiments]
    for run, sequence in zip(runs, sequences, strict=True):
        object.__setattr__(run, "mode_sequence", sequence)
    constraints_of(first.problem)
    found = copy.copy(first)
    found.problem = _change(first.problem, (*SHARED, *OF_TIMES), runs, structures)
    for name in ("halved", "structures"):
        vars(found).pop(name, None)
    _set_engines(found, structures, experiments)
    return found


def _change(given: Problem, shared: Sequence[str], runs: Sequence[Any], structures: Sequence[Structure]) -> Problem:
    """Return a problem with other experiments, and with what it shares with the given one."""
    problem: Problem = object.__new__(Problem)
    known = {name: value for name, value in vars(given).items() if name in (*GIVEN, "_functions", *shared)}
    vars(problem).update(known | {"experiments": tuple(runs), "structures": tuple(structures)})
    return problem


def _set_engines(evaluator: Evaluator, structures: Sequence[Structure], experiments: Sequence[Experiments]) -> None:
    given = zip(structures, evaluator.arguments, evaluator.meshes, experiments, strict=True)
    evaluator.engines = [SharedEngine(*each) for each in given]
