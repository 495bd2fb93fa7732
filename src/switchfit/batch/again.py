"""Fits that failed on a mesh that many share, done again on meshes of their own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from switchfit.batch.program import Chunk
from switchfit.discretization.mesh import Mesh
from switchfit.estimation.estimator import LARGEST_INTEGRATION_ERROR, Estimate, fit_locally
from switchfit.fit.accuracy import cost_error
from switchfit.fit.evaluator import Evaluator
from switchfit.fit.result import inverse_on
from switchfit.optimize import Status
from switchfit.problem.problem import Problem


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
    converged = [status.name for status in Status if status.successful]
    failed = np.flatnonzero(~np.isin(chunk.status, [*converged, Status.ERROR.name]))
    if not failed.size:
        return chunk
    arrays: dict[str, Any] = {name: np.array(value) for name, value in chunk._asdict().items()}
    arrays |= {name: arrays[name].astype(object) for name in ("status", "message")}
    for k in failed.tolist():
        try:
            problem = problem_of(k)
            if is_resolved(problem, meshes, arrays["theta"][k]):
                continue
            again = fit_locally(problem, start=arrays["theta"][k], tolerance=tolerance, max_iterations=max_iterations)
        except Exception:  # this end allows no fit of its own: what was found stays, and is listed
            continue
        if again.status.successful:
            adopt(arrays, k, again)
    return Chunk(**arrays | {name: arrays[name].astype(str) for name in ("status", "message")})


def is_resolved(problem: Problem, meshes: Sequence[Mesh], theta: Any, cost: float | None = None) -> bool:
    """Return whether cutting all steps in two changes J at theta by no more than the integration error
    that is allowed.
    """
    evaluator = Evaluator(problem, meshes=meshes)
    here = evaluator.cost(theta) if cost is None else cost
    fine = evaluator.halve_rows(theta).cost(theta)
    return cost_error(problem, fine, here, 0.0) <= max(LARGEST_INTEGRATION_ERROR, problem.rtol)


def adopt(arrays: dict[str, Any], k: int, again: Estimate) -> None:
    """Put a fit in place of the k-th one, whose iterations and evaluations count with its own."""
    for name in ("theta", "cost", "gradient", "hessian", "optimality"):
        arrays[name][k] = getattr(again, name)
    arrays["iterations"][k] += again.iterations
    arrays["evaluations"][k] += again.evaluations
    arrays["status"][k] = again.status.name
    arrays["free"][k] = again.free_basis.shape[1]
    arrays["covariance"][k] = inverse_on(again.free_basis, again.hessian)
    ordinary = again.status is Status.CONVERGED and not again.active
    arrays["message"][k] = "" if ordinary else again.message
