"""The verdict on a fit: good, doubtful or bad, why, and what to do next, as data; the report makes the sentence of it.

A wrong answer that is called good is the worst defect of such a rule, a right one that is called bad the second. What
tells a wrong end from a right one is whether the residuals look like noise *and* how much of the data is explained:

- sigma known: chi-square says whether the residuals are noise. If it says no but nearly everything is explained, the
  model is slightly wrong at high precision, as with most real logs: doubtful. If much is left, bad.
- sigma unknown: correlated residuals take the place of chi-square. Uncorrelated ones are noise, however large.
- reference signals: the share that is explained decides alone; noise in them cannot be told from a misfit.
- costs without data (switching-time optimisation) have no quality of fit: what is judged is the minimum.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from switchfit.fit.result import Fit, free_curvature, list_without_effect
from switchfit.optimize import Status
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import format_text
from switchfit.uncertainty.certificate import LARGE_INTEGRATION_ERROR, Certificate, certify
from switchfit.uncertainty.issues import BARELY_DETERMINED, find_without_effect
from switchfit.uncertainty.quality import MOST_OUTLIERS, ChannelQuality, Quality, measure_quality

Level = Literal["good", "doubtful", "bad"]
LEVELS: tuple[Level, ...] = ("good", "doubtful", "bad")

UNLIKELY = 1e-3
"""Probability of chi-square below which the residuals are not the noise that sigma says: one false alarm in a thousand
fits. Shared among the channels where each is tested by itself."""

CLEARLY_OFF = 0.1
"""How far the reduced chi-square must be from 1 as well: with 10,000 samples chi-square rejects a sigma that is 2 %
off, which no instrument is known to."""

WHITE = 0.05
"""Probability of the residuals' correlation above which they count as noise of another size: then it is sigma that is
wrong and not the model."""

EXPLAINED = 0.99
"""Share of a channel's variance that must be explained where sigma is known and chi-square too large: below it what
is left is a tenth of the signal, which is to be seen in a figure."""

EXPLAINED_UNKNOWN = 0.95
"""The same where sigma is unknown and the residuals are correlated: there is no noise level to compare with, and right
fits to real logs have been seen down to 0.96."""

NEARLY_ALL = 0.999
"""Share from which a model is no more than slightly wrong, whatever else is said against it: residuals of 3 % of the
signal. Below it, a collapsed mode or residuals of ten sigma beside a chi-square that is too large make a fit bad."""

FAR_OFF = 100.0
"""Reduced chi-square of residuals of ten sigma. Real logs with a model that is slightly wrong have 2 to 50."""

REFERENCE_LOST = 0.98
"""Share of all reference signals below which a fit is bad. Noise in a reference stays in it: right ends of the paper's
vehicle keep 0.999 with noise of 0.3 m, wrong ends have 0.84 to 0.991."""

REFERENCE_FOLLOWED = 0.995
"""The same below which it is doubtful."""

REFERENCE_CHANNEL = 0.95
"""Share of a single channel of a reference below which a fit is doubtful; no more than that, since it may be noise."""

HALF = 0.5
"""Share of all data below which a fit is doubtful even where what is left looks like noise: it says more of the
unknowns than of the data. Bad where there are too few samples to tell whether it is noise."""

MOSTLY = 0.9
"""Share of all data below which a fit to fewer samples than the tests of residuals need is doubtful."""

NO_RESIDUALS = 1e-10
"""Unexplained share of the variance that is rounding and tolerance: nothing is read from residuals of that size."""

WRONG_INTEGRATION = 1e-2
"""Integration error from which a fit is bad: the minimum may be that of the discretisation."""

AGREEING = 0.1
"""Share of other starts that end in the same minimum below which it is doubtful that there is no better one, unless
what is left of the data is noise: by chi-square, or by white residuals where sigma is unknown."""


@dataclass(frozen=True)
class Verdict:
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
    >>> print(fit.verdict)
    Good: the model explains 99.85 % of the variance (chi² 12.1 for 22 degrees of freedom).
    """

    level: Level
    reasons: tuple[Issue, ...]
    next_steps: tuple[Issue, ...] = ()

    def __str__(self) -> str:
        return format_text(self)


class Finding(NamedTuple):
    """One reason to doubt a fit, the level that follows from it, and what to do about it."""

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
    fitting = [] if quality is None else list(_judge_quality(fit, quality))
    collapsed = list(_find_collapsed(fit))
    if collapsed and quality is not None and _find_worst_share(quality.channels) < NEARLY_ALL:
        fitting = [_raise_to_bad(f) if f.reason.kind in MISFITS else f for f in fitting]
    if any(f.level == "bad" for f in fitting):
        collapsed = [f._replace(level="bad") for f in collapsed]
    correlated = [f for f in fitting if f.reason.kind == "correlated residuals"]
    found = [*_find_ending(fit), *(f for f in fitting if f not in correlated), *collapsed]
    # There is no better minimum than 0, and the integration error is all of a cost that is rounding.
    exact = quality is not None and 1 - quality.explained < NO_RESIDUALS
    if not exact:
        found += _judge_starts(fit, None if fitting else quality)
    if quality is not None:
        found += _find_undetermined(fit)
        found += _find_bounds(fit)
        found += [] if exact and fit.integration_error_of == "J" else _check_integration(fit)
        found += _check_certificate(certify(fit, None) if certificate is None else certificate)
        found += correlated
    found.sort(key=lambda f: -LEVELS.index(f.level))  # stable: in the order of weight on each level
    if not found:
        return Verdict("good", tuple(_list_merits(fit, quality)))
    steps = dict.fromkeys(step for f in found for step in f.steps)
    if fit.starts is not None and fit.starts[1] == 0:  # other starts were tried: they are no remedy any more
        steps.pop("more starts", None)
    subjects = {step: f.reason.subjects for f in found for step in f.steps if step in OF_SUBJECTS}
    advised = tuple(Issue(f"next: {step}", subjects.get(step, ())) for step in steps)
    return Verdict(found[0].level, tuple(f.reason for f in found), advised)


ELSEWHERE = ("more starts", "look at the residuals")
"""What to do about a model that does not fit: the minimum may be a local one, or the model wrong."""

CORRECTED = ("corrected errors", "look at the residuals")
"""What to do about correlated residuals of the right minimum."""

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

SEARCH_FAILED = {
    "switch": (),
    "wrong slope": ("check derivatives", "more starts"),
    "rounding": ("larger tolerance",),
}
"""What to do about a line search that failed, by the reason; otherwise more starts. About a switch: see `SWITCH`."""

DEFINE = "define it there"
"""What to do about an operation of a function that is not defined, or has no derivative, at a point."""

SWITCH = "transition time"
"""What to do about an unknown with which a function compares, the first of the subjects of this advice."""

OF_SUBJECTS = {DEFINE, FIX, SWITCH, *NO_EFFECT.values()}
"""Advice that is about the subjects of its reason."""

MISFITS = ("unexplained", "mostly outliers", "large residuals", "slightly wrong", "reference not followed")
"""Kinds of reasons that say that the model does not fit, other than by the size of the noise."""


def _find_ending(fit: Fit) -> Iterator[Finding]:
    """Yield findings if the fit did not converge, or ended at a jump of J that a function makes."""
    if fit.reason is not None and fit.reason.kind == "switch":
        yield Finding("doubtful", fit.reason, (SWITCH,))
    if fit.status.successful:
        return
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


def _judge_quality(fit: Fit, quality: Quality) -> Iterator[Finding]:
    """Judge how well the fit explains its data."""
    if not quality.channels:
        return
    references = tuple(c for c in quality.channels if c.kind == "reference")
    samples = tuple(c for c in quality.channels if c.kind != "reference")
    if references:
        yield from _judge_reference(quality, references)
    if not samples:
        return
    if fit.freedom <= 0 and fit.sigma_known is not None:
        figures = {"samples": float(fit.samples), "unknowns": float(fit.free_basis.shape[1])}
        yield Finding("doubtful", Issue("too few samples", figures=figures), ("more data",))
        return
    lost = max(samples, key=lambda c: c.outliers)
    if lost.outliers > MOST_OUTLIERS:
        reason = Issue("mostly outliers", (lost.label,), {"share": lost.outliers})
        yield Finding("bad", reason, ELSEWHERE)
        return
    if fit.sigma_known:
        yield from _judge_typical(quality, samples)
    too_small = quality.has_chi_square and quality.probability_below < UNLIKELY and quality.ratio < 1 - CLEARLY_OFF
    if quality.has_chi_square and not too_small:
        yield from _judge_chi_square(quality, samples)
    else:
        yield from _judge_residuals(quality, samples, sigma_too_large=too_small)


def _judge_chi_square(quality: Quality, samples: tuple[ChannelQuality, ...]) -> Iterator[Finding]:
    """Judge a fit by chi-square, of all data and of each channel."""
    large = quality.probability < UNLIKELY and quality.ratio > 1 + CLEARLY_OFF
    shared = UNLIKELY / len(samples)
    poor = [c for c in samples if c.probability < shared and c.chi_square > (1 + CLEARLY_OFF) * c.count]
    if not large and not poor:
        yield from _find_correlation(quality)
        return
    suspects = tuple(poor) or samples
    worst = min(suspects, key=lambda c: _zero_if_nan(c.explained))
    share = _zero_if_nan(worst.explained)
    ratio = max([quality.ratio, *(c.chi_square / c.count for c in poor)])
    figures = _describe_fit(quality) | {"worst": share}
    if all(c.whiteness > WHITE for c in suspects) and ratio < FAR_OFF:
        yield Finding("doubtful", Issue("sigma too small", (worst.label,), figures), ("check sigma", "more starts"))
    elif share < EXPLAINED or (share < NEARLY_ALL and ratio > FAR_OFF):
        yield Finding("bad", Issue("unexplained", (worst.label,), figures), ELSEWHERE)
    else:
        steps = ("look at the residuals", "more starts")
        yield Finding("doubtful", Issue("slightly wrong", (worst.label,), figures), steps)
        yield from _find_correlation(quality)


def _judge_residuals(
    quality: Quality, samples: tuple[ChannelQuality, ...], *, sigma_too_large: bool
) -> Iterator[Finding]:
    """Judge a fit whose sigma is unknown, or far too large, by the correlation of its residuals."""
    correlated = [c for c in samples if c.correlated and 1 - c.explained >= NO_RESIDUALS]
    if correlated:
        worst = min(correlated, key=lambda c: c.explained)
        figures = _describe_fit(quality) | {"worst": worst.explained}
        if worst.explained < EXPLAINED_UNKNOWN:
            yield Finding("bad", Issue("unexplained", (worst.label,), figures), ELSEWHERE)
        elif not sigma_too_large:
            # Wrong ends explain up to 99.8 %, too, and leave correlated residuals: below `NEARLY_ALL` of all data the
            # minimum is in doubt, not only the standard errors.
            steps = CORRECTED if quality.explained >= NEARLY_ALL else ("more starts", *CORRECTED)
            yield from (f._replace(steps=steps) for f in _find_correlation(quality))
        return
    if sigma_too_large:
        return
    untested = all(np.isnan(c.whiteness) for c in samples)
    figures = _describe_fit(quality) | {"worst": quality.explained}
    if untested and quality.explained < HALF:
        yield Finding("bad", Issue("unexplained", (), figures), ELSEWHERE)
    elif quality.explained < (MOSTLY if untested else HALF):
        yield Finding("doubtful", Issue("little explained", (), figures), ("more starts", "more data"))


def _judge_typical(quality: Quality, samples: tuple[ChannelQuality, ...]) -> Iterator[Finding]:
    """Judge a fit with a robust loss, which has no chi-square, by the size of its typical residuals."""
    robust = [c for c in samples if np.isfinite(c.typical)]
    if quality.are_residuals_large or any(c.are_residuals_large for c in robust):
        worst = max(robust, key=lambda c: c.typical)
        figures = _describe_fit(quality) | {"worst": worst.explained, "typical": worst.typical}
        yield Finding("doubtful", Issue("large residuals", (worst.label,), figures), (*ELSEWHERE, "check sigma"))


def _judge_reference(quality: Quality, references: tuple[ChannelQuality, ...]) -> Iterator[Finding]:
    """Judge how well reference signals are followed."""
    varying = [c for c in references if np.isfinite(c.explained)]
    if not varying:
        return
    worst = min(varying, key=lambda c: c.explained)
    if quality.explained < REFERENCE_FOLLOWED or worst.explained < REFERENCE_CHANNEL:
        level: Level = "bad" if quality.explained < REFERENCE_LOST else "doubtful"
        figures = _describe_fit(quality) | {"worst": worst.explained}
        yield Finding(level, Issue("reference not followed", (worst.label,), figures), ELSEWHERE)


def _find_correlation(quality: Quality) -> Iterator[Finding]:
    """Find residuals whose correlation makes the standard errors too small."""
    for issue in quality.residuals.issues:
        negligible = 1 - quality.explained < NO_RESIDUALS
        if issue.kind == "correlated residuals" and not negligible:
            yield Finding("doubtful", issue, CORRECTED)


def _raise_to_bad(finding: Finding) -> Finding:
    """Return a misfit with the level "bad", which it has if a mode has collapsed as well."""
    reason = finding.reason
    kind = "unexplained" if reason.kind == "slightly wrong" else reason.kind
    return Finding("bad", Issue(kind, reason.subjects, reason.figures), ELSEWHERE)


def _find_collapsed(fit: Fit) -> Iterator[Finding]:
    """Find modes that have collapsed, or are at their minimum duration."""
    collapsed = False
    for constraint in fit.active:
        if constraint.position is None:
            continue
        figures = {"position": float(constraint.position)}
        if constraint.kind == "collapsed":
            collapsed = True
            reason = Issue("a mode collapsed", (constraint.mode, constraint.run), figures)
            yield Finding("doubtful", reason, ("more starts", "leave the mode out"))
        else:
            reason = Issue("a mode is short", (constraint.mode, constraint.run), figures)
            yield Finding("doubtful", reason, ("lower min_duration",))
    if fit.status is Status.COLLAPSED and not collapsed:
        yield Finding("doubtful", Issue("idle", fit.idle), ("more starts", "leave the mode out"))


def _judge_starts(fit: Fit, quality: Quality | None) -> Iterator[Finding]:
    """Yield a finding if other starts ended lower, or few in the same minimum.

    `quality` is that of a fit that explains its data; None if it does not.
    """
    if fit.starts is None:
        return
    tried, better, agreeing = fit.starts
    figures = {"tried": float(tried), "better": float(better), "agreeing": float(agreeing)}
    if better > 0:
        yield Finding("bad", Issue("other starts are better", figures=figures), ("more starts",))
    elif tried > 0 and agreeing < AGREEING * tried and not (quality and _is_noise(quality, agreeing)):
        yield Finding("doubtful", Issue("few starts agree", figures=figures), ("more starts",))


def _find_undetermined(fit: Fit) -> Iterator[Finding]:
    """Yield findings if J does not depend on an unknown, or the data hardly determine a direction of the others."""
    without = list_without_effect(fit)
    for issue in find_without_effect(fit):
        yield Finding("doubtful", issue, (NO_EFFECT[issue.kind],))
    curvature = free_curvature(fit, without)
    smallest = float(curvature.scaled[0]) if len(curvature.scaled) else np.inf
    if (fit.status is Status.SINGULAR and not without) or smallest < BARELY_DETERMINED:
        names = curvature.weakest or tuple(name for name, _ in fit.flat_direction)
        reason = Issue("not determined", names, {"eigenvalue": smallest})
        yield Finding("doubtful", reason, (FIX,))


def _find_bounds(fit: Fit) -> Iterator[Finding]:
    """Find unknowns at bounds that the user gave. A cost without data may have its minimum there."""
    names = [c.unknown for c in fit.active if c.position is None and c.unknown not in fit.idle]
    if names and any(fit.comparisons):
        yield Finding("doubtful", Issue("at bounds", tuple(names)), ("move the bound",))


def _check_integration(fit: Fit) -> Iterator[Finding]:
    """Yield a finding if the integration error is too large."""
    error = fit.integration_error
    if not error <= LARGE_INTEGRATION_ERROR:
        level: Level = "doubtful" if error <= WRONG_INTEGRATION else "bad"
        reason = Issue("integration error", (fit.integration_error_of,), {"error": error})
        yield Finding(level, reason, ("smaller rtol",))


def _check_certificate(certificate: Certificate) -> Iterator[Finding]:
    """Find checks that failed; the integration error is judged by its size."""
    for failure in certificate.failures:
        if failure.kind != "integration error":
            yield Finding("doubtful", failure, ("check derivatives",))


def _list_merits(fit: Fit, quality: Quality | None) -> Iterator[Issue]:
    """Yield the reasons for a good verdict."""
    if quality is not None and quality.channels:
        yield Issue("fits", figures=_describe_fit(quality))
    else:
        yield Issue("a minimum", figures={"optimality": fit.optimality})
    if fit.starts is not None and fit.starts[0] > 0:
        tried, better, agreeing = map(float, fit.starts)
        yield Issue("starts agree", figures={"tried": tried, "better": better, "agreeing": agreeing})
    if fit.kinks:
        yield Issue("at kinks", tuple(kink.unknown for kink in fit.kinks))


def _describe_fit(quality: Quality) -> dict[str, float | tuple[float, ...]]:
    """Return the figures of a sentence about how well the data are explained."""
    return {
        "explained": quality.explained,
        "chi-square": quality.chi_square,
        "freedom": float(quality.freedom),
        "probability": quality.probability,
    }


def _is_noise(quality: Quality, agreeing: int) -> bool:
    """Return whether what is left of the data is noise: sigma says so, or, where it is unknown, the residuals are white
    and small, and a start at least has ended there as well: a minimum beside the best has been seen to leave white
    residuals half as large again.
    """
    if quality.has_chi_square:
        return True
    if agreeing < 2:
        return False
    samples = [c for c in quality.channels if c.kind == "measurements"]
    return bool(samples) and all(c.whiteness > WHITE and _zero_if_nan(c.explained) > EXPLAINED for c in samples)


def _find_worst_share(channels: tuple[ChannelQuality, ...]) -> float:
    """Return the smallest share that is explained of a channel; 1 without channels that vary."""
    return min((c.explained for c in channels if np.isfinite(c.explained)), default=1.0)


def _zero_if_nan(explained: float) -> float:
    """Return an explained share; 0 for a channel that is 0 throughout."""
    return 0.0 if np.isnan(explained) else explained
