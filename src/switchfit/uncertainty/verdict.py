"""The verdict on a fit: good, doubtful or bad, why, and what to do next, as data; the report makes the sentence of it.

`switchfit.uncertainty.answers` has the rules and the thresholds, for any number of fits. Here is what they are applied
to in a single one, and what the user is advised to do.

Warnings about the numbers of a fit, as data; the report writes the sentences.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from switchfit.fit.result import NAMED, Fit, disagreement, list_without_effect
from switchfit.optimize import Status
from switchfit.problem.inspection import name_whole_parameters
from switchfit.runtime.errors import Issue
from switchfit.runtime.presentation import Printed
from switchfit.uncertainty.answers import (
    AGREEING,
    BARELY_DETERMINED,
    LEVELS,
    NEARLY_ALL,
    NO_RESIDUALS,
    UNLIKELY,
    Doubt,
    Level,
    Numbers,
    compare_with_sigma,
    find_doubts,
)
from switchfit.uncertainty.certificate import LARGE_INTEGRATION_ERROR, Certificate, analyse_solution, certify
from switchfit.uncertainty.residuals import Quality, diagnose, measure_quality

UNSEEN = 100.0
"""Factor between the standard errors of the two Hessians above which the Gauss-Newton matrix counts as singular, as for
a transition at which the vector field does not jump, such as a block that comes to rest."""
DIFFERENT = 1.2
"""Factor between the standard errors of the two Hessians, for any combination of the unknowns, above which a warning is
given: a 95 % interval that is too narrow by this factor covers 90 %, one that is too wide 98 %."""


def find_issues(fit: Fit) -> list[Issue]:
    """Return the warnings about a fit, in the order of the report.

    Parameters
    ----------
    fit : Fit
    """
    sources = (
        _find_short_modes,
        _find_bounds,
        _find_idle,
        _find_kinks,
        find_without_effect,
        _find_undetermined,
        _find_missing_errors,
        _check_noise,
        _check_residuals,
        _compare_covariances,
        _check_integration,
    )
    return [issue for source in sources for issue in source(fit)]


def _find_short_modes(fit: Fit) -> Iterator[Issue]:
    """Find modes that have collapsed, or are at their minimum duration."""
    for constraint in fit.active:
        if constraint.position is not None:
            kind = "a mode collapsed" if constraint.kind == "collapsed" else "a mode is short"
            yield Issue(kind, (constraint.mode, constraint.run), {"position": float(constraint.position)})


def _find_bounds(fit: Fit) -> Iterator[Issue]:
    """Find unknowns that bounds hold which the user gave."""
    for constraint in fit.active:
        if constraint.position is None and constraint.unknown not in fit.idle:
            yield Issue(constraint.kind, (constraint.unknown,), {"value": constraint.value})


def _find_idle(fit: Fit) -> Iterator[Issue]:
    """Find unknowns on which the cost does not depend, because a mode has collapsed."""
    is_time = dict(zip(fit.theta_names, fit.is_time.tolist(), strict=True))
    for kind, wanted in (("idle times", True), ("idle parameters", False)):
        if names := tuple(name for name in fit.idle if is_time[name] is wanted):
            yield Issue(kind, names)


def _find_kinks(fit: Fit) -> Iterator[Issue]:
    """Find unknowns at which the derivative jumps through zero."""
    if fit.kinks:
        yield Issue("at kinks", tuple(kink.unknown for kink in fit.kinks))


def find_without_effect(fit: Fit) -> Iterator[Issue]:
    """Find unknowns on which the cost does not depend: no function reads them, only modes that do not occur do, or it
    is unknown why.

    Parameters
    ----------
    fit : Fit
    """
    without = list_without_effect(fit)
    for kind, group in (("not read", fit.unread), ("acts elsewhere", fit.absent)):
        if names := name_whole_parameters([name for name in without if name in group]):
            yield Issue(kind, names)
    if others := tuple(name for name in without if name not in (*fit.unread, *fit.absent)):
        yield Issue("without effect", others)


def _find_undetermined(fit: Fit) -> Iterator[Issue]:
    """Find a direction along which the cost hardly changes, of the unknowns on which it depends."""
    smallest, names = _find_weakest(fit)
    if abs(smallest) < BARELY_DETERMINED:
        yield Issue("not determined", names, {"eigenvalue": smallest})


def _find_weakest(fit: Fit) -> tuple[float, tuple[str, ...]]:
    """Return the smallest eigenvalue of the scaled Hessian of the free unknowns with an effect, infinite if there are
    none, and the unknowns with the largest components in its direction.
    """
    found = analyse_solution(fit, None)
    if flat := tuple(name for name in found.without if name not in list_without_effect(fit)):  # transition times
        return 0.0, flat[:NAMED]
    return (float(found.eigenvalues[0]), found.directions[0].names[:NAMED]) if found.directions else (np.inf, ())


def _find_missing_errors(fit: Fit) -> Iterator[Issue]:
    """Find the reason why a fit has no standard errors."""
    without = list_without_effect(fit)
    missing = ~np.isfinite(fit.standard_errors) & ~np.isin(fit.theta_names, without)
    if not missing.any():
        return
    k = fit.free_basis.shape[1]
    if not np.isfinite(fit.hessian).all():
        yield Issue("no errors: not finite")
    elif fit.sigma_known is None:
        if not any(fit.comparisons):  # a cost of the trajectory alone never has standard errors
            return
        yield Issue("no errors: no noise model")
    elif fit.sigma_known is False and fit.samples <= k:
        yield Issue("no errors: too few samples", figures={"samples": float(fit.samples), "unknowns": float(k)})
    else:
        names = () if missing.all() else tuple(np.array(fit.theta_names, dtype=object)[missing].tolist())
        yield Issue("no errors: not positive definite", names, {"eigenvalue": _find_weakest(fit)[0]})


def _check_noise(fit: Fit) -> Iterator[Issue]:
    """Test whether a known sigma contradicts the residuals: 2 J should be chi-square distributed."""
    variance = fit.residual_variance
    if not (fit.status.successful and fit.sigma_known and np.isfinite(variance)):
        return
    probability, is_size = compare_with_sigma(2 * fit.cost, fit.freedom)
    if probability < UNLIKELY or not is_size:
        yield Issue("sigma too small" if variance > 1 else "sigma too large", figures={"chi-square": variance})


def _check_residuals(fit: Fit) -> Iterator[Issue]:
    """Find residuals that are not white, normal noise."""
    if fit.status.successful and fit.sigma_known is not None:
        yield from diagnose(fit).issues


def _compare_covariances(fit: Fit) -> Iterator[Issue]:
    """Test whether the exact Hessian and the Gauss-Newton matrix give different standard errors."""
    found = disagreement(fit) if fit.status.successful else None
    if found is not None and found.factor > DIFFERENT:
        kind = "known to second order" if found.factor > UNSEEN else "covariances differ"
        figures = {"factor": found.factor, "exact": found.exact, "Gauss-Newton": found.gauss_newton}
        yield Issue(kind, (found.name,), figures)


def _check_integration(fit: Fit) -> Iterator[Issue]:
    """Test whether the integration is accurate enough."""
    if not fit.integration_error <= LARGE_INTEGRATION_ERROR:
        yield Issue("large integration error", (fit.integration_error_of,), {"error": fit.integration_error})


@dataclass(frozen=True)
class Verdict(Printed):
    """Whether to believe a fit; print it for one line that says so.

    Attributes
    ----------
    level : {"good", "doubtful", "bad"}
        Bad: not converged, or far from the data, or known not to be the best. Doubtful: read the reasons before using
        the numbers.
    reasons : tuple of Issue
        What speaks against the fit, in order of weight; for a good one what speaks for it.
    next_steps : tuple of Issue
        What to do, the most promising first; empty for a good fit.
    answers : tuple of Issue
        Of a single fit: whether it converged, who looked for a better one, and whether what is left of the data is
        noise. The last is left out if the fit did not converge.

    See Also
    --------
    Estimate.verdict, Estimate.success

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> fit = sf.estimate(heater_problem())

    >>> fit.verdict.level
    'good'
    >>> [reason.kind for reason in fit.verdict.reasons]
    ['fits']
    >>> str(fit.verdict)[:68]
    'Good: converged; one fit; the model explains 99.85 % of the variance'
    """

    level: Level
    reasons: tuple[Issue, ...]
    next_steps: tuple[Issue, ...] = ()
    answers: tuple[Issue, ...] = field(default=(), repr=False)


class Finding(NamedTuple):
    """One reason to doubt or to believe a fit, the level that follows from it, and what to do about it."""

    level: Level
    reason: Issue
    steps: tuple[str, ...] = ()


def judge(fit: Fit, certificate: Certificate | None = None) -> Verdict:
    """Return the verdict on a fit.

    Parameters
    ----------
    fit : Fit
    certificate : Certificate, optional
        If left out, the checks that do not need the model are made.
    """
    quality = measure_quality(fit) if fit.status.successful and np.isfinite(fit.cost) else None
    found = [finding for doubt in find_doubts(_list_numbers(fit, quality)) for finding in _explain(fit, quality, doubt)]
    found += _find_cut_search(fit, quality)
    found += _find_others(fit, certify(fit, None) if certificate is None else certificate)
    answers = _answer(fit, quality, {f.reason.kind: f.reason for f in found})
    if not found:
        return Verdict("good", (answers[-1], *_find_kinks(fit)), answers=answers)
    if has_looked(fit):  # it is no remedy any more
        found = [f._replace(steps=tuple(step for step in f.steps if step != "more starts")) for f in found]
    return build_verdict(found, answers)


def build_verdict(found: Sequence[Finding], answers: tuple[Issue, ...] = ()) -> Verdict:
    """Return the verdict that findings, one at least, lead to: the level of the worst, which comes first.

    Parameters
    ----------
    found : sequence of Finding
        In the order of weight on each level.
    answers : tuple of Issue
    """
    ranked = sorted(found, key=lambda f: -LEVELS.index(f.level))  # stable
    steps = dict.fromkeys(step for f in ranked for step in f.steps)
    subjects = {step: f.reason.subjects for f in ranked for step in f.steps if step in OF_SUBJECTS}
    advised = tuple(Issue(f"next: {step}", subjects.get(step, ())) for step in steps)
    return Verdict(ranked[0].level, tuple(f.reason for f in ranked), advised, answers)


def has_looked(fit: Fit) -> bool:
    """Return whether a search has looked elsewhere, to its end, and has found nothing lower than the fit.

    Parameters
    ----------
    fit : Fit
    """
    if fit.starts is not None and fit.starts[0] > 0:
        return fit.starts[1] == 0
    return len(fit.steps) > 1 and fit.steps[-1].ended == "" and fit.steps[-1].cost == fit.steps[-2].cost


def _list_numbers(fit: Fit, quality: Quality | None) -> Numbers:
    """Return the numbers by which a fit is judged, of one fit."""
    tried, lower, agreeing = fit.starts or (0, 0, 0)
    ended = Numbers(np.array([fit.status.successful]), fit.integration_error, lower, tried, agreeing)
    if quality is None:
        return ended
    is_flat = fit.status is Status.SINGULAR and not list_without_effect(fit)
    found = replace(
        ended,
        collapsed=fit.status is Status.COLLAPSED or any(c.position is not None for c in fit.active),
        at_bounds=len(list(_find_bounds(fit))) if any(fit.comparisons) else 0,
        smallest=0.0 if is_flat else _find_weakest(fit)[0],
    )
    if not quality.channels:
        return found
    is_exact = 1 - quality.explained < NO_RESIDUALS and fit.integration_error_of == "J"
    return replace(
        found,
        error=0.0 if is_exact else fit.integration_error,  # which is all of a cost that is rounding
        explained=quality.explained,
        probability=quality.probability,
        known=quality.known,
        freedom=np.inf if fit.sigma_known is None else fit.freedom,
        references=any(channel.kind == "reference" for channel in quality.channels),
    )


ELSEWHERE = ("more starts", "look at the residuals")
"""What to do about a model that does not fit: the minimum may be a local one, or the model wrong."""

SUSPECTED = {
    "model": ("look at the residuals", "corrected errors"),
    "outliers": ("robust loss",),
    "sigma": ("check sigma",),
}
"""What to do about residuals that are no noise, by what is suspected."""

FIX = "fix or add data"
"""What to do about unknowns that are not determined, which are the subjects of this advice."""

NO_EFFECT = {"not read": "remove or use", "acts elsewhere": "fix or let it act", "without effect": "fix alone"}
"""What to do about unknowns on which J does not depend, by the kind of reason; they are the subjects of the advice."""

ENDED = {
    Status.MAX_ITERATIONS: ("raise max_iterations", "more starts"),
    Status.INTERRUPTED: ("continue",),
    Status.NONFINITE_START: ("start elsewhere",),
    Status.INFEASIBLE: ("start nearer",),
}
"""What to do about a fit that did not converge, by its status; otherwise more starts."""

SEARCH_FAILED = {"switch": (), "wrong slope": ("check derivatives", "more starts"), "rounding": ("larger tolerance",)}
"""What to do about a line search that failed, by the reason; otherwise more starts. About a switch: see `SWITCH`."""

DEFINE = "define it there"
"""What to do about an operation of a function that is not defined, or has no derivative, at a point."""

SWITCH = "transition time"
"""What to do about an unknown with which a function compares, the first of the subjects of this advice."""

OF_SUBJECTS = {DEFINE, FIX, SWITCH, *NO_EFFECT.values()}
"""Advice that is about the subjects of its reason."""


def _explain(fit: Fit, quality: Quality | None, doubt: Doubt) -> Iterator[Finding]:
    """Yield the findings of a doubt about a fit, with what is known of it beyond the numbers."""
    kind, level = doubt.kind, doubt.level
    figures = _describe_fit(fit, quality)
    if kind == "not converged":
        yield from _find_ending(fit)
    elif kind == "a mode collapsed":
        yield from _find_collapsed(fit)
    elif kind == "at bounds":
        held = tuple(name for issue in _find_bounds(fit) for name in issue.subjects)
        yield Finding(level, Issue(kind, held), ("move the bound",))
    elif kind == "not determined":
        smallest, names = _find_weakest(fit)
        weakest = names or tuple(name for name, _ in fit.flat_direction)
        yield Finding(level, Issue(kind, weakest, {"eigenvalue": smallest}), (FIX,))
    elif kind == "integration error":
        reason = Issue(kind, (fit.integration_error_of,), {"error": fit.integration_error})
        yield Finding(level, reason, ("smaller rtol",))
    elif kind == "too few samples":
        unknowns = {"samples": float(fit.samples), "unknowns": float(fit.free_basis.shape[1])}
        yield Finding(level, Issue(kind, figures=figures | unknowns), ("more data",))
    elif kind == "no noise" and quality is not None:
        steps = SUSPECTED[quality.suspect]
        if quality.suspect == "model" and quality.explained < NEARLY_ALL:  # wrong ends explain as much
            steps = ("more starts", *steps)
        yield Finding(
            level, Issue(f"{quality.suspect} suspected", tuple(c.label for c in quality.worst), figures), steps
        )
    else:
        subjects = () if quality is None or not quality.channels else (quality.worst[0].label,)
        yield Finding(level, Issue(kind, subjects, figures), ELSEWHERE[:1] if "starts" in kind else ELSEWHERE)


def _find_ending(fit: Fit) -> Iterator[Finding]:
    """Yield findings about a fit that did not converge."""
    figures: dict[str, float | tuple[float, ...]]
    figures = {"optimality": fit.optimality, "tolerance": fit.tolerance, "iterations": float(fit.iterations)}
    subjects: tuple[str, ...] = (fit.status.name,)
    steps = ENDED.get(fit.status, ("more starts",))
    if fit.reason is not None and fit.reason.kind == "undefined":
        yield Finding("bad", fit.reason, (DEFINE,))
        steps = ()
    elif fit.status is Status.LINE_SEARCH_FAILED and fit.reason is not None:
        subjects = (*subjects, fit.reason.kind, *fit.reason.subjects)
        figures |= fit.reason.figures
        steps = SEARCH_FAILED.get(fit.reason.kind, ("more starts",))
    yield Finding("bad", Issue("not converged", subjects, figures), steps)


def _find_collapsed(fit: Fit) -> Iterator[Finding]:
    """Yield findings about modes that have collapsed, or are at their minimum duration."""
    steps = {"a mode collapsed": ("more starts", "leave the mode out"), "a mode is short": ("lower min_duration",)}
    found = list(_find_short_modes(fit))
    if fit.status is Status.COLLAPSED and all(issue.kind == "a mode is short" for issue in found):
        found.append(Issue("idle", fit.idle))
    yield from (Finding("doubtful", issue, steps.get(issue.kind, steps["a mode collapsed"])) for issue in found)


def _find_cut_search(fit: Fit, quality: Quality | None) -> Iterator[Finding]:
    """Find a search that its limit of time has ended, unless noise of a known size is all that is left of the data, or
    enough of its starts ended where the fit did.
    """
    is_noise = quality is not None and quality.channels and quality.known and quality.probability >= UNLIKELY
    tried, lower, agreeing = fit.starts or (0, 0, 0)
    is_agreed = lower == 0 and agreeing >= max(2, AGREEING * tried)
    is_cut = bool(fit.status.successful and fit.steps and fit.steps[-1].ended == "time")
    if is_cut and not is_noise and not is_agreed:
        yield Finding("doubtful", Issue("search cut short", (fit.steps[-1].strategy,)), ("more time",))


def _find_others(fit: Fit, certificate: Certificate) -> Iterator[Finding]:
    """Yield what is doubtful of a single fit besides the numbers: unknowns without effect, and checks that failed."""
    if fit.reason is not None and fit.reason.kind == "switch":  # it ended at a jump of J that a function makes
        yield Finding("doubtful", fit.reason, (SWITCH,))
    if not fit.status.successful:
        return
    for issue in find_without_effect(fit):
        yield Finding("doubtful", issue, (NO_EFFECT[issue.kind],))
    for failure in certificate.failures:
        if failure.kind != "integration error":
            yield Finding("doubtful", failure, ("check derivatives",))


def _answer(fit: Fit, quality: Quality | None, against: dict[str, Issue]) -> tuple[Issue, ...]:
    """Return the answers to the three questions."""

    def answer(default: Issue, *kinds: str) -> Issue:
        return next((reason for kind, reason in against.items() if kind in kinds), default)

    figures = _describe_fit(fit, quality)
    who = tuple(dict.fromkeys(step.strategy for step in fit.steps)) or ("local",)
    converged = answer(Issue("converged", figures=figures), "not converged", "undefined", "integration error")
    best = answer(Issue("looked", who, figures), "other starts are better", "few starts agree", "search cut short")
    if quality is None:
        return converged, best
    explained = Issue("fits" if quality.channels else "a minimum", figures=figures)
    doubted = ("unexplained", "little explained", "too few samples", *(f"{name} suspected" for name in SUSPECTED))
    return converged, best, answer(explained, *doubted)


def _describe_fit(fit: Fit, quality: Quality | None) -> dict[str, float]:
    """Return the figures of the sentences about a fit."""
    tried, better, agreeing = map(float, fit.starts or (0, 0, 0))
    figures = {"tried": tried, "better": better, "agreeing": agreeing, "agrees": float(has_looked(fit))}
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
        "correlated": float(worst.tests.get("model", 1.0) * len(quality.channels) < UNLIKELY),
        "narrowing": worst.widening,
    }
