"""What speaks against each of many fits, from the arrays in which they ended.

Ten thousand fits cannot be simulated one by one. Each is judged by what its program returns (status, J, theta, the
Hessian) and by the share of its data's variance that J leaves, by the rules of single fits
(`switchfit.uncertainty.verdict`), as if its residuals could not be tested. Not looked at are the correlation of the
residuals, single channels, other starts, and checks of derivatives: fit one by itself for these.

With J half a sum of squares, and V that of the data about their means, the share of the variance that is explained is
``1 - J / V``. So it needs V once for each data set, where a single fit compares its trajectory channel by channel.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.fit.statistics import count_samples
from switchfit.optimize import Status
from switchfit.problem.experiment import Experiment
from switchfit.problem.problem import Problem
from switchfit.uncertainty import doubts
from switchfit.uncertainty.chi_square import compare_with_sigma
from switchfit.uncertainty.doubts import Doubt, Numbers

AT_END = 1e-9
"""Duration of a mode, as a part of the horizon, or distance from a bound, as a part of it, that counts as zero."""

EXPLAINED_BADLY = ("unexplained", "no noise")
"""Doubts that chi-square gives."""


def describe_ends(
    problem: Problem, theta: FloatArray, cost: FloatArray, variation: FloatArray
) -> dict[str, NDArray[Any]]:
    """Return the fields `samples`, `explained`, `collapsed` and `at_bounds` of `Fits`, (R,) each.

    Parameters
    ----------
    problem : Problem
        Its bounds, modes and horizons; its data may differ from those that were fitted.
    theta : (R, d)
    cost : (R,)
    variation : (R,)
        Sum of `switchfit.fit.data_variation.measure_variation` over the experiments.
    """
    unknowns, priors = problem.unknowns, problem.unknowns.priors
    # The priors' part of J explains no data.
    squares = cost - np.array([priors.evaluate(each)[0] for each in theta]) if priors.any else cost
    with np.errstate(divide="ignore", invalid="ignore"):
        explained = np.where(variation == 0, squares <= 0, 1 - squares / variation)
        near = AT_END * np.abs(theta)
        held = (theta <= unknowns.lower + near) | (theta >= unknowns.upper - near)
        held &= ~unknowns.is_time & (unknowns.lower < unknowns.upper)  # equal bounds are a value that is known
        collapsed = sum(map(partial(_count_collapsed, problem), problem.experiments, problem.ends_of_modes(theta)))
    return {
        "samples": np.full(len(cost), count_samples(problem)),
        "explained": np.where(np.isnan(variation) | np.isnan(cost), np.nan, explained),
        "collapsed": np.asarray(collapsed, dtype=np.int64),
        "at_bounds": np.sum(held, axis=1),
    }


def _count_collapsed(problem: Problem, experiment: Experiment, ends: FloatArray) -> NDArray[np.int64]:
    """Return how many modes of an experiment last no longer than they must, from their ends (R, N + 2): (R,)."""
    least = np.array([problem.durations[mode] for mode in experiment.mode_sequence])
    shortest = least + AT_END * (experiment.end - experiment.t0)
    found: NDArray[np.int64] = np.sum(np.diff(ends, axis=1) <= shortest, axis=1)
    return found


def has_converged(status: NDArray[Any]) -> NDArray[np.bool_]:
    """Return which of fits with these names of their `Status` converged: (R,)."""
    return np.isin(status, [one.name for one in Status if one.successful])


def find_doubts(fits: Mapping[str, NDArray[Any]], sigma_known: bool | None, priors: int) -> list[Doubt]:
    """Return what speaks against each of R fits, in order of weight.

    Parameters
    ----------
    fits : mapping of str to array
        Fields of `Fits`: `status`, `cost`, `hessian`, `free`, `samples`, `explained`, `collapsed`, `at_bounds`.
    sigma_known, priors : as of `Fits`
    """
    status, explained, freedom = fits["status"], fits["explained"], fits["samples"] + priors - fits["free"]
    has_noise, has_shares = sigma_known is not None, bool(np.isfinite(explained).any())
    numbers = Numbers(
        has_converged(status),
        explained=explained,
        freedom=freedom if has_noise and has_shares else np.inf,
        collapsed=np.where(status == Status.COLLAPSED.name, 1, fits["collapsed"]),
        at_bounds=fits["at_bounds"] if has_noise or has_shares else 0,
        smallest=_find_smallest(fits["hessian"], fits["free"], status),
        references=not has_noise,
    )
    if has_shares and sigma_known:
        probability, known = compare_with_sigma(2 * fits["cost"], freedom, tests=len(status))
        numbers = replace(numbers, probability=probability, known=known)
    return doubts.find_doubts(numbers)


def _find_smallest(H: FloatArray, free: NDArray[np.int64], status: NDArray[np.str_]) -> FloatArray:
    """Return the smallest eigenvalue of each scaled Hessian, infinite where a constraint is active: (R,)."""
    found = np.where(status == Status.SINGULAR.name, 0.0, np.inf)
    diagonal = np.diagonal(H, axis1=1, axis2=2)
    # All of equal size in one call. Fits with fewer free directions would each need a basis of their own.
    whole = (free == H.shape[1]) & np.isfinite(H).all(axis=(1, 2)) & (diagonal > 0).all(axis=1)
    if whole.any():
        scale = diagonal[whole] ** -0.5
        smallest = np.linalg.eigvalsh(H[whole] * scale[:, :, None] * scale[:, None, :])[:, 0]
        found[whole] = np.minimum(found[whole], smallest)
    return found
