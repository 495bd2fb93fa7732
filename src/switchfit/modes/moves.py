"""Moves among the schedules of a problem: fit what generators propose, then move until nothing helps.

Moves are tried in the order of what they cost: modes are taken out, replaced, put in (pulses between the times of a
grid, compared by their simulations), and transition times hop over one or two sample intervals; each is followed by a
fit. A move is kept if the criterion falls.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.modes.fitted import Fitted
from switchfit.modes.fitter import Fitter
from switchfit.modes.pool import Pool
from switchfit.modes.schedule import Schedule, list_insertions, list_removals, list_substitutions
from switchfit.strategy.hops import choose_hops
from switchfit.strategy.library import Library
from switchfit.strategy.proposal import Proposal
from switchfit.strategy.short_fit import is_lower

LEAST_FALL_OF_CRITERION = 1e-6
"""A criterion has to fall by this part of itself, or by this much if it is small, for a move to count."""

FITTED_MOVES = 3
"""Moves of a kind that are fitted, those of the lowest simulated cost, each of another sequence."""

FITTED_PROPOSALS = 3
"""Proposals of a generator that are fitted for each run."""

FITTED_REMOVALS = 2
"""Removals that are fitted for each number of switches below the best; one where the data are explained: it is then for
the table alone."""

PLACES_BETWEEN_NEIGHBOURS = (0.25, 0.5, 0.75)
"""Places between its neighbours, as parts of the distance, to which a transition is moved."""

RULED_OUT_ABOVE = 20.0
"""Difference of the criterion from the best, by the quadratic model, above which a move is not fitted."""

MOST_ROUNDS_OF_MOVES = 12
"""Most rounds of moves."""

MOST_FEWER_SWITCHES = 8
"""Switches below the best down to which the table by number of switches is filled, for several runs."""

ListMoves = Callable[[Schedule, Library], Iterable[Schedule]]

KINDS_OF_MOVES: tuple[tuple[ListMoves, str, bool], ...] = (
    (list_removals, "removal of modes", True),
    (list_substitutions, "replacement of modes", True),
    (list_insertions, "insertion of modes", False),
)
"""Kinds of moves in the order of what they cost, and whether only those are fitted that the model does not rule out."""


class Move(NamedTuple):
    """Another schedule of experiment e, and J with it."""

    cost: float
    schedule: Schedule
    e: int


class Improver:
    """Moves on the schedules of a problem.

    Parameters
    ----------
    fitter : Fitter
    pool : Pool
        Gets all that is fitted.
    report : callable
        Called with what is under way after every fit; it may raise to end the search.
    """

    def __init__(self, fitter: Fitter, pool: Pool, report: Callable[[str], None]) -> None:
        self.fitter, self.pool, self.report = fitter, pool, report
        self.library = fitter.library
        self.spans = [(run.t0, run.end) for run in fitter.problem.experiments]

    def polish(self, schedules: Sequence[Schedule], parameters: FloatArray, what: str) -> Fitted:
        """Fit a start, without the modes that collapse, and add it to the pool."""
        found = self.fitter.polish(schedules, parameters)
        self.pool.add(found)
        self.report(what)
        return found

    def polish_proposals(self, proposals: Iterable[Proposal]) -> None:
        """Fit the best proposals of different sequences.

        Parameters
        ----------
        proposals : iterable of Proposal
        """
        taken: set[tuple[tuple[str, ...], ...]] = set()
        most = FITTED_PROPOSALS * len(self.spans)
        for proposal in sorted(proposals, key=lambda proposal: proposal.cost):
            # The lowest proposal of each sequence: a fit moves the times anyway, but never to another sequence.
            if proposal.sequences not in taken and len(taken) < most:
                taken.add(proposal.sequences)
                given = zip(proposal.sequences, proposal.transition_times, self.spans, strict=True)
                schedules = [Schedule(sequence, times, *span) for sequence, times, span in given]
                self.polish(schedules, proposal.parameters, "fits of proposals")

    def improve(self) -> None:
        """Move from the best until no move lowers the criterion."""
        hopped: set[tuple[tuple[str, ...], ...]] = set()
        for _ in range(MOST_ROUNDS_OF_MOVES):
            best = self.pool.best
            if best is None:
                return
            # Where every sequence takes seconds to compile, only those with fewer modes are tried.
            moves = KINDS_OF_MOVES if self.fitter.shares_programs else KINDS_OF_MOVES[:1]
            if any(self._try(best, partial(self._fit_lowest, *move)) for move in moves):
                continue
            # Hops come last, and once for each sequence: they take many evaluations of models.
            if best.sequences in hopped or not self._try(best, self._hop):
                return
            hopped.add(best.sequences)

    def _try(self, best: Fitted, move: Callable[[Fitted], None]) -> bool:
        """Try the moves of a kind; return whether the best is better."""
        before = self.pool.lowest
        move(best)
        # Relative to 1 where the criterion is near 0: information criteria cross it.
        return self.pool.lowest < before - LEAST_FALL_OF_CRITERION * max(abs(before), 1.0)

    def _hop(self, best: Fitted) -> None:
        """Fit from other sample intervals until that does not help; the time of a transition with a guard follows."""
        # Guards determine the times of their transitions: there is nothing to hop.
        here = None if best.guarded else best
        while here is not None:
            before, here = here, None
            ends = np.cumsum([schedule.switches for schedule in before.schedules])
            # Parameters that act in no mode have zero rows in the Hessian, and are held as in a fit.
            free = np.append(np.ones(ends[-1], dtype=bool), before.acting)
            evaluator = self.fitter.get_evaluator(before.schedules)
            for theta in choose_hops(evaluator, before.theta, before.cost, free):
                pairs = zip(before.schedules, np.split(theta, ends), strict=False)
                # A hop of one time may lead past another; `polish` drops the mode that is left without a duration.
                moved = [schedule.replace(schedule.sequence, np.sort(times)) for schedule, times in pairs]
                found = self.polish(moved, theta[ends[-1] :], "hops over samples")
                if is_lower(found.cost, before.cost):
                    # Another sequence is in the pool now, and gets moves of its own.
                    here = found if found.sequences == before.sequences else None
                    break

    @staticmethod
    def place(best: Fitted, e: int, schedule: Schedule) -> list[Schedule]:
        """Return the schedules with another one for a run."""
        return [*best.schedules[:e], schedule, *best.schedules[e + 1 :]]

    def simulate(self, best: Fitted, list_moves: ListMoves) -> list[Move]:
        """Return all moves of a kind from the best, with their J at its parameters."""
        found = []
        for e, schedule in enumerate(best.schedules):
            # All moves of a run in one call: of one sequence together, which machine code simulates without being
            # assigned anew.
            every = list(list_moves(schedule, self.library))
            costs = self.fitter.compute_costs(best.schedules, e, every, best.parameters)
            found += [Move(*each, e) for each in zip(costs.tolist(), every, strict=True)]
        return found

    def choose_lowest(self, best: Fitted, moves: Iterable[Move]) -> list[tuple[float, list[Schedule]]]:
        """Return the lowest J of each sequence to which moves lead, and the schedules, lowest expected criterion
        first.
        """
        found: dict[tuple[int, tuple[str, ...]], Move] = {}
        for move in sorted(moves, key=lambda move: move.cost):
            if np.isfinite(move.cost):
                # Sorted by cost, so that the first of a sequence is its lowest.
                found.setdefault((move.e, move.schedule.sequence), move)
        # J decides within a sequence; between sequences the criterion does, which counts switches.
        pairs = [(move.cost, self.place(best, move.e, move.schedule)) for move in found.values()]
        return sorted(pairs, key=lambda pair: self._expect(best, *pair))

    def _fit_lowest(self, list_moves: ListMoves, what: str, screened: bool, best: Fitted) -> None:
        """Simulate all moves of a kind, and fit those of the lowest expected criterion, one of each sequence.

        `screened` fits only those that the quadratic model does not rule out, where the best explains the data: a move
        that lowers the criterion then changes little, and the model is good.
        """
        screened = screened and self.pool.is_explained() is True
        for _, given in self.choose_lowest(best, self.simulate(best, list_moves))[:FITTED_MOVES]:
            if not (screened and self.is_ruled_out(best, given)):
                self.polish(given, best.parameters, what)

    def _expect(self, best: Fitted, cost: float, given: Sequence[Schedule]) -> float:
        """Return the criterion of schedules with this J."""
        switches = sum(schedule.switches for schedule in given)
        return self.pool.score.compute(self.pool.criterion, cost, int(best.acting.sum()), switches)

    def is_ruled_out(self, best: Fitted, given: Sequence[Schedule]) -> bool:
        """Return whether the criterion of schedules is far above the best by the quadratic model, without a fit."""
        expected = self._expect(best, self.fitter.predict(given, best.parameters), given)
        return expected > self.pool.compute(best) + RULED_OUT_ABOVE

    def fill_numbers(self) -> None:
        """Fit schedules with fewer switches than the best, each from the next longer one without a mode.

        Those with one or two more, if there are any, are fitted from other places as well.
        """
        best = self.pool.best
        if best is None:
            return
        lowest = 0 if len(self.spans) == 1 else max(best.switches - MOST_FEWER_SWITCHES, 0)
        for switches in range(best.switches, lowest, -1):
            self._slide(switches, best)
            if switches in self.pool.by_switches:
                self._fit_removals(self.pool.by_switches[switches])
        for switches in (lowest, best.switches + 1, best.switches + 2):
            self._slide(switches, best)

    def _slide(self, switches: int, best: Fitted) -> None:
        """Fit a schedule with so many switches, if there is one, from other places of each transition between its
        neighbours.

        One with fewer switches than the data have is often in a local minimum where a mode was removed. With sigma
        known these are far above the best in any case.
        """
        fitted = self.pool.by_switches.get(switches)
        # The best has been moved in every way already.
        if fitted is None or fitted is best or self.pool.score.has_chi_square:
            return
        for e, schedule in enumerate(fitted.schedules):
            knots = schedule.knots
            for i in range(schedule.switches):
                for part in PLACES_BETWEEN_NEIGHBOURS:
                    times = schedule.times.copy()
                    times[i] = knots[i] + part * (knots[i + 2] - knots[i])
                    moved = schedule.replace(schedule.sequence, times)
                    self.polish(self.place(fitted, e, moved), fitted.parameters, "fits with fewer switches")

    def _fit_removals(self, fitted: Fitted) -> None:
        """Fit the schedules without one of the modes whose removal costs least."""
        found = sorted(self.simulate(fitted, list_removals), key=lambda move: move.cost)
        for move in found[: 1 if self.pool.is_explained() else FITTED_REMOVALS]:
            self.polish(self.place(fitted, move.e, move.schedule), fitted.parameters, "fits with fewer switches")
