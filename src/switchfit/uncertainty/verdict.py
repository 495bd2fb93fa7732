"""The verdict on a fit: good, doubtful or bad, why, and what to do next, as data; the report makes the sentence of it.

Three questions, each answered by one number with one threshold:

1. Did it converge, on a mesh that is fine enough? The relative integration error of J, `FINE`.
2. Is it the best that was found, and who looked? The number of ends that are lower, 0. Where nothing says what the
   noise is, the share of other starts that ended at the same J too, `AGREEING`.
3. Does the model explain the data? The probability of what is left if it is noise, `UNLIKELY`; where that cannot be
   told, the share of the variance that is explained, `MOSTLY`.

No to the first or second is bad, and so is a model that explains less than it leaves (`HALF`), unless what is left is
noise. What is left and is no noise is doubtful: a wrong end, a wrong model, a wrong sigma and outliers all do that. So
is whatever the data do not determine. A wrong answer that is called good is the worst defect of such a rule, a right
one that is called bad the second.

Warnings about the numbers of a fit, as data; the report writes the sentences.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.fit.result import NAMED, Fit, disagreement, list_without_effect
from switchfit.optimize import Status
from switchfit.problem.reads import name_whole_parameters
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import Printed
from switchfit.uncertainty.certificate import LARGE_INTEGRATION_ERROR, Certificate, analyse_solution, certify
from switchfit.uncertainty.residuals import HALF, NO_RESIDUALS, UNLIKELY, Quality, find_residual_issues, measure_quality

Level = Literal["good", "doubtful", "bad"]
LEVELS: tuple[Level, ...] = ("good", "doubtful", "bad")

FINE = 1e-3
"""Integration error of J, relative, up to which a minimum is that of the data: chi-square is off by less than 1 in a
thousand samples then. Above it, the minimum may be that of the mesh."""

AGREEING = 0.1
"""Share of other starts that end in the same minimum below which it is doubtful that there is no better one, unless
what is left of the data is noise."""

MOSTLY = 0.9
"""Share below which a fit is doubtful where no test tells whether what is left is noise: fewer than 20 values without a
sigma, and fits of many. A tenth of the variance is to be seen in a figure."""

NEARLY_ALL = 0.999
"""Share from which a reference signal is followed, whose noise cannot be told from a misfit, and from which a model
with correlated residuals is no more than slightly wrong: they are 3 % of the signal. Wrong ends of the test bed reach
0.99893 of references and 0.99884 of data; real logs that are fitted rightly and leave no noise have more."""

BARELY_DETERMINED = 1e-6
"""Smallest eigenvalue of the Hessian, scaled to unit curvature, below which a direction is not determined: correlations
of 0.999999 have it."""

VANISHING = 10.0
"""Standard errors of an unknown on a logarithmic scale, in parts of it, above which the data do not tell it from 0."""

UNSEEN = 100.0
"""Factor between the standard errors of the two Hessians above which the Gauss-Newton matrix counts as singular, as for
a transition at which the vector field does not jump, such as a block that comes to rest."""

DIFFERENT = 1.2
"""Factor between the standard errors of the two Hessians, for any combination of the unknowns, above which a warning is
given: a 95 % interval that is too narrow by this factor covers 90 %, one that is too wide 98 %."""

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

WRITTEN_OTHERWISE = {"undefined": DEFINE, "cost corner": "cost as a state"}
"""What to do about a function that kept a fit from converging, by the kind of the reason."""

SWITCH = "transition time"
"""What to do about an unknown with which a function compares, the first of the subjects of this advice."""

OTHER_SIDE = "other side"
"""What to do about transition times that are held by jumps at known times, the subjects of this advice."""

PROFILES = "look at profiles"
"""What to do about transition times that may be elsewhere, the subjects of this advice."""

OF_SUBJECTS = {DEFINE, FIX, SWITCH, OTHER_SIDE, PROFILES, *NO_EFFECT.values()}
"""Advice that is about the subjects of its reason."""


@dataclass(frozen=True)
class Numbers:
    """Numbers about R fits from which they are judged: arrays (R,), or one number where it is that of all of them.

    Attributes
    ----------
    converged : (R,) bool
    error
        Integration error of J, or of a constraint, relative.
    lower, tried, agreeing
        How many other starts ended lower, were tried, and ended at the same J.
    explained
        Share of the variance of the data; NaN without data, or if they do not vary.
    probability
        Of what is left of the data, or of more, if it is noise; NaN where no test tells.
    known : bool
        Whether the size of the noise is known: sigma is, and is not far too large.
    freedom
        Values less unknowns; infinite where residuals are of no use.
    collapsed, at_bounds : int
        How many modes have collapsed, and how many unknowns are at bounds.
    smallest
        Smallest eigenvalue of the scaled Hessian; infinite if nothing is free.
    references : bool
        Whether there are reference signals among the data.
    """

    converged: NDArray[np.bool_]
    error: Any = 0.0
    lower: Any = 0
    tried: Any = 0
    agreeing: Any = 0
    explained: Any = np.nan
    probability: Any = np.nan
    known: Any = False
    freedom: Any = np.inf
    collapsed: Any = 0
    at_bounds: Any = 0
    smallest: Any = np.inf
    references: bool = False


class Doubt(NamedTuple):
    """One thing that speaks against some of R fits.

    Attributes
    ----------
    kind : str
        As of the reasons of a verdict.
    level : {"doubtful", "bad"}
    which : (R,) bool
    """

    kind: str
    level: Level
    which: NDArray[np.bool_]


def find_doubts(fits: Numbers) -> list[Doubt]:
    """Return what speaks against fits, in order of weight.

    Parameters
    ----------
    fits : Numbers
    """
    found = [doubt for doubt in _list_doubts(fits) if doubt.which.any()]
    return sorted(found, key=lambda doubt: -LEVELS.index(doubt.level))  # stable


def _list_doubts(fits: Numbers) -> Iterator[Doubt]:
    ended = fits.converged
    explained, probability, known = np.broadcast_arrays(fits.explained, fits.probability, fits.known, ended)[:3]
    tested, noise = ~np.isnan(probability), probability >= UNLIKELY
    share = np.where(tested & np.isnan(explained), noise, explained)  # of data that are 0 throughout
    exact = 1 - share < NO_RESIDUALS
    noise = noise | exact
    few = ended & (fits.freedom <= 0)
    judged = ended & ~few
    yield Doubt("not converged", "bad", ~ended)
    yield Doubt("integration error", "bad", ended & np.logical_not(fits.error <= FINE))
    yield Doubt("other starts are better", "bad", (fits.lower > 0) & ~exact)  # nothing is better than 0
    confirmed = noise & (known | exact | ((fits.agreeing >= 2) & (share >= NEARLY_ALL)))
    lonely = (fits.lower == 0) & (fits.agreeing < AGREEING * fits.tried)
    yield Doubt("few starts agree", "doubtful", lonely & ~confirmed)
    unexplained = judged & (share < HALF) & ~noise
    no_noise = judged & (share >= HALF) & tested & ~noise
    wanted = np.where(noise, HALF, MOSTLY) if not fits.references else NEARLY_ALL
    little = judged & (share < wanted) & ~known & ~unexplained & ~no_noise
    yield Doubt("unexplained", "bad", unexplained)
    yield Doubt("no noise", "doubtful", no_noise)
    yield Doubt("little explained", "doubtful", little)
    yield Doubt("too few samples", "doubtful", few)
    yield Doubt("a mode collapsed", "doubtful", ended & (fits.collapsed > 0))
    yield Doubt("at bounds", "doubtful", ended & (fits.at_bounds > 0))
    yield Doubt("not determined", "doubtful", ended & (fits.smallest < BARELY_DETERMINED))


def find_levels(doubts: list[Doubt], count: int) -> NDArray[np.str_]:
    """Return "good", "doubtful" or "bad" for each of so many fits: (R,).

    Parameters
    ----------
    doubts : list of Doubt
    count : int
    """
    places = np.zeros(count, dtype=int)
    for doubt in doubts:
        places[doubt.which] = np.maximum(places[doubt.which], LEVELS.index(doubt.level))
    return np.array(LEVELS)[places]


def find_issues(fit: Fit) -> Iterator[Issue]:
    """Yield the warnings about a fit, in the order of the report.

    Parameters
    ----------
    fit : Fit
    """
    yield from _find_short_modes(fit)
    yield from _find_bounds(fit)
    yield from _find_jumps(fit)
    is_time = dict(zip(fit.theta_names, fit.is_time.tolist(), strict=True))
    for kind, wanted in (("idle times", True), ("idle parameters", False)):
        if names := tuple(name for name in fit.idle if is_time[name] is wanted):
            yield Issue(kind, names)
    yield from _find_kinks(fit)
    yield from find_without_effect(fit)
    smallest, names = _find_weakest(fit)
    if abs(smallest) < BARELY_DETERMINED:
        yield Issue("not determined", names, {"eigenvalue": smallest})
    yield from _find_missing_errors(fit, smallest)
    if fit.status.successful:
        yield from find_residual_issues(fit)
        yield from _compare_covariances(fit)
    if not fit.integration_error <= LARGE_INTEGRATION_ERROR:
        yield Issue("large integration error", (fit.integration_error_of,), {"error": fit.integration_error})


def _find_short_modes(fit: Fit) -> Iterator[Issue]:
    """Find modes that have collapsed, or are at their minimum duration."""
    for constraint in fit.active:
        if constraint.position is not None:
            kind = "a mode collapsed" if constraint.kind == "collapsed" else "a mode is short"
            yield Issue(kind, (constraint.mode, constraint.run), {"position": float(constraint.position)})


def _find_bounds(fit: Fit) -> Iterator[Issue]:
    """Find unknowns that bounds hold which the user gave; equal bounds are a value that is known."""
    known = {*fit.idle, *np.array(fit.theta_names)[fit.lower == fit.upper].tolist()}
    for constraint in fit.active:
        if constraint.kind in ("lower bound", "upper bound") and constraint.unknown not in known:
            yield Issue(constraint.kind, (constraint.unknown,), {"value": constraint.value})


def _find_jumps(fit: Fit) -> Iterator[Issue]:
    """Find transition times that are held by jumps at known times."""
    held = [each for each in fit.active if each.kind == "known jump" and each.unknown not in fit.idle]
    if held:
        places = tuple(each.value for each in held)
        yield Issue("at known jumps", tuple(each.unknown for each in held), {"at": places})


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


def _find_weakest(fit: Fit) -> tuple[float, tuple[str, ...]]:
    """Return the smallest eigenvalue of the scaled Hessian of the free unknowns with an effect, infinite if there are
    none, and the unknowns with the largest components in its direction.
    """
    found = analyse_solution(fit, None)
    if flat := tuple(name for name in found.without if name not in list_without_effect(fit)):  # transition times
        return 0.0, flat[:NAMED]
    return (float(found.eigenvalues[0]), found.directions[0].names[:NAMED]) if found.directions else (np.inf, ())


def _find_missing_errors(fit: Fit, smallest: float) -> Iterator[Issue]:
    """Find the reason why a fit has no standard errors; `smallest`: of the eigenvalues of its scaled Hessian."""
    missing = ~np.isfinite(fit.standard_errors) & ~np.isin(fit.theta_names, list_without_effect(fit))
    if not missing.any() or not np.isfinite(fit.hessian).all():
        return
    if fit.sigma_known is None:
        if any(fit.comparisons):  # a cost of the trajectory alone never has standard errors
            yield Issue("no errors: no noise model")
    elif fit.sigma_known or fit.freedom > 0:  # with too few samples the verdict says so
        names = () if missing.all() else tuple(np.array(fit.theta_names, dtype=object)[missing].tolist())
        yield Issue("no errors: not positive definite", names, {"eigenvalue": smallest})


def _compare_covariances(fit: Fit) -> Iterator[Issue]:
    """Test whether the exact Hessian and the Gauss-Newton matrix give different standard errors."""
    found = disagreement(fit)
    if found is not None and found.factor > DIFFERENT:
        kind = "known to second order" if found.factor > UNSEEN else "covariances differ"
        figures = {"factor": found.factor, "exact": found.exact, "Gauss-Newton": found.gauss_newton}
        yield Issue(kind, (found.name,), figures)


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
    found = [Finding("doubtful", issue, (OTHER_SIDE,)) for issue in _find_jumps(fit)]  # which may be all that is wrong
    found += [f for doubt in find_doubts(_list_numbers(fit, quality)) for f in _explain(fit, quality, doubt)]
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
    if fit.reason is not None and fit.reason.kind in WRITTEN_OTHERWISE:
        yield Finding("bad", fit.reason, (WRITTEN_OTHERWISE[fit.reason.kind],))
        steps = ()
    elif fit.status is Status.LINE_SEARCH_FAILED and fit.reason is not None:
        subjects = (*subjects, fit.reason.kind, *fit.reason.subjects)
        figures |= fit.reason.figures
        steps = SEARCH_FAILED.get(fit.reason.kind, ("more starts",))
    smallest, names = _find_weakest(fit)
    if fit.status is Status.MAX_ITERATIONS and abs(smallest) < BARELY_DETERMINED:  # it creeps along a valley
        yield Finding("bad", Issue("not converged", subjects, figures))
        yield Finding("doubtful", Issue("not determined", names, {"eigenvalue": smallest}), (FIX, *steps[:1]))
    else:
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
    if fit.rivals:
        names, places, rises = zip(*fit.rivals, strict=True)
        yield Finding("doubtful", Issue("rivals", names, {"at": places, "rise": rises}), (PROFILES,))
    for issue in find_without_effect(fit):
        yield Finding("doubtful", issue, (NO_EFFECT[issue.kind],))
    vanishing = np.isin(fit.theta_names, fit.log_scaled) & ~fit.is_time & (fit.standard_errors > VANISHING * fit.theta)
    if vanishing.any():
        names = tuple(np.array(fit.theta_names, dtype=object)[vanishing].tolist())
        yield Finding("doubtful", Issue("vanishing", names), ("linear scale",))
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
    agrees = has_looked(fit) and not any(_find_jumps(fit))  # no search looks beyond a known jump
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
        "correlated": float(worst.tests.get("model", 1.0) * len(quality.channels) < UNLIKELY),
        "narrowing": worst.widening,
    }
