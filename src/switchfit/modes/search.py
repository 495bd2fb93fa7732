"""`find_modes`: which modes were active, in which order, and when."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, get_args

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray
from switchfit.estimation.estimates import Estimate
from switchfit.modes.criterion import CRITERIA, INFORMATION, CriterionName, Score
from switchfit.modes.result import ModeSearch
from switchfit.modes.search_run import Method, SearchProgress, SearchRun, SearchSettings, build_result
from switchfit.modes.status import ModeEnding, ModeStatus
from switchfit.problem.problem import Problem, require_samples
from switchfit.problem.validation.arrays import as_array, as_count, as_finite, as_positive, as_seed
from switchfit.problem.validation.messages import join_names, shorten
from switchfit.problem.validation.names import as_choice
from switchfit.problem.validation.objects import as_callable, as_instance
from switchfit.strategy.library import build_library

MOST_GRID_PLACES = 1_000_000
"""Number of places on the grid of the longest experiment, at most."""

SEARCH_METHODS: tuple[Method, ...] = get_args(Method)


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
    method = as_choice(method, "method", SEARCH_METHODS)
    width = as_count(width, "width", at_least=len(modes.modes))  # each of which may come first
    grid = None if grid is None else _check_grid(grid, problem)
    given = None if starts is None else _check_starts(problem, starts)
    settings = SearchSettings(modes, chooser, base, method, width, grid, given, as_seed(seed), callback, began)
    if not modes.possible_switches:
        ending = ModeEnding(ModeStatus.NO_SUCCESSION, limit=modes.max_switches)
        return build_result(problem, score, settings, None, ending=ending)
    return SearchRun(problem, score, settings).run()


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


def _check_grid(grid: object, problem: Problem) -> float:
    length, least = as_positive(grid, "grid"), max(run.end - run.t0 for run in problem.experiments) / MOST_GRID_PLACES
    if length < least:
        raise ValueError(f"grid must be at least {least:g}, a millionth of the longest experiment; got {length:g}.")
    return length


def _check_criterion(
    problem: Problem, criterion: object, switch_cost: object
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
        # "bic" is the default: who gives a switch_cost and no criterion means that cost.
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
