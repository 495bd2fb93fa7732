"""Findings about a single fit: reasons to doubt it, the level that follows, and what to do about each.

A doubt comes from numbers alone (`doubts`); here it gets what is known of the fit beyond them: names of unknowns, why
the fit did not converge, what the residuals suspect.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from switchfit.fit.result import Fit
from switchfit.optimize import Status
from switchfit.runtime.issue import Issue
from switchfit.uncertainty.advice import (
    ADVICE_BY_FAILURE,
    ADVICE_BY_STATUS,
    ADVICE_BY_SUSPECT,
    ADVICE_WITHOUT_EFFECT,
    FIX,
    LOOK_ELSEWHERE,
    PROFILES,
    SWITCH,
    WRITTEN_OTHERWISE,
)
from switchfit.uncertainty.certificate import Certificate
from switchfit.uncertainty.chi_square import UNLIKELY_AS_NOISE
from switchfit.uncertainty.doubts import AGREEING, BARELY_DETERMINED, NEARLY_ALL, Doubt, Level
from switchfit.uncertainty.issues import (
    find_active_bounds,
    find_short_modes,
    find_times_at_jumps,
    find_weakest,
    find_without_effect,
)
from switchfit.uncertainty.quality import Quality

VANISHING_ERRORS = 10.0
"""Standard errors of an unknown on a logarithmic scale, in parts of it, above which the data do not tell it from 0."""


class Finding(NamedTuple):
    """One reason to doubt or to believe a fit, the level that follows from it, and what to do about it."""

    level: Level
    reason: Issue
    steps: tuple[str, ...] = ()


def has_looked(fit: Fit) -> bool:
    """Return whether a search has looked elsewhere, to its end, and has found nothing lower than the fit.

    Parameters
    ----------
    fit : Fit
    """
    # (tried, lower, agreeing): a start that ended lower means that the fit is not where it should be.
    if fit.starts is not None and fit.starts[0] > 0:
        return fit.starts[1] == 0
    return len(fit.steps) > 1 and fit.steps[-1].ended == "" and fit.steps[-1].cost == fit.steps[-2].cost


def explain_doubt(fit: Fit, quality: Quality | None, doubt: Doubt) -> Iterator[Finding]:
    """Yield the findings of a doubt about a fit, with what is known of it beyond the numbers."""
    kind, level = doubt.kind, doubt.level
    figures = describe_fit(fit, quality)
    if kind == "not converged":
        yield from _find_ending(fit)
    elif kind == "a mode collapsed":
        yield from _find_collapsed(fit)
    elif kind == "at bounds":
        held = tuple(name for issue in find_active_bounds(fit) for name in issue.subjects)
        yield Finding(level, Issue(kind, held), ("move the bound",))
    elif kind == "not determined":
        # The smallest eigenvalue of the Hessian scaled to unit curvature, and who trades off in its eigenvector. A flat
        # direction has names of its own.
        smallest, names = find_weakest(fit)
        weakest = names or tuple(name for name, _ in fit.flat_direction)
        yield Finding(level, Issue(kind, weakest, {"eigenvalue": smallest}), (FIX,))
    elif kind == "integration error":
        reason = Issue(kind, (fit.integration_error_of,), {"error": fit.integration_error})
        yield Finding(level, reason, ("smaller rtol",))
    elif kind == "too few samples":
        unknowns = {"samples": float(fit.samples), "unknowns": float(fit.free_basis.shape[1])}
        yield Finding(level, Issue(kind, figures=figures | unknowns), ("more data",))
    elif kind == "no noise" and quality is not None:
        steps = ADVICE_BY_SUSPECT[quality.suspect]
        if quality.suspect == "model" and quality.explained < NEARLY_ALL:  # wrong ends explain as much
            steps = ("more starts", *steps)
        yield Finding(
            level, Issue(f"{quality.suspect} suspected", tuple(c.label for c in quality.worst), figures), steps
        )
    else:
        subjects = () if quality is None or not quality.channels else (quality.worst[0].label,)
        yield Finding(level, Issue(kind, subjects, figures), LOOK_ELSEWHERE[:1] if "starts" in kind else LOOK_ELSEWHERE)


def _find_ending(fit: Fit) -> Iterator[Finding]:
    """Yield findings about a fit that did not converge."""
    figures: dict[str, float | tuple[float, ...]]
    figures = {"optimality": fit.optimality, "tolerance": fit.tolerance, "iterations": float(fit.iterations)}
    subjects: tuple[str, ...] = (fit.status.name,)
    steps = ADVICE_BY_STATUS.get(fit.status, ("more starts",))
    if fit.reason is not None and fit.reason.kind in WRITTEN_OTHERWISE:
        yield Finding("bad", fit.reason, (WRITTEN_OTHERWISE[fit.reason.kind],))
        steps = ()
    # The reason why the last step failed, such as a model that cannot be integrated there, says more than the status.
    elif fit.status is Status.LINE_SEARCH_FAILED and fit.reason is not None:
        subjects = (*subjects, fit.reason.kind, *fit.reason.subjects)
        figures |= fit.reason.figures
        steps = ADVICE_BY_FAILURE.get(fit.reason.kind, ("more starts",))
    smallest, names = find_weakest(fit)
    # Two findings of two levels: that it has not converged is bad; why, a direction that the data hardly determine, is
    # no mistake of the fit.
    if fit.status is Status.MAX_ITERATIONS and abs(smallest) < BARELY_DETERMINED:  # it creeps along a valley
        yield Finding("bad", Issue("not converged", subjects, figures))
        yield Finding("doubtful", Issue("not determined", names, {"eigenvalue": smallest}), (FIX, *steps[:1]))
    else:
        yield Finding("bad", Issue("not converged", subjects, figures), steps)


def _find_collapsed(fit: Fit) -> Iterator[Finding]:
    """Yield findings about modes that have collapsed, or are at their minimum duration."""
    steps = {"a mode collapsed": ("more starts", "leave the mode out"), "a mode is short": ("lower min_duration",)}
    found = list(find_short_modes(fit))
    if fit.status is Status.COLLAPSED and all(issue.kind == "a mode is short" for issue in found):
        found.append(Issue("idle", fit.idle))
    yield from (Finding("doubtful", issue, steps.get(issue.kind, steps["a mode collapsed"])) for issue in found)


def find_cut_search(fit: Fit, quality: Quality | None) -> Iterator[Finding]:
    """Find a search that its limit of time has ended, unless noise of a known size is all that is left of the data, or
    enough of its starts ended where the fit did.
    """
    is_noise = quality is not None and quality.channels and quality.known and quality.probability >= UNLIKELY_AS_NOISE
    tried, lower, agreeing = fit.starts or (0, 0, 0)
    is_agreed = lower == 0 and agreeing >= max(2, AGREEING * tried)
    # A fit that has not converged has its own finding; and only the last step can have been cut.
    is_cut = bool(fit.status.successful and fit.steps and fit.steps[-1].ended == "time")
    if is_cut and not is_noise and not is_agreed:
        yield Finding("doubtful", Issue("search cut short", (fit.steps[-1].strategy,)), ("more time",))


def find_other_doubts(fit: Fit, certificate: Certificate) -> Iterator[Finding]:
    """Yield what is doubtful of a single fit besides the numbers: unknowns without effect, and checks that failed."""
    if fit.reason is not None and fit.reason.kind == "switch":  # it ended at a jump of J that a function makes
        yield Finding("doubtful", fit.reason, (SWITCH,))
    if not fit.status.successful:
        return
    if fit.rivals:
        names, places, rises = zip(*fit.rivals, strict=True)
        yield Finding("doubtful", Issue("rivals", names, {"at": places, "rise": rises}), (PROFILES,))
    for issue in find_without_effect(fit):
        yield Finding("doubtful", issue, (ADVICE_WITHOUT_EFFECT[issue.kind],))
    # On a logarithmic scale 0 is infinitely far away: an unknown that the data cannot tell from it creeps there, and
    # its error grows with the distance.
    vanishing = (
        np.isin(fit.theta_names, fit.log_scaled) & ~fit.is_time & (fit.standard_errors > VANISHING_ERRORS * fit.theta)
    )
    if vanishing.any():
        names = tuple(np.array(fit.theta_names, dtype=object)[vanishing].tolist())
        yield Finding("doubtful", Issue("vanishing", names), ("linear scale",))
    for failure in certificate.failures:
        # That one is a doubt from numbers alone already (`doubts`).
        if failure.kind != "integration error":
            yield Finding("doubtful", failure, ("check derivatives",))


def describe_fit(fit: Fit, quality: Quality | None) -> dict[str, float]:
    """Return the figures of the sentences about a fit."""
    tried, better, agreeing = map(float, fit.starts or (0, 0, 0))
    agrees = has_looked(fit) and not any(find_times_at_jumps(fit))  # no search looks beyond a known jump
    figures = {"tried": tried, "better": better, "agreeing": agreeing, "agrees": float(agrees)}
    if quality is None or not quality.channels:
        return figures | {"optimality": fit.optimality}
    worst = quality.worst[0]
    return figures | {
        "explained": quality.explained,
        "chi-square": quality.chi_square,
        "freedom": float(fit.freedom),
        "probability": quality.probability,
        "known": float(quality.known),
        "worst": worst.explained,
        "size": worst.size,
        "correlated": float(worst.tests.get("model", 1.0) * len(quality.channels) < UNLIKELY_AS_NOISE),
        "narrowing": worst.widening,
    }
