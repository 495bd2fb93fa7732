"""Profiles of the transition times of a fit that samples or kinks are near, where one parabola is no picture.

With samples within a few standard errors of the estimate, J is made of one parabola for each stretch between samples.
Of many fits the pieces are kept (`switchfit.batch.interval_pieces`), so that intervals can be had at any level.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.fit.result import Fit
from switchfit.meshes.evaluator import Evaluator
from switchfit.meshes.follower import Follower
from switchfit.meshes.halving import halve_cells
from switchfit.problem.problem import Problem
from switchfit.uncertainty.density_intervals import HIGHEST_RISE, list_resets
from switchfit.uncertainty.profile_pieces import NUMBERS_OF_PIECE
from switchfit.uncertainty.walk_tracing import MOST_HALVINGS, trace_walks
from switchfit.uncertainty.walks import Derivatives, Walks, join_walks, list_transitions, list_walks, stack_sample_times

MOST_PIECES = 60
"""Sample times that are passed in one direction; with more of them in an interval the kinks average out."""

MOST_TRACED_RUNS = 15
"""Problems of more experiments, whose evaluations take long, keep the intervals of one parabola."""

NEAR_IN_STANDARD_ERRORS = 5.0
"""Pieces are traced if a sample lies within this many standard errors, twice as far as a 99 % interval reaches. Where
most of what is known about a transition time comes from the samples next to it, its profile is far from a parabola
before it reaches them."""

HIGHEST_LEVEL = 0.99
"""Pieces are traced up to the end of an interval of this level, whatever lower level is asked for."""


def trace_profiles(
    fit: Fit, problem: Problem, evaluator: Evaluator, level: float = HIGHEST_LEVEL
) -> tuple[FloatArray, NDArray[np.intp]]:
    """Return the pieces of the profiles of transition times with samples near, or at a kink: (T, 2, P, 5); and where in
    theta these times stand: (T,).

    They go up to the ends of intervals of a level. A model with thin layers has none, as its J is rough on one mesh:
    the mesh would have to be made anew at every step.

    Parameters
    ----------
    fit : Fit
    problem : Problem
    evaluator : Evaluator
    level : float
    """
    # Arrays without entries, of the right shapes and types: what is saved can be loaded again.
    nothing = fit.saved_pieces[:0], fit.saved_piece_places[:0]
    highest = compute_threshold(fit, max(level, HIGHEST_LEVEL))
    # Quantiles of a density ask for all of its mass, farther out than the one crossing of a threshold.
    rise = max(highest, HIGHEST_RISE * fit.variance_scale)
    if np.isnan(highest) or fit.constraints or len(problem.experiments) > MOST_TRACED_RUNS:
        return nothing
    if any(mesh.has_layers for mesh in evaluator.meshes):
        return nothing
    # Unknowns that are free one by one, and have an effect on J.
    movable = (np.sum(fit.free_basis**2, axis=1) > 1 - 1e-9) & fit.hessian.any(axis=1)
    # Fits as rows of arrays, here one: `walks` are the same code as for many fits.
    kinks, resets, at, places = {kink.unknown for kink in fit.kinks}, list_resets(fit), fit.theta[None], []
    ways: list[Walks] = []
    for e, k in list_transitions(problem):
        samples = stack_sample_times(problem, at, e)
        near = is_any_near(samples, at[:, k], fit.standard_errors[k : k + 1])[0]
        # A time that a kink holds always has two different sides. Others need their pieces where a sample is near.
        if fit.theta_names[k] in kinks or (movable[k] and (near or k in resets)):
            threshold = np.array([rise if k in resets else highest])
            ways.append(list_walks(problem, e, k, at, movable[None], threshold, samples, MOST_PIECES))
            places.append(k)
    if not ways:
        return nothing
    walks, follower = join_walks(ways), Follower(halve_cells(evaluator))  # its meshes suit the estimate alone

    def evaluate(which: NDArray[np.intp], thetas: FloatArray) -> Derivatives:
        found = [follower(theta, side) for theta, side in zip(thetas, walks.side[which].tolist(), strict=True)]
        return Derivatives(*(np.array([getattr(one, name) for one in found]) for name in Derivatives._fields))

    # Stretches are one more than the samples between them, and the last of them is cut up to MOST_HALVINGS times.
    most = MOST_PIECES + MOST_HALVINGS + 1
    costs = np.full(len(walks.place), fit.cost)
    pieces = trace_walks(walks, costs, evaluate, most, problem.unknowns.times).reshape(-1, 2, most, NUMBERS_OF_PIECE)
    known = ~np.isnan(pieces[..., 0])
    # A side whose first piece could not be traced has no profile; the interval of one parabola stays then.
    complete = known[:, :, 0].all(axis=1)
    return pieces[complete, :, : int(known.sum(axis=2).max())], np.array(places)[complete]


def compute_threshold(fit: Fit, level: float) -> float:
    """Return by how much J may exceed its minimum: half the squared quantile, times the residual variance.

    NaN for a fit without a noise model, or one that did not converge.
    """
    return 0.5 * fit.quantile(level) ** 2 * fit.variance_scale if fit.status.successful else np.nan


def is_any_near(samples: FloatArray, values: FloatArray, errors: FloatArray) -> NDArray[np.bool_]:
    """Return of which fits a sample is so near to a transition time that one parabola does not give its interval: (F,).

    Parameters
    ----------
    samples : (F, S)
        Sample times.
    values, errors : (F,)
        Of the transition time, and its standard errors.
    """
    with np.errstate(invalid="ignore"):
        near = np.abs(samples - values[:, None]) <= NEAR_IN_STANDARD_ERRORS * errors[:, None]
    return np.asarray((errors > 0) & near.any(axis=1))
