"""The neighbours of a mode sequence: all sequences that differ from it by one change.

Two modes in a row are exchanged, one is replaced, left out or put in. A search that ends at the best has compared it
with all of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise, takewhile

import numpy as np

from switchfit.modes.fitted import Fitted
from switchfit.modes.moves import Improver
from switchfit.modes.schedule import Schedule, list_insertions, list_removals, list_substitutions, merge_neighbours
from switchfit.modes.status import ModeWarning
from switchfit.strategy.library import Library

CHANGE_WITHOUT_TRACE = 1e-7
"""Part of J below which a change leaves no trace in what is measured: other cells of the mesh change J by less."""

MOST_ROUNDS_OF_NEIGHBOURS = 4
"""Most times that all neighbours are looked at, each time those of a better sequence."""


def list_neighbours(schedule: Schedule, library: Library) -> Iterator[Schedule]:
    """Yield schedules of all neighbouring sequences, most of them with several times.

    Parameters
    ----------
    schedule : Schedule
    library : Library
    """
    yield from _list_exchanges(schedule, library)
    yield from list_substitutions(schedule, library)
    yield from list_removals(schedule, library)
    yield from (more for more in list_insertions(schedule, library) if more.switches > schedule.switches)


def _list_exchanges(schedule: Schedule, library: Library) -> Iterator[Schedule]:
    """Yield the schedules with two modes in a row exchanged: each as long as before, or in the place of the other."""
    for i, (one, other) in enumerate(pairwise(schedule.sequence)):
        sequence = (*schedule.sequence[:i], other, one, *schedule.sequence[i + 2 :])
        moved, knots = schedule.times.copy(), schedule.knots
        # The two modes with their durations exchanged as well.
        moved[i] = knots[i] + knots[i + 2] - knots[i + 1]
        for times in (moved, schedule.times):
            changed = merge_neighbours(schedule.replace(sequence, times))
            if library.admits(changed.sequence):
                yield changed


def look_around(improver: Improver) -> list[ModeWarning]:
    """Fit the neighbours of the best, and those of what is better, until nothing is.

    Returns
    -------
    list of ModeWarning
        A mode that could be put into the best sequence and leaves no trace in what is measured; the longest of each
        mode in each experiment.
    """
    found: dict[tuple[int, str], ModeWarning] = {}
    for _ in range(MOST_ROUNDS_OF_NEIGHBOURS):
        best = improver.pool.best
        if best is None:
            break
        found = _fit_neighbours(improver, best)
        if improver.pool.best is best:
            break
        improver.improve()
    return list(found.values())


def _fit_neighbours(improver: Improver, best: Fitted) -> dict[tuple[int, str], ModeWarning]:
    """Fit the neighbours of each sequence, each from its best times; return the modes that leave no trace."""
    untraced: dict[tuple[int, str], ModeWarning] = {}
    known = {fitted.sequences: fitted.cost for fitted in improver.pool}
    problem, several = improver.fitter.problem, len(best.schedules) > 1
    every = improver.simulate(best, list_neighbours)
    for cost, changed, e in every:
        schedule = best.schedules[e]
        # More modes at the same J: what is measured does not tell whether they were active.
        if changed.switches > schedule.switches and abs(cost - best.cost) <= CHANGE_WITHOUT_TRACE * best.cost:
            mode, begin, end = _find_change(schedule, changed)
            name, unit = problem.run_names[e] if several else "", problem.experiments[e].time_unit
            note = ModeWarning("no trace", mode, name, begin, end, unit=unit)
            untraced[e, mode] = max(untraced.get((e, mode), note), note, key=lambda each: each.end - each.begin)
    for cost, given in improver.choose_lowest(best, every):
        # A sequence that is in the pool with a lower J has been fitted from a better place.
        if cost < known.get(tuple(each.sequence for each in given), np.inf):
            if several and improver.is_ruled_out(best, given):
                continue
            fitted = improver.fitter.fit(given, best.parameters)
            if improver.fitter.collapse(fitted) is None:  # one that has is a shorter sequence
                improver.pool.add(fitted)
            improver.report("fits of neighbouring sequences")
    return untraced


def _find_change(schedule: Schedule, changed: Schedule) -> tuple[str, float, float]:
    """Return the first mode of the changed schedule that is active at another time, and when."""
    knots = np.unique(np.concatenate([schedule.knots, changed.knots]))
    middles = 0.5 * (knots[:-1] + knots[1:])
    before = [schedule.sequence[k] for k in np.searchsorted(schedule.times, middles)]
    after = [changed.sequence[k] for k in np.searchsorted(changed.times, middles)]
    # There is one: every neighbour has other modes or other times.
    first = next(k for k in range(len(middles)) if before[k] != after[k])
    span = list(takewhile(lambda k: after[k] == after[first] != before[k], range(first, len(middles))))
    return after[first], float(knots[first]), float(knots[span[-1] + 1])
