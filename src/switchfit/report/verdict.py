"""The line of a verdict: its level, the answers to three questions, other reasons by weight, and what to do next."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from switchfit.optimize import Status
from switchfit.report import sentences
from switchfit.report.sentences import get_figure, join_words, list_figures, write_places
from switchfit.runtime.errors import Issue
from switchfit.runtime.presentation import format_text, join_first
from switchfit.uncertainty.answers import LEVELS, NEARLY_ALL, NO_RESIDUALS, UNLIKELY
from switchfit.uncertainty.verdict import Verdict

LISTED_REASONS, LISTED_STEPS, LISTED_NAMES = 4, 2, 3
"""Largest numbers of reasons, steps and names in the line; the data has all of them."""


@format_text.register(Verdict)
def write_verdict(verdict: Verdict) -> str:
    """Return the verdict in one line.

    Parameters
    ----------
    verdict : Verdict
    """
    collapsed = [reason for reason in verdict.reasons if reason.kind == "a mode collapsed"]
    others = [reason for reason in verdict.reasons if reason not in (*verdict.answers, *collapsed[1:])]
    reasons = [_count_modes(collapsed) if reason in collapsed else write_reason(reason) for reason in others]
    more = len(reasons) - LISTED_REASONS
    rest = ["and another reason" if more == 1 else f"and {more} more reasons"] if more > 0 else []
    reasons = [*map(write_reason, verdict.answers), *reasons[:LISTED_REASONS], *rest]
    steps = ", or ".join(write_step(step) for step in verdict.next_steps[:LISTED_STEPS])
    return f"{verdict.level.capitalize()}: {'; '.join(reasons)}{f': {steps}' if steps else ''}."


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
    return sentences.write_sentence(_REASONS[reason.kind], reason, _WORDS) if reason.kind in _REASONS else str(reason)


def write_step(step: Issue) -> str:
    """Return what to do as a part of a sentence.

    Parameters
    ----------
    step : Issue
    """
    single = len(step.subjects) == 1
    they_act, them = ("it acts", "it") if single else ("they act", "them")
    words = {"names": _name(step.subjects), "them": them, "they_act": they_act}
    if step.kind == "next: define it there":
        return sentences.suggest_definition(step.subjects[1])
    text = _STEPS.get(step.kind.removeprefix("next: "), step.kind).format(*step.subjects, **words)
    return text.replace("one of them", "it") if single else text


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


def _name_mode(issue: Issue) -> str:
    mode, run = (*issue.subjects, "", "")[:2]
    return f"mode {mode!r}" + (f" of {run}" if run else "")


def _count_modes(collapsed: list[Issue]) -> str:
    if len(collapsed) == 1:
        return write_reason(collapsed[0])
    names = tuple(_name_mode(issue).removeprefix("mode ") for issue in collapsed)
    return f"{len(names)} modes collapsed ({_name(names)})"


def _count_starts(issue: Issue) -> str:
    tried, better, agreeing = (int(get_figure(issue, name)) for name in ("tried", "better", "agreeing"))
    return write_agreement(tried, better, agreeing, few=issue.kind == "few starts agree")


_ENDINGS: Mapping[str, str] = {
    Status.MAX_ITERATIONS.name: "not converged: stopped at iteration {iterations:.0f}",
    Status.LINE_SEARCH_FAILED.name: "not converged: the line search failed (optimality {optimality:.1e})",
    Status.INTERRUPTED.name: "not converged: interrupted at iteration {iterations:.0f}",
    Status.NONFINITE_START.name: "not started: the cost or a derivative is not finite at the first guess",
    Status.SADDLE.name: "not a minimum but a saddle point",
    Status.INFEASIBLE.name: "a guard or terminal constraint is not met",
    Status.ERROR.name: "the fit ended with an error",
}


_SEARCHES: Mapping[str, str] = {
    "jump": "where the cost jumps, at {places}",
    "switch": "where the cost jumps, at {places}",
    "kink": "where the slope of the cost jumps, at {places}",
    "not finite": "beside where the cost is not finite, at {places}",
    "wrong slope": "since the derivatives do not belong to the cost",
    "rounding": "since what the cost can still fall is less than its rounding error",
    "valley": "in a narrow valley of the cost",
}
"""How a line search failed, by the kind of the reason."""


def _write_ending(issue: Issue) -> str:
    status, kind = (*issue.subjects, "", "")[:2]
    text = f"{_ENDINGS.get(status, 'not converged')} {_SEARCHES.get(kind, '')}".rstrip()
    return sentences.write_sentence(text, issue, _WORDS)


def _describe_many(issue: Issue) -> str:
    """Return how many fits are of each level, and how much of the data they explain."""
    counts = {level: int(get_figure(issue, level)) for level in LEVELS}
    total = sum(counts.values())
    parts = [f"{count} {'is' if count == 1 else 'are'} {level}" for level, count in counts.items() if count]
    if len(parts) == 1:
        parts = [parts[0].replace(f"{total} ", "the only fit " if total == 1 else f"all {total} fits ", 1)]
    else:
        parts[0] = parts[0].replace(" ", f" of {total} fits ", 1)
    worst = get_figure(issue, "worst")
    if not np.isfinite(worst):
        return join_words(parts)
    if total == 1:
        return f"{parts[0]} and explains {format_share(worst)} of the variance"
    return f"{parts[0]} and explain {format_share(worst)} of the variance or more (fit {issue.subjects[0]} least)"


def _count_fits(issue: Issue) -> str:
    """Return the number of fits that a reason is about."""
    count, total = int(get_figure(issue, "count")), int(get_figure(issue, "fits"))
    return "the only fit" if total == 1 else f"all {total} fits" if count == total else f"{count} of {total} fits"


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


_WORDS: sentences.Words = {
    "names": lambda issue: _name(issue.subjects),
    "mode": _name_mode,
    "explanation": _explain,
    "explanation of the worst": _explain_worst,
    "agreement": _count_starts,
    "fits": _count_fits,
    "least": _name_least,
    "act": lambda issue: "acts" if len(issue.subjects) == 1 else "act",
    "per cent": lambda issue: 100 * get_figure(issue, "share"),
    "level in per cent": lambda issue: 100 * get_figure(issue, "level"),
    "places": lambda issue: write_places(issue.subjects[2:], list_figures(issue, "at"), digits=6),
    "statuses": lambda issue: ", ".join(issue.subjects[:LISTED_NAMES]),
}
"""Fields of the reasons that are no figures."""

_REASONS: dict[str, sentences.Sentence] = {
    "converged": "converged",
    "looked": _write_looks,
    "fits": _write_fit,
    "predicts": _write_prediction,
    "predicts badly": _write_prediction,
    "prediction errors correlated": "the residuals of {names} are correlated",
    "nothing left to test": "as many unknowns were estimated from this run as it has values, so that nothing is left "
    "to test",
    "input not explained": "the residuals depend on {names}: the model misses a part of it",
    "own unknowns not converged": "the estimation of {names} did not converge",
    "a minimum": "a minimum (KKT residual {optimality:.1e})",
    "at kinks": "{names} at a kink of the cost",
    "not converged": _write_ending,
    "undefined": sentences.write_undefined,
    "switch": "{1}, which derivatives do not include",
    "unexplained": "{explanation of the worst}",
    "little explained": "{explanation of the worst}",
    "model suspected": _write_wrong_model,
    "outliers suspected": "{explanation of the worst}, what is left of {names} has outliers: values or the model are "
    "wrong there",
    "sigma suspected": "{explanation of the worst}, what is left of {names} is {size:.2g} sigma and looks like noise: "
    "sigma is too small",
    "too few samples": "{samples:.0f} values for {unknowns:.0f} unknowns leave nothing to check the fit with",
    "a mode collapsed": "{mode} collapsed",
    "a mode is short": "{mode} is at its minimum duration",
    "idle": "the cost does not depend on {names}",
    "other starts are better": "{agreement}",
    "few starts agree": "{agreement}",
    "search cut short": "{names} ended by its limit of time",
    "not determined": "the data hardly determine {names}",
    "not read": "no function of the model reads {names}",
    "acts elsewhere": "{names} {act} only in modes or at transitions that do not occur",
    "without effect": "the cost does not depend on {names}",
    "at bounds": "{names} at a bound",
    "integration error": "the integration error of {names} is {error:.1e}, relative",
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
    "intervals too short": "{level in per cent:.0f} % intervals of {names} hold the truth in {per cent:.0f} % of the "
    "fits",
    "stopped": "stopped, {fits} were not done",
    "study": "{fits} converged, in one minimum",
}

_STEPS = {
    "look at plot": "look at .plot()",
    "give a better guess": "give the other run a better guess of them",
    "more starts": "strategy='thorough'",
    "more time": "time_budget with more seconds",
    "look at the residuals": "look at estimate.plot_residuals()",
    "check sigma": "check sigma",
    "corrected errors": "take the corrected standard errors",
    "robust loss": "give the Measurements a robust loss",
    "leave the mode out": "leave the mode out of mode_sequence",
    "lower min_duration": "lower min_duration or leave the mode out",
    "move the bound": "move the bound if it is not a physical one",
    "fix or add data": "fix one of them or add data",
    "remove or use": "remove {names} from parameters, or use {them} in the model",
    "fix or let it act": "fix {names}, or fit a log in which {they_act}",
    "transition time": "make {} a transition time if it is one, or use a smooth function",
    "larger tolerance": "ask for a larger tolerance",
    "fix alone": "fix {names}, or let {them} act on what is measured",
    "more data": "add data",
    "smaller rtol": "give the Problem a smaller rtol",
    "raise max_iterations": "raise max_iterations",
    "continue": "continue with start=estimate.theta",
    "start elsewhere": "start elsewhere, or check the model there",
    "start nearer": "start nearer to a point that meets it",
    "check derivatives": "run sf.check_derivatives(problem)",
    "fit alone": "fit problem {} by itself with sf.estimate",
    "look at the fit": "look at the verdict on the fit that was resampled",
    "see failures": "see .failures",
    "take quantiles": "take quantiles of .theta in place of standard deviations",
    "profiles": "take estimate.profile() for them",
    "go on": "call it again with the same folder",
}
