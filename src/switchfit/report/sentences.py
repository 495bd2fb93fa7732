"""Sentences for what results are made of: constraints, kinks, issues, and how a fit ended."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from switchfit.fit.termination import Kink, Termination
from switchfit.optimize import Status
from switchfit.problem.constraints import Constraint
from switchfit.problem.readers import name_whole_parameters
from switchfit.report.logs import LOG_ISSUES
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import format_count, format_text
from switchfit.uncertainty.identification import Combination

ALLOWED = "Standard errors allow for the correlation of the residuals."
"""Below a table whose standard errors are corrected."""

LISTED = 6
"""Largest number of channels that a sentence names."""


# --- words, constraints, kinks ----------------------------------------------------------------------------------------


def join_words(words: Sequence[str]) -> str:
    """Return "a", "a and b", or "a, b and c"."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


def capitalise(text: str) -> str:
    """Return a text with a capital letter at its beginning."""
    return text[:1].upper() + text[1:]


def _describe_mode(position: float, mode: str, run: str) -> str:
    return f"mode {position + 1:.0f} ({mode!r})" + (f" of {run}" if run else "")


@format_text.register(Constraint)
def write_constraint(constraint: Constraint) -> str:
    """Return which constraint is active."""
    if constraint.position is None:
        return f"{constraint.unknown} at its {constraint.kind} {constraint.value:g}"
    state = "has collapsed to nothing" if constraint.kind == "collapsed" else "is at its minimum duration"
    return f"{_describe_mode(constraint.position, constraint.mode, constraint.run)} {state}"


@format_text.register(Kink)
def write_kink(kink: Kink) -> str:
    """Return which unknown is at a kink, and the derivatives on both sides."""
    return f"{kink.unknown} at a kink ({kink.left:.1e}, {kink.right:.1e})"


@format_text.register(Combination)
def write_combination(combination: Combination) -> str:
    """Return which unknowns trade off."""
    names = combination.unknowns
    if not names:
        return "none"
    return f"{join_words(names)} trade off" if len(names) > 1 else f"{names[0]} by itself"


# --- how a fit ended --------------------------------------------------------------------------------------------------


@format_text.register(Termination)
def write_termination(ended: Termination) -> str:
    """Return how a fit ended, with its numbers, what to do next, and the active constraints."""
    if ended.reason is not None and ended.reason.kind == "message":
        return str(ended.reason)
    active = f" Active: {'; '.join(map(str, ended.active))}." if ended.active else ""
    told = ended.status in (Status.NONFINITE_START, Status.LINE_SEARCH_FAILED)
    undefined = "" if told or ended.reason is None or ended.reason.kind != "undefined" else f" {ended.reason}"
    return _ENDINGS[ended.status](ended) + undefined + active


def _describe_stop(ended: Termination) -> str:
    earlier = ended.earlier_iterations
    before = f", {earlier} of them before the mesh was refined," if earlier else ""
    return (
        f"Stopped after {format_count(ended.iterations, 'iteration')}{before} with optimality {ended.optimality:.1e} "
        f"above the tolerance {ended.tolerance:.1e}. Raise max_iterations, use hessian='exact', or start closer."
    )


def _describe_kink(ended: Termination) -> str:
    kinks = ", ".join(
        f"{kink.unknown} = {kink.value:.10g}, where the derivative jumps from {kink.left:.1e} to {kink.right:.1e}"
        for kink in ended.kinks
    )
    return (
        f"Converged at a kink of the cost: {kinks}. The one-sided derivatives have opposite signs, so this is a "
        "minimiser although no gradient vanishes there; covariances do not apply to such an unknown."
    )


def _describe_failed_search(ended: Termination) -> str:
    reason = f" {ended.reason}" if ended.reason is not None else ""
    return (
        "The line search found no decrease of the cost along a descent direction (optimality "
        f"{ended.optimality:.1e}), nor did it after a fresh start from there.{reason}"
    )


def _describe_flat_direction(ended: Termination) -> str:
    names = {name for name, _ in ended.flat_direction}
    if names and names <= {*ended.unread, *ended.absent}:
        return f"Converged (optimality {ended.optimality:.1e}), but {describe_unread(ended.unread, ended.absent)}."
    direction = " ".join(f"{part:+.2g} {name}" for name, part in ended.flat_direction) or "no direction"
    return (
        f"Converged, but the cost is flat to second order along {direction} (scaled eigenvalue "
        f"{ended.smallest_eigenvalue:.1e}): these unknowns are not identified. Fix one of them or add data."
    )


def describe_unread(unread: Sequence[str], absent: Sequence[str]) -> str:
    """Return which parameters no function reads that acts, and what to do, as parts of a sentence.

    Parameters
    ----------
    unread, absent : sequence of str
        As of `Fit`.
    """
    parts = []
    if unread:
        names = join_words(name_whole_parameters(unread))
        parts.append(f"no function of the model reads {names}: remove {names} from parameters, or use it in the model")
    if absent:
        every = name_whole_parameters(absent)
        names, act = join_words(every), "acts" if len(every) == 1 else "act"
        what = f"fix {names}, or fit a log in which {'it acts' if len(every) == 1 else 'they act'}"
        parts.append(f"{names} {act} only in modes or at transitions that do not occur: {what}")
    return "; ".join(parts)


def _describe_infeasible(ended: Termination) -> str:
    violated = "; ".join(f"{name} = {value:.2e}" for name, value in ended.violated)
    return f"The constraints are not met: {violated}. Start nearer to a point that meets them, or check that one can."


_ENDINGS: dict[Status, Callable[[Termination], str]] = {
    Status.CONVERGED: lambda ended: (
        f"Converged: the optimality {ended.optimality:.1e} is below the tolerance {ended.tolerance:.1e}."
    ),
    Status.CONVERGED_PRECISION: lambda ended: (
        f"Converged to the precision of the cost: the optimality {ended.optimality:.1e} is above the tolerance "
        f"{ended.tolerance:.1e}, but the decrease still predicted is below the error of the cost {ended.cost:.6e}, by "
        "rounding or by integration, or would move no unknown by a quarter of its standard error. Ask for a larger "
        "tolerance."
    ),
    Status.CONVERGED_AT_KINK: _describe_kink,
    Status.MAX_ITERATIONS: _describe_stop,
    Status.LINE_SEARCH_FAILED: _describe_failed_search,
    Status.INTERRUPTED: lambda ended: (
        f"Interrupted after {format_count(ended.iterations, 'iteration')} with optimality {ended.optimality:.1e}: the "
        "best point so far."
    ),
    Status.NONFINITE_START: lambda ended: (
        "The cost or its derivatives are not finite at the starting point. "
        + ("Start elsewhere, or check the model there." if ended.reason is None else str(ended.reason))
    ),
    Status.SADDLE: lambda ended: (
        "A stationary point but no minimum: the scaled Hessian on the free directions has the eigenvalue "
        f"{ended.smallest_eigenvalue:.1e}, and no step along it decreased the cost. Start elsewhere."
    ),
    Status.SINGULAR: _describe_flat_direction,
    Status.COLLAPSED: lambda ended: (
        f"Converged (optimality {ended.optimality:.1e}), with a mode that has no duration: the cost depends neither on "
        f"where it would stand nor on what acts in it alone ({', '.join(ended.idle)}). Leave it out of mode_sequence, "
        "start from another guess, or give min_duration."
    ),
    Status.INFEASIBLE: _describe_infeasible,
    Status.ERROR: lambda ended: (
        f"The fit ended with an error, and was left where it was. {ended.reason or ''}".rstrip()
    ),
}


# --- issues -----------------------------------------------------------------------------------------------------------


def _get(issue: Issue, name: str) -> float:
    """Return a figure that is one number; NaN if the issue lacks it."""
    value = issue.figures.get(name, np.nan)
    return np.nan if isinstance(value, tuple) else value


def _pair_figures(issue: Issue, name: str) -> list[tuple[str, float]]:
    """Return a figure that has a number for each subject: (subject, number)."""
    value = issue.figures.get(name, ())
    return list(zip(issue.subjects, value if isinstance(value, tuple) else (value,), strict=False))


def _join(issue: Issue) -> str:
    return ", ".join(issue.subjects)


@format_text.register(Issue)
def write_issue(issue: Issue) -> str:
    """Return an issue as a sentence or two."""
    if issue.kind in _ISSUES:
        return _ISSUES[issue.kind](issue)
    return f"{issue.kind}: {_join(issue)}" if issue.subjects else issue.kind


def _name_held_mode(issue: Issue) -> str:
    mode, run = (*issue.subjects, "", "")[:2]
    return capitalise(_describe_mode(_get(issue, "position"), mode, run))


def _describe_held_by_bound(issue: Issue) -> str:
    return (
        f"{_join(issue)} is at its {issue.kind} {_get(issue, 'value'):g}: it has no standard error, and those of "
        "the others take it as known. Move the bound if it is not a physical one."
    )


def _describe_kinks(issue: Issue) -> str:
    names = _shorten_list(list(issue.subjects))
    if len(issue.subjects) == 1:
        return (
            f"{names} is at a kink of the cost, as where a transition meets a sample. It has no standard error, and "
            "those of the others take it as known; its profile gives an interval."
        )
    return (
        f"{names} are at kinks of the cost, as where a transition meets a sample. They have no standard errors, and "
        "those of the others take them as known; their profiles give intervals."
    )


def _describe_hardly_determined(issue: Issue) -> str:
    *others, last = issue.subjects or ("the unknowns",)
    what = f"{', '.join(others)} and {last} apart from one another" if others else last
    return (
        f"The data hardly determine {what} (smallest eigenvalue {_get(issue, 'eigenvalue'):.2g} of the Hessian scaled "
        "to unit curvature). Fix one of the unknowns, or add data that tell them apart."
    )


def _describe_wrong_sigma(issue: Issue) -> str:
    ratio = _get(issue, "chi-square")
    if issue.kind == "sigma too small":
        cause, effect = "the model misses something (look at the residuals)", "small"
        factor = np.sqrt(ratio)
    else:
        cause, effect = "the samples were smoothed before", "large"
        factor = 1 / np.sqrt(ratio) if ratio > 0 else np.inf
    return (
        f"The reduced chi-square is {ratio:.3g} where 1 is expected: sigma is too {effect}, or {cause}. Standard "
        f"errors are too {effect}, by a factor of {factor:.2g} if it is sigma."
    )


def _shorten_list(entries: list[str]) -> str:
    more = f" and {len(entries) - LISTED} more" if len(entries) > LISTED else ""
    return ", ".join(entries[:LISTED]) + more


def _describe_correlation(issue: Issue) -> str:
    where = _shorten_list([f"{label} ({value:.2f})" for label, value in _pair_figures(issue, "correlation")])
    return (
        f"Neighbouring residuals are correlated in {where}: the model misses something there, or the samples were "
        f"smoothed before. The {_get(issue, 'values'):.0f} values are worth about {_get(issue, 'effective'):.0f} "
        "independent ones: the standard errors, which take them as independent, are too small by a factor of up to "
        f"{_get(issue, 'narrowing'):.2g}."
    )


def _describe_non_normality(issue: Issue) -> str:
    each = zip(_pair_figures(issue, "kurtosis"), _pair_figures(issue, "outliers"), strict=False)
    where = [f"{label} (kurtosis {kurtosis:.1f}, {count:.0f} beyond 4 sigma)" for (label, kurtosis), (_, count) in each]
    return (
        f"The residuals are not normal in {_shorten_list(where)}. Look for outliers; intervals from a bootstrap do not "
        "take them as normal."
    )


def _describe_second_order(issue: Issue) -> str:
    return (
        f"To first order the fitted values hardly depend on {_join(issue)}: its standard errors from the exact "
        f"Hessian and from the Gauss-Newton matrix are {_format_errors(issue)}. What is known of it is known to second "
        "order: trust its profile likelihood more than either."
    )


def _describe_covariances(issue: Issue) -> str:
    return (
        "Standard errors from the exact Hessian and from the Gauss-Newton matrix differ by up to a factor "
        f"{_get(issue, 'factor'):.3g} (of {_join(issue)}: {_format_errors(issue)}): within its noise the model is "
        "not linear in its unknowns. Trust profile likelihoods more than either."
    )


def _format_errors(issue: Issue) -> str:
    return f"{_get(issue, 'exact'):.2g} and {_get(issue, 'Gauss-Newton'):.2g}"


def _describe_wrong_slope(issue: Issue) -> str:
    each = zip(_pair_figures(issue, "derivatives"), _pair_figures(issue, "differences"), strict=False)
    entries = [f"{name} (derivative {stated:.3g}, differences {found:.3g})" for (name, stated), (_, found) in each]
    wrong = f"; it is wrong in {', '.join(entries)}" if entries else ""
    return (
        f"The gradient does not belong to the cost: along that direction it says {_get(issue, 'before'):.3g}, "
        f"differences of the cost say {_get(issue, 'after'):.3g}{wrong}. Check the derivatives."
    )


def _describe_jump(issue: Issue) -> str:
    places = _pair_figures(issue, "at")
    if len(places) == 1:
        where = f"{places[0][0]} passes {places[0][1]:.8g}"
    else:
        where = "the step passes " + ", ".join(f"{name} = {value:.8g}" for name, value in places)
    return (
        f"The cost jumps from {_get(issue, 'before'):.8g} to {_get(issue, 'after'):.8g} where {where}. The optimiser "
        "needs a cost that is continuous there."
    )


def _describe_switch(issue: Issue) -> str:
    name, comparison = issue.subjects
    at, before, after = (_get(issue, figure) for figure in ("at", "before", "after"))
    seen = f"The cost jumps from {before:.8g} to {after:.8g} where {name} passes {at:.8g}: " if np.isfinite(at) else ""
    return (
        f"{seen}{comparison}, and derivatives do not include such a switch. If {name} is a time, make it a transition "
        "time; if it is a level that a state passes, give that transition a guard. Otherwise use a smooth function, or "
        "fix it."
    )


def write_undefined(issue: Issue) -> str:
    """Return which function has no finite value or derivative, and where, as a part of a sentence.

    Parameters
    ----------
    issue : Issue
    """
    role, operation, line, run = issue.subjects
    state, order = issue.figures.get("x", ()), int(_get(issue, "order"))
    x = [float(f"{value:.6g}") for value in (state if isinstance(state, tuple) else (state,))]
    t = f"t = {_get(issue, 't'):.6g}, " if "t" in issue.figures else ""
    lacks = "derivatives" if _get(issue, "valued") else "value"
    function = f"{role}{f' of {run}' if run else ''} has no finite {lacks}{f' at {t}x = {x}' if x else ''}"
    which = ("", "the derivative of ", "the second derivative of ")[order]
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


def _write_places(issue: Issue) -> str:
    return ", ".join(f"{name} = {value:.8g}" for name, value in _pair_figures(issue, "at"))


def _describe_near_kink(issue: Issue) -> str:
    return (
        f"The derivatives are right, but there is a kink close by, near {_write_places(issue)}: along that direction "
        f"the slope jumps from {_get(issue, 'before'):.3g} to {_get(issue, 'after'):.3g}. Start elsewhere, or fix what "
        "is at the kink there."
    )


def _add_delay_hint(sentence: Callable[[Issue], str]) -> Callable[[Issue], str]:
    """Return a writer of why a line search failed, with a hint if a delay is estimated."""

    def write(issue: Issue) -> str:
        hint = (
            " A delay is estimated here: J has a kink where a transition meets the moment of which a late sample is, "
            "and the fit may have ended at one. Fix the delay at its estimate to see."
        )
        return sentence(issue) + (hint if _get(issue, "delayed") == 1.0 else "")

    return write


_ISSUES: dict[str, Callable[[Issue], str]] = {
    **LOG_ISSUES,
    # Before the numbers are believed
    "mode collapsed": lambda issue: (
        f"{_name_held_mode(issue)} has collapsed to nothing: the data want no such mode there. Leave it out of "
        "mode_sequence, start from another guess, or give min_duration."
    ),
    "minimum duration": lambda issue: (
        f"{_name_held_mode(issue)} is at its minimum duration: the data would have it shorter. Lower min_duration, or "
        "leave the mode out."
    ),
    "lower bound": _describe_held_by_bound,
    "upper bound": _describe_held_by_bound,
    "idle times": lambda issue: (
        "Where the collapsed mode would stand does not matter, since the same mode is active before and after it: "
        f"{_join(issue)} may lie anywhere in between, and the numbers above say no more than that."
    ),
    "idle parameters": lambda issue: (
        f"{_join(issue)}: acts only in modes that have collapsed. The data say nothing about it, and its value "
        "above is where the fit left it, not an estimate."
    ),
    "at a kink": _describe_kinks,
    "not read": lambda issue: (
        f"No function of the model reads {_join(issue)}: the data say nothing about it, and its value above is the "
        "first guess. Remove it from parameters, or use it in the model, whose functions may spell its name otherwise."
    ),
    "acts elsewhere": lambda issue: (
        f"{_join(issue)}: read only by modes, or at transitions, that do not occur in mode_sequence. The data say "
        "nothing about it, and its value above is the first guess. Fix it, or fit a log in which it acts too."
    ),
    "without effect": lambda issue: (
        f"The cost does not depend on {_join(issue)}, to second order: the data say nothing about it, and its value "
        "above is the first guess. Fix it, or let it act on what is measured."
    ),
    "hardly determined": _describe_hardly_determined,
    "no errors: not finite": lambda issue: "No standard errors: the cost or its derivatives are not finite.",
    "no errors: no noise model": lambda issue: (
        "No standard errors: the cost has no noise model. They need a cost that is made of Measurements alone, with "
        "sigma or without."
    ),
    "no errors: too few samples": lambda issue: (
        f"No standard errors: sigma is unknown and {_get(issue, 'samples'):.0f} values are too few to estimate it "
        f"beside {_get(issue, 'unknowns'):.0f} unknowns."
    ),
    "no errors: not positive definite": lambda issue: (
        "No standard errors: the Hessian is not positive definite (smallest eigenvalue "
        f"{_get(issue, 'eigenvalue'):.2g}, scaled to unit curvature)."
    ),
    "sigma too small": _describe_wrong_sigma,
    "sigma too large": _describe_wrong_sigma,
    "correlated residuals": _describe_correlation,
    "residuals not normal": _describe_non_normality,
    "known to second order": _describe_second_order,
    "covariances differ": _describe_covariances,
    "large integration error": lambda issue: (
        f"The integration error of {_join(issue)} is {_get(issue, 'error'):.1e}, relative: the numbers have fewer "
        "digits than it seems. Give the Problem a smaller rtol, or solver='stiff' if a mode is stiff."
    ),
    # Failures of a certificate
    "optimality": lambda issue: (
        f"the KKT residual {_get(issue, 'optimality'):.1e} is above the tolerance {_get(issue, 'tolerance'):.1e}"
    ),
    "negative curvature": lambda issue: (
        f"the Hessian has a negative eigenvalue on the free directions ({_get(issue, 'eigenvalue'):.1e}, scaled)"
    ),
    "integration error": lambda issue: (
        f"the integration error of {_join(issue)} is {_get(issue, 'error'):.1e}, relative"
    ),
    "derivative gap": lambda issue: (
        f"the paper's equations differ from the derivatives of J by {_get(issue, 'gap'):.1e}, relative"
    ),
    "Taylor orders": lambda issue: (
        f"the Taylor orders are {_format_orders(issue)} instead of (any), 2, 3 or more: gradient or Hessian do not "
        "belong to J"
    ),
    # Failures of a derivative check
    "cost not finite": lambda issue: (
        "J or its derivatives are not finite at this theta or near it, and cannot be checked. The states of "
        "sf.simulate(problem, theta) are NaN from where the solution breaks down. If a mode is stiff there, explicit "
        "steps are unstable: give the Problem solver='stiff'. Else check at another theta"
    ),
    "derivatives of another cost": lambda issue: "the derivatives do not belong to the cost",
    # Why a line search failed, or a fit ended with an error
    "wrong slope": _add_delay_hint(_describe_wrong_slope),
    "jump": _add_delay_hint(_describe_jump),
    "switch": _describe_switch,
    "undefined": lambda issue: (
        f"{capitalise(write_undefined(issue))}. {capitalise(suggest_definition(issue.subjects[1]))}."
    ),
    "kink": _add_delay_hint(_describe_near_kink),
    "not finite": lambda issue: (
        f"A little farther on, at {_write_places(issue)}, the cost or its derivatives are not finite: a function of "
        "the model is not defined there, or a state grows without bound. Start elsewhere, or bound the unknowns."
    ),
    "rounding": _add_delay_hint(
        lambda issue: (
            "The derivatives are right, but what the cost can still fall along that direction is less than its "
            f"rounding error, {_get(issue, 'noise'):.1e}. Scale the unknowns to be of size one, or ask for a larger "
            "tolerance."
        )
    ),
    "valley": _add_delay_hint(
        lambda issue: (
            "The derivatives are right, but the cost has a narrow valley there (condition number of the scaled Hessian "
            f"{_get(issue, 'condition'):.1e}). Start elsewhere, fix one of the unknowns that trade off, or take "
            "hessian='gauss-newton'."
        )
    ),
    "error": _join,
    # What a file of an earlier version holds as a sentence
    "message": _join,
}


def _format_orders(issue: Issue) -> str:
    orders = issue.figures.get("orders", ())
    return ", ".join(f"{order:.2f}" for order in (orders if isinstance(orders, tuple) else (orders,)))
