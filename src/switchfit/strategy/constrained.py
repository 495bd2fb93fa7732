"""Guards and terminal constraints inside a quadratic programme: SciPy's SLSQP with exact first derivatives.

The augmented Lagrangian of a local fit meets its constraints little by little, and from far away it may collapse on the
way. SLSQP ([1]_) linearises them in each of its programmes. Its steps are of first order; a local fit ends what it
began.

References
----------
.. [1] D. Kraft, A software package for sequential quadratic programming, DFVLR-FB 88-28, 1988.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from switchfit.fit.evaluator import ConstrainedEvaluation, Evaluator
from switchfit.fit.random_starts import find_nearest_feasible
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem

ROUNDS = 3
"""Times that meshes are made anew where a round ended."""

ITERATIONS = 200
TOLERANCE = 1e-10
"""On the change of J, in units of J at the start."""

MOVED = 1e-6
"""Part of the unknowns' sizes by which the end of a round moves if another one is worth it."""


def meet_constraints(problem: Problem, theta: FloatArray) -> tuple[FloatArray, int]:
    """Return where SLSQP ends that begins at theta (d,), and the evaluations that it took."""
    evaluations = 0
    for _ in range(ROUNDS):
        end, taken = _run_once(Evaluator(problem, theta), theta)
        end = find_nearest_feasible(problem, end)  # SLSQP meets bounds and order to its tolerance alone
        evaluations += taken
        moved = np.max(np.abs(end - theta) / np.maximum(problem.sizes, np.finfo(float).tiny), initial=0.0)
        theta = end
        if moved <= MOVED:
            break
    return theta, evaluations


def _run_once(evaluator: Evaluator, theta: FloatArray) -> tuple[FloatArray, int]:
    import scipy.optimize  # here, since it takes longer to import than most fits

    unknowns = evaluator.problem.unknowns
    unit = np.where(unknowns.is_time | (theta == 0), 1.0, np.abs(theta))  # SLSQP is sensitive to scales
    seen: dict[bytes, ConstrainedEvaluation] = {}

    def look(z: FloatArray) -> ConstrainedEvaluation:
        key = z.tobytes()
        if key not in seen:
            seen[key] = evaluator.constrained(np.clip(unit * z, unknowns.lower, unknowns.upper))
        return seen[key]

    first = max(abs(look(theta / unit).cost), np.finfo(float).tiny)

    def cost(z: FloatArray) -> tuple[float, FloatArray]:
        here = look(z)
        return here.cost / first, unit * here.gradient / first

    constraints: list[dict[str, Any]] = [
        {"type": "eq", "fun": lambda z: look(z).constraints, "jac": lambda z: look(z).jacobian * unit}
    ]
    if len(unknowns.b):
        rows = {"fun": lambda z: unknowns.A @ (unit * z) - unknowns.b, "jac": lambda z: unknowns.A * unit}
        constraints.append({"type": "ineq", **rows})
    with np.errstate(all="ignore"):
        found = scipy.optimize.minimize(
            cost,
            theta / unit,
            jac=True,
            method="SLSQP",
            bounds=scipy.optimize.Bounds(unknowns.lower / unit, unknowns.upper / unit),
            constraints=constraints,
            options={"ftol": TOLERANCE, "maxiter": ITERATIONS},
        )
    end = np.clip(unit * found.x, unknowns.lower, unknowns.upper)
    return (end if np.isfinite(end).all() else theta), len(seen)
