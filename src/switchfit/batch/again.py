"""Repeat single fits of a batch: those that failed on the shared mesh, and doubtful ones with guards or constraints.

From a far guess guards pull transitions together, and the modes between them collapse. Each such fit of a batch is then
made alone, with the constraints inside the quadratic programme, and where that does not help with transitions that may
happen anywhere, and from there on their guards.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.batch.program import Chunk
from switchfit.batch.quality import count_priors, count_samples, describe_ends
from switchfit.batch.verdict import EXPLAINED_BADLY, find_doubts, has_converged
from switchfit.discretization.mesh import Mesh
from switchfit.estimation.estimator import Estimate
from switchfit.estimation.local_fit import LARGEST_INTEGRATION_ERROR, fit_locally
from switchfit.fit.accuracy import cost_error
from switchfit.fit.evaluator import Evaluator
from switchfit.fit.result import inverse_on
from switchfit.fit.solution import is_sigma_known
from switchfit.optimize import Status
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem
from switchfit.strategy.quick import End, fit_briefly


def redo_unresolved(
    chunk: Chunk, problem_of: Callable[[int], Problem], meshes: Sequence[Mesh], *, tolerance: float, max_iterations: int
) -> Chunk:
    """Return the chunk with fits that failed where the shared meshes are too coarse replaced by those that `estimate`
    finds.

    A mode that is active elsewhere than where the meshes were refined may find cells there that are far too long for
    it: what stops the optimiser is then the mesh and not the model. A fit that fails again is left as it was.

    Parameters
    ----------
    chunk : Chunk
    problem_of : callable
        The problem of the k-th fit of the chunk, with its own data.
    meshes : sequence of Mesh
    tolerance, max_iterations : as of `estimate`
    """
    failed = np.flatnonzero(~has_converged(chunk.status) & (chunk.status != Status.ERROR.name))
    if not failed.size:
        return chunk
    arrays = _open(chunk)
    for k in failed.tolist():
        try:
            problem = problem_of(k)
            if is_resolved(problem, meshes, arrays["theta"][k]):
                continue
            again = fit_locally(problem, start=arrays["theta"][k], tolerance=tolerance, max_iterations=max_iterations)
        except Exception:  # a fit from this end fails too: the first one stays, and is listed as failed
            continue
        if again.status.successful:
            replace_fit(arrays, k, again)
    return _close(arrays)


def redo_doubted(
    chunk: Chunk,
    problem_of: Callable[[int], Problem],
    starts: FloatArray,
    variation: FloatArray | float,
    *,
    tolerance: float,
    max_iterations: int,
) -> Chunk:
    """Return the chunk with fits that did not converge, lost modes or are far from their data replaced by better ones,
    where there are any; only of problems with guards or terminal constraints, which the compiled program does not take.

    Parameters
    ----------
    chunk : Chunk
    problem_of : callable
        The problem of the k-th fit of the chunk, with its own data.
    starts : (R, d)
        Where each of them begins.
    variation : float or (R,)
        As of `describe_ends`.
    tolerance, max_iterations : as of `estimate`
    """
    arrays = _open(chunk)
    totals = np.broadcast_to(np.asarray(variation, dtype=float), len(starts))
    for k in range(len(starts)):
        try:
            problem = problem_of(k)
        except Exception:  # the problem cannot be built, and the fit is listed as failed
            continue
        if not problem.constraint_names:
            continue
        guarded = any(structure.guarded for structure in problem.structures)
        for find in (fit_briefly, _fit_free_of_guards) if guarded else (fit_briefly,):
            if not _is_doubted(problem, arrays, k, float(totals[k])):
                break
            try:
                end = find(problem, starts[k])
                if end.failed:
                    continue
                again = fit_locally(problem, start=end.theta, tolerance=tolerance, max_iterations=max_iterations)
            except (ValueError, ArithmeticError, np.linalg.LinAlgError):  # nothing better from this start
                continue
            before = arrays["cost"][k] if has_converged(arrays["status"][k : k + 1])[0] else np.inf
            if again.status.successful and again.cost < before:
                replace_fit(arrays, k, again)
    return _close(arrays)


def _fit_free_of_guards(problem: Problem, start: FloatArray) -> End:
    """Return where a fit ends whose transitions may happen anywhere, and one on the guards from there."""
    free = fit_briefly(replace(problem, system=replace(problem.system, guards={})), start)
    return free if free.failed else fit_briefly(problem, free.theta)


def _is_doubted(problem: Problem, arrays: dict[str, Any], k: int, variation: float) -> bool:
    """Return whether a better end may be elsewhere: not converged, a mode has collapsed, or far from the data."""
    here = slice(k, k + 1)
    ends = describe_ends(problem, arrays["theta"][here], arrays["cost"][here], variation)
    if ends["collapsed"][0] > 0:
        return True
    doubts = find_doubts(
        **{name: arrays[name][here] for name in ("cost", "hessian", "free")},
        status=arrays["status"][here].astype(str),
        samples=np.array([count_samples(problem)]),
        sigma_known=is_sigma_known(problem),
        priors=count_priors(problem),
        **ends,
    )
    return any(doubt.kind in ("not converged", "little explained", *EXPLAINED_BADLY) for doubt in doubts)


def find_replaced(one: Chunk, other: Chunk) -> NDArray[np.bool_]:
    """Return which fits of a chunk were replaced by others in a second one: (R,)."""
    return np.asarray(np.any(one.theta != other.theta, axis=1))


def _open(chunk: Chunk) -> dict[str, Any]:
    """Return copies of the arrays of a chunk, with text of any length, to write to."""
    arrays: dict[str, Any] = {name: np.array(value) for name, value in chunk._asdict().items()}
    return arrays | {name: arrays[name].astype(object) for name in ("status", "message")}


def _close(arrays: dict[str, Any]) -> Chunk:
    """Return a chunk of the arrays that `_open` returned."""
    return Chunk(**arrays | {name: arrays[name].astype(str) for name in ("status", "message")})


def is_resolved(problem: Problem, meshes: Sequence[Mesh], theta: Any, cost: float | None = None) -> bool:
    """Return whether cutting all steps in two changes J at theta by no more than the integration error
    that is allowed.
    """
    evaluator = Evaluator(problem, meshes=meshes)
    here = evaluator.cost(theta) if cost is None else cost
    fine = evaluator.halve_rows(theta).cost(theta)
    return cost_error(problem, fine, here, 0.0) <= max(LARGEST_INTEGRATION_ERROR, problem.rtol)


def replace_fit(arrays: dict[str, Any], k: int, again: Estimate) -> None:
    """Replace the k-th fit; iterations and evaluations of both are added."""
    for name in ("theta", "cost", "gradient", "hessian", "optimality"):
        arrays[name][k] = getattr(again, name)
    arrays["iterations"][k] += again.iterations
    arrays["evaluations"][k] += again.evaluations
    arrays["status"][k] = again.status.name
    arrays["free"][k] = again.free_basis.shape[1]
    arrays["covariance"][k] = inverse_on(again.free_basis, again.hessian)
    ordinary = again.status is Status.CONVERGED and not again.active
    arrays["message"][k] = "" if ordinary else again.message
