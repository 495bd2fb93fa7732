"""Search among the schedules of several experiments that share parameters, each with a sequence of its own.

Each experiment is searched alone first. Then they take turns: one is searched while the others stand for a quadratic
cost of the parameters, their times following (the Schur complement of their Hessians); what it proposes is fitted
together with the others. That goes on until no turn lowers the criterion of all.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from switchfit.modes.criterion import Score
from switchfit.modes.fitter import Fitter
from switchfit.modes.folder import SearchFolder
from switchfit.modes.hunt import WIDER, Hunt, Settings
from switchfit.modes.library import Library
from switchfit.modes.moves import Improver
from switchfit.modes.neighbours import Untraced
from switchfit.modes.pool import Pool
from switchfit.problem.data import FloatArray
from switchfit.problem.experiment import name_runs
from switchfit.problem.problem import Problem

SWEEPS = 3
"""Most turns of each experiment."""

JOINED = 2
"""Ends of a turn that are fitted together with the other experiments."""


class JointHunt:
    """Search among the schedules of several experiments; see `Hunt` for the parameters."""

    def __init__(
        self,
        problem: Problem,
        library: Library,
        score: Score,
        settings: Settings,
        report: Callable[[str], None],
        folder: SearchFolder | None = None,
    ) -> None:
        self.fitter = Fitter(problem, library)
        self.pool = Pool(score, settings.criterion)
        self.improver = Improver(self.fitter, self.pool, report)
        self.settings, self.library, self.report, self.folder = settings, library, report, folder
        names = name_runs(problem.experiments)
        self.parts: list[Hunt] = []
        self.places: list[NDArray[np.intp]] = []
        for e, name in enumerate(names):
            part = self.fitter.problem.without_runs(*(other for other in names if other != name))
            own = Score.of(part, score.switch_cost)
            places = locate_parameters(self.fitter.problem, part, e)
            starts = None if settings.starts is None else tuple(start[places] for start in settings.starts)
            given = Settings(settings.criterion, settings.method, settings.width, settings.grid, starts, settings.seed)
            run = problem.experiments[e]
            hunt = Hunt(part, library, own, given, partial(self._report_of, name), name, folder, run)
            self.parts.append(hunt)
            self.places.append(places)
        self.fitters = [self.fitter, *(part.fitter for part in self.parts)]
        if folder is not None:
            for fitted in folder.load_fits("all", self.fitter):
                self.pool.add(fitted)

    def _report_of(self, name: str, what: str) -> None:
        self.report(f"{name}: {what}")

    def search(self) -> None:
        """Search each experiment alone, then in turns."""
        for part in self.parts:
            part.search()
        self._join()
        self._take_turns(self.settings.width)

    def widen(self) -> None:
        """Search the experiments that are not explained from more starts, then all in turns."""
        for part in self.parts:
            part.fitter.quadratic = None
            if part.pool.is_explained() is not True:
                part.widen()
        self._join()
        self._take_turns(WIDER * self.settings.width)

    def _join(self) -> None:
        """Fit the best of each experiment together: from the median of their parameters, and from the guess."""
        ends = [part.pool.best for part in self.parts]
        known = [end for end in ends if end is not None]
        if len(known) < len(ends):
            return
        median = self.fitter.start.copy()
        for i in range(len(median)):
            values = [
                end.parameters[np.flatnonzero(places == i)[0]]
                for end, places in zip(known, self.places, strict=True)
                if i in places and end.acting[np.flatnonzero(places == i)[0]]
            ]
            median[i] = np.median(values) if values else median[i]
        schedules = [end.schedules[0] for end in known]
        for start in (median, self.fitter.start):
            self.improver.polish(schedules, start, "fit of all experiments")
        self._save("all experiments together")

    def _take_turns(self, width: int) -> None:
        for sweep in range(SWEEPS):
            changed = [self._take_turn(e, lambda part, q: part.search_from(q, width)) for e in range(len(self.parts))]
            self._save(f"sweep {sweep + 1}")
            if not any(changed):
                break
        self.improver.improve()

    def look_around(self) -> list[Untraced]:
        """Fit the neighbours of each experiment's sequence; return the modes that could be put in without a trace."""
        found: list[Untraced] = []

        def look(e: int, part: Hunt, _: FloatArray) -> None:
            found.extend(change._replace(run=e) for change in part.look_around())

        for e in range(len(self.parts)):
            self._take_turn(e, partial(look, e))
        return found

    def _take_turn(self, e: int, search: Callable[[Hunt, FloatArray], object]) -> bool:
        """Search one experiment, the others as a quadratic; return whether the criterion of all has fallen."""
        best, part = self.pool.best, self.parts[e]
        if best is None:
            return False
        before = self.pool.compute(best)
        part.fitter.quadratic = self.fitter.combine_runs(best, e).restrict(self.places[e])
        turn = Pool(part.score, self.settings.criterion)
        known, part.pool, part.improver.pool = part.pool, turn, turn
        try:
            start = best.parameters[self.places[e]]
            part.improver.polish([best.schedules[e]], start, "fit of its schedule")
            search(part, start)
        finally:
            part.pool = part.improver.pool = known
            part.fitter.quadratic = None
        for end in turn.list_best()[:JOINED]:
            if end.sequences[0] != best.sequences[e]:
                schedules = [*best.schedules[:e], end.schedules[0], *best.schedules[e + 1 :]]
                parameters = best.parameters.copy()
                parameters[self.places[e]] = end.parameters
                self.improver.polish(schedules, parameters, "fit of all experiments")
        now = self.pool.best
        return now is not None and self.pool.compute(now) < before - 1e-6 * max(abs(before), 1.0)

    def _save(self, label: str) -> None:
        if self.folder is not None:
            self.folder.save("all", label, self.pool)


def locate_parameters(whole: Problem, part: Problem, e: int) -> NDArray[np.intp]:
    """Return the positions of the parameters and initial states of one run's problem among those of all runs: (K,).

    Both are counted from the end of the transition times.

    Parameters
    ----------
    whole, part : Problem
    e : int
        Index of the run.
    """
    firsts = [sum(len(run.transition_times) for run in problem.experiments) for problem in (whole, part)]
    found = np.zeros(len(part.theta_names) - firsts[1], dtype=np.intp)
    for name, span in part.unknowns.parameters.items():
        there = whole.unknowns.parameters[name]
        found[span.start - firsts[1] : span.stop - firsts[1]] = np.arange(there.start, there.stop) - firsts[0]
    own, there_states = part.unknowns.initial_states[0], whole.unknowns.initial_states[e]
    found[own[own >= 0] - firsts[1]] = there_states[there_states >= 0] - firsts[0]
    return found
