"""Which parameters and initial states act in mode sequences: those that functions of the sequences read."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from switchfit.problem.problem import Problem
from switchfit.problem.readers import list_readers
from switchfit.problem.structure import Structure


class ActingParameters:
    """Which parameters and initial states the functions of a problem's sequences read.

    Parameters
    ----------
    problem : Problem
        Of a library; its sequences do not matter.
    structure_of : callable (e, sequence) -> Structure
        Of an experiment with another sequence.
    """

    def __init__(self, problem: Problem, structure_of: Callable[[int, tuple[str, ...]], Structure]) -> None:
        self.problem, self._structure_of = problem, structure_of
        self._first = sum(len(run.transition_times) for run in problem.experiments)
        self._of_runs = [list_readers(structure) for structure in problem.structures]

    def find(self, sequences: Sequence[tuple[str, ...]]) -> NDArray[np.bool_]:
        """Return what functions of the sequences read, arrays as a whole, and the initial states: (M,).

        Parameters
        ----------
        sequences : sequence of tuple of str, one for each experiment
        """
        names = []
        for e, (sequence, readers) in enumerate(zip(sequences, self._of_runs, strict=True)):
            library = self.problem.structures[e]
            own = self._structure_of(e, sequence) if _has_functions_at_transitions(library) else None
            names.append(readers.find(sequence, own))
        return self._mark(names)

    def find_in_library(self) -> NDArray[np.bool_]:
        """Return what any function of the library reads, arrays as a whole, and the initial states: (M,)."""
        names = []
        for structure, readers in zip(self.problem.structures, self._of_runs, strict=True):
            library = structure.library
            at = (*library.reset_maps, *library.guards, *library.transition_costs)
            read = readers.find(readers.modes, None)
            names.append(read.union(*(f.parameters for f in at if f is not None)))
        return self._mark(names)

    def find_arrays(self) -> NDArray[np.bool_]:
        """Return which of the parameters are entries of an array: (M,)."""
        found = np.zeros(len(self.problem.theta_names) - self._first, dtype=bool)
        for span in self.problem.unknowns.parameters.values():
            found[span.start - self._first : span.stop - self._first] = span.stop - span.start > 1
        return found

    def _mark(self, names: Sequence[Iterable[str]]) -> NDArray[np.bool_]:
        """Return the free parameters that have one of the model's names in an experiment, and its initial state."""
        unknowns = self.problem.unknowns
        found = np.zeros(len(self.problem.theta_names) - self._first, dtype=bool)
        for run, own, states in zip(self.problem.experiments, names, unknowns.initial_states, strict=True):
            for name in own:
                span = unknowns.parameters.get(run.parameter_map.get(name, name))
                if span is not None:
                    found[span.start - self._first : span.stop - self._first] = True
            found[states[states >= 0] - self._first] = True
        return found


def _has_functions_at_transitions(structure: Structure) -> bool:
    library = structure.library
    return bool(library.reset_maps or library.guards or library.transition_costs) and not structure.jumps
