"""Which parameters the functions of an experiment read."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from switchfit.problem.structure import Structure


class Readers(NamedTuple):
    """Which of the model's parameters the functions of an experiment read.

    Attributes
    ----------
    always : set of str
        By functions that act whatever the sequence.
    modes : dict of mode to set of str
    """

    always: frozenset[str]
    modes: Mapping[str, frozenset[str]]

    def find(self, sequence: Iterable[str], structure: Structure | None) -> set[str]:
        """Return what a sequence reads, with the functions at its transitions if its structure is given."""
        found = set(self.always).union(*(self.modes[mode] for mode in sequence))
        if structure is not None:
            at = (*structure.reset_maps, *structure.guards, *structure.transition_costs)
            found = found.union(*(function.parameters for function in at if function is not None))
        return found


def list_readers(structure: Structure) -> Readers:
    """Return which parameters each mode of a structure reads, and which the functions read that always act."""
    observes = [observe for observe, _ in structure.outputs]
    jumps = [structure.reset_maps[i] for i in structure.jumps]
    at_all_times = [*structure.running, *observes, *jumps]
    functions = [structure.initial_state, *at_all_times, *structure.terminal, *structure.terminal_constraints]
    always = {name for function in functions if function is not None for name in function.parameters}
    always = always.union(*(sensor.named for sensor in structure.measurements))
    pairs = zip(structure.mode_names, structure.modes, strict=True)
    return Readers(frozenset(always), {name: frozenset(mode.parameters) for name, mode in pairs})
