"""The search among the schedules of one problem: starts, generators, moves, and more of them if nothing explains the
data.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from switchfit.modes.criterion import CriterionName, Score
from switchfit.modes.fitter import Fitted, Fitter
from switchfit.modes.folder import SearchFolder
from switchfit.modes.generators import Method, choose_methods, generate
from switchfit.modes.library import Library
from switchfit.modes.moves import Improver
from switchfit.modes.pool import Pool
from switchfit.modes.schedule import Schedule, space_evenly
from switchfit.modes.starts import draw_starts, propose_starts
from switchfit.problem.data import FloatArray
from switchfit.problem.experiment import Experiment
from switchfit.problem.problem import Problem

EXPLAINED = 1e-3
"""Probability of chi-square above which the data are explained, and no further start is needed."""

PASSES = 3
"""Most passes of a generator with the parameters of the best fit."""

WIDER = 4
"""Factor of the width where nothing explains the data."""

MOST_SHORTEST = 30
"""Sequences with the fewest switches up to which all are fitted."""

MORE_STARTS = 8
"""Random starts of the parameters where nothing explains the data."""


@dataclass(frozen=True)
class Settings:
    """What a search is asked for; see `find_modes`."""

    criterion: CriterionName
    method: Method
    width: int
    grid: float | None
    starts: tuple[FloatArray, ...] | None
    seed: int


class Hunt:
    """Search among the schedules of a problem with one experiment, or keeps those of several.

    Parameters
    ----------
    problem : Problem
    library : Library
    score : Score
        Of the whole problem, if this is a part of it.
    settings : Settings
    report : callable
        Called with what is under way; it may raise to end the search.
    name : str
        Of its part of the folder.
    folder : SearchFolder or None
        Keeps what was found, and what was done.
    run : Experiment, optional
        Whose sequence is tried first; the problem's own by default.
    """

    def __init__(
        self,
        problem: Problem,
        library: Library,
        score: Score,
        settings: Settings,
        report: Callable[[str], None],
        name: str = "search",
        folder: SearchFolder | None = None,
        run: Experiment | None = None,
    ) -> None:
        self.fitter = Fitter(problem, library)
        self.library, self.score, self.settings = library, score, settings
        self.pool = Pool(score, settings.criterion)
        self.improver = Improver(self.fitter, self.pool, report)
        self.report, self.name, self.folder = report, name, folder
        self.run = problem.experiments[0] if run is None else run
        if folder is not None:
            for fitted in folder.load_fits(name, self.fitter):
                self.pool.add(fitted)

    @property
    def best(self) -> Fitted | None:
        """The fit with the lowest criterion."""
        return self.pool.best

    def is_explained(self) -> bool | None:
        """Return whether chi-square says that the best explains the data; None where it cannot say."""
        best = self.best
        probability = np.nan if best is None else self.pool.measure_probability(best)
        return None if np.isnan(probability) else bool(probability >= EXPLAINED)

    def search(self) -> None:
        """Search from all starts of the parameters, or until the data are explained."""
        given = self.settings.starts
        starts = propose_starts(self.fitter) if given is None else list(given)
        self._do("given sequence", self._fit_given)
        for k, start in enumerate(starts):
            self._do(f"start {k + 1}", partial(self.search_from, start, self.settings.width))
            if given is None and self.is_explained():
                break

    def widen(self) -> None:
        """Search from more starts, with more hypotheses."""
        width = WIDER * self.settings.width
        starts = draw_starts(self.fitter, MORE_STARTS, self.settings.seed)
        best = self.best
        for k, start in enumerate(starts if best is None else [best.parameters, *starts]):
            self._do(f"wider start {k + 1}", partial(self.search_from, start, width))
            if self.is_explained():
                break

    def _do(self, label: str, step: Callable[[], None]) -> None:
        """Do one part of the search, unless the folder has its results."""
        if self.folder is not None and self.folder.is_done(self.name, label):
            return
        step()
        if self.folder is not None:
            self.folder.save(self.name, label, self.pool)

    def _fit_given(self) -> None:
        """Fit the sequence that the problem was given, and every sequence without a switch."""
        run = self.run
        schedule = Schedule(tuple(run.mode_sequence), run.initial_times, run.t0, run.end)
        if self.library.admits(schedule.sequence):
            self.improver.polish([schedule], self.fitter.start, "fit of the given sequence")
        fewest = min(self.library.possible_switches)
        if self.library.count_sequences(fewest) > MOST_SHORTEST:
            return
        for sequence in self.library.list_sequences(fewest):
            even = space_evenly(sequence, run.t0, run.end, self.library)
            if even is not None:
                self.improver.polish([even], self.fitter.start, "fits with the fewest switches")

    def search_from(self, start: FloatArray, width: int) -> None:
        """Search with a generator at a start of the parameters, and again at those of the best fit; then move.

        Parameters
        ----------
        start : (M,)
        width : int
        """
        parameters, last = start, np.inf
        for _ in range(PASSES):
            for method in choose_methods(self.settings.method, self.score):
                self.report(f"{method}")
                proposals = generate(method, self.fitter, self.score, parameters, width, self.settings.grid)
                self.improver.polish_proposals(proposals)
            best = self.best
            if best is None or len(parameters) == 0:
                break
            now = self.pool.compute(best)
            if not now < last - 1e-6 * abs(last) or np.allclose(best.parameters, parameters, rtol=1e-3, atol=0.0):
                break
            parameters, last = best.parameters, now
        self.improver.improve()
