"""One search for the mode sequence: starts, generators, moves, and more of them if nothing explains the data.

From each start of the parameters a generator proposes schedules, by the beam or by insertion; the best are fitted, and
moves follow. Where nothing explains the data, other noise is assumed, then the search is widened. Where the residuals
are not noise, the criteria are discounted.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.estimation.estimates import Estimate
from switchfit.modes.certifier import Certifier
from switchfit.modes.criterion import CriterionName, Score
from switchfit.modes.faults import assume_fault, count_outliers
from switchfit.modes.fitter import Fitter
from switchfit.modes.judge import Judge
from switchfit.modes.moves import Improver
from switchfit.modes.neighbours import look_around
from switchfit.modes.noise import UNEXPLAINED, is_correlated, is_far_from_noise, measure_worth
from switchfit.modes.pool import Pool
from switchfit.modes.pulses import insert_modes
from switchfit.modes.result import ModeSearch
from switchfit.modes.schedule import Schedule
from switchfit.modes.starts import propose_starts
from switchfit.modes.status import ModeStatus, ModeWarning
from switchfit.problem.experiment import name_runs
from switchfit.problem.problem import Problem
from switchfit.runtime.progress import show_detail, show_line
from switchfit.strategy.beam import REPLAYS, Beam, prepare
from switchfit.strategy.joint_beams import Beams
from switchfit.strategy.library import Library
from switchfit.strategy.proposal import Proposal, Quadratic
from switchfit.strategy.random_starts import draw_starts
from switchfit.strategy.sequences import Rules
from switchfit.uncertainty.quality import measure_quality

WORST_DISPERSION = 4.0
"""Dispersion above which it is no matter of noise, but the structure of the model is wrong (Burnham and Anderson, Model
Selection and Multimodel Inference, 2002, section 2.5)."""

Method = Literal["auto", "beam", "insertion"]

WIDTH_FACTOR = 4
"""Factor of the width where nothing explains the data."""

STARTS_WITHOUT_GAIN = 3
"""Random starts in a row that lead to nothing better, after which it is the model that is doubted."""

LOWER_BY_START = 1e-3
"""Part of the criterion by which a start has to lower it to count as better."""

MOST_RANDOM_STARTS = 8
"""Random starts of the parameters where nothing explains the data."""


class SearchProgress(NamedTuple):
    """How far a search is, for a callback.

    Attributes
    ----------
    stage : str
    fits, evaluations : int
    sequences : tuple of tuple of str
        Of the best so far; empty if there is none.
    cost, criterion : float
        Of the best so far.

    See Also
    --------
    find_modes

    Examples
    --------
    >>> seen = []
    >>> search = sf.find_modes(heater_problem(), max_switches=2, callback=seen.append)
    >>> seen[-1].sequences, seen[-1].fits == search.fits
    ((('on', 'off'),), True)
    """

    stage: str
    fits: int
    evaluations: int
    sequences: tuple[tuple[str, ...], ...]
    cost: float
    criterion: float


class _StoppedError(Exception):
    """The callback has stopped the search."""


@dataclass(frozen=True)
class SearchSettings:
    """What a search is asked for; see `find_modes`. During it, sequences are compared by `criterion`."""

    library: Library
    chooser: CriterionName | Callable[[Estimate], float]
    criterion: CriterionName
    method: Method
    width: int
    grid: float | None
    starts: tuple[FloatArray, ...] | None
    seed: int
    callback: Callable[[SearchProgress], object] | None
    began: float


def build_result(
    problem: Problem, score: Score, settings: SearchSettings, fitter: Fitter | None, **found: Any
) -> ModeSearch:
    """Return the result of a search with what was found, fields of `ModeSearch`."""
    runs, library, chooser = problem.experiments, settings.library, settings.chooser
    return ModeSearch(
        modes=library.modes,
        durations=tuple(library.durations[mode] for mode in library.modes),
        max_switches=library.max_switches,
        criterion=chooser if isinstance(chooser, str) else getattr(chooser, "__name__", "criterion"),
        parameter_names=() if fitter is None else fitter.parameter_names,
        run_names=name_runs(runs),
        time_units=tuple(run.time_unit for run in runs),
        starts=tuple(run.t0 for run in runs),
        ends=tuple(run.end for run in runs),
        sigma_known=score.sigma_known,
        fits=0 if fitter is None else fitter.fits,
        evaluations=0 if fitter is None else fitter.evaluations,
        seconds=time.perf_counter() - settings.began,
        problem=problem,
        **found,
    )


class SearchRun:
    """One call of `find_modes`; one inside it if it `assumes` other noise than is given."""

    def __init__(self, problem: Problem, score: Score, settings: SearchSettings, *, assumes: bool = False) -> None:
        self.problem, self.score, self.settings, self.assumes = problem, score, settings, assumes
        # Programs have room for the largest number of switches that a sequence has.
        self.library = replace(settings.library, max_switches=max(settings.library.possible_switches))
        self.fitter, self.pool = Fitter(problem, self.library), Pool(score, settings.criterion)
        self.improver = Improver(self.fitter, self.pool, self._report)
        self.certifier = Certifier(self.fitter.problem, problem, settings.library)

    def _report(self, stage: str) -> None:
        """Write to the line of progress, and call the callback."""
        best = self.pool.best
        show_detail(stage, np.inf if best is None else best.cost)
        callback = self.settings.callback
        if callback is None:
            return
        found = ((), np.nan, np.nan) if best is None else (best.sequences, best.cost, self.pool.compute(best))
        if callback(SearchProgress(stage, self.fitter.fits, self.fitter.evaluations, *found)):
            raise _StoppedError

    def run(self) -> ModeSearch:
        """Search, with other noise or wider where nothing explains the data, and return the result."""
        untraced, interrupted = list[ModeWarning](), False
        with show_line("search for the mode sequence"):
            try:
                self._search()
                # What nothing explains may be the noise, which one search with another loss or sigma shows, or else a
                # search that was too narrow.
                if self._is_explained() is False:
                    found = self._assume_other_noise()
                    if found is not None:
                        return found
                    self._widen()
                self.improver.fill_numbers()
                # Another criterion prefers another number of switches: moves are tried once more, by what counts now.
                if self._discount():
                    self.improver.improve()
                    self.improver.fill_numbers()
                if self.pool.is_explained() is not False and self.score.sigma_known is not None:
                    # Around a best that explains nothing, all neighbours are as good: to look there would say nothing.
                    untraced = look_around(self.improver)
            except (KeyboardInterrupt, _StoppedError):
                interrupted = True
                if self.pool.best is None:
                    raise KeyboardInterrupt from None
            judge = Judge(self.pool, self.fitter, self.certifier, self.settings.chooser, interrupted, untraced)
            return build_result(self.problem, self.score, self.settings, self.fitter, **judge.conclude())

    def _search(self) -> None:
        """Search from all starts of the parameters, or until the data are explained."""
        given = self.settings.starts
        if any(len(run.mode_sequence) > 1 for run in self.problem.experiments):
            self._fit_given()
        for start in propose_starts(self.fitter) if given is None else given:
            self._search_from(start, self.settings.width)
            if given is None and self.pool.is_explained():
                break
        # No generator has led anywhere: at least there is a fit whose message says why.
        if self.pool.best is None:
            self._fit_given()

    def _widen(self) -> None:
        """Search from more starts, with more hypotheses."""
        # The first of the drawn ones is the guess, from which the search has begun already.
        starts = list(
            draw_starts(self.fitter.problem, 1 + MOST_RANDOM_STARTS, self.settings.seed)[1:, self.fitter.first :]
        )
        best, waited = self.pool.best, 0
        # The best parameters first: with four times the hypotheses, the beam may leave them another way.
        for start in starts if best is None else [best.parameters, *starts]:
            before = self.pool.lowest
            self._search_from(start, WIDTH_FACTOR * self.settings.width)
            waited = 0 if self.pool.lowest < before - LOWER_BY_START * abs(before) else waited + 1
            if self.pool.is_explained() or waited == STARTS_WITHOUT_GAIN:
                break

    def _fit_given(self) -> None:
        """Fit the sequence that the problem was given."""
        self.improver.polish(self._list_given(), self.fitter.start, "fit of the given sequence")

    def _list_given(self) -> list[Schedule]:
        """Return the schedule that each experiment was given; one of the library if that is not admitted."""
        pairs = zip(self.problem.experiments, self.fitter.problem.experiments, strict=True)
        runs = [given if self.library.admits(given.mode_sequence) else own for given, own in pairs]
        return [Schedule(tuple(run.mode_sequence), run.initial_times, run.t0, run.end) for run in runs]

    def _search_from(self, start: FloatArray, width: int) -> None:
        """Search with a generator at a start (M,) of the parameters, then move."""
        runs = self._prepare_beams()
        penalty = self.score.measure_penalty(self.settings.criterion)

        def follow_run(e: int, q: FloatArray, evidence: Quadratic | None) -> list[Proposal]:
            return runs[e].run(Rules.of(self.library, runs[e].modes), q, penalty, width, REPLAYS, evidence)

        if runs:
            self._report("beam")
            # Each run has a beam of its own, in which the evidence of the others on shared parameters is a quadratic
            # cost.
            beams = Beams(self.fitter.problem, [each.own for each in runs])
            self.improver.polish_proposals(beams.join(*beams.follow(start, follow_run)))
        else:
            self._report("insertion")
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
            return [prepare(problem, e, self.library, self.settings.grid) for e in range(len(problem.experiments))]
        except ValueError:
            if method != "auto":
                raise
            return []

    def _assume_other_noise(self) -> ModeSearch | None:
        """Search with a robust loss, or with another sigma, if that is what the residuals ask for.

        Returns
        -------
        ModeSearch or None
            What says so: of outliers a warning; where sigma is wrong, or the model, the data stay unexplained. None if
            the residuals are no such noise, or are not explained by it either.
        """
        estimate = self._estimate_best() if self.score.has_chi_square and not self.assumes else None
        fault = "model" if estimate is None else measure_quality(estimate).suspect
        if estimate is None or fault == "model":
            return None
        # `assumes` keeps the inner search from doubting the noise once more.
        problem = assume_fault(self.problem, fault, estimate)
        score = Score.of(problem, self.score.switch_cost)
        found = SearchRun(problem, score, self.settings, assumes=True).run()
        if found.best is None or found.status in (ModeStatus.NOT_EXPLAINED, ModeStatus.NOT_CONVERGED):
            return None
        warnings, ending = found.warnings, found.ending
        if fault == "outliers":
            warnings = (ModeWarning(fault, samples=count_outliers(found.best)), *warnings)
        else:
            ratio = float(np.sqrt(estimate.residual_variance))
            # A sigma that fits the residuals explains them by construction: that is no proof of the sequence.
            ending = replace(ending, status=ModeStatus.NOT_EXPLAINED, reason=fault, ratio=ratio)
        fits, evaluations = self.fitter.fits + found.fits, self.fitter.evaluations + found.evaluations
        return replace(found, warnings=warnings, ending=ending, fits=fits, evaluations=evaluations)

    def _estimate_best(self) -> Estimate | None:
        """Return the estimate of the best so far; None if there is nothing to estimate."""
        best = self.pool.best
        return self.certifier.estimate(best) if best is not None and best.has_unknowns else None

    def _is_explained(self) -> bool | None:
        """Return whether the best explains the data by chi-square, or else by its residuals; None for other costs."""
        explained = self.pool.is_explained()
        if explained is False or self.score.sigma_known is None:
            return explained
        estimate = self._estimate_best()
        return explained if estimate is None else not is_far_from_noise(estimate, self.score)

    def _discount(self) -> bool:
        """Discount the criteria where the residuals of the best are not the noise that they assume; return whether.

        A mode that makes up for an error of the model gains more than any criterion asks for, as long as n correlated
        values count as n independent ones. The fit with the lowest criterion as it stands, the most flexible, says what
        they are worth; mBIC then decides.
        """
        best = self.pool.best
        if best is None or not self.score.has_information(self.settings.chooser):
            return False
        estimate, worth, dispersion = self._estimate_best(), 1.0, 1.0
        unknowns = int(best.acting.sum()) + best.free_switches
        if estimate is not None and is_correlated(estimate, self.score, UNEXPLAINED):
            # Fewer values than unknowns would say nothing at all.
            worth = min(max(measure_worth(estimate), (unknowns + 1) / self.score.values), 1.0)
        if self.pool.measure_probability(best) < UNEXPLAINED:
            dispersion = self.score.measure_dispersion(best.cost, unknowns)
        if worth == dispersion == 1.0 or dispersion > WORST_DISPERSION:
            return False
        self.pool.discount(replace(self.score, worth=worth, dispersion=dispersion))
        return True
