"""Meshes that follow theta: made anew where the errors of their rows are too large.

A mesh is made for one theta. Where the model is sharp, as where a body comes to rest by friction, its short cells are
in the wrong place at any other theta: J is then that of another model, and the optimizer is misled. Every evaluation in
machine code has an estimate of the errors of its rows. Where it is too large, the point is evaluated once more, on a
mesh of its own; if the point is accepted, this mesh is the one of the next points. All costs that the optimizer
compares are thus accurate, each on its own mesh, and the derivatives are those on the mesh of the point.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from switchfit.discretization.mesh import Mesh
from switchfit.engine.adaptive import refine_mesh
from switchfit.engine.protocol import Evaluation, Matrix
from switchfit.fit.evaluator import Evaluator
from switchfit.problem.data import FloatArray
from switchfit.runtime.errors import NotIntegrableError

LARGEST_ROW_ERROR = 1e-3
"""Estimate of the error of a row, relative to the size of its state, above which a mesh is made anew. The estimate is of
order 3: where it is 1e-3, a row of a smooth model is accurate to about 1e-4 squared, and one that holds a kink to
1e-3."""

MOST_STEPS = 20
"""Steps of the adaptive solve at a trial, as a multiple of the cells of the mesh: a trial that needs more is refused."""


class Follower:
    """Evaluates a problem at the points of a minimisation, on meshes that are made anew where they are too coarse.

    Parameters
    ----------
    evaluator : Evaluator
        On meshes for the first point.

    Attributes
    ----------
    evaluator : Evaluator
        On the meshes of the last accepted point.
    """

    def __init__(self, evaluator: Evaluator) -> None:
        self.evaluator = evaluator
        self._trials: dict[bytes, Evaluator] = {}

    def __call__(self, theta: FloatArray, side: int = 1, *, matrix: Matrix = "exact") -> Evaluation[FloatArray]:
        """Evaluate as `Evaluator` does."""
        return self._evaluate(theta, lambda evaluator: evaluator(theta, side, matrix=matrix))

    def arrow(self, theta: FloatArray, side: int = 1, *, matrix: Matrix = "exact") -> Evaluation[Any]:
        """Evaluate as `Evaluator.arrow` does."""
        return self._evaluate(theta, lambda evaluator: evaluator.arrow(theta, side, matrix=matrix))

    def constrained(self, theta: FloatArray, side: int, multipliers: FloatArray) -> Evaluation[FloatArray]:
        """Evaluate as `Evaluator.constrained` does."""
        return self._evaluate(theta, lambda evaluator: evaluator.constrained(theta, side, multipliers))

    def accept(self, theta: FloatArray) -> None:
        """Keep the meshes of theta for the points after it."""
        self.evaluator = self._trials.get(theta.tobytes(), self.evaluator)
        self._trials.clear()

    def _evaluate(self, theta: FloatArray, evaluate: Callable[[Evaluator], Evaluation[Any]]) -> Evaluation[Any]:
        own = self._trials.get(theta.tobytes())
        if own is not None:
            return evaluate(own)
        found = evaluate(self.evaluator)
        coarse = list_coarse(found)
        if not coarse:
            return found
        try:
            own = refine_for(self.evaluator, theta, coarse)
        except (NotIntegrableError, ArithmeticError):
            return replace(found, cost=np.nan)
        self._trials[theta.tobytes()] = own
        return evaluate(own)


def list_coarse(found: Evaluation[Any]) -> list[int]:
    """Return the experiments in which the error of a row is too large, or not a number."""
    errors = enumerate(found.row_errors)
    return [e for e, error in errors if error is not None and not error.relative <= LARGEST_ROW_ERROR]


def refine_for(evaluator: Evaluator, theta: FloatArray, coarse: list[int]) -> Evaluator:
    """Return the problem with meshes for theta (d,) in the `coarse` experiments."""

    def refine(e: int, mesh: Mesh) -> Mesh:
        if e not in coarse:
            return mesh
        return refine_mesh(evaluator.problem, e, theta, most=MOST_STEPS * mesh.cells)

    return Evaluator(evaluator.problem, meshes=[refine(e, mesh) for e, mesh in enumerate(evaluator.meshes)])
