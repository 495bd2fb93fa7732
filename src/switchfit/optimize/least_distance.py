"""Least-distance problems, min ½‖e + q‖² under linear inequalities, solved by daqp.

daqp is a dual active-set method ([1]_). Every quadratic programme of the SQP is brought into this form, in which
nothing has a scale any more.

References
----------
.. [1] D. Arnström, A. Bemporad, D. Axehill, A dual active-set solver for embedded quadratic programming using recursive
   LDLᵀ updates, IEEE Trans. Autom. Control 67 (2022) 4362-4369.
"""

from __future__ import annotations

import daqp
import numpy as np

from switchfit.arrays import BoolArray, FloatArray
from switchfit.optimize import algebra
from switchfit.optimize.linear_constraints import LinearConstraints

TOLERANCES = 1e-12, 1e-10, 1e-8, 1e-6
"""By which daqp may violate a row of length one, in turn: rows that are nearly parallel need more than others."""

PARALLEL = 1e-14
"""Square of the sine of the angle from which on daqp takes rows for independent, in the metric of the matrix.

A matrix of the condition 1e12 brings rows to within 1e-6 of one another.
"""

SOLVED, EQUALITY = 1, 5
"""What daqp calls a programme that it has solved, and a row that holds with equality."""


def find_least_distance(
    target: FloatArray, rows: FloatArray, lower: FloatArray, upper: FloatArray, equal: BoolArray | None = None
) -> tuple[FloatArray, FloatArray] | None:
    """Minimize ½‖e + q‖² subject to ``lower <= G e <= upper``: e and what the rows exert; None if infeasible.

    Tolerances are absolute: rows are to be of the length one, and all quantities of the order 1.

    Parameters
    ----------
    target : array, shape (n,)
        q.
    rows : array, shape (k, n)
        G.
    lower, upper : arrays, shape (k,)
    equal : array of bool, shape (k,), optional
        Which of these hold with equality.

    Returns
    -------
    e, pull : arrays, shape (n,), (k,)
        ``e + q = Gᵀ pull``, positive where a lower bound presses and negative where an upper one does.
    """
    sense = np.zeros(lower.size, dtype=np.int32) if equal is None else np.where(equal, EQUALITY, 0).astype(np.int32)
    identity = np.eye(target.size)
    for tolerance in TOLERANCES:
        # A looser tolerance is a worse solution: it is tried only where daqp does not end with the one before.
        e, _, flag, found = daqp.solve(
            identity, target, rows, upper, lower, sense, primal_tol=tolerance, sing_tol=PARALLEL
        )
        if flag == SOLVED:
            return e, -found["lam"]
    return None


def nearest_feasible(constraints: LinearConstraints, theta: FloatArray, size: FloatArray | float = 1.0) -> FloatArray:
    """Return the feasible point nearest to theta (d,), up to rounding, each unknown being measured by its size (d,)."""
    # Bit for bit what it was where nothing is to be done.
    if np.all(constraints.slack(theta) >= 0.0):
        return theta
    # In units of the sizes, and of the largest violation: min ||s||^2 subject to lower <= N s <= upper.
    rows, lengths = algebra.unit_rows(constraints.A * size)
    lower = np.concatenate([(constraints.lower - theta) / size, (constraints.b - constraints.A @ theta) / lengths])
    upper = np.concatenate([(constraints.upper - theta) / size, np.full(len(rows), np.inf)])
    violation = max(algebra.largest(lower), -algebra.smallest(upper))
    normals = np.concatenate([np.eye(theta.size), rows])
    found = find_least_distance(np.zeros(theta.size), normals, lower / violation, upper / violation)
    if found is None:
        raise ValueError("no point satisfies all the constraints")
    return np.asarray(np.clip(theta + violation * size * found[0], constraints.lower, constraints.upper))
