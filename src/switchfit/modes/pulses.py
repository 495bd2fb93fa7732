"""Insertion of modes: pulses where the insertion rate is lowest, fitted, and modes removed that are not needed.

Where J is a running cost, the rate tells where an additional mode pays ([1]_), and the search may begin with a schedule
of one mode. For data it is the wrong tool: a pulse of no length says nothing about a mode that is missing for long.

References
----------
.. [1] H. Axelsson, Y. Wardi, M. Egerstedt, E. I. Verriest, Gradient descent approach to optimal mode scheduling in
   hybrid dynamical systems, J. Optim. Theory Appl. 136 (2008) 167-186.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from switchfit.discretization.mesh import Mesh
from switchfit.fit.evaluator import Evaluator
from switchfit.modes.fitter import Fitted
from switchfit.modes.library import Library
from switchfit.modes.rates import Insertion, add_all_modes, compute_rates
from switchfit.modes.schedule import Schedule, list_removals, splice, spread
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem
from switchfit.runtime.progress import show_detail
from switchfit.strategy.proposal import Proposal

LENGTHS = (0.02, 0.1)
"""Lengths of the pulses that are proposed, as parts of the horizon."""

LEFT = 0.25
"""Part of the interrupted mode that a pulse leaves at least."""

MINIMA = 3
"""Local minima of the rate of each mode at which pulses are proposed."""

FITTED = 8
"""Proposals that are fitted from one schedule."""

REMOVED_FROM = 1
"""How many of these fits, the lowest ones, are repeated without each of their modes."""

LOWER = 1e-6
"""A cost has to fall by this part of itself to count as lower."""

PATIENCE = 2
"""Schedules in a row from which no insertion leads to a lower J + switch_cost N, after which the search ends."""


def propose_insertions(
    problem: Problem,
    library: Library,
    parameters: FloatArray,
    *,
    schedules: Sequence[Schedule],
    meshes: Sequence[Mesh] | None = None,
) -> list[Proposal]:
    """Return schedules with one pulse more, where the insertion rate has its lowest local minima.

    Parameters
    ----------
    problem : Problem
        With all modes of the library.
    library : Library
    parameters : (M,)
        Free parameters and initial states, in the order of theta.
    schedules : sequence of Schedule, one for each experiment
        Where pulses are inserted.
    meshes : sequence of Mesh, optional
        Refined at the schedules if left out.

    Returns
    -------
    list of Proposal
        Those first that lower J most to first order, ``J + rate length``, which is their cost.
    """
    cost, rates = rate_schedules(problem, schedules, parameters, meshes)
    proposals = []
    for e, (schedule, rate) in enumerate(zip(schedules, rates, strict=True)):
        for pulse in rate.minima(MINIMA):
            if pulse.mode not in library.modes:
                continue
            for begin, length in _place_pulse(schedule, pulse.time):
                changed = splice(schedule, pulse.mode, begin, begin + length)
                moved = spread(changed, library) if library.admits(changed.sequence) else None
                if moved is None or moved.switches <= schedule.switches:  # a transition that moves is the fit's task
                    continue
                whole = [*schedules[:e], moved, *schedules[e + 1 :]]
                sequences, times = tuple(s.sequence for s in whole), tuple(s.times for s in whole)
                proposals.append(Proposal(sequences, times, parameters, cost + pulse.rate * length))
    return sorted(proposals, key=lambda proposal: proposal.cost)


def _place_pulse(schedule: Schedule, time: float) -> list[tuple[float, float]]:
    """Return begin and length of the pulses at a time, each inside the mode that it interrupts, of which it leaves a
    part.
    """
    knots = schedule.knots
    i = min(int(np.searchsorted(schedule.times, time, "right")), schedule.switches)
    room = (1 - LEFT) * (knots[i + 1] - knots[i])
    lengths = {min(part * (schedule.tf - schedule.t0), room) for part in LENGTHS}
    return [(min(time, float(knots[i + 1]) - length), length) for length in sorted(lengths) if length > 0.0]


def rate_schedules(
    problem: Problem, schedules: Sequence[Schedule], parameters: FloatArray, meshes: Sequence[Mesh] | None = None
) -> tuple[float, tuple[Insertion, ...]]:
    """Return J and the insertion rates of a schedule for each experiment.

    Parameters
    ----------
    problem : Problem
    schedules : sequence of Schedule
    parameters : (M,)
    meshes : sequence of Mesh, optional
    """
    whole = add_all_modes(problem, max(s.switches for s in schedules))
    own = whole.with_sequences([s.sequence for s in schedules], [_guess_times(s) for s in schedules])
    theta = np.concatenate([*(s.times for s in schedules), parameters])
    evaluator = Evaluator(own, theta, meshes)
    return evaluator.cost(theta), compute_rates(evaluator, theta)


def _guess_times(schedule: Schedule) -> FloatArray:
    """Return times that increase strictly, as guesses must, also where modes of the schedule have collapsed."""
    if (schedule.durations > 0.0).all():
        return schedule.times
    return np.linspace(schedule.t0, schedule.tf, schedule.switches + 2)[1:-1]


def insert_modes(
    problem: Problem,
    library: Library,
    parameters: FloatArray,
    *,
    fit: Callable[[Sequence[Schedule], FloatArray], Fitted],
    schedules: Sequence[Schedule],
    switch_cost: float = 0.0,
    meshes: Sequence[Mesh] | None = None,
) -> dict[int, Fitted]:
    """Insert pulses, fit, remove modes, and go on as long as ``J + switch_cost N`` falls.

    A running cost is no likelihood: no information criterion counts its switches. `switch_cost` says what a switch
    costs in units of J; with 0 the search goes on to `max_switches` of the library, as long as J falls.

    Parameters
    ----------
    problem : Problem
    library : Library
    parameters : (M,)
        Free parameters and initial states, in the order of theta.
    fit : callable ``(schedules, parameters) -> Fitted``
        As `Fitter.polish`, which leaves out modes that collapse.
    schedules : sequence of Schedule
        Where to begin. One mode and no transition will do.
    switch_cost : float
    meshes : sequence of Mesh, optional
        Of the rates.

    Returns
    -------
    dict of int to Fitted
        The best fit that was found for each number of switches.
    """
    current = fit(schedules, parameters)
    best: dict[int, Fitted] = {current.switches: current}
    visited: set[bytes] = set()
    waited = 0
    while waited <= PATIENCE:
        visited.add(current.theta.tobytes())
        show_detail(f"{current.switches} switches", current.cost)
        lowest = min(_weigh(each, switch_cost) for each in best.values())
        for end in _insert_and_fit(problem, library, current, fit, meshes):
            known = best.get(end.switches)
            if known is None or end.cost < known.cost - LOWER * abs(known.cost):
                best[end.switches] = end
        candidates = [each for each in best.values() if each.theta.tobytes() not in visited]
        if not candidates:
            break
        current = min(candidates, key=lambda each: _weigh(each, switch_cost))
        fell = min(_weigh(each, switch_cost) for each in best.values()) < lowest - LOWER * abs(lowest)
        waited = 0 if fell else waited + 1
    return dict(sorted(best.items()))


def _weigh(fitted: Fitted, switch_cost: float) -> float:
    return fitted.cost + switch_cost * fitted.switches


def _insert_and_fit(
    problem: Problem,
    library: Library,
    current: Fitted,
    fit: Callable[[Sequence[Schedule], FloatArray], Fitted],
    meshes: Sequence[Mesh] | None,
) -> list[Fitted]:
    """Return the ends of fits with one pulse more, and of the lowest of them without each of their modes."""
    proposals = propose_insertions(problem, library, current.parameters, schedules=current.schedules, meshes=meshes)
    ends = []
    for proposal in proposals[:FITTED]:
        pairs = zip(current.schedules, proposal.sequences, proposal.transition_times, strict=True)
        ends.append(fit([old.replace(sequence, times) for old, sequence, times in pairs], proposal.parameters))
    for end in sorted(ends, key=lambda each: each.cost)[:REMOVED_FROM]:
        for e, schedule in enumerate(end.schedules):
            for without in list_removals(schedule, library):
                ends.append(fit([*end.schedules[:e], without, *end.schedules[e + 1 :]], end.parameters))
    return [end for end in ends if not end.failed]
