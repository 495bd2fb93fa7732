"""When `estimate` tries no more: noise of a known size is left, or a search has looked and found nothing lower."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from switchfit.fit.data_variation import measure_variation
from switchfit.fit.search_record import Step
from switchfit.fit.statistics import count_priors, count_samples
from switchfit.optimize import Status
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem
from switchfit.problem.reference_signals import ReferenceSignal
from switchfit.strategy.known_order import explain_no_beam
from switchfit.uncertainty.chi_square import CLEARLY_OFF, UNLIKELY_AS_NOISE, compare_with_sigma
from switchfit.uncertainty.doubts import NEARLY_ALL
from switchfit.uncertainty.issues import find_without_effect
from switchfit.uncertainty.judged_fit import JudgedFit

ADVISED_MORE_STARTS = "next: more starts"
"""Step that a verdict advises where the fit may be better elsewhere."""

DEEP = 10.0
"""Multiple of what chi-square hides by which J rises at least around a time that is in no doubt. Wrong ends of weak
events reach 9.7; the times of a thermostat that switches five times in 40 samples begin at 59."""


def is_enough(problem: Problem, fit: JudgedFit, steps: Sequence[Step] = ()) -> bool:
    """Return whether nothing more has to be tried.

    Where the size of the noise is known, a right end leaves that noise. Where it is not, a minimum near the lowest may
    leave as little: a search has to have looked elsewhere. Where what is left is no noise, the end may be wrong or the
    model: it is the model if a search has looked and found nothing lower.

    Parameters
    ----------
    problem : Problem
    fit : JudgedFit
        The best so far.
    steps : sequence of Step
        The fit from the first guess, and the searches since.
    """
    if fit.status is Status.INTERRUPTED or _is_model_at_fault(problem, fit) or is_confirmed(problem, fit):
        return True
    if not fit.status.successful:
        return False
    if len(steps) < 2:
        # Without a time there is no schedule to search for: what the verdict says is all that can be asked.
        if not any(run.transition_times for run in problem.experiments):
            return not is_doubted(fit)
        # A verdict takes as long as many steps, and so does a beam, which finds other minima that leave nearly noise.
        is_noise = not problem.is_least_squares or is_explained(problem, fit.cost, 1.0)
        if not is_noise and not (is_explained(problem, fit.cost) and explain_no_beam(problem)):
            return False
        answer = fit.verdict.answers[-1]
        return not is_doubted(fit) and answer.kind == "fits" and answer.figures.get("known") == 1.0
    items = [item for run in problem.experiments for item in run.data]
    if not any(isinstance(item, Measurements | ReferenceSignal) for item in items):
        # No quality of fit tells a local minimum from the lowest: a few starts have to.
        return len(steps) > 2 and steps[-1].cost == steps[-2].cost
    if not is_doubted(fit):
        return True
    # The beam has no derivative to follow where an unknown has no effect, as the height of a weir that is not reached.
    is_blind = len(steps) == 2 and any(issue.kind == "without effect" for issue in find_without_effect(fit))
    return steps[-1].cost == steps[-2].cost and not steps[-1].ended and not is_blind


def _is_model_at_fault(problem: Problem, fit: JudgedFit) -> bool:
    """Return whether what is doubted of a fit is how a function is written alone, from wherever the fit begins.

    Derivatives leave a switch out, also at the best end, and where there are none in the initial state, other starts
    have as few.
    """
    if fit.reason is None:
        return False
    if fit.reason.kind == "switch":
        return not is_doubted(fit)
    is_known = fit.reason.kind == "undefined" and fit.reason.figures["valued"] == 1.0
    begins = [run.t0 for run in problem.experiments]
    return fit.status is Status.NONFINITE_START and is_known and fit.reason.figures.get("t", begins[0]) in begins


def is_confirmed(problem: Problem, fit: JudgedFit) -> bool:
    """Return whether J alone says that nothing is in doubt, without a simulation of what was fitted.

    Parameters
    ----------
    problem : Problem
    fit : JudgedFit
    """
    if fit.status is not Status.CONVERGED or fit.active or fit.idle or fit.integration_error > problem.rtol:
        return False
    # A larger J may be that of another minimum, and noise all the same by chi-square: residuals tell them apart. Of a
    # flame that is quenched, 100 samples, a wrong end has a reduced chi-square of 1.26, and outliers.
    return is_explained(problem, fit.cost, 1.0)


def is_explained(problem: Problem, cost: float, least: float = UNLIKELY_AS_NOISE) -> bool:
    """Return whether J leaves nothing but noise of the data, whose size is known, or next to nothing of references.

    Parameters
    ----------
    problem : Problem
    cost : float
    least : float
        Probability that chi-square has at least; 1 is that of one that is not clearly too large (`CLEARLY_OFF`).
    """
    items = [item for run in problem.experiments for item in run.data]
    if all(isinstance(item, ReferenceSignal) for item in items):
        return cost <= (1 - NEARLY_ALL) * float(measure_variation(problem).sum())
    if not (problem.is_sigma_known and problem.is_least_squares):
        return False
    freedom = _count_freedom(problem)
    return freedom > 0 and bool(compare_with_sigma(2 * cost, freedom)[0] >= least)


def _count_freedom(problem: Problem) -> int:
    """Return the degrees of freedom, with all unknowns free, without a simulation."""
    return count_samples(problem) + count_priors(problem) - len(problem.theta_names)


def is_shallow(problem: Problem, fit: JudgedFit) -> bool:
    """Return whether chi-square may hide that a transition of a good fit is in the wrong place: J does not rise by a
    large multiple of what it hides before the time is half through the shorter mode beside it.

    Parameters
    ----------
    problem : Problem
    fit : JudgedFit
    """
    freedom = _count_freedom(problem)
    if not (problem.is_sigma_known and problem.is_least_squares and freedom > 0):
        return False
    # J is accepted up to this above its mean, freedom / 2, and the lowest may be two standard deviations below it.
    hidden = 0.5 * CLEARLY_OFF * freedom + 2 * np.sqrt(0.5 * freedom)
    for e, run in enumerate(problem.experiments):
        places = problem.unknowns.times[e]
        modes = np.diff(run.ends_of_modes(np.where(places >= 0, fit.theta[places], run.initial_times)))
        for i in np.flatnonzero(places[: len(modes) - 1] >= 0).tolist():
            # Beyond half of the shorter mode another transition is near, and one parabola about the fit says nothing. A
            # time at a kink has no parabola at all, and is in doubt.
            half, error = 0.5 * min(modes[i], modes[i + 1]), fit.standard_errors[places[i]]
            if not error > 0.0 or not 0.5 * (half / error) ** 2 > DEEP * hidden:
                return True
    return False


def is_doubted(fit: JudgedFit) -> bool:
    """Return whether a better end may be elsewhere, by what the verdict says.

    Parameters
    ----------
    fit : JudgedFit
    """
    return not fit.status.successful or any(step.kind == ADVISED_MORE_STARTS for step in fit.verdict.next_steps)
