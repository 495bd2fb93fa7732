"""When `estimate` tries no more: noise of a known size is left, or a search has looked and found nothing lower."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from switchfit.estimation.estimator import Estimate
from switchfit.fit.result import Step
from switchfit.fit.variation import measure_variation
from switchfit.optimize import Status
from switchfit.problem.data import Measurements, ReferenceSignal
from switchfit.problem.problem import Problem, keep_with_problem
from switchfit.uncertainty.answers import NEARLY_ALL, UNLIKELY, compare_with_sigma

MORE_STARTS = "next: more starts"
"""Step that a verdict advises where the fit may be better elsewhere."""


def is_enough(problem: Problem, fit: Estimate, steps: Sequence[Step] = ()) -> bool:
    """Return whether nothing more has to be tried.

    Where the size of the noise is known, a right end leaves that noise. Where it is not, a minimum near the lowest may
    leave as little: a search has to have looked elsewhere. Where what is left is no noise, the end may be wrong or the
    model: it is the model if a search has looked and found nothing lower.

    Parameters
    ----------
    problem : Problem
    fit : Estimate
        The best so far.
    steps : sequence of Step
        The fit from the first guess, and the searches since.
    """
    if fit.status is Status.INTERRUPTED or _is_model_at_fault(fit) or is_confirmed(problem, fit):
        return True
    if not fit.status.successful:
        return False
    if len(steps) < 2:
        if not any(run.transition_times for run in problem.experiments):
            return not is_doubted(fit)
        if problem.is_least_squares and not is_explained(problem, fit.cost):  # a verdict takes as long as many steps
            return False
        answer = fit.verdict.answers[-1]
        return not is_doubted(fit) and answer.kind == "fits" and answer.figures.get("known") == 1.0
    return not is_doubted(fit) or (steps[-1].cost == steps[-2].cost and not steps[-1].ended)


def _is_model_at_fault(fit: Estimate) -> bool:
    """Return whether what ended a fit is how a function is written, from wherever the fit begins.

    Derivatives leave a switch out; and where J has a value at the start, but no derivatives, other starts have as few.
    """
    if fit.reason is None:
        return False
    if fit.reason.kind == "switch":
        return True
    underivable = fit.reason.kind == "undefined" and fit.reason.figures["valued"] == 1.0
    return fit.status is Status.NONFINITE_START and underivable


def is_confirmed(problem: Problem, fit: Estimate) -> bool:
    """Return whether J alone says that nothing is in doubt, without a simulation of what was fitted.

    Parameters
    ----------
    problem : Problem
    fit : Estimate
    """
    if fit.status is not Status.CONVERGED or fit.active or fit.idle or fit.integration_error > problem.rtol:
        return False
    return is_explained(problem, fit.cost)


def is_explained(problem: Problem, cost: float) -> bool:
    """Return whether J leaves nothing but noise of the data, whose size is known, or next to nothing of references.

    Parameters
    ----------
    problem : Problem
    cost : float
    """
    items = [item for run in problem.experiments for item in run.data]
    if all(isinstance(item, ReferenceSignal) for item in items):
        return cost <= (1 - NEARLY_ALL) * _compute_cost_of_means(problem)
    if not (problem.is_sigma_known and problem.is_least_squares):
        return False
    count = sum(item.count for item in items if isinstance(item, Measurements))
    freedom = count + int(np.count_nonzero(problem.unknowns.priors.precision)) - len(problem.theta_names)
    return freedom > 0 and bool(compare_with_sigma(2 * cost, freedom)[0] >= UNLIKELY)


@keep_with_problem
def _compute_cost_of_means(problem: Problem) -> float:
    """Return J of references that are met by their means."""
    return float(measure_variation(problem).sum())


def is_doubted(fit: Estimate) -> bool:
    """Return whether a better end may be elsewhere, by what the verdict says.

    Parameters
    ----------
    fit : Estimate
    """
    return not fit.status.successful or any(step.kind == MORE_STARTS for step in fit.verdict.next_steps)
