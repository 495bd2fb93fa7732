"""Minima of J on other paths through the corners of modes.

J has a kink where a trajectory takes another path through them, as where a pendulum with dry friction turns once more
before it rests, and may have a minimum on either side.
"""

from __future__ import annotations

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.engine.corners.branches import has_corners
from switchfit.meshes.evaluator import Evaluator
from switchfit.strategy.interval_models import MATRICES, MOST_SECOND_MODELS, minimize_quadratic
from switchfit.strategy.short_fit import make_feasible
from switchfit.strategy.time_limit import check_time

ERRORS_BEYOND = (2.0, 4.0, 6.0)
"""Standard errors from a minimum, along each unknown with the others following, at which other paths are looked for. Of
78 fits of a pendulum with dry friction 11 ended 0.6 to 2.8 above another minimum, which these found in all cases: one
of them began at 6."""


def look_beyond_corners(
    evaluator: Evaluator, theta: FloatArray, cost: float, covariance: FloatArray
) -> list[FloatArray]:
    """Return where quadratic models of J about points near by are lowest, the best first, if that is below a cost and
    the trajectory of the point takes another path through the corners of its modes than that of theta.

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
        A minimum.
    cost : float
    covariance : (d, d)
    """
    errors, models = np.sqrt(covariance.diagonal()), []
    if not any(map(has_corners, evaluator.structures)):
        return []
    evaluator.cost(theta)
    path = evaluator.paths
    for place in np.flatnonzero(errors > 0.0):
        for side in (-1.0, 1.0):
            for distance in ERRORS_BEYOND:
                # Along the column of the covariance: the valley of J, in which the others follow this unknown.
                point = theta + side * distance / errors[place] * covariance[:, place]
                point = make_feasible(evaluator.problem, point)
                check_time()
                # Farther out on this side it would not be finite either.
                if not np.isfinite(evaluator.cost(point)):
                    break
                if evaluator.paths == path:
                    continue
                for matrix in MATRICES:
                    there = evaluator(point, matrix=matrix)
                    # J is smooth on one path: a model about the first point on another one says how low J may be there.
                    found = minimize_quadratic(there.gradient, there.hessian, errors > 0.0, int(place), -np.inf, np.inf)
                    if found is not None:
                        break
                if found is not None and there.cost + found[0] < cost:
                    models.append((there.cost + found[0], point + found[1]))
                break
    return [start for _, start in sorted(models, key=lambda model: model[0])[:MOST_SECOND_MODELS]]
