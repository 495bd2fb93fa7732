"""`find_modes`: which modes, in which order, and when: starts, generators, moves, and more of them if nothing explains
the data.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray
from switchfit.estimation.estimator import Estimate
from switchfit.modes.conclusion import Judge, look_around
from switchfit.modes.criterion import (
    CRITERIA,
    INFORMATION,
    UNEXPLAINED,
    CriterionName,
    Score,
    assume,
    count_far,
    is_correlated,
    is_far_from_noise,
    measure_worth,
)
from switchfit.modes.fitter import Fitter
from switchfit.modes.hunt import Improver, Pool, insert_modes, propose_starts
from switchfit.modes.result import Certifier, ModeEnding, ModeSearch, ModeStatus, ModeWarning
from switchfit.modes.schedule import Schedule
from switchfit.problem.experiment import name_runs
from switchfit.problem.problem import Problem, require_samples
from switchfit.problem.validation.arrays import as_array, as_count, as_finite, as_positive, as_seed
from switchfit.problem.validation.messages import join_names, shorten
from switchfit.problem.validation.names import as_choice
from switchfit.problem.validation.objects import as_callable, as_instance
from switchfit.runtime.progress import show_detail, show_line
from switchfit.strategy.beam import REPLAYS, Beam, Proposal, Quadratic, prepare
from switchfit.strategy.known_order import Beams
from switchfit.strategy.library import Library, Rules, build_library
from switchfit.strategy.starts import draw_starts
from switchfit.uncertainty.residuals import measure_quality

MOST_PLACES = 1_000_000
"""Number of places on the grid of the longest experiment, at most."""

WORST_DISPERSION = 4.0
"""Dispersion above which it is no matter of noise, but the structure of the model is wrong (Burnham and Anderson, Model
Selection and Multimodel Inference, 2002, section 2.5)."""

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


def find_modes(
    problem: Problem,
    library: Iterable[str] | str | None = None,
    *,
    first: str | Iterable[str] | None = None,
    last: str | Iterable[str] | None = None,
    successions: Mapping[str, str | Sequence[str]] | None = None,
    min_duration: float | Mapping[str, float] | None = None,
    max_switches: int = 8,
    criterion: CriterionName | Callable[[Estimate], float] = "bic",
    switch_cost: float | None = None,
    method: Method = "auto",
    width: int = 40,
    grid: float | None = None,
    starts: ArrayLike | None = None,
    callback: Callable[[SearchProgress], object] | None = None,
    seed: int = 0,
) -> ModeSearch:
    """Find which modes were active, in which order, and when, together with the parameters.

    Parameters
    ----------
    problem : Problem
        One experiment or several. Their mode sequences are first guesses: ``("stick",)`` with ``transition_times=()``
        will do.
    library : sequence of str, optional
        Modes that may occur; all modes of the system if left out.
    first, last : str or sequence of str, optional
        Modes with which a sequence may begin and end; any if left out.
    successions : mapping, optional
        The modes that may follow each mode, such as ``{"flight": ("slide",), "slide": ("stick",)}``; a mode that is
        left out is the last. Any if left out. They help more than anything else.
    min_duration : float or mapping of str to float, optional
        Shortest time that a mode lasts; that of the problem if left out. As in `estimate`, it holds for the first and
        the last mode too, of which only what is inside the log counts: where a log begins or ends in the middle of a
        mode, give that mode a smaller one, as in ``{"slip": 0.5, "stick": 0.0}``.
    max_switches : int
        Largest number of switches in an experiment.
    criterion : {"bic", "mbic", "aicc", "cost"} or callable
        By which the number of switches is chosen. "bic" counts log n for a switch, "mbic" twice as much, since the
        place of a switch is searched for; both are reported. "cost" is J plus `switch_cost` for every switch. A
        callable takes an `Estimate` and returns a number; lower is better.
    switch_cost : float, optional
        Cost of a switch, in units of J, for costs that are no likelihood; the criterion is then "cost".
    method : {"auto", "beam", "insertion"}
        Which generator proposes schedules: "beam" follows many hypotheses through the data; "insertion" puts short
        pulses in where the cost falls. "auto" is "beam" for data, and "insertion" for other costs. The beam needs
        machine code: without it "auto" is "insertion".
    width : int
        Hypotheses that the beam keeps.
    grid : float, optional
        Distance of the times at which switches are looked for; at least a millionth of the longest experiment.
    starts : (S, M) array_like, optional
        Values of the free parameters and initial states to begin with, in the order of theta. If left out, the guess,
        and the guess changed by a standard deviation of its prior or by a factor of 0.7 and 1.4, until the data are
        explained.
    callback : callable, optional
        Called with a `SearchProgress` after every fit; a true return value stops. Ctrl-C does as well; both return the
        best so far.
    seed : int
        Of random starts, which are drawn if nothing explains the data.

    Returns
    -------
    ModeSearch
        Its status says whether the sequence may be relied on.

    Raises
    ------
    ValueError
        For names that the system lacks, a criterion that the cost does not have, transition times with bounds, a free
        tf, ``method="beam"`` for a model without machine code, or another bad setting.
    TypeError
        If an argument is of the wrong type.

    Notes
    -----
    Whatever proposes a schedule, exact fits of its times and parameters decide, in one program of machine code for all
    sequences of the library. From the best, modes are taken out, replaced and put in, and transition times moved over
    samples, as long as the criterion falls. The best is estimated and certified as by `estimate`.

    A transition with a guard takes place on it: its time follows, and does not count as an unknown.

    See Also
    --------
    ModeSearch : what it returns.
    estimate : for a sequence that is known.

    Examples
    --------
    A heater was on at first. Was it switched off, and on again?

    >>> search = sf.find_modes(heater_problem(), first="on", max_switches=3)
    >>> search.mode_sequence, search.transition_times[0].round(1)
    (('on', 'off'), array([2.5]))
    >>> search.status.name
    'FOUND'
    """
    began = time.perf_counter()
    as_instance(problem, "problem", Problem, "an sf.Problem")
    if callback is not None:
        as_callable(callback, "callback", "a function callback(progress)", arguments=1)
    _check_experiments(problem)
    modes = build_library(
        problem, library, first=first, last=last, successions=successions, min_duration=min_duration,
        max_switches=max_switches,
    )  # fmt: skip
    chooser, score, base = _check_criterion(problem, criterion, switch_cost)
    method = as_choice(method, "method", METHODS)
    width = as_count(width, "width", at_least=len(modes.modes))  # each of which may come first
    grid = None if grid is None else _check_grid(grid, problem)
    given = None if starts is None else _check_starts(problem, starts)
    settings = Settings(modes, chooser, base, method, width, grid, given, as_seed(seed), callback, began)
    if not modes.possible_switches:
        ending = ModeEnding(ModeStatus.NO_SUCCESSION, limit=modes.max_switches)
        return _build_result(problem, score, settings, None, ending=ending)
    return _Search(problem, score, settings).run()


def _check_experiments(problem: Problem) -> None:
    require_samples(problem)
    for name, run in zip(problem.run_names, problem.experiments, strict=True):
        if run.has_free_tf:
            raise ValueError(f"find_modes needs a known tf; that of {name} is free. Give tf as a number.")
        for i, tau in enumerate(run.transition_times, start=1):
            bounded = np.isfinite(tau.lower) or np.isfinite(tau.upper)
            if tau.fixed or bounded or tau.prior is not None or tau.scale == "log":
                raise ValueError(
                    f"transition time {i} of {name} is fixed, or has bounds, a prior or a logarithmic scale, but "
                    "find_modes looks for the number of transitions as well: give transition times as numbers."
                )


def _check_grid(grid: Any, problem: Problem) -> float:
    length, least = as_positive(grid, "grid"), max(run.end - run.t0 for run in problem.experiments) / MOST_PLACES
    if length < least:
        raise ValueError(f"grid must be at least {least:g}, a millionth of the longest experiment; got {length:g}.")
    return length


def _check_criterion(
    problem: Problem, criterion: Any, switch_cost: Any
) -> tuple[CriterionName | Callable[[Estimate], float], Score, CriterionName]:
    """Return how the number of switches is chosen, what criteria need, and the criterion of the search."""
    chooser: Any = criterion if callable(criterion) else as_choice(criterion, "criterion", CRITERIA)
    if callable(criterion):
        as_callable(criterion, "criterion", "a function criterion(estimate)", arguments=1)
    each = 0.0 if switch_cost is None else as_finite(switch_cost, "switch_cost")
    if each < 0:
        raise ValueError(f"switch_cost must be zero or positive; got {each}.")
    score = Score.of(problem, each)
    if switch_cost is not None:
        if chooser not in ("bic", "cost"):
            raise ValueError(
                f"switch_cost is the cost of a switch for criterion='cost'; got criterion={shorten(criterion)} beside "
                "it. Leave one of them out."
            )
        return "cost", score, "cost"
    if chooser == "cost" or (score.sigma_known is None and not callable(chooser)):
        needed = "switch_cost" if chooser == "cost" else "Measurements alone: a running cost is no likelihood"
        raise ValueError(f"criterion={chooser!r} needs {needed}. Give switch_cost, the cost of a switch in units of J.")
    if score.sigma_known is None:
        return chooser, score, "cost"
    return chooser, score, chooser if chooser in INFORMATION else "bic"


def _check_starts(problem: Problem, given: ArrayLike) -> tuple[FloatArray, ...]:
    found = np.atleast_2d(as_array(given, "starts"))
    names = problem.theta_names[int(problem.unknowns.is_time.sum()) :]
    if found.ndim != 2 or found.shape[1] != len(names) or not len(found) or not np.all(np.isfinite(found)):
        raise ValueError(
            f"starts must have a row for each start with {len(names)} finite values: {join_names(names) or 'none'}; "
            f"got {shorten(found)}."
        )
    return tuple(found)


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
    callback: Callable[[SearchProgress], object] | None
    began: float


def _build_result(
    problem: Problem, score: Score, settings: Settings, fitter: Fitter | None, **found: Any
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


class _Search:
    """One call of `find_modes`; one inside it if it `assumes` other noise than is given."""

    def __init__(self, problem: Problem, score: Score, settings: Settings, *, assumes: bool = False) -> None:
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
                if self._is_explained() is False:
                    found = self._assume_other_noise()
                    if found is not None:
                        return found
                    self._widen()
                self.improver.fill_numbers()
                if self._discount():
                    self.improver.improve()
                    self.improver.fill_numbers()
                if self.pool.is_explained() is not False and self.score.sigma_known is not None:
                    untraced = look_around(self.improver)
            except (KeyboardInterrupt, _StoppedError):
                interrupted = True
                if self.pool.best is None:
                    raise KeyboardInterrupt from None
            judge = Judge(self.pool, self.fitter, self.certifier, self.settings.chooser, interrupted, untraced)
            return _build_result(self.problem, self.score, self.settings, self.fitter, **judge.conclude())

    def _search(self) -> None:
        """Search from all starts of the parameters, or until the data are explained."""
        given = self.settings.starts
        if any(len(run.mode_sequence) > 1 for run in self.problem.experiments):
            self._fit_given()
        for start in propose_starts(self.fitter) if given is None else given:
            self._search_from(start, self.settings.width)
            if given is None and self.pool.is_explained():
                break
        if self.pool.best is None:
            self._fit_given()

    def _widen(self) -> None:
        """Search from more starts, with more hypotheses."""
        starts = list(draw_starts(self.fitter.problem, 1 + MORE_STARTS, self.settings.seed)[1:, self.fitter.first :])
        best, waited = self.pool.best, 0
        for start in starts if best is None else [best.parameters, *starts]:
            before = self.pool.lowest
            self._search_from(start, WIDER * self.settings.width)
            waited = 0 if self.pool.lowest < before - LOWER_BY_START * abs(before) else waited + 1
            if self.pool.is_explained() or waited == PATIENCE:
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
        problem = assume(self.problem, fault, estimate)
        score = Score.of(problem, self.score.switch_cost)
        found = _Search(problem, score, self.settings, assumes=True).run()
        if found.best is None or found.status in (ModeStatus.NOT_EXPLAINED, ModeStatus.NOT_CONVERGED):
            return None
        warnings, ending = found.warnings, found.ending
        if fault == "outliers":
            warnings = (ModeWarning(fault, samples=count_far(found.best)), *warnings)
        else:
            ratio = float(np.sqrt(estimate.residual_variance))
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
