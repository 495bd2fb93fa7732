"""Verdicts on many fits: how many are good, doubtful and bad, why, and what to do next.

Ten thousand fits cannot be simulated one by one. Each is judged by what its program returns (status, J, theta, the
Hessian) and by the share of its data's variance that J leaves, by the rules of single fits
(`switchfit.uncertainty.verdict`), as if its residuals could not be tested. Not looked at are the correlation of the
residuals, single channels, other starts, and checks of derivatives: fit one by itself for these.

How well each of many fits explains its data, and where it ended: from J and theta alone, without a simulation.

With J half a sum of squares, and V that of the data about their means, the share of the variance that is explained is
``1 - J / V``. So it needs V once for each data set, where a single fit compares its trajectory channel by channel.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.optimize import Status
from switchfit.problem.data import FloatArray, Measurements
from switchfit.problem.experiment import Experiment
from switchfit.problem.problem import Problem
from switchfit.problem.unknowns import get_min_duration
from switchfit.runtime import special
from switchfit.runtime.errors import Issue
from switchfit.uncertainty import verdict
from switchfit.uncertainty.residuals import HALF, UNLIKELY, compare_with_sigma
from switchfit.uncertainty.verdict import FINE, LEVELS, Doubt, Finding, Level, Numbers, Verdict, build_verdict

AT_END = 1e-9
"""Duration of a mode, as a part of the horizon, or distance from a bound, as a part of it, that counts as zero."""


def describe_ends(
    problem: Problem, theta: FloatArray, cost: FloatArray, variation: FloatArray | float
) -> dict[str, NDArray[Any]]:
    """Return the fields `explained`, `collapsed` and `at_bounds` of `Fits`, (R,) each.

    Parameters
    ----------
    problem : Problem
        Its bounds, modes and horizons; its data may differ from those that were fitted.
    theta : (R, d)
    cost : (R,)
    variation : float or (R,)
        Sum of `switchfit.fit.evaluator.measure_variation` over the experiments.
    """
    unknowns, priors = problem.unknowns, problem.unknowns.priors
    squares = cost - np.array([priors.evaluate(each)[0] for each in theta]) if priors.any else cost
    total = np.broadcast_to(np.asarray(variation, dtype=float), cost.shape)
    with np.errstate(divide="ignore", invalid="ignore"):
        explained = np.where(total == 0, np.where(squares <= 0, 1.0, 0.0), 1 - squares / total)
    free = ~unknowns.is_time
    near = AT_END * np.maximum(np.abs(theta), 1e-300)
    with np.errstate(invalid="ignore"):
        held = (theta <= unknowns.lower + near) | (theta >= unknowns.upper - near)
        collapsed = sum(map(partial(_count_collapsed, problem), problem.experiments, problem.ends_of_modes(theta)))
    return {
        "explained": np.where(np.isnan(total) | np.isnan(cost), np.nan, explained),
        "collapsed": np.asarray(collapsed, dtype=np.int64),
        "at_bounds": np.sum(held & free & ~np.isnan(theta), axis=1).astype(np.int64),
    }


def _count_collapsed(problem: Problem, experiment: Experiment, ends: FloatArray) -> NDArray[np.int64]:
    """Return how many modes of an experiment last no longer than they must, from their ends (R, N + 2): (R,)."""
    least = np.array([get_min_duration(problem.min_duration, mode) for mode in experiment.mode_sequence])
    shortest = least + AT_END * (experiment.end - experiment.t0)
    found: NDArray[np.int64] = np.sum(np.diff(ends, axis=1) <= shortest, axis=1)
    return found


def count_samples(problem: Problem) -> int:
    """Return the measured values that are not missing."""
    return sum(item.count for run in problem.experiments for item in run.data if isinstance(item, Measurements))


def count_priors(problem: Problem) -> int:
    """Return the unknowns that have a prior."""
    return int(np.count_nonzero(problem.unknowns.priors.precision))


def measure_variance(cost: FloatArray, freedom: NDArray[np.int64], sigma_known: bool | None) -> FloatArray:
    """Return by what covariances are multiplied: 1 if sigma is known, the residual variance if not; NaN where neither
    is: (R,).
    """
    if sigma_known:
        return np.ones(len(cost))
    there = (freedom > 0) & (sigma_known is False)
    return np.where(there, 2 * cost / np.maximum(freedom, 1), np.nan)


MINOR = 0.01
"""Share of a study's fits that may have failed, or ended at a bound or with a collapsed mode, without a doubt about its
standard deviations and 95 % intervals."""

FAR_AWAY = 10.0
"""Robust standard deviations (1.48 times the median deviation) from the median beyond which a fit of a study has ended
in another minimum. The tails of noise do not reach that far; a single fit that does shows in standard deviations."""

EXPLAINED_BADLY = ("unexplained", "no noise")
"""Doubts that chi-square gives."""

LEVEL = 0.95
"""Level at which a study's intervals are checked against the truth. It is said if they miss it half as often again as
they should (`HALF`), and chance does not explain it."""


def has_converged(status: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which of fits with these names of their `Status` converged: (R,)."""
    return np.isin(status, [one.name for one in Status if one.successful])


def find_doubts(fits: Mapping[str, NDArray[Any]], sigma_known: bool | None, priors: int) -> list[Doubt]:
    """Return what speaks against each of R fits, in order of weight.

    Parameters
    ----------
    fits : mapping of str to array
        Fields of `Fits`: `status`, `cost`, `hessian`, `free`, `samples`, `explained`, `collapsed`, `at_bounds`.
    sigma_known, priors : as of `Fits`
    """
    status, explained = fits["status"], fits["explained"]
    collapsed = np.where(status == Status.COLLAPSED.name, 1, fits["collapsed"])
    numbers = Numbers(has_converged(status), explained=explained, collapsed=collapsed, references=sigma_known is None)
    has_shares = bool(np.isfinite(explained).any())
    if has_shares or sigma_known is not None:
        smallest = _find_smallest(fits["hessian"], fits["free"], status)
        numbers = replace(numbers, at_bounds=fits["at_bounds"], smallest=smallest)
    if has_shares and sigma_known is not None:
        numbers = replace(numbers, freedom=fits["samples"] + priors - fits["free"])
    if has_shares and sigma_known:
        probability, known = compare_with_sigma(2 * fits["cost"], numbers.freedom, tests=len(status))
        numbers = replace(numbers, probability=probability, known=known)
    return verdict.find_doubts(numbers)


def judge_many(fits: Any) -> Verdict:
    """Return the verdict on fits of many logs, or of anything in which each fit counts by itself."""
    R = len(fits.status)
    doubts = fits.doubts
    levels = verdict.find_levels(doubts, R)
    counts: dict[str, float] = {level: float(np.sum(levels == level)) for level in LEVELS}
    stopped = list(_find_stop(fits))
    if not doubts and not stopped:
        known = np.isfinite(fits.explained)
        if not known.any():
            return Verdict("good", (Issue("many fits", figures=counts),))
        counts |= {"worst": float(fits.explained[known].min()), "median": float(np.median(fits.explained[known]))}
        return Verdict("good", (Issue("many fits", (str(fits.runs[_find_worst(fits, known)]),), counts),))
    level: Level = "bad" if counts["bad"] >= HALF * R else "doubtful"
    reasons = [Issue("many fits", (), counts)] if R > 1 else []
    reasons += [_count(fits, doubt) for doubt in doubts] + [finding.reason for finding in stopped]
    steps = [Issue("next: fit alone", (str(fits.runs[_find_worst(fits, doubts[0].which)]),))] if doubts else []
    steps += [Issue(f"next: {step}") for finding in stopped for step in finding.steps]
    if any(doubt.kind == "a mode collapsed" for doubt in doubts):
        steps.append(Issue("next: leave the mode out"))
    return Verdict(level, tuple(reasons), tuple(steps))


def judge_study(
    fits: Any,
    *,
    truth: FloatArray | None = None,
    intervals: FloatArray | None = None,
    error: float = 0.0,
    origin: Verdict | None = None,
    considered: NDArray[np.bool_] | None = None,
) -> Verdict:
    """Return the verdict on fits whose spread is what they are for.

    Parameters
    ----------
    fits : Fits
    truth : (d,), optional
        What all of them should find.
    intervals : (R, d, 2), optional
        Of each fit, at `LEVEL`.
    error : float
        Integration error of J, relative.
    origin : Verdict, optional
        On the fit that the data are made of.
    considered : (d,) bool, optional
        Unknowns whose spread means something; all if left out.
    """
    R, ended = len(fits.status), fits.success
    shared = np.ones(len(fits.theta_names), dtype=bool) if considered is None else considered
    found: list[Finding] = []
    if origin is not None and origin.level == "bad":
        found.append(Finding("bad", Issue("resampled fit", (origin.level,)), ("look at the fit",)))
    failed = int(R - ended.sum())
    if failed > MINOR * R:
        level: Level = "bad" if failed >= HALF * R else "doubtful"
        found.append(Finding(level, _count(fits, Doubt("not converged", level, ~ended)), ("see failures",)))
    distances = measure_distances(fits, shared)
    elsewhere = distances > FAR_AWAY
    if elsewhere.any():
        farthest = str(fits.runs[int(np.argmax(distances))])
        figures = {"count": float(elsewhere.sum()), "fits": float(R)}
        found.append(Finding("doubtful", Issue("ended elsewhere", (farthest,), figures), ("take quantiles",)))
    for doubt in fits.doubts:
        many = doubt.which.sum() > MINOR * R
        if doubt.kind in ("a mode collapsed", "at bounds", "not determined") and many:
            step = "leave the mode out" if doubt.kind == "a mode collapsed" else "take quantiles"
            found.append(Finding("doubtful", _count(fits, doubt), (step,)))
        elif doubt.kind in EXPLAINED_BADLY and origin is None and np.any(doubt.which & ~elsewhere):
            found.append(Finding("doubtful", _count(fits, doubt), ("check sigma",)))
    if truth is not None and intervals is not None:
        found += _check_coverage(fits, truth, intervals, ended & ~elsewhere)
    if not error <= FINE:
        found.append(Finding("bad", Issue("integration error", ("J",), {"error": error}), ("smaller rtol",)))
    found += _find_stop(fits)
    figures = {"count": float(ended.sum()), "fits": float(R)}
    return build_verdict(found or [Finding("good", Issue("study", figures=figures))])


def judge_failed_starts(fits: Any) -> Verdict:
    """Return the verdict on fits from many starts none of which could be fitted to the end.

    Parameters
    ----------
    fits : Fits
    """
    everywhere = Doubt("not converged", "bad", np.ones(len(fits.status), dtype=bool))
    return Verdict("bad", (_count(fits, everywhere),), (Issue("next: start elsewhere"),))


def measure_distances(fits: Any, considered: NDArray[np.bool_]) -> FloatArray:
    """Return how far fits converged from the others, in spreads; 0 for those that did not converge: (R,).

    An unknown's deviation from the median is measured by the median of these deviations, or by the median standard
    error, or 1e-3 of the unknown's size where most are held. Of some unknowns (d,), the largest counts.
    """
    ended = fits.success
    found = np.zeros(len(ended))
    if ended.sum() < 3:
        return found
    theta = fits.theta[ended]
    centre = np.median(theta, axis=0)
    deviation = np.abs(theta - centre)
    errors = fits.standard_errors[ended]
    usual = np.array([np.median(e[np.isfinite(e)]) if np.isfinite(e).any() else 0.0 for e in errors.T])
    spread = np.maximum(1.4826 * np.median(deviation, axis=0), usual)
    spread = np.where(spread > 0, spread, 1e-3 * np.maximum(np.abs(centre), 1e-300))
    found[ended] = np.max(deviation / spread * considered, axis=1)
    return found


def _find_smallest(H: FloatArray, free: NDArray[np.int64], status: NDArray[np.str_]) -> FloatArray:
    """Return the smallest eigenvalue of each scaled Hessian, infinite where a constraint is active: (R,)."""
    found = np.where(status == Status.SINGULAR.name, 0.0, np.inf)
    diagonal = np.diagonal(H, axis1=1, axis2=2)
    whole = (free == H.shape[1]) & np.isfinite(H).all(axis=(1, 2)) & (diagonal > 0).all(axis=1)
    if whole.any():
        scale = diagonal[whole] ** -0.5
        smallest = np.linalg.eigvalsh(H[whole] * scale[:, :, None] * scale[:, None, :])[:, 0]
        found[whole] = np.minimum(found[whole], smallest)
    return found


def _check_coverage(
    fits: Any, truth: FloatArray, intervals: FloatArray, counted: NDArray[np.bool_]
) -> Iterator[Finding]:
    """Find unknowns whose intervals hold the truth less often than they should."""
    low, high = np.moveaxis(intervals[counted], 2, 0)
    known = ~np.isnan(low).all(axis=0) if len(low) else np.zeros(low.shape[1], dtype=bool)
    if not known.any():
        return
    n = len(low)
    inside = np.sum((low <= truth) & (truth <= high), axis=0)
    chance = special.bdtr(inside, n, LEVEL)  # of so few, or fewer
    short = known & (n - inside > (1 + HALF) * (1 - LEVEL) * n) & (chance < UNLIKELY / len(truth))
    if short.any():
        order = np.argsort(np.where(short, inside, n + 1), kind="stable")[: short.sum()]
        names = tuple(fits.theta_names[i] for i in order)
        shares = {"share": float(inside[order[0]] / n), "level": LEVEL}
        yield Finding("doubtful", Issue("intervals too short", names, shares), ("profiles",))


def _find_stop(fits: Any) -> Iterator[Finding]:
    """Find out whether the fits were stopped before the last."""
    left = fits.requested - len(fits.status)
    if left > 0:
        figures = {"count": float(left), "fits": float(fits.requested)}
        yield Finding("doubtful", Issue("stopped", figures=figures), ("go on",))


def _count(fits: Any, doubt: Doubt) -> Issue:
    """Return a reason with the number of fits that it is about, the worst of them and how much that explains."""
    figures = {"count": float(doubt.which.sum()), "fits": float(len(doubt.which))}
    if doubt.kind == "not converged":
        endings = Counter(fits.status[doubt.which].tolist()).most_common()
        return Issue("some not converged", tuple(name for name, _ in endings), figures)
    worst = _find_worst(fits, doubt.which)
    return Issue(f"some {doubt.kind}", (str(fits.runs[worst]),), figures | {"worst": float(fits.explained[worst])})


def _find_worst(fits: Any, which: NDArray[np.bool_]) -> int:
    """Return the place of the worst of some fits: the one that explains least, if any does."""
    places = np.flatnonzero(which)
    shares = fits.explained[places]
    return int(places[0] if np.isnan(shares).all() else places[np.nanargmin(shares)])
