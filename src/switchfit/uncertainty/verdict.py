"""The verdict on a fit: good, doubtful or bad, why, and what to do next, as data; the report writes the line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from switchfit.fit.result import Fit
from switchfit.optimize import Status
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import Printed
from switchfit.uncertainty.advice import ADVICE_BY_SUSPECT, OF_SUBJECTS, OTHER_SIDE
from switchfit.uncertainty.certificate import Certificate, certify
from switchfit.uncertainty.doubts import VERDICT_LEVELS, Level, Numbers, find_doubts
from switchfit.uncertainty.explained_variance import NO_RESIDUALS
from switchfit.uncertainty.findings import (
    Finding,
    describe_fit,
    explain_doubt,
    find_cut_search,
    find_other_doubts,
    has_looked,
)
from switchfit.uncertainty.issues import (
    find_active_bounds,
    find_kinks,
    find_times_at_jumps,
    find_weakest,
    list_without_effect,
)
from switchfit.uncertainty.quality import Quality, measure_quality


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


def judge(fit: Fit, certificate: Certificate | None = None) -> Verdict:
    """Return the verdict on a fit.

    Parameters
    ----------
    fit : Fit
    certificate : Certificate, optional
        If left out, the checks that do not need the model are made.
    """
    quality = measure_quality(fit) if fit.status.successful and np.isfinite(fit.cost) else None
    found = [
        Finding("doubtful", issue, (OTHER_SIDE,)) for issue in find_times_at_jumps(fit)
    ]  # which may be all that is wrong
    found += [f for doubt in find_doubts(_list_numbers(fit, quality)) for f in explain_doubt(fit, quality, doubt)]
    found += find_cut_search(fit, quality)
    found += find_other_doubts(fit, certify(fit, None) if certificate is None else certificate)
    answers = _answer(fit, quality, {f.reason.kind: f.reason for f in found})
    if not found:
        return Verdict("good", (answers[-1], *find_kinks(fit)), answers=answers)
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
    ranked = sorted(found, key=lambda f: -VERDICT_LEVELS.index(f.level))  # stable
    steps = dict.fromkeys(step for f in ranked for step in f.steps)
    subjects = {step: f.reason.subjects for f in ranked for step in f.steps if step in OF_SUBJECTS}
    advised = tuple(Issue(f"next: {step}", subjects.get(step, ())) for step in steps)
    return Verdict(ranked[0].level, tuple(f.reason for f in ranked), advised, answers)


def _list_numbers(fit: Fit, quality: Quality | None) -> Numbers:
    """Return the numbers by which a fit is judged, of one fit."""
    tried, lower, agreeing = fit.starts or (0, 0, 0)
    ended = Numbers(np.array([fit.status.successful]), fit.integration_error, lower, tried, agreeing)
    if quality is None:
        return ended
    # An unknown without effect makes the Hessian singular too, but has a finding of its own.
    is_flat = fit.status is Status.SINGULAR and not list_without_effect(fit)
    found = replace(
        ended,
        collapsed=fit.status is Status.COLLAPSED or any(c.position is not None for c in fit.active),
        at_bounds=len(list(find_active_bounds(fit))) if any(fit.comparisons) else 0,
        smallest=0.0 if is_flat else find_weakest(fit)[0],
    )
    # A cost without data: no share is explained, and integration error was judged with `ended`.
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


def _answer(fit: Fit, quality: Quality | None, against: dict[str, Issue]) -> tuple[Issue, ...]:
    """Return the answers to the three questions."""

    def answer(default: Issue, *kinds: str) -> Issue:
        return next((reason for kind, reason in against.items() if kind in kinds), default)

    figures = describe_fit(fit, quality)
    who = tuple(dict.fromkeys(step.strategy for step in fit.steps)) or ("local",)
    converged = answer(Issue("converged", figures=figures), "not converged", "undefined", "integration error")
    best = answer(Issue("looked", who, figures), "other starts are better", "few starts agree", "search cut short")
    if quality is None:
        return converged, best
    explained = Issue("fits" if quality.channels else "a minimum", figures=figures)
    doubted = (
        "unexplained",
        "little explained",
        "too few samples",
        *(f"{name} suspected" for name in ADVICE_BY_SUSPECT),
    )
    return converged, best, answer(explained, *doubted)
