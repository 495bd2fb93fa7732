"""Search all truths of a set, and count."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

import switchfit as sf
from benchmarks.modes.sets import SETS
from benchmarks.modes.truths import Truth

AS_GOOD = 1e-3
"""A criterion that is higher by no more than this is as good."""

CLOSE = 2.0
"""Sequences whose criteria differ by less are ambiguous."""


@dataclass(frozen=True)
class Outcome:
    """What the search of one truth found.

    Attributes
    ----------
    same : bool
        Whether the sequence is the true one.
    gap : float
        The criterion of the fit from the truth less that of what was found.
    right_number : dict
        Whether each criterion, among the fits by number of switches, chooses the true number.
    named : bool
        Whether the true sequence is the best or one of those that are named beside it.
    status : str
    complete : bool
        Whether the library has all modes of the truth.
    lateness : float
        Largest error of a transition time, in s; NaN with another sequence.
    seconds, wall : float
        Of processor time, and of the clock.
    fits, evaluations : int
    """

    same: bool
    gap: float
    right_number: dict[str, bool]
    named: bool
    status: str
    complete: bool
    lateness: float
    seconds: float
    wall: float
    fits: int
    evaluations: int

    @property
    def as_good(self) -> bool:
        """Whether the criterion is at least as good as that of the fit from the truth."""
        return self.gap >= -AS_GOOD

    @property
    def wrong(self) -> bool:
        """Whether what was found is worse than the truth, or cannot be the truth."""
        return not self.complete or not self.as_good


def search(name: str, seed: int) -> Outcome:
    """Search one truth of a set."""
    truth = SETS[name][0](seed)
    reference = truth.fit_from_truth()
    began, clock = time.process_time(), time.perf_counter()
    found = sf.find_modes(truth.problem, criterion="mbic", **truth.settings)
    seconds, wall = time.process_time() - began, time.perf_counter() - clock
    best = found.best
    same = tuple(found.mode_sequence) == truth.sequence
    mine = compute_criterion(truth, len(found.mode_sequence) - 1, best.cost, "mbic")
    theirs = compute_criterion(truth, len(truth.times), reference.cost, "mbic")
    costs = {number: fit.cost for number, fit in found.by_switches.items()}
    chosen = {
        kind: min(costs, key=lambda number: compute_criterion(truth, number, costs[number], kind))
        for kind in ("bic", "mbic", "aicc")
    }
    return Outcome(
        same,
        theirs - mine,
        {kind: number == len(truth.times) for kind, number in chosen.items()},
        any(truth.sequence in fit.sequences for fit in found.chosen) or truth.sequence in found.ending.other,
        str(found.status.name),
        truth.is_complete,
        float(np.max(np.abs(np.ravel(found.transition_times) - truth.times), initial=0.0)) if same else np.nan,
        seconds,
        wall,
        found.fits,
        found.evaluations,
    )


def compute_criterion(truth: Truth, switches: int, cost: float, kind: str) -> float:
    """Return a criterion for known sigma, apart from the library: ``2 J`` plus what unknowns cost."""
    n, M = truth.samples, len(truth.parameters)
    k = switches + M
    if kind == "aicc":
        return 2 * cost + 2 * k + 2 * k * (k + 1) / (n - k - 1)
    return float(2 * cost + (M + (2 if kind == "mbic" else 1) * switches) * np.log(n))


def run(name: str, seeds: Iterable[int], processes: int = 1) -> list[Outcome]:
    """Search the truths of some seeds of a set; the first, which compiles, twice."""
    seeds = list(seeds)
    if processes == 1:
        search(name, seeds[0])
        return [search(name, seed) for seed in seeds]
    with ProcessPoolExecutor(processes) as pool:
        return list(pool.map(search, [name] * len(seeds), seeds))


HEADER = (
    "set",
    "truths",
    "true sequence",
    "criterion as good as from the truth",
    "right number: BIC, modified, AICc",
    "FOUND",
    "of these wrong",
    "of these another sequence",
    "the truth within 2 of it",
    "the truth better by more",
    "AMBIGUOUS",
    "of these with the truth named",
    "largest error of a time, median (s)",
    "processor time, median (s)",
    "fits, median",
    "evaluations, median",
)


def count(name: str, outcomes: list[Outcome]) -> tuple[Any, ...]:
    """Return the row of a set."""
    there = [outcome for outcome in outcomes if outcome.complete]
    found = [outcome for outcome in outcomes if outcome.status == "FOUND"]
    others = [outcome for outcome in found if not outcome.same]
    ambiguous = [outcome for outcome in outcomes if outcome.status == "AMBIGUOUS"]
    late = [outcome.lateness for outcome in there if outcome.same]
    numbers = (sum(outcome.right_number[kind] for outcome in there) for kind in ("bic", "mbic", "aicc"))
    return (
        name,
        len(outcomes),
        f"{sum(outcome.same for outcome in there)} of {len(there)}",
        f"{sum(outcome.as_good for outcome in there)} of {len(there)}",
        ", ".join(map(str, numbers)),
        len(found),
        sum(outcome.wrong for outcome in found),
        len(others),
        sum(abs(outcome.gap) <= CLOSE for outcome in others),
        sum(outcome.gap < -CLOSE for outcome in others),
        len(ambiguous),
        sum(outcome.named for outcome in ambiguous),
        f"{statistics.median(late):.3f}" if late else "",
        f"{statistics.median(outcome.seconds for outcome in outcomes):.3f}",
        f"{statistics.median(outcome.fits for outcome in outcomes):.0f}",
        f"{statistics.median(outcome.evaluations for outcome in outcomes):.0f}",
    )


def as_record(name: str, seed: int, outcome: Outcome) -> dict[str, Any]:
    """Return an outcome for a file."""
    return {"set": name, "seed": seed, **asdict(outcome)}
