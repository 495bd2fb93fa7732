"""The line of a verdict: its level, the answers to three questions, other reasons, and what to do next."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from switchfit.optimize import Status
from switchfit.report.shares import format_share, write_chi_square, write_explained, write_worst_explained
from switchfit.report.templates import Sentence, describe_starts, suggest_definition, write_sentence, write_undefined
from switchfit.report.wording import get_figure, join_words, name_first
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import format_count, format_text
from switchfit.uncertainty.chi_square import UNLIKELY_AS_NOISE
from switchfit.uncertainty.doubts import NEARLY_ALL, VERDICT_LEVELS
from switchfit.uncertainty.explained_variance import NO_RESIDUALS
from switchfit.uncertainty.verdict import Verdict

LISTED_REASONS, LISTED_STEPS = 4, 2
"""Largest numbers of reasons and steps in the line; the data has all of them."""

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
    return write_sentence(REASONS[reason.kind], reason) if reason.kind in REASONS else str(reason)


def write_step(step: Issue) -> str:
    """Return what to do as a part of a sentence.

    Parameters
    ----------
    step : Issue
    """
    # The remedy depends on the operation, so that no fixed sentence will do.
    if step.kind == "next: define it there":
        return suggest_definition(step.subjects[1])
    kind = step.kind.removeprefix("next: ")
    text = _STEPS.get(kind, kind).format(*step.subjects, names=name_first(step.subjects))
    # A sentence about several unknowns, said of one.
    return text.replace("one of them", "it") if len(step.subjects) == 1 else text


def _write_fit(issue: Issue) -> str:
    """Return how much is explained, and that what is left is noise where a test says so."""
    is_noise = (
        get_figure(issue, "explained") < 1 - NO_RESIDUALS and get_figure(issue, "probability") >= UNLIKELY_AS_NOISE
    )
    return write_explained(issue) + (", what is left is noise" if is_noise else "")


def _write_looks(issue: Issue) -> str:
    """Return who looked for a better fit."""
    if get_figure(issue, "tried") > 0:
        return describe_starts(issue)
    if len(issue.subjects) < 2:
        return "one fit"
    found = f"the lowest of {join_words(issue.subjects)}"
    return f"{issue.subjects[-1]} found nothing lower" if get_figure(issue, "agrees") else found


def _write_wrong_model(issue: Issue) -> str:
    """Return that what is left of the data is no noise, what is wrong then, and what it does to standard errors."""
    widening, size = get_figure(issue, "narrowing"), get_figure(issue, "size")
    # Correlation is the graver finding: it changes standard errors, while a size may be that of a wrong sigma.
    left, errors = f"is {size:.2g} sigma", ""
    if get_figure(issue, "correlated"):
        left, errors = "is correlated", f" (standard errors too small by a factor of {widening:.2g})"
    # Where other starts disagree, the fit may be in the wrong minimum of a right model.
    wrong = "the minimum or the model is wrong" if get_figure(issue, "agrees") == 0 else "the model is wrong"
    if get_figure(issue, "explained") >= NEARLY_ALL:
        wrong = "the model is slightly wrong"
    return f"{write_worst_explained(issue)}, what is left of {name_first(issue.subjects)} {left}: {wrong}{errors}"


def _write_ending(issue: Issue) -> str:
    # Status, and why the line search failed, if it did.
    status, kind = (*issue.subjects, "", "")[:2]
    text = f"{_UNCONVERGED.get(status, 'not converged')} {_SEARCHES.get(kind, '')}".rstrip()
    return write_sentence(text, issue)


def _describe_many(issue: Issue) -> str:
    """Return how many fits are of each level, and how much of the data they explain."""
    counts = {level: int(get_figure(issue, level)) for level in VERDICT_LEVELS}
    parts = join_words([f"{count} {level}" for level, count in counts.items() if count])
    text, worst = f"{parts} of {format_count(sum(counts.values()), 'fit')}", get_figure(issue, "worst")
    if not np.isfinite(worst):
        return text
    return f"{text}, explaining {format_share(worst)} of the variance or more (fit {issue.subjects[0]} least)"


def _write_prediction(issue: Issue) -> str:
    """Return how much of another run is predicted."""
    explained = get_figure(issue, "explained")
    if np.isnan(explained):
        return "the other run does not vary"
    chi_square = write_chi_square(issue).removeprefix(" (").removesuffix(")")
    figures = f"fit {get_figure(issue, 'percent'):.1f} %{f'; {chi_square}' if chi_square else ''}"
    if issue.kind == "predicts":
        return f"the fitted parameters predict {format_share(explained)} of the variance ({figures})"
    return f"the fitted parameters do not predict this run within the noise and their own error ({figures})"


REASONS: dict[str, Sentence] = {
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
