"""The best fit of each sequence that a search has found, and its criteria.

Search among the schedules of the runs of one problem: polish what generators propose, then move until nothing helps.

Moves are tried in the order of what they cost: modes are taken out, replaced, put in (pulses between the times of a
grid, compared by their simulations), and transition times hop over one or two sample intervals; each is followed by a
fit. A move is kept if the criterion falls.

Insertion of modes: pulses where the insertion rate is lowest, fitted, and modes removed that are not needed.

Where J is a running cost, the rate tells where an additional mode pays ([1]_), and the search may begin with a schedule
of one mode. For data it is the wrong tool: a pulse of no length says nothing about a mode that is missing for long.

Values of the parameters at which a search begins.

References
----------
.. [1] H. Axelsson, Y. Wardi, M. Egerstedt, E. I. Verriest, Gradient descent approach to optimal mode scheduling in
   hybrid dynamical systems, J. Optim. Theory Appl. 136 (2008) 167-186.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.modes.criterion import CriterionName, Score
from switchfit.modes.fitter import Fitted, Fitter
from switchfit.modes.rates import compute_rates
from switchfit.modes.schedule import (
    Schedule,
    drop_empty,
    list_insertions,
    list_removals,
    list_substitutions,
    splice,
    spread,
)
from switchfit.runtime.progress import show_detail
from switchfit.strategy.beam import Proposal
from switchfit.strategy.hops import choose_hops, is_lower
from switchfit.strategy.library import Library

EXPLAINED = 1e-3
"""Probability of chi-square above which the data are explained, and no further start is needed."""

Sequences = tuple[tuple[str, ...], ...]

LOWER = 1e-6
"""A criterion has to fall by this part of itself, or by this much if it is small, for a move to count."""

FITTED_MOVES = 3
"""Moves of a kind that are fitted, those of the lowest simulated cost, each of another sequence."""

FITTED_PROPOSALS = 3
"""Proposals of a generator that are fitted for each run."""

FITTED_REMOVALS = 2
"""Removals that are fitted for each number of switches below the best; one where the data are explained: it is then for
the table alone."""

PLACES = (0.25, 0.5, 0.75)
"""Places between its neighbours, as parts of the distance, to which a transition is moved."""

FAR = 20.0
"""Difference of the criterion from the best, by the quadratic model, above which a move is not fitted."""

ROUNDS = 12
"""Most rounds of moves."""

CHAIN = 8
"""Switches below the best down to which the table by number of switches is filled, for several runs."""

ListMoves = Callable[[Schedule, Library], Iterable[Schedule]]

MOVES: tuple[tuple[ListMoves, str, bool], ...] = (
    (list_removals, "removal of modes", True),
    (list_substitutions, "replacement of modes", True),
    (list_insertions, "insertion of modes", False),
)
"""Kinds of moves in the order of what they cost, and whether only those are fitted that the model does not rule out."""

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

PATIENCE_WITH_PULSES = 2
"""Schedules in a row from which no insertion leads to a lower J + switch_cost N, after which the search ends."""

FACTORS = (0.7, 1.4)
"""By which a guess without a prior is multiplied."""

MOST_ALONE = 4
"""Parameters up to which each is changed alone too."""


class Pool:
    """The lowest end of each sequence.

    Parameters
    ----------
    score : Score
    criterion : {"bic", "mbic", "aicc", "cost"}
        By which sequences are compared during the search.

    Attributes
    ----------
    undiscounted : Score
    as_it_stands : Fitted or None
        The best before the criteria were discounted; None if they were not.
    """

    def __init__(self, score: Score, criterion: CriterionName) -> None:
        self.score = self.undiscounted = score
        self.criterion = criterion
        self._found: dict[Sequences, Fitted] = {}
        self.as_it_stands: Fitted | None = None

    def __iter__(self) -> Iterator[Fitted]:
        return iter(self._found.values())

    def add(self, fitted: Fitted) -> None:
        """Add a fit, unless it failed or the same sequence has a lower one."""
        known = self._found.get(fitted.sequences)
        if not fitted.failed and (known is None or fitted.cost < known.cost):
            self._found[fitted.sequences] = fitted

    def compute(self, fitted: Fitted, criterion: CriterionName | None = None, *, discounted: bool = True) -> float:
        """Return a criterion of a fit, by default that of the search."""
        name, score = criterion or self.criterion, self.score if discounted else self.undiscounted
        switches = fitted.switches if name == "cost" else fitted.free_switches
        return score.compute(name, fitted.cost, int(fitted.acting.sum()), switches)

    @property
    def is_likelihood(self) -> bool:
        """Whether the cost is one."""
        return self.score.sigma_known is not None

    def discount(self, score: Score) -> None:
        """Compare by mBIC with a discounted score from now on.

        Parameters
        ----------
        score : Score
        """
        self.as_it_stands = self.best
        self.score, self.criterion = score, "mbic"

    @property
    def best(self) -> Fitted | None:
        """The fit with the lowest criterion; None if there is none."""
        return min(self, key=self.compute, default=None)

    @property
    def lowest(self) -> float:
        """The criterion of the best; infinite if there is none."""
        return min(map(self.compute, self), default=np.inf)

    def is_explained(self) -> bool | None:
        """Return whether chi-square says that the best explains the data; None where it cannot say."""
        best = self.best
        probability = np.nan if best is None else self.measure_probability(best)
        return None if np.isnan(probability) else bool(probability >= EXPLAINED)

    def list_best(self, criterion: CriterionName | None = None) -> list[Fitted]:
        """Return all fits, the lowest criterion first."""
        return sorted(self, key=lambda fitted: self.compute(fitted, criterion))

    @property
    def by_switches(self) -> dict[int, Fitted]:
        """The fit of the lowest cost for each number of switches, ascending."""
        found: dict[int, Fitted] = {}
        for fitted in sorted(self, key=lambda fitted: fitted.cost):
            found.setdefault(fitted.switches, fitted)
        return dict(sorted(found.items()))

    def measure_probability(self, fitted: Fitted) -> float:
        """Return the probability of chi-square at its cost, NaN where 2 J has no such distribution."""
        return self.score.measure_probability(fitted.cost, int(fitted.acting.sum()) + fitted.free_switches)


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
            if proposal.sequences not in taken and len(taken) < most:
                taken.add(proposal.sequences)
                given = zip(proposal.sequences, proposal.transition_times, self.spans, strict=True)
                schedules = [Schedule(sequence, times, *span) for sequence, times, span in given]
                self.polish(schedules, proposal.parameters, "fits of proposals")

    def improve(self) -> None:
        """Move from the best until no move lowers the criterion."""
        hopped: set[tuple[tuple[str, ...], ...]] = set()
        for _ in range(ROUNDS):
            best = self.pool.best
            if best is None:
                return
            # Where every sequence takes seconds to compile, only those with fewer modes are tried.
            moves = MOVES if self.fitter.shares_programs else MOVES[:1]
            if any(self._try(best, partial(self._fit_lowest, *move)) for move in moves):
                continue
            if best.sequences in hopped or not self._try(best, self._hop):
                return
            hopped.add(best.sequences)

    def _try(self, best: Fitted, move: Callable[[Fitted], None]) -> bool:
        """Try the moves of a kind; return whether the best is better."""
        before = self.pool.lowest
        move(best)
        return self.pool.lowest < before - LOWER * max(abs(before), 1.0)

    def _hop(self, best: Fitted) -> None:
        """Fit from other sample intervals until that does not help; the time of a transition with a guard follows."""
        here = None if best.guarded else best
        while here is not None:
            before, here = here, None
            ends = np.cumsum([schedule.switches for schedule in before.schedules])
            free = np.append(np.ones(ends[-1], dtype=bool), before.acting)
            evaluator = self.fitter.get_evaluator(before.schedules)
            for theta in choose_hops(evaluator, before.theta, before.cost, free):
                pairs = zip(before.schedules, np.split(theta, ends), strict=False)
                moved = [schedule.replace(schedule.sequence, np.sort(times)) for schedule, times in pairs]
                found = self.polish(moved, theta[ends[-1] :], "hops over samples")
                if is_lower(found.cost, before.cost):
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
                found.setdefault((move.e, move.schedule.sequence), move)
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
        return expected > self.pool.compute(best) + FAR

    def fill_numbers(self) -> None:
        """Fit schedules with fewer switches than the best, each from the next longer one without a mode.

        Those with one or two more, if there are any, are fitted from other places as well.
        """
        best = self.pool.best
        if best is None:
            return
        lowest = 0 if len(self.spans) == 1 else max(best.switches - CHAIN, 0)
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
        if fitted is None or fitted is best or self.pool.score.has_chi_square:
            return
        for e, schedule in enumerate(fitted.schedules):
            knots = schedule.knots
            for i in range(schedule.switches):
                for part in PLACES:
                    times = schedule.times.copy()
                    times[i] = knots[i] + part * (knots[i + 2] - knots[i])
                    moved = schedule.replace(schedule.sequence, times)
                    self.polish(self.place(fitted, e, moved), fitted.parameters, "fits with fewer switches")

    def _fit_removals(self, fitted: Fitted) -> None:
        """Fit the schedules without one of the modes whose removal costs least."""
        found = sorted(self.simulate(fitted, list_removals), key=lambda move: move.cost)
        for move in found[: 1 if self.pool.is_explained() else FITTED_REMOVALS]:
            self.polish(self.place(fitted, move.e, move.schedule), fitted.parameters, "fits with fewer switches")


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
        schedule = drop_empty(schedules[e])
        for pulse in rate.minima(MINIMA):
            for begin, length in _place_pulse(schedule, pulse.time):
                changed = splice(schedule, pulse.mode, begin, begin + length)
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
    room = (1 - LEFT) * (knots[i + 1] - knots[i])
    lengths = {min(part * (schedule.tf - schedule.t0), room) for part in LENGTHS}
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
        candidates = [each for each in pool.by_switches.values() if each.theta.tobytes() not in visited]
        if not candidates:
            break
        current = min(candidates, key=weigh)
        waited = 0 if is_lower(min(map(weigh, pool)), lowest) else waited + 1


def _insert_and_fit(improver: Improver, current: Fitted) -> None:
    """Fit with one pulse more, and the lowest of these ends without each of its modes."""
    given = list_pulses(improver.fitter, current.schedules, current.parameters)[:FITTED]
    ends = [improver.polish(each, current.parameters, "insertion") for _, each in given]
    for end in sorted(ends, key=lambda each: each.cost)[:REMOVED_FROM]:
        for e, schedule in enumerate(end.schedules):
            for without in list_removals(schedule, improver.library):
                improver.polish(improver.place(end, e, without), end.parameters, "insertion")


def propose_starts(fitter: Fitter) -> list[FloatArray]:
    """Return the guess, then all parameters lower and higher together, then each alone: (M,) arrays.

    Lower and higher is one standard deviation of a prior, or a factor of 0.7 and 1.4. Parameters that are 0 without a
    prior stay.
    """
    guess, (lower, upper) = fitter.start, fitter.bounds
    priors = fitter.problem.unknowns.priors
    precision, log = priors.precision[fitter.first :], priors.log[fitter.first :]
    with np.errstate(divide="ignore"):
        sd = np.where(precision > 0, precision**-0.5, 0.0)
    changed = []
    for factor, sign in zip(FACTORS, (-1, 1), strict=True):
        by_prior = np.where(log, guess * np.exp(sign * sd), guess + sign * sd)
        changed.append(np.clip(np.where(precision > 0, by_prior, factor * guess), lower, upper))
    starts = [guess, *changed]
    if 1 < len(guess) <= MOST_ALONE:
        places = np.arange(len(guess))
        starts += [np.where(places == i, moved, guess) for i in places for moved in changed]
    return list({start.tobytes(): start for start in starts}.values())
