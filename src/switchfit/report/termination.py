"""How a fit ended, as a sentence with its numbers, the active constraints and the kinks, and what to do next."""

from __future__ import annotations

from collections.abc import Sequence

from switchfit.fit.termination import Kink, Termination
from switchfit.optimize import Status
from switchfit.problem.constraints import Constraint
from switchfit.problem.reads import name_whole_parameters
from switchfit.report.verdict import write_reason, write_step
from switchfit.runtime.issue import Issue
from switchfit.runtime.presentation import format_count, format_text
from switchfit.uncertainty.advice import WRITTEN_OTHERWISE

_FIT_ENDINGS: dict[Status | str, str] = {
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
    # A flat direction that has only unknowns that nothing reads is no question of data: it is a mistake in the model.
    flat = {name for name, _ in ended.flat_direction}
    only_unread = ended.status is Status.SINGULAR and flat and flat <= {*ended.unread, *ended.absent}
    template = _FIT_ENDINGS["only unread" if only_unread else ended.status]
    # Some reasons are said by the sentence of the status; one that is not must not get lost.
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
