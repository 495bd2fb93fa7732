"""Insertion of modes: pulses where the insertion rate is lowest, fitted, and modes removed that are not needed.

Where J is a running cost, the rate tells where an additional mode pays ([1]_), and the search may begin with a schedule
of one mode. For data it is the wrong tool: a pulse of no length says nothing about a mode that is missing for long.

References
----------
.. [1] H. Axelsson, Y. Wardi, M. Egerstedt, E. I. Verriest, Gradient descent approach to optimal mode scheduling in
   hybrid dynamical systems, J. Optim. Theory Appl. 136 (2008) 167-186.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.modes.fitted import Fitted
from switchfit.modes.fitter import Fitter
from switchfit.modes.moves import Improver
from switchfit.modes.rates import compute_rates
from switchfit.modes.schedule import Schedule, drop_empty, list_removals, splice, spread
from switchfit.runtime.progress import show_detail
from switchfit.strategy.short_fit import is_lower

PULSE_LENGTHS = (0.02, 0.1)
"""Lengths of the pulses that are proposed, as parts of the horizon."""

LEAST_PART_LEFT = 0.25
"""Part of the interrupted mode that a pulse leaves at least."""

MINIMA_OF_EACH_MODE = 3
"""Local minima of the rate of each mode at which pulses are proposed."""

FITTED_PULSES = 8
"""Proposals that are fitted from one schedule."""

REMOVED_FROM = 1
"""How many of these fits, the lowest ones, are repeated without each of their modes."""

PATIENCE_WITH_PULSES = 2
"""Schedules in a row from which no insertion leads to a lower J + switch_cost N, after which the search ends."""


def list_pulses(
    fitter: Fitter, schedules: Sequence[Schedule], parameters: FloatArray
) -> list[tuple[float, list[Schedule]]]:
    """Return schedules with one pulse more, where the insertion rate has its lowest local minima, and by how much J
    changes to first order, ``rate length``, the lowest first.

    Parameters
    ----------
    fitter : Fitter
    schedules : sequence of Schedule, one for each experiment
        Where pulses are inserted.
    parameters : (M,)
    """
    library = fitter.library
    theta = np.concatenate([*(schedule.times for schedule in schedules), parameters])
    found: list[tuple[float, list[Schedule]]] = []
    for e, rate in enumerate(compute_rates(fitter.get_evaluator(schedules), theta)):
        # `splice` takes modes that last; a fit may end with some that do not.
        schedule = drop_empty(schedules[e])
        for pulse in rate.minima(MINIMA_OF_EACH_MODE):
            for begin, length in _place_pulse(schedule, pulse.time):
                changed = splice(schedule, pulse.mode, begin, begin + length)
                # A pulse between two modes may make a succession that the library does not have.
                moved = spread(changed, library) if library.admits(changed.sequence) else None
                if moved is not None and moved.switches > schedule.switches:  # to move a transition is the fit's task
                    found.append((pulse.rate * length, [*schedules[:e], moved, *schedules[e + 1 :]]))
    return sorted(found, key=lambda item: item[0])


def _place_pulse(schedule: Schedule, time: float) -> list[tuple[float, float]]:
    """Return begin and length of the pulses at a time, each inside the mode that it interrupts, of which it leaves a
    part.
    """
    knots = schedule.knots
    i = min(int(np.searchsorted(schedule.times, time, "right")), schedule.switches)
    # A pulse that takes all of a mode replaces it, which is a move of another kind.
    room = (1 - LEAST_PART_LEFT) * (knots[i + 1] - knots[i])
    lengths = {min(part * (schedule.tf - schedule.t0), room) for part in PULSE_LENGTHS}
    return [(min(time, float(knots[i + 1]) - length), length) for length in sorted(lengths) if length > 0.0]


def insert_modes(improver: Improver, schedules: Sequence[Schedule], parameters: FloatArray) -> None:
    """Insert pulses, fit, remove modes, and go on as long as ``J + switch_cost N`` falls.

    A running cost is no likelihood: no information criterion counts its switches. If a switch costs nothing, the search
    goes on to `max_switches` of the library, as long as J falls.

    Parameters
    ----------
    improver : Improver
        Its pool gets the best fit for each number of switches.
    schedules : sequence of Schedule
        Where to begin. One mode and no transition will do.
    parameters : (M,)
    """
    pool, visited, waited = improver.pool, set[bytes](), 0
    weigh = partial(pool.compute, criterion="cost")
    current = improver.polish(schedules, parameters, "insertion")
    while waited <= PATIENCE_WITH_PULSES:
        visited.add(current.theta.tobytes())
        show_detail(f"{current.switches} switches", current.cost)
        lowest = min(map(weigh, pool), default=np.inf)
        _insert_and_fit(improver, current)
        # To the last bit: `Fitter.fit` hands out the same fit for the same start, so that a schedule which was visited
        # comes back as it was.
        candidates = [each for each in pool.by_switches.values() if each.theta.tobytes() not in visited]
        if not candidates:
            break
        # The best that was not looked at yet, even if it is no better: from there two pulses may pay where one does
        # not.
        current = min(candidates, key=weigh)
        waited = 0 if is_lower(min(map(weigh, pool)), lowest) else waited + 1


def _insert_and_fit(improver: Improver, current: Fitted) -> None:
    """Fit with one pulse more, and the lowest of these ends without each of its modes."""
    given = list_pulses(improver.fitter, current.schedules, current.parameters)[:FITTED_PULSES]
    # The rate is a derivative at no length; which pulse pays shows after the fit alone.
    ends = [improver.polish(each, current.parameters, "insertion") for _, each in given]
    for end in sorted(ends, key=lambda each: each.cost)[:REMOVED_FROM]:
        for e, schedule in enumerate(end.schedules):
            for without in list_removals(schedule, improver.library):
                improver.polish(improver.place(end, e, without), end.parameters, "insertion")
