"""Intervals of transition times across sample times, where the cost has kinks.

With samples within a few standard errors of the estimate one parabola is no picture of J. Here it is made of one
parabola for each stretch between samples (`switchfit.uncertainty.walks`), and the interval is where 2 (J_p − J) stays
below the squared quantile. Of many fits the pieces are kept (`switchfit.batch.intervals`), so that intervals can be had
at any level.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.fit.evaluator import Evaluator
from switchfit.fit.following import Follower
from switchfit.fit.result import Fit, TimeProfile
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem
from switchfit.uncertainty.walks import (
    MOST_HALVINGS,
    Derivatives,
    Samples,
    Walks,
    find_first_root,
    join_walks,
    list_transitions,
    list_walks,
    trace_walks,
)

MOST_PIECES = 60
"""Sample times that are passed in one direction; with more of them in an interval the kinks average out."""

MOST_RUNS = 15
"""Problems of more experiments, whose evaluations take long, keep the intervals of one parabola."""

NEAR = 5.0
"""Pieces are traced if a sample lies within this many standard errors, twice as far as a 99 % interval reaches. Where
most of what is known about a transition time comes from the samples next to it, its profile is far from a parabola
before it reaches them."""

BISECTIONS = 40
"""Halvings of a piece until its crossing of the threshold is known to rounding."""

HIGHEST_LEVEL = 0.99
"""Pieces are traced up to the end of an interval of this level, whatever lower level is asked for."""


def replace_intervals(fit: Fit, intervals: FloatArray, level: float, profiles: Sequence[TimeProfile]) -> FloatArray:
    """Return intervals (d, 2) with those of transition times that have pieces from these.

    Parameters
    ----------
    fit : Fit
    intervals : (d, 2)
    level : float
    profiles : sequence of TimeProfile
    """
    found, threshold = intervals.copy(), _compute_threshold(fit, level)
    if threshold is not None:
        for profile in profiles:
            k = fit.theta_names.index(profile.unknown)
            found[k, 0] = find_ends(profile.below, np.array(threshold), -1)
            found[k, 1] = find_ends(profile.above, np.array(threshold), 1)
    return found


def trace_profiles(
    fit: Fit, problem: Problem, evaluator: Evaluator, level: float = HIGHEST_LEVEL
) -> tuple[TimeProfile, ...]:
    """Return the profiles of transition times with samples near, or at a kink, up to the ends of intervals of a level.

    None of a model with thin layers, whose J is rough on one mesh: the mesh would have to be made anew at every step.

    Parameters
    ----------
    fit : Fit
    problem : Problem
    evaluator : Evaluator
    level : float
    """
    highest = _compute_threshold(fit, max(level, HIGHEST_LEVEL))
    if highest is None or fit.constraints or len(problem.experiments) > MOST_RUNS:
        return ()
    if any(mesh.has_layers for mesh in evaluator.meshes):
        return ()
    movable, kinks = _find_movable(fit), {kink.unknown for kink in fit.kinks}
    at, names = fit.theta[None], []
    ways: list[Walks] = []
    for e, k in list_transitions(problem):
        samples = Samples.of(problem, at, e)
        near = is_any_near(samples, at[:, k], fit.standard_errors[k : k + 1])[0]
        if fit.theta_names[k] in kinks or (movable[k] and near):
            ways.append(list_walks(problem, e, k, at, movable[None], np.array([highest]), samples, MOST_PIECES))
            names.append(fit.theta_names[k])
    if not ways:
        return ()
    walks, follower = join_walks(ways), Follower(evaluator.halved)  # its meshes suit the estimate alone

    def evaluate(which: NDArray[np.intp], thetas: FloatArray) -> Derivatives:
        found = [follower(theta, side) for theta, side in zip(thetas, walks.side[which].tolist(), strict=True)]
        return Derivatives(*(np.array([getattr(one, name) for one in found]) for name in Derivatives._fields))

    count = len(walks.place)
    start = Derivatives(*(np.array([each] * count) for each in (fit.cost, fit.gradient, fit.hessian)))
    smooth = np.zeros(count, dtype=bool)
    pieces = trace_walks(walks, start, smooth, evaluate, MOST_PIECES + MOST_HALVINGS + 1)
    sides = [found[~np.isnan(found[:, 0])] for found in pieces]
    profiles = [TimeProfile(name, *sides[2 * i : 2 * i + 2]) for i, name in enumerate(names)]
    return tuple(profile for profile in profiles if len(profile.below) and len(profile.above))


def _compute_threshold(fit: Fit, level: float) -> float | None:
    """Return by how much J may exceed its minimum: half the squared quantile, times the residual variance.

    None for a fit without a noise model, or one that did not converge.
    """
    if fit.sigma_known is None or not fit.status.successful:
        return None
    scale = 1.0 if fit.sigma_known else 2.0 * fit.cost / max(fit.freedom, 1)
    return 0.5 * fit.quantile(level) ** 2 * scale


def is_any_near(samples: Samples, values: FloatArray, errors: FloatArray) -> NDArray[np.bool_]:
    """Return of which fits a sample is so near to a transition time that one parabola does not give its interval: (F,).

    Parameters
    ----------
    samples : Samples
    values, errors : (F,)
        Of the transition time, and its standard errors.
    """
    with np.errstate(invalid="ignore"):
        near = np.abs(samples.times - values[:, None]) <= NEAR * errors[:, None]
    return np.asarray((errors > 0) & near.any(axis=1))


def _find_movable(fit: Fit) -> Any:
    """Return which unknowns are free one by one, and have an effect on J: (d,) of bool."""
    Z = fit.free_basis
    return (np.sum(Z * Z, axis=1) > 1 - 1e-9) & fit.hessian.any(axis=1)


def find_ends(pieces: FloatArray, thresholds: FloatArray, side: int) -> FloatArray:
    """Return where profiles first reach thresholds above the estimate; where the last piece ends if they do not.

    A piece is the cubic that also has the rise with which the piece after it begins; the last one is a parabola.

    Parameters
    ----------
    pieces : (..., P, 5)
        Outwards; after the last of them NaN.
    thresholds : (...)
    side : -1 or 1
    """
    found = np.full(pieces.shape[:-2], np.nan)
    searched = np.ones(found.shape, dtype=bool)
    for p in range(pieces.shape[-2]):
        start, stop, rise, slope, curvature = np.moveaxis(pieces[..., p, :], -1, 0)
        after = pieces[..., p + 1, 2] if p + 1 < pieces.shape[-2] else np.full_like(found, np.nan)
        length, height, last = side * (stop - start), thresholds - rise, np.isnan(after)
        with np.errstate(invalid="ignore", divide="ignore"):
            parabola = find_first_root(height, slope, curvature)
            cubic = np.where(after >= thresholds, _bisect(after - rise, slope, curvature, length, height), np.inf)
            reach = np.where(height <= 0, 0.0, np.where(last, parabola, cubic))
        searched &= ~np.isnan(start)
        found = np.where(searched, start + side * np.minimum(reach, length), found)
        searched &= ~(reach <= length)
    return found


def _bisect(
    gain: FloatArray, slope: FloatArray, curvature: FloatArray, length: FloatArray, height: FloatArray
) -> FloatArray:
    """Return where cubics from 0, with slope and curvature there and a gain after a length, reach a height."""
    third = (gain - slope * length - 0.5 * curvature * length**2) / length**3
    low, high = np.zeros_like(length), length
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        below = middle * (slope + middle * (0.5 * curvature + middle * third)) < height
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return high
