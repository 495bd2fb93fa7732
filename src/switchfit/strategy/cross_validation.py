"""Cross-validation over runs: fit all but some, and predict these with their own transition times."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from switchfit.estimation.estimator import Estimate
from switchfit.problem.data import FloatArray
from switchfit.problem.experiment import name_runs
from switchfit.problem.problem import Problem
from switchfit.problem.validation import as_count
from switchfit.strategy.choice import estimate as fit_problem
from switchfit.strategy.likelihood import compute_log_likelihood
from switchfit.strategy.other_run import build_other_problem
from switchfit.strategy.validation import Validation, validate_problem


def choose_folds(problems: Sequence[Problem], given: bool | int) -> tuple[tuple[str, ...], ...]:
    """Return the runs that are left out together, for each fold; no fold if runs are not to be left out.

    Parameters
    ----------
    problems : sequence of Problem
    given : bool or int
        As in `compare`.
    """
    if given is False:
        return ()
    runs = name_runs(problems[0].experiments)
    if len(runs) < 2:
        raise ValueError(
            "cross_validate leaves runs out, and the problem has one: give the Problem several experiments, or use "
            "validate with another log."
        )
    if any(name_runs(problem.experiments) != runs for problem in problems):
        raise ValueError("cross_validate needs experiments of the same names in all models.")
    count = len(runs) if given is True else as_count(given, "cross_validate", at_least=2, at_most=len(runs))
    return tuple(tuple(runs[k::count]) for k in range(count))


def hold_out(estimate: Estimate, problem: Problem, fold: tuple[str, ...]) -> tuple[float, float]:
    """Return the score of the runs of a fold with the parameters of the other runs, and their fit in per cent.

    Parameters
    ----------
    estimate : Estimate
        Of all runs.
    problem : Problem
    fold : tuple of str
        Names of the runs that are left out.
    """
    runs = name_runs(problem.experiments)
    rest = [name for name in runs if name not in fold]
    train, test = problem.without_runs(*fold), problem.without_runs(*rest)
    start = _carry_theta(problem, estimate.theta, train, [runs.index(name) for name in rest])
    fit = fit_problem(train, start=start, strategy="local")  # from the fit of all runs, others are not looked for
    begin = begin_at(test, _carry_theta(problem, estimate.theta, test, [runs.index(name) for name in fold]))
    found = validate_problem(fit, build_other_problem(fit, begin), None, "local")
    return score(found), found.percent


def score(found: Validation) -> float:
    """Return ``-2 log L`` of a validation plus 2 for each unknown that was estimated from its data.

    Where sigma is left out, it is the residual variance of the fit.

    Parameters
    ----------
    found : Validation
    """
    own = 0 if found.refit is None else len(found.refit.theta) - len(found.refit.constraints)
    if found.sigma_known:
        return -2 * compute_log_likelihood(found.problem, found.comparisons) + 2 * own
    squares, count, logs = 0.0, 0, 0.0
    for comparison in (c for run in found.comparisons for c in run):
        there = np.isfinite(comparison.residuals)
        sigma = np.ones(int(there.sum())) if comparison.sigma is None else comparison.sigma[there]
        squares += float(np.sum((comparison.residuals[there] / sigma) ** 2))
        count += len(sigma)
        logs += float(np.log(sigma).sum())
    variance = found.fit.residual_variance
    return squares / variance + count * float(np.log(2 * np.pi * variance)) + 2 * logs + 2 * own


def _carry_theta(problem: Problem, theta: FloatArray, part: Problem, kept: Sequence[int]) -> FloatArray:
    """Return the theta of a part of a problem: some of its runs (from 0), in the same order."""
    whole, own = problem.unknowns, part.unknowns
    found = part.initial_theta
    for e, run in enumerate(kept):
        for there, here in ((whole.times[run], own.times[e]), (whole.initial_states[run], own.initial_states[e])):
            found[here[here >= 0]] = theta[there[there >= 0]]
    for name, span in own.parameters.items():
        found[span] = theta[whole.parameters[name]]
    return found


def begin_at(problem: Problem, theta: FloatArray) -> Problem:
    """Return a problem with theta for its first guess; of transition times only where they are in order.

    Parameters
    ----------
    problem : Problem
    theta : (d,)
    """
    runs, unknowns = [], problem.unknowns
    for run, where, states in zip(problem.experiments, unknowns.times, unknowns.initial_states, strict=True):
        times = run.initial_times
        times[where >= 0] = theta[where[where >= 0]]
        if np.all(np.diff(run.ends_of_modes(times)) > 0):
            moved = [replace(tau, value=value) for tau, value in zip(run.times, times, strict=True)]
            count = len(run.transition_times)
            run = replace(run, transition_times=tuple(moved[:count]), tf=moved[count] if run.has_free_tf else run.tf)
        if (states >= 0).any():
            initial = problem.system.initial_state if run.initial_state is None else run.initial_state
            moved = [replace(x, value=theta[i]) if i >= 0 else x for x, i in zip(initial, states.tolist(), strict=True)]
            run = replace(run, initial_state=moved)
        runs.append(run)
    parameters = dict(problem.parameters)
    for name, span in unknowns.parameters.items():
        parameters[name] = replace(parameters[name], value=theta[span].reshape(parameters[name].shape))
    return replace(problem, experiments=runs, parameters=parameters)
