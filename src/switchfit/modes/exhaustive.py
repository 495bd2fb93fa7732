"""Propose every sequence of a small library, with its transition times on a coarse grid."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import combinations
from math import comb

import numpy as np

from switchfit.modes.fitter import Fitter
from switchfit.modes.library import Library
from switchfit.modes.proposal import Proposal
from switchfit.modes.schedule import Schedule, spread
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem

MOST_SIMULATIONS = 12_000
"""Simulations of all sequences and grids together, about half a second."""

FINEST, COARSEST = 24, 3
"""Cells of the grid: at most, and at least, however many switches there are."""


def generate(
    problem: Problem,
    library: Library,
    parameters: FloatArray,
    *,
    cost: Callable[[Sequence[Schedule], FloatArray], float] | None = None,
    grid: float | None = None,
    penalty: float = 0.0,
) -> list[Proposal]:
    """Return the best times on a grid for each sequence, those of lowest cost first.

    Sequences are listed in the order of their number of switches, as long as their simulations are not too many.

    Parameters
    ----------
    problem : Problem
        With one experiment.
    library : Library
    parameters : (M,)
        At which the costs are compared.
    cost : callable, optional
        Returns J of one schedule for each experiment and the parameters; by default, on meshes of its own.
    grid : float, optional
        Distance of the grid's times; chosen by the number of sequences if left out.
    penalty : float
        Cost of a switch, in units of J.
    """
    run = problem.experiments[0]
    evaluate = Fitter(problem, library).cost if cost is None else cost
    found = []
    left = MOST_SIMULATIONS
    for switches in library.possible_switches:
        count = library.count_sequences(switches)
        cells = _choose_cells(switches, count, left, run.end - run.t0, grid)
        if cells is None:
            break
        left -= count * comb(cells - 1, switches)
        places = np.linspace(run.t0, run.end, cells + 1)[1:-1]
        for sequence in library.list_sequences(switches):
            best, lowest = None, np.inf
            for schedule in _list_schedules(sequence, places, run.t0, run.end, library):
                here = evaluate([schedule], parameters)
                if here < lowest:
                    best, lowest = schedule, here
            if best is not None:
                found.append(Proposal((sequence,), (best.times,), parameters, lowest + penalty * switches))
    return sorted(found, key=lambda proposal: proposal.cost)


def _choose_cells(switches: int, count: int, left: int, length: float, grid: float | None) -> int | None:
    """Return the number of cells of the grid; None if simulations are too many on the coarsest one."""
    if grid is not None:
        cells = max(round(length / grid), switches + 1)
        return cells if count * comb(cells - 1, switches) <= left else None
    share = left / 2
    for cells in range(FINEST, max(COARSEST, switches + 1) - 1, -1):
        if count * comb(cells - 1, switches) <= share:
            return cells
    return None


def _list_schedules(
    sequence: tuple[str, ...], places: FloatArray, t0: float, tf: float, library: Library
) -> Iterator[Schedule]:
    for times in combinations(places.tolist(), len(sequence) - 1):
        schedule = spread(Schedule(sequence, np.array(times), t0, tf), library)
        if schedule is not None:
            yield schedule
