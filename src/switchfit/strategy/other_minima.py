"""Other minima near the end of a good fit: starts that may lead lower, and rivals that the data do not exclude."""

from __future__ import annotations

import logging
from operator import itemgetter

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.fit.search_record import Rival
from switchfit.meshes.evaluator import Evaluator
from switchfit.meshes.follower import Follower
from switchfit.strategy.corner_paths import look_beyond_corners
from switchfit.strategy.far_minima import find_far_minima
from switchfit.strategy.hops import look_near
from switchfit.strategy.short_fit import fit_briefly, is_lower
from switchfit.strategy.time_limit import OutOfTimeError
from switchfit.uncertainty.judged_fit import JudgedFit
from switchfit.uncertainty.transition_profiles import compute_threshold

logger = logging.getLogger("switchfit")

RIVAL_LEVEL, RIVAL_ITERATIONS = 0.95, 20
"""Confidence level at which the data do not tell two minima apart; and the most iterations of a fit of the other."""

LEAST_GAIN_OF_MINIMUM = 0.1
"""By how much J has to be lower on another path for a fit: the data cannot tell less, and the model errs as much."""


def find_other_minima(fit: JudgedFit, own: Evaluator | None) -> tuple[list[FloatArray], tuple[Rival, ...]]:
    """Return starts at other minima that may be lower than the end of a good fit, the best first: in a transition time,
    or where the state meets corners in another way; and the minima in a time that the data do not tell from it.

    `own` is the problem's own evaluator, whose meshes may be coarser than those of the fit: where they suit its end, a
    look takes half the time. Without one, nothing is looked for.
    """
    evaluator, theta, scale = fit.evaluator_at_solution(), fit.theta, fit.variance_scale
    hops: list[FloatArray] = []
    rivals: dict[str, Rival] = {}
    if own is None or not (fit.status.is_strict_minimum and scale > 0.0):
        return hops, ()
    try:
        evaluator = own if Follower(own).suits(theta) else evaluator
        cost = evaluator.cost(theta)
        errors = np.sqrt(np.diag(fit.held_covariance))  # 0 at kinks, which hold their times
        hops, close = find_far_minima(evaluator, theta, cost, errors, scale)
        hops += look_near(evaluator, theta, cost - LEAST_GAIN_OF_MINIMUM * scale, errors)
        if not hops and not evaluator.problem.constraint_names:
            hops = look_beyond_corners(evaluator, theta, cost - LEAST_GAIN_OF_MINIMUM * scale, fit.held_covariance)
        # A start that leads lower ends this minimum, and with it the question which others are as good.
        for place, point in [] if hops else close:
            end = fit_briefly(evaluator.problem, point, RIVAL_ITERATIONS, evaluator)
            if is_lower(end.cost, cost):
                hops.append(end.theta)
            elif end.cost < cost + compute_threshold(fit, RIVAL_LEVEL):
                name, value = fit.theta_names[place], float(end.theta[place])
                low, high = fit.confidence_intervals(RIVAL_LEVEL)[place]
                if not low <= value <= high:
                    rival = name, value, end.cost - cost
                    rivals[name] = min(rivals.get(name, rival), rival, key=itemgetter(2))
    except (KeyboardInterrupt, OutOfTimeError):
        pass
    except Exception:  # the fit is not lost by what is met elsewhere
        logger.info("the look at other minima has failed", exc_info=True)
    return hops, tuple(rivals.values())
