"""Sentences for what results are made of: constraints, kinks, issues, odd things in logs, how a fit ended, verdicts.

Most are templates: text with fields for names and numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from string import Formatter
from typing import Any

import numpy as np

from switchfit.fit.result import Kink, Termination
from switchfit.optimize import Status
from switchfit.problem.inspection import name_whole_parameters
from switchfit.problem.unknowns import Constraint
from switchfit.runtime.errors import Issue
from switchfit.runtime.presentation import format_count, format_text, join_first
from switchfit.uncertainty.residuals import NO_RESIDUALS, UNLIKELY
from switchfit.uncertainty.verdict import LEVELS, NEARLY_ALL, WRITTEN_OTHERWISE, Verdict

ALLOWED = "Standard errors allow for the correlation of the residuals."
"""Below a table whose standard errors are corrected."""


# --- templates --------------------------------------------------------------------------------------------------------

Sentence = str | Callable[[Issue], str]
"""A template, whose fields are subjects by their number, words, and figures by their name; or a function."""


def write_sentence(sentence: Sentence, issue: Issue) -> str:
    """Return the sentence on an issue.

    Parameters
    ----------
    sentence : str or callable
    issue : Issue
    """
    if callable(sentence):
        return sentence(issue)
    names = [name for _, name, *_ in Formatter().parse(sentence) if name and not name.isdigit()]
    fields = {name: _WORDS[name](issue) if name in _WORDS else get_figure(issue, name) for name in names}
    return sentence.format(*issue.subjects, **fields)


def get_figure(issue: Issue, name: str) -> float:
    """Return a figure that is one number; NaN if the issue lacks it.

    Parameters
    ----------
    issue : Issue
    name : str
    """
    value = issue.figures.get(name, np.nan)
    return np.nan if isinstance(value, tuple) else value


def list_figures(issue: Issue, name: str) -> tuple[float, ...]:
    """Return a figure that may be several numbers; nothing if the issue lacks it.

    Parameters
    ----------
    issue : Issue
    name : str
    """
    value = issue.figures.get(name, ())
    return value if isinstance(value, tuple) else (value,)


def list_each(issue: Issue, template: str, *names: str, first: int = 0) -> str:
    """Return subjects of an issue, each with its figures, such as "mu = 0.3, tau_1 = 2".

    Parameters
    ----------
    issue : Issue
    template : str
        With a field for the subject, and one for each figure.
    names : str
        Of the figures.
    first : int, optional
        Of the subjects.
    """
    each = zip(issue.subjects[first:], *(list_figures(issue, name) for name in names), strict=False)
    return join_first([template.format(*entries) for entries in each])


def join_words(words: Sequence[str]) -> str:
    """Return "a", "a and b", or "a, b and c"."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def capitalise(text: str) -> str:
    """Return a text with a capital letter at its beginning."""
    return text[:1].upper() + text[1:]


# --- constraints, kinks -----------------------------------------------------------------------------------------------


@format_text.register(Constraint)
def write_constraint(constraint: Constraint) -> str:
    """Return which constraint is active."""
    if constraint.kind == "known jump":
        return f"{constraint.unknown} at the known jump at {constraint.value:g}"
    if constraint.position is None:
        return f"{constraint.unknown} at its {constraint.kind} {constraint.value:g}"
    state = "has collapsed to nothing" if constraint.kind == "collapsed" else "is at its minimum duration"
    run = f" of {constraint.run}" if constraint.run else ""
    return f"mode {constraint.position + 1} ({constraint.mode!r}){run} {state}"


@format_text.register(Kink)
def write_kink(kink: Kink) -> str:
    """Return which unknown is at a kink, and the derivatives on both sides."""
    return f"{kink.unknown} = {kink.value:.10g}, where the derivative jumps from {kink.left:.1e} to {kink.right:.1e}"


# --- how a fit ended --------------------------------------------------------------------------------------------------


@format_text.register(Termination)
def write_termination(ended: Termination) -> str:
    """Return how a fit ended, with its numbers, what to do next, and the active constraints."""
    active = f" Active: {'; '.join(map(str, ended.active))}." if ended.active else ""
    flat = {name for name, _ in ended.flat_direction}
    only_unread = ended.status is Status.SINGULAR and flat and flat <= {*ended.unread, *ended.absent}
    template = _ENDINGS["only unread" if only_unread else ended.status]
    if "{reason}" not in template and ended.reason is not None and ended.reason.kind in WRITTEN_OTHERWISE:
        template += "{reason}"
    return template.format(**vars(ended) | _describe_ending(ended)) + active


def _describe_ending(ended: Termination) -> dict[str, str]:
    """Return the fields of the sentences that are no numbers."""
    earlier = ended.earlier_iterations
    unknown = "Start elsewhere, or check the model there." if ended.status is Status.NONFINITE_START else ""
    return {
        "iterations": format_count(ended.iterations, "iteration"),
        "earlier": f", {earlier} of them before the mesh was refined," if earlier else "",
        "kinks": ", ".join(map(str, ended.kinks)),
        "unread": describe_unread(ended.unread, ended.absent),
        "direction": " ".join(f"{part:+.2g} {name}" for name, part in ended.flat_direction) or "no direction",
        "idle": ", ".join(ended.idle),
        "violated": "; ".join(f"{name} = {value:.2e}" for name, value in ended.violated),
        "reason": f" {ended.reason or unknown}".rstrip(),
    }


def describe_unread(unread: Sequence[str], absent: Sequence[str]) -> str:
    """Return which parameters no function reads that acts, and what to do, as parts of a sentence.

    Parameters
    ----------
    unread, absent : sequence of str
        As of `Fit`.
    """
    reasons = (("not read", unread, "remove or use"), ("acts elsewhere", absent, "fix or let it act"))
    issues = [(Issue(kind, name_whole_parameters(names)), step) for kind, names, step in reasons if names]
    return "; ".join(f"{write_reason(issue)}: {write_step(Issue(step, issue.subjects))}" for issue, step in issues)


_ENDINGS: dict[Status | str, str] = {
    "only unread": "Converged (optimality {optimality:.1e}), but {unread}.",
    Status.CONVERGED: "Converged: the optimality {optimality:.1e} is below the tolerance {tolerance:.1e}.",
    Status.CONVERGED_PRECISION: "Converged to the precision of the cost {cost:.6e}: the optimality {optimality:.1e} is "
    "above the tolerance {tolerance:.1e}, but the decrease still predicted is below the error of the cost, or would "
    "move no unknown by a quarter of its standard error. Ask for a larger tolerance.",
    Status.CONVERGED_AT_KINK: "Converged at a kink of the cost: {kinks}. The one-sided derivatives have opposite "
    "signs, so this is a minimiser although no gradient vanishes there.",
    Status.MAX_ITERATIONS: "Stopped after {iterations}{earlier} with optimality {optimality:.1e} above the tolerance "
    "{tolerance:.1e}. Raise max_iterations, use hessian='exact', or start closer.",
    Status.LINE_SEARCH_FAILED: "The line search found no decrease of the cost along a descent direction (optimality "
    "{optimality:.1e}), nor did it after a fresh start from there.{reason}",
    Status.INTERRUPTED: "Interrupted after {iterations} with optimality {optimality:.1e}: the best point so far.",
    Status.NONFINITE_START: "The cost or its derivatives are not finite at the starting point.{reason}",
    Status.SADDLE: "A stationary point but no minimum: the scaled Hessian on the free directions has the eigenvalue "
    "{smallest_eigenvalue:.1e}, and no step along it decreased the cost. Start elsewhere.",
    Status.SINGULAR: "Converged, but the cost is flat to second order along {direction} (scaled eigenvalue "
    "{smallest_eigenvalue:.1e}): these unknowns are not identified. Fix one of them or add data.",
    Status.COLLAPSED: "Converged (optimality {optimality:.1e}), with a mode that has no duration: the cost does not "
    "depend on {idle}. Leave it out of mode_sequence, start from another guess, or give min_duration.",
    Status.INFEASIBLE: "The constraints are not met: {violated}. Start nearer to a point that meets them, or check "
    "that one can.",
    Status.ERROR: "The fit ended with an error, and was left where it was.{reason}",
}


# --- logs -------------------------------------------------------------------------------------------------------------


def _locate(issue: Issue) -> str:
    """Return the file and the line, with how many more lines there are of the kind."""
    source, place = issue.subjects[:2]
    count = get_figure(issue, "count")
    more = f" (and {count - 1:.0f} more)" if count > 1 else ""
    return f"{source}, {place} {get_figure(issue, 'line'):.0f}{more}"


def _add_unit(issue: Issue, name: str) -> str:
    unit = issue.subjects[2]
    return f"{get_figure(issue, name):.6g} {unit}".rstrip()


_REPAIRS = {
    "log: unsorted times": ("repair='sort' sorts by time", "sorted"),
    "log: clock jump": (
        "if these are two recordings, split the file there; else repair='sort' sorts by time",
        "sorted",
    ),
    "log: repeated time": ("repair='drop-duplicates' keeps the first sample of each", "the first sample is kept"),
    "log: wrapped angle": ("repair='unwrap:{2}' makes it continuous", "unwrapped"),
}
"""What repairs it, and what to say once that is done."""


def _write_repair(issue: Issue) -> str:
    remedy, repaired = _REPAIRS[issue.kind]
    return repaired if get_figure(issue, "repaired") == 1.0 else remedy.format(*issue.subjects)


# --- issues -----------------------------------------------------------------------------------------------------------


@format_text.register(Issue)
def write_issue(issue: Issue) -> str:
    """Return an issue as a sentence or two."""
    if issue.kind in _ISSUES:
        return write_sentence(_ISSUES[issue.kind], issue)
    if issue.kind in _REASONS:
        text = write_sentence(_REASONS[issue.kind], issue)
        return f"{text if text.startswith(tuple(filter(None, issue.subjects))) else capitalise(text)}."
    return f"{issue.kind}: {_join(issue)}" if issue.subjects else issue.kind


def _join(issue: Issue) -> str:
    return ", ".join(issue.subjects)


def _write_combination(issue: Issue) -> str:
    """Return which unknowns trade off, or the single one."""
    names = issue.subjects
    return f"{join_words(names)} {'trade off' if len(names) > 1 else 'by itself'}" if names else "none"


def _write_jump(issue: Issue) -> str:
    """Return where the cost jumps, as the beginning of a sentence; empty where that is not known."""
    template = "The cost jumps from {before:.8g} to {after:.8g} where {0} passes {at:.8g}: "
    return write_sentence(template, issue) if np.isfinite(get_figure(issue, "at")) else ""


def write_undefined(issue: Issue) -> str:
    """Return which function has no finite value or derivative, and where, as a part of a sentence.

    Parameters
    ----------
    issue : Issue
    """
    role, operation, line, run = issue.subjects
    x = [float(f"{value:.6g}") for value in list_figures(issue, "x")]
    t = f"t = {get_figure(issue, 't'):.6g}, " if "t" in issue.figures else ""
    lacks = "derivatives" if get_figure(issue, "valued") else "value"
    function = f"{role}{f' of {run}' if run else ''} has no finite {lacks}{f' at {t}x = {x}' if x else ''}"
    which = ("", "the derivative of ", "the second derivative of ")[int(get_figure(issue, "order"))]
    return f"{function}: {which}{operation}{f' at {line}' if line else ''} is not finite"


def suggest_definition(operation: str) -> str:
    """Return what to do about an operation that is not defined, or has no derivative, somewhere.

    Parameters
    ----------
    operation : str
        Its name in JAX.
    """
    example = EXAMPLES.get(operation, "its argument away from there, as by jnp.where")
    return f"keep {example}, or make what happens there a mode of its own"


EXAMPLES = {
    "sqrt": "its argument positive, as jnp.sqrt(jnp.maximum(x, 1e-9))",
    "log": "its argument positive, as jnp.log(jnp.maximum(x, 1e-9))",
    "pow": "its base positive, as jnp.maximum(x, 1e-9) ** p",
    "jnp.linalg.norm": "it from 0, as jnp.sqrt(jnp.sum(x**2) + 1e-12)",
    "div": "its denominator away from 0, as a / jnp.maximum(x, 1e-9)",
}
"""What to keep from where an operation is not defined, or has no derivative."""


_DELAYED = " J has a kink where a transition meets a late sample's moment: fix the delay at its estimate to see."
"""Behind why a line search failed if a delay is estimated."""

_BOUND = "{names} is at its {kind} {value:g}: it has no standard error, and those of the others take it as known."
_ISSUES: dict[str, Sentence] = {
    "trade off": _write_combination,
    # Odd things in logs
    "log: unsorted times": "{where}: times are not in order, {time} is written too late; {repair}.",
    "log: clock jump": "{where}: the clock jumps back by {step}, to {time}; {repair}.",
    "log: repeated time": "{where}: the time {time} stands there twice; {repair}.",
    "log: missing times": "{where}: without a time; left out.",
    "log: broken lines": "{where}: broken; left out.",
    "log: damaged sentences": "{where}: no sentence, or with a wrong checksum; left out.",
    "log: no stamps": "{0}: messages of {1} have no stamps; the times are those of the recorder.",
    "log: refused": "Left out: {0}",
    "log: gap": "{where}: a gap of {step} after {time}, where samples are typically {typical} apart.",
    "log: wrapped angle": "{where}: the angle {2!r} jumps by a turn of {turn:.6g}; {repair}.",
    "log: text": "{where}: {3!r} in column {2!r} is not a number, and the column is left out; leave the cell "
    "empty, or repair='drop-broken-lines' leaves out such lines.",
    "log: constant": "{0}: constant in all samples: {1}.",
    "log: empty": "{0}: without any value: {1}.",
    "log: repeated name": "{0} has several columns {1!r}, which are left out; rename all but one.",
    # Before the numbers are believed
    "lower bound": _BOUND,
    "upper bound": _BOUND,
    "idle times": "{names} may lie anywhere between its neighbours: the same mode is active before and after the "
    "collapsed one.",
    "idle parameters": "{names}: acts only in modes that have collapsed, so that its value above is no estimate.",
    "no errors: no noise model": "No standard errors: they need a cost that is made of Measurements alone.",
    "no errors: not positive definite": "No standard errors{of names}: the Hessian is not positive definite (smallest "
    "eigenvalue {eigenvalue:.2g}, scaled to unit curvature).",
    "sigma too small": "The reduced chi-square is {chi-square:.3g}, not 1: sigma is too small, or the model misses "
    "something (look at the residuals). If it is sigma, standard errors are {factor:.3g} times too small.",
    "sigma too large": "The reduced chi-square is {chi-square:.3g}, not 1: sigma is too large, or the samples were "
    "smoothed before. If it is sigma, standard errors are {factor:.3g} times too large.",
    "correlated residuals": "Neighbouring residuals are correlated in {correlated}: the {values:.0f} values are worth "
    "about {effective:.0f} independent ones, and standard errors are too small by a factor of up to {narrowing:.2g}.",
    "known to second order": "To first order the fitted values hardly depend on {names}: its standard errors are "
    "{exact:.2g} and, from the Gauss-Newton matrix, {Gauss-Newton:.2g}. Trust its profile likelihood more than either.",
    "covariances differ": "Standard errors from the exact Hessian and the Gauss-Newton matrix differ by up to a factor "
    "{factor:.3g} (of {names}: {exact:.2g} and {Gauss-Newton:.2g}): trust profile likelihoods more.",
    "large integration error": "The integration error of {names} is {error:.1e}, relative: the numbers have fewer "
    "digits than it seems. Give the Problem a smaller rtol, or solver='stiff' if a mode is stiff.",
    # Failures of a certificate
    "optimality": "the KKT residual {optimality:.1e} is above the tolerance {tolerance:.1e}",
    "negative curvature": "the Hessian has a negative eigenvalue on the free directions ({eigenvalue:.1e}, scaled)",
    "integration error": "the integration error of {names} is {error:.1e}, relative",
    "derivative gap": "the paper's equations differ from the derivatives of J by {gap:.1e}, relative",
    "Taylor orders": "the Taylor orders are {orders} instead of (any), 2, 3 or more: gradient or Hessian do not "
    "belong to J",
    # Failures of a derivative check
    "cost not finite": "J or its derivatives are not finite at this theta or near it. The states of "
    "sf.simulate(problem, theta) are NaN from where the solution breaks down; for a stiff mode, give the Problem "
    "solver='stiff'",
    "cost not continuous": "J jumps at this theta or near it, whatever its derivatives are. Steps of a stiff mode may "
    "be unstable: give the Problem solver='stiff'",
    "hidden switch": "{0}, and derivatives leave out how that place moves: they are right up to the error of the mesh "
    "where the model only bends there, for which a smaller rtol helps, and wrong where it jumps. Make it a transition, "
    "or use a smooth function",
    "derivatives of another cost": "the derivatives do not belong to the cost",
    # Why a line search failed, or a fit ended with an error
    "wrong slope": "The gradient does not belong to the cost: along that direction it says {before:.3g}, differences "
    "of the cost say {after:.3g}. Check the derivatives.{delay}",
    "jump": "The cost jumps from {before:.8g} to {after:.8g} where the step passes {places}. The optimiser needs a "
    "cost that is continuous there.{delay}",
    "switch": "{jump}{1}, and derivatives do not include such a switch. If {0} is a time, make it a transition time; "
    "if it is a level that a state passes, give that transition a guard. Otherwise use a smooth function, or fix it.",
    "undefined": "{undefined}. {definition}.",
    "cost corner": "{0}, and steps end at corners of modes alone: make the cost a state of the modes, with a "
    "TerminalCost of that state.",
    "kink": "The derivatives are right, but there is a kink close by, near {places}: along that direction the slope "
    "jumps from {before:.3g} to {after:.3g}. Start elsewhere, or fix what is at the kink there.{delay}",
    "not finite": "A little farther on, at {places}, the cost or its derivatives are not finite: a function of the "
    "model is not defined there, or a state grows without bound. Start elsewhere, or bound the unknowns.",
    "rounding": "The derivatives are right, but what the cost can still fall along that direction is less than its "
    "rounding error, {noise:.1e}. Scale the unknowns to be of size one, or ask for a larger tolerance.{delay}",
    "valley": "The derivatives are right, but the cost has a narrow valley there. Start elsewhere, fix one of "
    "the unknowns that trade off, or take hessian='gauss-newton'.{delay}",
    "error": "{names}",
}
"""Kind of an issue -> its sentence."""


# --- verdict ----------------------------------------------------------------------------------------------------------

LISTED_REASONS, LISTED_STEPS, LISTED_NAMES = 4, 2, 3
"""Largest numbers of reasons, steps and names in the line; the data has all of them."""


@format_text.register(Verdict)
def write_verdict(verdict: Verdict) -> str:
    """Return the verdict in one line.

    Parameters
    ----------
    verdict : Verdict
    """
    reasons, most = list_reasons(verdict), len(verdict.answers) + LISTED_REASONS
    rest = [f"and {format_count(len(reasons) - most, 'more reason')}"] if len(reasons) > most else []
    said = "; ".join([*map(write_reason, reasons[:most]), *rest])
    steps = ", or ".join(write_step(step) for step in verdict.next_steps[:LISTED_STEPS])
    return f"{verdict.level.capitalize()}: {said}{f': {steps}' if steps else ''}."


def list_reasons(verdict: Verdict) -> list[Issue]:
    """Return the answers to the three questions, then what else speaks against the fit.

    Parameters
    ----------
    verdict : Verdict
    """
    return [*verdict.answers, *(reason for reason in verdict.reasons if reason not in verdict.answers)]


def write_reason(reason: Issue) -> str:
    """Return a reason as a part of a sentence.

    Parameters
    ----------
    reason : Issue
    """
    return write_sentence(_REASONS[reason.kind], reason) if reason.kind in _REASONS else str(reason)


def write_step(step: Issue) -> str:
    """Return what to do as a part of a sentence.

    Parameters
    ----------
    step : Issue
    """
    if step.kind == "next: define it there":
        return suggest_definition(step.subjects[1])
    kind = step.kind.removeprefix("next: ")
    text = _STEPS.get(kind, kind).format(*step.subjects, names=_name(step.subjects))
    return text.replace("one of them", "it") if len(step.subjects) == 1 else text


def write_agreement(tried: int, better: int, agreeing: int, *, few: bool = False) -> str:
    """Return how many of the other starts found the lowest J, as a part of a sentence.

    Parameters
    ----------
    tried, better, agreeing : int
        As in `Fit.starts`.
    few : bool
        Whether so few starts agree that the minimum is doubtful.
    """
    if better > 0:
        return f"{better} of {tried} other starts are better"
    count = "none" if not agreeing else f"only {agreeing}" if few else str(agreeing)
    return f"the lowest J was found from {count} of {tried} other starts"


def format_share(share: float) -> str:
    """Return a share in per cent, rounded down to one digit after its leading nines.

    Parameters
    ----------
    share : float
        At most 1.
    """
    if share <= 0:
        return "none"
    if 1 - share < 1e-6:
        return "all but 1e-6" if share < 1 - 1e-12 else "all"
    digits = 0 if share < 0.9 else max(int(np.ceil(-np.log10(1 - share))) - 1, 1)
    scaled = share * 10 ** (digits + 2)
    return f"{np.floor(scaled + 1e-9 * scaled) / 10**digits:.{digits}f} %"  # 0.29 * 100 is below 29


def _explain(issue: Issue) -> str:
    """Return how much of the variance is explained, if there is any, and chi-square if it is known."""
    explained = get_figure(issue, "explained")
    if np.isnan(explained):
        return f"the data do not vary{_chi_square(issue)}"
    only = " only" if issue.kind in ("unexplained", "little explained") and explained > 0 else ""
    return f"the model explains{only} {format_share(explained)} of the variance{_chi_square(issue)}"


def _chi_square(issue: Issue) -> str:
    chi_square, freedom = get_figure(issue, "chi-square"), get_figure(issue, "freedom")
    if not np.isfinite(chi_square):
        return ""
    return f" (chi² {chi_square:.3g} for {freedom:.0f} degrees of freedom)".replace("e+0", "e").replace("e+", "e")


def _explain_worst(issue: Issue) -> str:
    """Return how much of the variance is explained, and how much of the worst channel if that is clearly less."""
    explained, worst = get_figure(issue, "explained"), get_figure(issue, "worst")
    text = _explain(issue)
    if issue.subjects and 1 - worst > 1.5 * (1 - explained):
        text += f", {format_share(worst)} of {issue.subjects[0]}"
    return text


def _write_fit(issue: Issue) -> str:
    """Return how much is explained, and that what is left is noise where a test says so."""
    is_noise = get_figure(issue, "explained") < 1 - NO_RESIDUALS and get_figure(issue, "probability") >= UNLIKELY
    return _explain(issue) + (", what is left is noise" if is_noise else "")


def _write_looks(issue: Issue) -> str:
    """Return who looked for a better fit."""
    if get_figure(issue, "tried") > 0:
        return _count_starts(issue)
    if len(issue.subjects) < 2:
        return "one fit"
    found = f"the lowest of {join_words(issue.subjects)}"
    return f"{issue.subjects[-1]} found nothing lower" if get_figure(issue, "agrees") else found


def _write_wrong_model(issue: Issue) -> str:
    """Return that what is left of the data is no noise, what is wrong then, and what it does to standard errors."""
    widening, size = get_figure(issue, "narrowing"), get_figure(issue, "size")
    left, errors = f"is {size:.2g} sigma", ""
    if get_figure(issue, "correlated"):
        left, errors = "is correlated", f" (standard errors too small by a factor of {widening:.2g})"
    wrong = "the minimum or the model is wrong" if get_figure(issue, "agrees") == 0 else "the model is wrong"
    if get_figure(issue, "explained") >= NEARLY_ALL:
        wrong = "the model is slightly wrong"
    return f"{_explain_worst(issue)}, what is left of {_name(issue.subjects)} {left}: {wrong}{errors}"


def _name(names: tuple[str, ...]) -> str:
    """Return the first names, and the number of the others."""
    return join_words(names or ("the unknowns",)) if len(names) <= LISTED_NAMES else join_first(names, LISTED_NAMES)


def _count_starts(issue: Issue) -> str:
    tried, better, agreeing = (int(get_figure(issue, name)) for name in ("tried", "better", "agreeing"))
    return write_agreement(tried, better, agreeing, few=issue.kind == "few starts agree")


_UNCONVERGED: Mapping[str, str] = {
    Status.MAX_ITERATIONS.name: "not converged: stopped at iteration {iterations:.0f}",
    Status.LINE_SEARCH_FAILED.name: "not converged: the line search failed (optimality {optimality:.1e})",
    Status.INTERRUPTED.name: "not converged: interrupted at iteration {iterations:.0f}",
    Status.NONFINITE_START.name: "not started: the cost or a derivative is not finite at the first guess",
    Status.SADDLE.name: "not a minimum but a saddle point",
    Status.INFEASIBLE.name: "a guard or terminal constraint is not met",
    Status.ERROR.name: "the fit ended with an error",
}


_SEARCHES: Mapping[str, str] = {
    "jump": "where the cost jumps, at {where it failed}",
    "switch": "where the cost jumps, at {where it failed}",
    "kink": "where the slope of the cost jumps, at {where it failed}",
    "not finite": "beside where the cost is not finite, at {where it failed}",
    "wrong slope": "since the derivatives do not belong to the cost",
    "rounding": "since what the cost can still fall is less than its rounding error",
    "valley": "in a narrow valley of the cost",
}
"""How a line search failed, by the kind of the reason."""


def _write_ending(issue: Issue) -> str:
    status, kind = (*issue.subjects, "", "")[:2]
    text = f"{_UNCONVERGED.get(status, 'not converged')} {_SEARCHES.get(kind, '')}".rstrip()
    return write_sentence(text, issue)


def _describe_many(issue: Issue) -> str:
    """Return how many fits are of each level, and how much of the data they explain."""
    counts = {level: int(get_figure(issue, level)) for level in LEVELS}
    parts = join_words([f"{count} {level}" for level, count in counts.items() if count])
    text, worst = f"{parts} of {format_count(sum(counts.values()), 'fit')}", get_figure(issue, "worst")
    if not np.isfinite(worst):
        return text
    return f"{text}, explaining {format_share(worst)} of the variance or more (fit {issue.subjects[0]} least)"


def _count_fits(issue: Issue) -> str:
    """Return the number of fits that a reason is about."""
    return f"{get_figure(issue, 'count'):.0f} of {format_count(int(get_figure(issue, 'fits')), 'fit')}"


def _name_least(issue: Issue) -> str:
    """Return which fit explains least, and how much; empty where that is not known."""
    share = get_figure(issue, "worst")
    return f" (fit {issue.subjects[0]} explains {format_share(share)} of the variance)" if np.isfinite(share) else ""


def _write_prediction(issue: Issue) -> str:
    """Return how much of another run is predicted."""
    explained = get_figure(issue, "explained")
    if np.isnan(explained):
        return "the other run does not vary"
    chi_square = _chi_square(issue).removeprefix(" (").removesuffix(")")
    figures = f"fit {get_figure(issue, 'percent'):.1f} %{f'; {chi_square}' if chi_square else ''}"
    if issue.kind == "predicts":
        return f"the fitted parameters predict {format_share(explained)} of the variance ({figures})"
    return f"the fitted parameters do not predict this run within the noise and their own error ({figures})"


_REASONS: dict[str, Sentence] = {
    "looked": _write_looks,
    "fits": _write_fit,
    "predicts": _write_prediction,
    "predicts badly": _write_prediction,
    "prediction errors correlated": "the residuals of {first names} are correlated",
    "nothing left to test": "as many unknowns were estimated from this run as it has values, so that nothing is left "
    "to test",
    "input not explained": "the residuals depend on {first names}: the model misses a part of it",
    "own unknowns not converged": "the estimation of {first names} did not converge",
    "a minimum": "a minimum (KKT residual {optimality:.1e})",
    "at kinks": "{first names} at a kink of the cost",
    "not converged": _write_ending,
    "undefined": write_undefined,
    "cost corner": "{0}, at which steps do not end",
    "switch": "{1}, which derivatives do not include",
    "unexplained": "{explanation of the worst}",
    "little explained": "{explanation of the worst}",
    "model suspected": _write_wrong_model,
    "outliers suspected": "{explanation of the worst}, what is left of {first names} has outliers: values or the model "
    "are wrong there",
    "sigma suspected": "{explanation of the worst}, what is left of {first names} is {size:.2g} sigma and looks like "
    "noise: sigma is too small",
    "too few samples": "{samples:.0f} values for {unknowns:.0f} unknowns leave nothing to check the fit with",
    "a mode collapsed": "{mode} collapsed",
    "a mode is short": "{mode} is at its minimum duration",
    "idle": "the cost does not depend on {first names}",
    "other starts are better": "{agreement}",
    "few starts agree": "{agreement}",
    "search cut short": "{first names} ended by its limit of time",
    "not determined": "the data hardly determine {first names}",
    "not read": "no function of the model reads {first names}",
    "acts elsewhere": "only modes or transitions that do not occur read {first names}",
    "without effect": "the cost does not depend on {first names}",
    "at bounds": "{first names} at a bound",
    "at known jumps": "held by known jumps, which no transition passes: {times at jumps}",
    "rivals": "{rivals}",
    "vanishing": "{first names} tends to 0",
    "integration error": "the integration error of {first names} is {error:.1e}, relative",
    "many fits": _describe_many,
    "some not converged": "{fits} did not converge ({statuses})",
    "some unexplained": "the model is far from the data in {fits}{least}",
    "some no noise": "what is left is no noise in {fits}{least}",
    "some little explained": "little of the variance is explained in {fits}{least}",
    "some too few samples": "no more values than unknowns in {fits}{least}",
    "some a mode collapsed": "modes collapsed in {fits}",
    "some at bounds": "unknowns are at a bound in {fits}",
    "some not determined": "the data hardly determine the unknowns of {fits}",
    "ended elsewhere": "{fits} ended in another minimum, fit {0} farthest off",
    "resampled fit": "the fit that was resampled is {0}",
    "intervals too short": "{level in per cent:.0f} % intervals of {first names} hold the truth in {per cent:.0f} % of "
    "the fits",
    "stopped": "stopped, {fits} were not done",
    "study": "{fits} converged, in one minimum",
}

_STEPS = {
    "look at plot": "look at .plot()",
    "give a better guess": "give the other run a better guess of them",
    "more starts": "strategy='thorough'",
    "more time": "time_budget with more seconds",
    "look at the residuals": "look at estimate.plot_residuals()",
    "corrected errors": "take the corrected standard errors",
    "robust loss": "give the Measurements a robust loss",
    "leave the mode out": "leave the mode out of mode_sequence",
    "lower min_duration": "lower min_duration or leave the mode out",
    "linear scale": "use a linear scale with lower=0",
    "look at profiles": "look at estimate.profile() of {names}",
    "other side": "put the guess of {names} on the other side of that jump",
    "move the bound": "move the bound if it is not a physical one",
    "fix or add data": "fix one of them or add data",
    "remove or use": "remove {names} from parameters or use in the model",
    "fix or let it act": "fix {names}, or fit a log with other modes",
    "cost as a state": "make the cost a state of the modes, with a TerminalCost of that state",
    "transition time": "make {} a transition time if it is one, or use a smooth function",
    "larger tolerance": "ask for a larger tolerance",
    "fix alone": "fix {names}, or measure something else",
    "more data": "add data",
    "smaller rtol": "give the Problem a smaller rtol",
    "continue": "continue with start=estimate.theta",
    "start elsewhere": "start elsewhere, or check the model there",
    "start nearer": "start nearer to a point that meets it",
    "check derivatives": "run sf.check_derivatives(problem)",
    "fit alone": "fit problem {} by itself with sf.estimate",
    "look at the fit": "look at the verdict on the fit that was resampled",
    "see failures": "see .failures",
    "take quantiles": "take quantiles of .theta in place of standard deviations",
    "profiles": "take estimate.profile() for them, or sf.bootstrap where there are guards",
    "go on": "call it again with the same folder",
}

_WORDS: Mapping[str, Callable[[Issue], Any]] = {
    "where": _locate,
    "repair": _write_repair,
    **{name: partial(_add_unit, name=name) for name in ("time", "step", "typical")},
    "names": _join,
    "of names": lambda issue: f" of {join_words(issue.subjects)}" if issue.subjects else "",
    "correlated": lambda issue: list_each(issue, "{} ({:.2f})", "correlation"),
    "jump": _write_jump,
    "places": lambda issue: list_each(issue, "{} = {:.8g}", "at"),
    "kind": lambda issue: issue.kind,
    "orders": lambda issue: ", ".join(f"{order:.2f}" for order in list_figures(issue, "orders")),
    "undefined": lambda issue: capitalise(write_undefined(issue)),
    "definition": lambda issue: capitalise(suggest_definition(issue.subjects[1])),
    "delay": lambda issue: _DELAYED if get_figure(issue, "delayed") == 1.0 else "",
    "first names": lambda issue: _name(issue.subjects),
    "mode": lambda issue: " of ".join((f"mode {issue.subjects[0]!r}", *filter(None, issue.subjects[1:2]))),
    "explanation of the worst": _explain_worst,
    "agreement": _count_starts,
    "fits": _count_fits,
    "least": _name_least,
    "per cent": lambda issue: 100 * get_figure(issue, "share"),
    "level in per cent": lambda issue: 100 * get_figure(issue, "level"),
    "rivals": lambda issue: list_each(issue, "{} may be {:.6g} as well, where J is {:.2g} higher", "at", "rise"),
    "times at jumps": lambda issue: list_each(issue, "{} at {:.8g}", "at"),
    "where it failed": lambda issue: list_each(issue, "{} = {:.6g}", "at", first=2),
    "statuses": lambda issue: ", ".join(issue.subjects[:LISTED_NAMES]),
}
"""What a field of a sentence stands for that is neither a subject nor a figure."""
