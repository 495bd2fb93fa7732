"""Which parameters and initial states act in mode sequences: those that functions of the sequences read."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from switchfit.problem.problem import Problem
from switchfit.problem.readers import find_targets
from switchfit.problem.structure import Structure


def find_read(problem: Problem, structures: Iterable[Structure], *, library: bool) -> NDArray[np.bool_]:
    """Return what the functions of a problem read, arrays as a whole, and the initial states, in the order of theta
    after the times: (M,).

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
        found[span] = name in read
    for states in unknowns.initial_states:
        found[states[states >= 0]] = True
    return found[int(unknowns.is_time.sum()) :]


def find_arrays(problem: Problem) -> NDArray[np.bool_]:
    """Return which of the parameters are entries of an array: (M,)."""
    found = np.zeros(len(problem.theta_names), dtype=bool)
    for span in problem.unknowns.parameters.values():
        found[span] = span.stop - span.start > 1
    return found[int(problem.unknowns.is_time.sum()) :]
