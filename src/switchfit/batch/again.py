"""Repeat single fits of a batch: those that failed on the shared mesh, and doubtful ones with guards or constraints.

From a far guess guards pull transitions together, and the modes between them collapse. Each such fit of a batch is then
made alone, with the constraints inside the quadratic programme, and where that does not help with transitions that may
happen anywhere, and from there on their guards.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from switchfit.batch.program import Chunk, Limits
from switchfit.batch.quality import count_priors, count_samples, describe_ends
from switchfit.batch.verdict import EXPLAINED_BADLY, find_doubts, has_converged
from switchfit.discretization.mesh import Mesh
from switchfit.estimation.estimator import Estimate
from switchfit.estimation.local_fit import LARGEST_INTEGRATION_ERROR, fit_locally
from switchfit.fit.accuracy import cost_error
from switchfit.fit.evaluator import Evaluator, evaluator_of
from switchfit.optimize import Status
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem
from switchfit.strategy.quick import End, fit_briefly


def redo_unresolved(
    chunk: Chunk, problem_of: Callable[[int], Problem], meshes: Sequence[Mesh] | None, limits: Limits
) -> None:
    """Replace fits whose integration error is too large by those that `estimate` finds.

    Of fits that share meshes, those that failed are looked at. A mode that is active elsewhere than where the meshes
    were refined may find cells there that are far too long for it: what stops the optimiser is then the mesh and not
    the model. A fit that fails again is left as it was.

    Parameters
    ----------
    chunk : Chunk
        It is written to.
    problem_of : callable
        The problem of the k-th fit of the chunk, with its own data.
    meshes : sequence of Mesh, optional
        Those that all fits share; None if each has the meshes of its first guess.
    limits : Limits
    """
    failed = ~has_converged(chunk.status)
    looked_at = (chunk.status != Status.ERROR.name) & (failed | (meshes is None))
    for k in np.flatnonzero(looked_at).tolist():
        theta = chunk.theta[k]
        try:
            problem = problem_of(k)
            if _is_resolved(problem, meshes, theta, chunk.cost[k]):
                continue
            again = fit_locally(problem, start=theta, **limits._asdict())
        except Exception as error:
            if not failed[k]:
                chunk.set_error(k, error)
            continue  # a fit from this end fails too: the first one stays, and is listed as failed
        if again.status.successful or not failed[k]:
            replace_fit(chunk, k, again)


def redo_doubted(
    chunk: Chunk,
    problem_of: Callable[[int], Problem],
    starts: FloatArray,
    variation: FloatArray | float,
    limits: Limits,
) -> None:
    """Replace fits that did not converge, lost modes or are far from their data by better ones, where there are any;
    only of problems with guards or terminal constraints, which the compiled program does not take.

    Parameters
    ----------
    chunk : Chunk
        It is written to.
    problem_of : callable
        The problem of the k-th fit of the chunk, with its own data.
    starts : (R, d)
        Where each of them begins.
    variation : float or (R,)
        As of `describe_ends`.
    limits : Limits
    """
    totals = np.broadcast_to(np.asarray(variation, dtype=float), len(starts))
    for k in range(len(starts)):
        try:
            problem = problem_of(k)
        except Exception:  # the problem cannot be built, and the fit is listed as failed
            continue
        guarded = any(structure.guarded for structure in problem.structures)
        for find in (fit_briefly, _fit_free_of_guards) if guarded else (fit_briefly,):
            if not _is_doubted(problem, chunk, k, float(totals[k])):
                break
            try:
                end = find(problem, starts[k])
                if end.failed:
                    continue
                again = fit_locally(problem, start=end.theta, **limits._asdict())
            except (ValueError, ArithmeticError, np.linalg.LinAlgError):  # nothing better from this start
                continue
            before = chunk.cost[k] if has_converged(chunk.status)[k] else np.inf
            if again.status.successful and again.cost < before:
                replace_fit(chunk, k, again)


def _fit_free_of_guards(problem: Problem, start: FloatArray) -> End:
    """Return where a fit ends whose transitions may happen anywhere, and one on the guards from there."""
    free = fit_briefly(replace(problem, system=replace(problem.system, guards={})), start)
    return free if free.failed else fit_briefly(problem, free.theta)


def _is_doubted(problem: Problem, chunk: Chunk, k: int, variation: float) -> bool:
    """Return whether a better end may be elsewhere: not converged, a mode has collapsed, or far from the data."""
    arrays = {name: array[k : k + 1] for name, array in chunk.to_arrays().items()}
    arrays |= describe_ends(problem, arrays["theta"], arrays["cost"], variation)
    if arrays["collapsed"][0] > 0:
        return True
    arrays["samples"] = np.array([count_samples(problem)])
    doubts = find_doubts(arrays, problem.is_sigma_known, count_priors(problem))
    return any(doubt.kind in ("not converged", "little explained", *EXPLAINED_BADLY) for doubt in doubts)


def _is_resolved(problem: Problem, meshes: Sequence[Mesh] | None, theta: FloatArray, cost: float) -> bool:
    """Return whether cutting all steps in two changes J at theta by no more than the integration error that is allowed.

    `cost` is J where it ended on meshes of its own; on shared ones, it is found anew, as what failed may have none.
    """
    evaluator = evaluator_of(problem) if meshes is None else Evaluator(problem, meshes=meshes)
    fine = evaluator.halve_rows(theta).cost(theta)
    error = cost_error(problem, fine, cost if meshes is None else evaluator.cost(theta), 0.0)
    return error <= max(LARGEST_INTEGRATION_ERROR, problem.rtol)


def replace_fit(chunk: Chunk, k: int, again: Estimate) -> None:
    """Replace the k-th fit by an estimate."""
    ordinary = again.status is Status.CONVERGED and not again.active
    chunk.replace_fit(k, again, "" if ordinary else again.message)
