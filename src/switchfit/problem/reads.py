"""Which parameters the functions of a problem read, and which free parameters no function reads."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.problem.problem import Problem, keep_with_problem
from switchfit.problem.structure import Structure
from switchfit.problem.tracing import trace_structure


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
    unknowns, here = problem.unknowns, find_targets(problem, problem.structures, library=False)
    free, known = unknowns.parameters, unknowns.priors.precision > 0
    # Found here first, without a library: most problems read all that they have, and need no more.
    left = [name for name, span in free.items() if name not in here and not known[span].any()]
    if not left:
        return Unread()
    try:  # the modes, reset maps and guards that do not occur may have faults
        libraries = [trace_structure(problem._sources, run, len(run.mode_sequence)) for run in problem.experiments]
        elsewhere = find_targets(problem, libraries, library=True)
    except ValueError:
        return Unread()
    unread = tuple(entry for name in left if name not in elsewhere for entry in unknowns.names[free[name]])
    return Unread(unread, tuple(entry for name in left if name in elsewhere for entry in unknowns.names[free[name]]))


def name_whole_parameters(entries: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the parameters that entries of theta belong to, such as "k" of "k[0]" and "k[1]".

    Parameters
    ----------
    entries : iterable of str
    """
    return tuple(dict.fromkeys(name.partition("[")[0] for name in entries))


def find_targets(problem: Problem, structures: Iterable[Structure], *, library: bool) -> dict[str, set[int]]:
    """Return the entries of the problem's parameters that its experiments read: in their own sequences, or in any of a
    library.

    Parameters
    ----------
    problem : Problem
    structures : iterable of Structure, one for each experiment
    library : bool
    """
    found: dict[str, set[int]] = {}
    for run, structure in zip(problem.experiments, structures, strict=True):
        functions = structure.library.roles if library else structure.acting
        read = chain.from_iterable(function.read.items() for function in functions.values())
        named = ((name, (0,)) for sensor in structure.measurements for name in sensor.named)
        for name, entries in chain(read, named):
            found.setdefault(run.parameter_map.get(name, name), set()).update(entries)
    return found


def find_read(problem: Problem, structures: Iterable[Structure], *, library: bool) -> NDArray[np.bool_]:
    """Return what the functions of a problem read, and the initial states, in the order of theta after the times: (M,).

    Parameters
    ----------
    problem : Problem
    structures : iterable of Structure, one for each experiment
    library : bool
        Whether all functions of their libraries count, or those of their sequences alone.
    """
    unknowns, read = problem.unknowns, find_targets(problem, structures, library=library)
    found = np.zeros(len(unknowns.names), dtype=bool)
    for name, span in unknowns.parameters.items():
        found[[span.start + i for i in read.get(name, ())]] = True
    for states in unknowns.initial_states:
        found[states[states >= 0]] = True
    return found[int(unknowns.is_time.sum()) :]
