"""The search among the schedules of one problem: starts, generators, moves, and more of them if nothing explains the
data.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from switchfit.estimation.estimator import Estimate
from switchfit.fit.random_starts import draw_starts
from switchfit.modes.criterion import CriterionName, Score
from switchfit.modes.fitter import Fitter
from switchfit.modes.moves import Improver
from switchfit.modes.pool import Pool
from switchfit.modes.pulses import insert_modes
from switchfit.modes.schedule import Schedule, space_evenly
from switchfit.modes.starts import propose_starts
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem
from switchfit.strategy.beam import REPLAYS, Beam, prepare
from switchfit.strategy.beams import Beams
from switchfit.strategy.branching import Rules
from switchfit.strategy.library import Library
from switchfit.strategy.proposal import Proposal, Quadratic

Method = Literal["auto", "beam", "insertion"]
METHODS: tuple[Method, ...] = get_args(Method)

WIDER = 4
"""Factor of the width where nothing explains the data."""

PATIENCE = 3
"""Random starts in a row that lead to nothing better, after which it is the model that is doubted."""

LOWER_BY_START = 1e-3
"""Part of the criterion by which a start has to lower it to count as better."""

MORE_STARTS = 8
"""Random starts of the parameters where nothing explains the data."""


@dataclass(frozen=True)
class Settings:
    """What a search is asked for; see `find_modes`. During it, sequences are compared by `criterion`."""

    library: Library
    chooser: CriterionName | Callable[[Estimate], float]
    criterion: CriterionName
    method: Method
    width: int
    grid: float | None
    starts: tuple[FloatArray, ...] | None
    seed: int
    callback: Callable[[Any], object] | None


class Hunt:
    """Search among the schedules of a problem.

    Parameters
    ----------
    problem : Problem
    score : Score
    settings : Settings
    report : callable
        Called with what is under way; it may raise to end the search.
    """

    def __init__(self, problem: Problem, score: Score, settings: Settings, report: Callable[[str], None]) -> None:
        self.library, self.score, self.settings = settings.library.trimmed, score, settings
        self.fitter = Fitter(problem, self.library)
        self.pool = Pool(score, settings.criterion)
        self.improver = Improver(self.fitter, self.pool, report)
        self.report, self.runs = report, problem.experiments

    def search(self) -> None:
        """Search from all starts of the parameters, or until the data are explained."""
        given = self.settings.starts
        starts = propose_starts(self.fitter) if given is None else list(given)
        if any(len(run.mode_sequence) > 1 for run in self.runs):
            self._fit_given()
        for start in starts:
            self.search_from(start, self.settings.width)
            if given is None and self.pool.is_explained():
                break
        if self.pool.best is None:
            self._fit_given()

    def widen(self) -> None:
        """Search from more starts, with more hypotheses."""
        width = WIDER * self.settings.width
        starts = draw_starts(self.fitter.problem, 1 + MORE_STARTS, self.settings.seed)[1:, self.fitter.first :]
        best, waited = self.pool.best, 0
        for start in starts if best is None else [best.parameters, *starts]:
            before = np.inf if self.pool.best is None else self.pool.compute(self.pool.best)
            self.search_from(start, width)
            now = np.inf if self.pool.best is None else self.pool.compute(self.pool.best)
            waited = 0 if now < before - LOWER_BY_START * abs(before) else waited + 1
            if self.pool.is_explained() or waited == PATIENCE:
                break

    def _fit_given(self) -> None:
        """Fit the sequence that the problem was given."""
        self.improver.polish(self._list_given(), self.fitter.start, "fit of the given sequence")

    def _list_given(self) -> list[Schedule]:
        """Return the schedule that each experiment was given; one of the library if that is not admitted."""
        found = []
        for run in self.runs:
            schedule = Schedule(tuple(run.mode_sequence), run.initial_times, run.t0, run.end)
            if not self.library.admits(schedule.sequence):
                sequence = next(self.library.list_sequences(min(self.library.possible_switches)))
                schedule = space_evenly(sequence, run.t0, run.end, self.library) or schedule
            found.append(schedule)
        return found

    def search_from(self, start: FloatArray, width: int) -> None:
        """Search with a generator at a start of the parameters, then move.

        Parameters
        ----------
        start : (M,)
        width : int
        """
        runs = self._prepare_beams()
        penalty = self.score.measure_penalty(self.settings.criterion)

        def follow_run(e: int, q: FloatArray, evidence: Quadratic | None) -> list[Proposal]:
            return runs[e].run(Rules.of(self.library, runs[e].modes), q, penalty, width, REPLAYS, evidence)

        if runs:
            self.report("beam")
            beams = Beams(self.fitter.problem, [each.own for each in runs])
            self.improver.polish_proposals(beams.join(*beams.follow(start, follow_run)))
        else:
            self.report("insertion")
            best = self.pool.best
            insert_modes(self.improver, self._list_given() if best is None else best.schedules, start)
        self.improver.improve()

    def _prepare_beams(self) -> list[Beam]:
        """Return the beams of all runs; none for other costs than data, and where a beam cannot follow an experiment,
        unless it is asked for.
        """
        method, problem = self.settings.method, self.fitter.problem
        if method == "insertion" or (method == "auto" and self.score.sigma_known is None):
            return []
        try:
            return [prepare(problem, e, self.library, self.settings.grid) for e in range(len(self.runs))]
        except ValueError:
            if method != "auto":
                raise
            return []
