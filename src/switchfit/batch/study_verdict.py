"""Verdicts on studies: fits whose spread is what they are for, and fits from many starts.

A study is doubted where many of its fits failed, ended in another minimum or lost a mode, where chi-square does not
confirm them, and where their intervals miss the truth too often.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.batch.doubts import EXPLAINED_BADLY
from switchfit.batch.fits import Fits, build_reason, find_stop
from switchfit.runtime import special
from switchfit.runtime.issue import Issue
from switchfit.uncertainty.chi_square import UNLIKELY_AS_NOISE
from switchfit.uncertainty.doubts import FINE, Doubt, Level
from switchfit.uncertainty.explained_variance import HALF
from switchfit.uncertainty.findings import Finding
from switchfit.uncertainty.verdict import Verdict, build_verdict

FORGIVEN_SHARE = 0.01
"""Share of a study's fits that may have failed, or ended at a bound or with a collapsed mode, without a doubt about its
standard deviations and 95 % intervals."""

ELSEWHERE_FROM = 10.0
"""Robust standard deviations (1.48 times the median deviation) from the median beyond which a fit of a study has ended
in another minimum. The tails of noise do not reach that far; a single fit that does shows in standard deviations."""

COVERAGE_LEVEL = 0.95
"""Level at which a study's intervals are checked against the truth. It is said if they miss it half as often again as
they should (`HALF`), and chance does not explain it."""


def judge_study(
    fits: Fits,
    *,
    truth: FloatArray | None = None,
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
    if failed > FORGIVEN_SHARE * R:
        level: Level = "bad" if failed >= HALF * R else "doubtful"
        found.append(Finding(level, build_reason(fits, Doubt("not converged", level, ~ended)), ("see failures",)))
    # A median and its deviation, since another minimum pulls means and standard deviations along.
    distances = _measure_distances(fits, shared)
    elsewhere = distances > ELSEWHERE_FROM
    if elsewhere.any():
        farthest = str(fits.runs[int(np.argmax(distances))])
        figures = {"count": float(elsewhere.sum()), "fits": float(R)}
        found.append(Finding("doubtful", Issue("ended elsewhere", (farthest,), figures), ("take quantiles",)))
    for doubt in fits.doubts:
        many = doubt.which.sum() > FORGIVEN_SHARE * R
        if doubt.kind in ("a mode collapsed", "at bounds", "not determined") and many:
            step = "leave the mode out" if doubt.kind == "a mode collapsed" else "take quantiles"
            found.append(Finding("doubtful", build_reason(fits, doubt), (step,)))
        elif doubt.kind in EXPLAINED_BADLY and origin is None and np.any(doubt.which & ~elsewhere):
            found.append(Finding("doubtful", build_reason(fits, doubt), ("check sigma",)))
    if truth is not None:
        found += _check_coverage(fits, truth, ended & ~elsewhere)
    if not error <= FINE:
        found.append(Finding("bad", Issue("integration error", ("J",), {"error": error}), ("smaller rtol",)))
    found += find_stop(fits)
    figures = {"count": float(ended.sum()), "fits": float(R)}
    return build_verdict(found or [Finding("good", Issue("study", figures=figures))])


def judge_starts(fits: Fits, best: Verdict | None) -> Verdict:
    """Return the verdict on fits from many starts: that on the best end, and whether starts are left.

    Parameters
    ----------
    fits : Fits
    best : Verdict or None
        None where no start could be fitted to the end.
    """
    if best is None:
        everywhere = Doubt("not converged", "bad", np.ones(len(fits), dtype=bool))
        best = Verdict("bad", (build_reason(fits, everywhere),), (Issue("next: start elsewhere"),))
    for stop in find_stop(fits):
        level, against = (stop.level, ()) if best.level == "good" else (best.level, best.reasons)
        best = Verdict(level, (*against, stop.reason), (*best.next_steps, Issue("next: go on")), best.answers)
    return best


def _measure_distances(fits: Fits, considered: NDArray[np.bool_]) -> FloatArray:
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
    # A standard error says how far noise spreads where most fits end at the same place to rounding, as at a kink.
    usual = np.array([np.median(e[np.isfinite(e)]) if np.isfinite(e).any() else 0.0 for e in errors.T])
    spread = np.maximum(1.4826 * np.median(deviation, axis=0), usual)
    spread = np.where(spread > 0, spread, 1e-3 * np.maximum(np.abs(centre), 1e-300))
    # An unknown that is not considered counts 0.
    found[ended] = np.max(deviation / spread * considered, axis=1)
    return found


def _check_coverage(fits: Fits, truth: FloatArray, counted: NDArray[np.bool_]) -> Iterator[Finding]:
    """Find unknowns whose intervals hold the truth less often than they should."""
    low, high = np.moveaxis(fits.confidence_intervals(COVERAGE_LEVEL)[counted], 2, 0)
    known = ~np.isnan(low).all(axis=0) if len(low) else np.zeros(low.shape[1], dtype=bool)
    if not known.any():
        return
    n = len(low)
    inside = np.sum((low <= truth) & (truth <= high), axis=0)
    chance = special.bdtr(inside, n, COVERAGE_LEVEL)  # of so few, or fewer
    short = known & (n - inside > (1 + HALF) * (1 - COVERAGE_LEVEL) * n) & (chance < UNLIKELY_AS_NOISE / len(truth))
    if short.any():
        order = np.argsort(np.where(short, inside, n + 1), kind="stable")[: short.sum()]
        names = tuple(fits.theta_names[i] for i in order)
        shares = {"share": float(inside[order[0]] / n), "level": COVERAGE_LEVEL}
        yield Finding("doubtful", Issue("intervals too short", names, shares), ("profiles",))
