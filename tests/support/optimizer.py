"""The optimiser's functions with the settings that its tests leave out."""

import numpy as np

from switchfit.optimize import LinearConstraints
from switchfit.optimize import minimize as minimize_problem
from switchfit.optimize.breakpoints import Breakpoints
from switchfit.optimize.minimization_problem import MinimizationProblem
from switchfit.optimize.positive_definite import CholeskyFactor
from switchfit.optimize.qp import Room, solve_programme


def rows(A, b, lower=None, upper=None):
    """Constraints with the names "row 0", "low 0" and "up 0"."""
    A = np.asarray(A, float)
    m, d = A.shape
    lower = np.full(d, -np.inf) if lower is None else np.asarray(lower, float)
    upper = np.full(d, np.inf) if upper is None else np.asarray(upper, float)
    names = [f"row {i}" for i in range(m)] + [f"low {i}" for i in range(d)] + [f"up {i}" for i in range(d)]
    return LinearConstraints(A, np.asarray(b, float), lower, upper, tuple(names))


def box(lower, upper):
    return rows(np.zeros((0, len(lower))), [], lower, upper)


def free(d):
    return box(np.full(d, -np.inf), np.full(d, np.inf))


def minimize(
    evaluate, start, *, constraints, breakpoints=(), hessian="exact", blocks=(), tolerance=1e-7, max_iterations=200,
    size=0.0, idle=None, reach=None, equalities=(), accuracy=None, status=None, **settings,
):  # fmt: skip
    """Return the result, whose status is the one given unless it does not matter."""
    start = np.array(start, float)
    labels = np.array(blocks, float) if hessian == "block-diagonal" else None
    size, usual = np.broadcast_to(np.asarray(size, float), start.shape), 0.1 * np.where(start, abs(start), 1.0)
    problem = MinimizationProblem(
        evaluate, constraints, Breakpoints.of(breakpoints), hessian, labels, tolerance, max_iterations, size, idle,
        usual if reach is None else np.asarray(reach, float), equalities, accuracy,
    )  # fmt: skip
    result = minimize_problem(problem, start, **settings)
    assert status in (None, result.status), result.status
    return result


def draw_matrix(rng, values, decades=3):
    """A symmetric matrix with these eigenvalues, rows and columns rescaled over as many decades each way; the scale."""
    Q, _ = np.linalg.qr(rng.normal(size=(len(values), len(values))))
    B, scale = (Q * values) @ Q.T, 10.0 ** rng.uniform(-decades, decades, len(values))
    return scale[:, None] * (0.5 * (B + B.T)) * scale, scale


def solve_qp(gradient, matrix, normals, offsets):
    """Return the step d and the multipliers of the lowest ``gᵀd + ½ dᵀBd`` with ``C d >= c``."""
    k, d = normals.shape
    unbounded = np.full(d, np.inf)
    room = Room(np.vstack([normals, np.eye(d)]), np.append(offsets, -unbounded), np.full(k + d, np.inf))
    step, pull = solve_programme(gradient, matrix, CholeskyFactor.of(matrix), room)
    return step, pull[:k]
