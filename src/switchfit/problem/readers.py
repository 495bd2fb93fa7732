"""Which parameters the functions of an experiment read, and which of a problem's none of them reads."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple

from switchfit.problem.problem import Problem, keep_with_problem
from switchfit.problem.structure import Structure, trace_structure


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


class Unread(NamedTuple):
    """Free parameters on which J cannot depend, by the names of their entries in theta.

    A parameter with a prior is not among them: J depends on it through the prior.

    Attributes
    ----------
    unread : tuple of str
        Those that no function of the model reads.
    absent : tuple of str
        Those that are read only by modes that occur in no mode_sequence, or at transitions that do not occur.
    """

    unread: tuple[str, ...] = ()
    absent: tuple[str, ...] = ()


@keep_with_problem
def find_unread(problem: Problem) -> Unread:
    """Return the free parameters that no function reads which acts in the sequences of a problem.

    If a mode that does not occur cannot be traced, as it needs a parameter that the problem lacks, it is unknown what
    it reads: parameters that nothing else reads are in neither list.

    Parameters
    ----------
    problem : Problem
    """
    unknowns, texts = problem.unknowns, problem.unknowns.priors.texts()
    here = find_targets(problem, problem.structures, library=False)
    free = {name: range(span.start, span.stop) for name, span in unknowns.parameters.items()}
    left = [name for name, span in free.items() if name not in here and not any(texts[i] for i in span)]
    if not left:
        return Unread()
    try:
        elsewhere = find_targets(problem, _trace_libraries(problem), library=True)
    except ValueError:
        return Unread()
    unread = tuple(unknowns.names[i] for name in left if name not in elsewhere for i in free[name])
    return Unread(unread, tuple(unknowns.names[i] for name in left if name in elsewhere for i in free[name]))


def name_whole_parameters(entries: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the parameters that entries of theta belong to, such as "k" of "k[0]" and "k[1]".

    Parameters
    ----------
    entries : iterable of str
    """
    return tuple(dict.fromkeys(name.partition("[")[0] for name in entries))


def find_targets(problem: Problem, structures: Iterable[Structure], *, library: bool) -> set[str]:
    """Return the problem's parameters that its experiments read: in their own sequences, or in any of a library.

    Parameters
    ----------
    problem : Problem
    structures : iterable of Structure, one for each experiment
    library : bool
    """
    found: set[str] = set()
    for run, structure in zip(problem.experiments, structures, strict=True):
        readers = list_readers(structure)
        modes = readers.modes if library else {structure.mode_names[k] for k in structure.mode_of_segment}
        names = readers.find(modes, structure.library if library else structure)
        found.update(run.parameter_map.get(name, name) for name in names)
    return found


def _trace_libraries(problem: Problem) -> list[Structure]:
    """Return the structures with all modes of the system, traced if the problem's own have those of a sequence alone.

    Raises
    ------
    ValueError
        If a mode, a reset map or a guard that does not occur cannot be traced.
    """
    if problem.max_transitions is not None:
        return list(problem.structures)
    each = zip(problem.experiments, problem.structures, strict=True)
    return [trace_structure(problem.system, run, problem._functions, problem.solver, own.N) for run, own in each]
