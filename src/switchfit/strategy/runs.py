"""Each run alone first: runs that begin badly are found, and put right, one by one before all are fitted together.

A joint fit from a start at which a few runs are far off is led astray by them: the shared unknowns follow the worst.
So each run is fitted by itself, with shared unknowns of its own. Their weighted median is what most runs agree on,
whatever a few say; each run's own unknowns follow to it by the Schur complement of its Hessian, and the fit of all
begins there.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from switchfit.fit.evaluator import evaluator_of
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import GIVEN, Problem
from switchfit.runtime.progress import show_detail
from switchfit.strategy.quick import End, check_time, fit_briefly

FitAlone = Callable[[Problem, FloatArray], tuple[FloatArray, FloatArray, int]]
"""Fits a run from a start: theta (d,), its Hessian (d, d), and the evaluations that it took."""


def has_runs(problem: Problem) -> bool:
    """Return whether there are several runs with data of their own."""
    return len(problem.experiments) > 1


def fit_runs_alone(problem: Problem, theta: FloatArray, fit: FitAlone) -> End:
    """Return where a fit of all runs ends that begins at the fits of each.

    Parameters
    ----------
    problem : Problem
    theta : (d,)
        The first guess.
    fit : callable
        Fits one run.
    """
    layout = evaluator_of(problem).layout
    evaluations = 0
    values: dict[int, list[tuple[float, float]]] = {int(k): [] for k in layout.shared}
    alone = []
    for e in range(len(problem.experiments)):
        check_time()
        show_detail(f"run {e + 1} of {len(problem.experiments)}")
        part, places = isolate_run(problem, e)
        start = np.clip(theta[places], part.unknowns.lower, part.unknowns.upper)
        try:
            found, hessian, taken = fit(part, start)
        except (ValueError, ArithmeticError):
            continue
        evaluations += taken
        shared = np.isin(places, layout.shared)
        reduced, follows = _reduce_to_shared(hessian, shared)
        for place, value, weight in zip(places[shared], found[shared], _compute_weights(reduced), strict=True):
            values[int(place)].append((float(value), weight))
        alone.append((places, shared, found, follows))
    combined = theta.copy()
    for place, of_runs in values.items():
        combined[place] = _compute_weighted_median(np.array(of_runs)) if of_runs else theta[place]
    for places, shared, found, follows in alone:
        combined[places[~shared]] = found[~shared] + follows @ (combined[places[shared]] - found[shared])
    end = fit_briefly(problem, _make_feasible(problem, combined))
    return end._replace(evaluations=end.evaluations + evaluations // len(problem.experiments))


def isolate_run(problem: Problem, e: int) -> tuple[Problem, NDArray[np.intp]]:
    """Return the problem of one run, and where its unknowns stand in theta."""
    run, structure = problem.experiments[e], problem.structures[e]
    names = [run.parameter_map.get(name, name) for name, _, _ in structure.parameters]
    parameters = {name: problem.parameters[name] for name in problem.parameters if name in set(names)}
    given = {name: getattr(problem, name) for name in GIVEN}
    part = Problem(**given | {"experiments": run, "parameters": parameters})
    own = part.unknowns.parameters
    spans = [np.arange(span.start, span.stop) for name, span in problem.unknowns.parameters.items() if name in own]
    times, states = problem.unknowns.times[e], problem.unknowns.initial_states[e]
    return part, np.concatenate([times[times >= 0], *spans, states[states >= 0]]).astype(np.intp)


def _reduce_to_shared(hessian: FloatArray, shared: NDArray[np.bool_]) -> tuple[FloatArray, FloatArray]:
    """Return the Schur complement of the own unknowns, (s, s), and the derivative of these in the shared, (o, s)."""
    own = ~shared
    follows = -np.linalg.pinv(hessian[np.ix_(own, own)], hermitian=True) @ hessian[np.ix_(own, shared)]
    return hessian[np.ix_(shared, shared)] + hessian[np.ix_(shared, own)] @ follows, follows


def _compute_weights(curvature: FloatArray) -> FloatArray:
    """Return the weight of each shared unknown: one over its standard error; 0 if it is not determined."""
    if not curvature.size:
        return np.zeros(0)
    variances = np.linalg.pinv(curvature, hermitian=True).diagonal()
    return np.where(variances > 0, 1 / np.sqrt(np.where(variances > 0, variances, 1.0)), 0.0)


def _compute_weighted_median(given: FloatArray) -> float:
    """Return the median of values (k, 2) with weights."""
    order = np.argsort(given[:, 0])
    values, weights = given[order].T
    weights = weights if weights.sum() > 0 else np.ones(len(values))
    return float(values[np.searchsorted(np.cumsum(weights), 0.5 * weights.sum())])


def _make_feasible(problem: Problem, theta: FloatArray) -> FloatArray:
    """Return theta inside its bounds, the times of each run in order."""
    theta = np.clip(theta, problem.unknowns.lower, problem.unknowns.upper)
    for run, where in zip(problem.experiments, problem.unknowns.times, strict=True):
        free = where[where >= 0]
        theta[free] = np.maximum.accumulate(np.clip(theta[free], run.t0, run.end))
    return theta
