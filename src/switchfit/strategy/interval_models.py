"""Quadratic models of J with one transition time inside an interval, all other unknowns following.

Between two samples J is smooth in a transition time, so that a model about a point inside tells how low J is there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.engine.evaluation import Evaluation, Matrix
from switchfit.meshes.evaluator import Evaluator
from switchfit.optimize import lapack
from switchfit.strategy.time_limit import check_time

MOST_SECOND_MODELS = 4
"""Intervals, those with the lowest models, of which a second model is made, about the minimum of the first. That about
the middle of an interval errs by 1e-4 of J: of five fits that began there with ten joint tosses, one lowered J."""

INSIDE_INTERVAL = 1e-3
"""Least distance of a start from the ends of its interval, as a part of the interval."""

MATRICES: tuple[Matrix, ...] = ("exact", "gauss-newton")
"""Of models far from a minimum: the second where the first leads to none, since residuals are large at first, and so is
their part of the exact Hessian."""

FindLowest = Callable[[FloatArray], tuple[float, FloatArray]]


def list_hops(
    evaluator: Evaluator,
    theta: FloatArray,
    intervals: Sequence[list[tuple[int, float, float]]],
    free: NDArray[np.bool_],
    matrices: Sequence[Matrix],
) -> Iterator[tuple[float, FloatArray, FindLowest]]:
    """Yield for each of some intervals of each run the lowest J of the quadratic model about its middle, theta there,
    and a function that returns both of the model about another point.

    The model of the whole J is that about theta, of which a run has the part `here`, and of that run the one about a
    point, with the first of some matrices that leads to a minimum. A sigma stays what it is: far from a minimum it
    would make up for residuals that the other unknowns are to fit.
    """
    if not any(intervals):
        return
    unknowns, whole = evaluator.problem.unknowns, evaluator(theta)
    # Unknowns at a bound stay there: an unbounded quadratic model would lead outside.
    free = free & (unknowns.lower < theta) & (theta < unknowns.upper) & ~evaluator.problem.is_sigma
    for e, listed in enumerate(intervals):
        here = _evaluate_run(evaluator, e, theta) if listed else whole
        # One evaluation of the whole and one of the run at theta serve all intervals; each adds one of the run alone.
        for place, low, high in listed:
            model = partial(_find_lowest, evaluator, e, whole, here, theta, free, matrices, place, low, high)
            middle = theta.copy()
            middle[place] = 0.5 * (low + high)
            yield *model(middle), model


@np.errstate(over="ignore", invalid="ignore")  # a model whose numbers are not finite has no minimum
def _find_lowest(
    evaluator: Evaluator,
    e: int,
    whole: Evaluation[FloatArray],
    here: Evaluation[FloatArray],
    theta: FloatArray,
    free: NDArray[np.bool_],
    matrices: Sequence[Matrix],
    place: int,
    low: float,
    high: float,
    point: FloatArray,
) -> tuple[float, FloatArray]:
    """Return the lowest J with the unknown at `place` between two values, and theta there (d,); infinite where the
    model about the point has no minimum.
    """
    check_time()
    own, mine = evaluator.problem.own_places[e]
    # At the upper end of its interval J has another derivative beyond the sample: it has to be that from inside.
    side, away = 1 if point[place] < high else -1, (theta - point)[mine]
    for matrix in matrices:
        there = _evaluate_run(evaluator, e, point, side, matrix)
        if not np.isfinite(there.hessian).all():
            break
        curvature = there.hessian[own[:, None], own]
        # The model of the run is about `point`, that of all else about theta; with away = theta - point, both are
        # written about theta: J, g and H of the run are moved there by its own quadratic model, g + H away.
        cost = whole.cost - here.cost + there.cost + (there.gradient[own] + 0.5 * curvature @ away) @ away
        gradient, hessian = whole.gradient.copy(), whole.hessian.copy()
        # Two names of a run may be one unknown of the problem: an indexed sum would keep the last of them alone.
        np.add.at(gradient, mine, (there.gradient - here.gradient)[own] + curvature @ away)
        np.add.at(hessian, (mine[:, None], mine), curvature - here.hessian[own[:, None], own])
        inside = INSIDE_INTERVAL * (high - low)  # where a reset map acts, J at the end is that of the next interval
        found = minimize_quadratic(
            gradient, hessian, free, place, low + inside - theta[place], high - inside - theta[place]
        )
        if found is not None:
            return float(cost + found[0]), theta + found[1]
    return np.inf, theta


def _evaluate_run(
    evaluator: Evaluator, e: int, theta: FloatArray, side: int = 1, matrix: Matrix = "exact"
) -> Evaluation[FloatArray]:
    return evaluator.engines[e].derivatives(*evaluator.problem.vectors(theta, e), side, matrix)


def minimize_quadratic(
    gradient: FloatArray, hessian: FloatArray, free: NDArray[np.bool_], place: int, low: float, high: float
) -> tuple[float, FloatArray] | None:
    """Return the lowest value of a quadratic model with the unknown at `place` between two values, and the step (d,);
    None if it has no minimum.
    """
    # A Cholesky factorisation tells at once whether the model has a minimum, and gives the step.
    step, places = np.zeros(len(gradient)), np.flatnonzero(free | (np.arange(len(free)) == place))
    factor, step[places], failed = lapack.dposv(hessian[places[:, None], places], -gradient[places])
    if failed:
        return None
    if not low <= step[place] <= high:
        # Along the way on which the others follow the unknown to its limit.
        away, is_it = np.clip(step[place], low, high) - step[place], places == place
        # Column of H^-1 for the unknown at `place`, scaled so that this moves by 1: how all others follow it.
        along = lapack.dpotrs(factor, is_it.astype(float))[0]
        step[places] += along * (away / along[is_it])
    return float((gradient + 0.5 * hessian @ step) @ step), step
