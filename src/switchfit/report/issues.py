"""The sentence of each kind of issue: oddities of logs, warnings of fits, failed checks, failed line searches."""

from __future__ import annotations

from switchfit.report.templates import Sentence, write_sentence
from switchfit.report.verdict import REASONS
from switchfit.report.wording import capitalise, join_subjects, join_words
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import format_text

_BOUND = "{names} is at its {kind} {value:g}: it has no standard error, and those of the others take it as known."


@format_text.register(Issue)
def write_issue(issue: Issue) -> str:
    """Return an issue as a sentence or two."""
    # Kinds that only a verdict has are parts of sentences there; here they stand alone, and end with a point.
    if issue.kind in _ISSUES:
        return write_sentence(_ISSUES[issue.kind], issue)
    if issue.kind in REASONS:
        text = write_sentence(REASONS[issue.kind], issue)
        return f"{text if text.startswith(tuple(filter(None, issue.subjects))) else capitalise(text)}."
    return f"{issue.kind}: {join_subjects(issue)}" if issue.subjects else issue.kind


def _write_combination(issue: Issue) -> str:
    """Return which unknowns trade off, or the single one."""
    names = issue.subjects
    return f"{join_words(names)} {'trade off' if len(names) > 1 else 'by itself'}" if names else "none"


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
