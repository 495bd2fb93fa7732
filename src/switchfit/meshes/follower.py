"""Follower: an evaluator whose meshes follow theta, made anew where the errors of their rows are too large.

A mesh is made for one theta. Where the model is sharp, as where a body comes to rest by friction, its short cells are
in the wrong place at any other theta: J is then that of another model, and the optimizer is misled. Every evaluation in
machine code has an estimate of the errors of its rows. Where it is too large, the point is evaluated once more, on a
mesh of its own; if the point is accepted, this mesh is the one of the next points. All costs that the optimizer
compares are thus accurate, each on its own mesh, and the derivatives are those on the mesh of the point.

A layer as thin as that of friction regularised at 1e-6 m/s stays coarse on a mesh of its own, by this measure. J and
its gradient are accurate there, but second derivatives of f are as large as the square of the inverse of its thickness,
and their sum over the layer is not. The Gauss-Newton matrix, which has none of them, then takes the place of the
Hessian. Where a body only passes such a layer, as at a reversal, its rows look accurate: there the Hessian shows that
it is wrong by misjudging the steps, and by other entries on halved cells.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.discretization.mesh import Mesh
from switchfit.engine.corners.split_engine import SplitEngine
from switchfit.engine.evaluation import Evaluation, Matrix
from switchfit.meshes.evaluator import Evaluator
from switchfit.meshes.refinement import refine_mesh_of_run
from switchfit.runtime.errors import NotIntegrableError

LARGEST_ROW_ERROR = 1e-3
"""Estimate of the error of a row, relative to the size of its state, above which a mesh is made anew. The estimate has
the order 4, the error 6: where the estimate is 1e-3, the error of a row is about 1e-3**1.5 = 3e-5 in a smooth model,
and 1e-3 where a kink is inside the row. Fits of the bed of poor starts end with 1e-7 to 1e-5 on meshes that suit them,
and with 0.01 to 1 on those of far guesses."""

COST_ACCURACY_IN_RTOL = 10.0
"""Relative accuracy of J where steps pass thin layers, in units of rtol: J of the benchmark differs by 1e-8 to
1e-7 from mesh to mesh."""

MOST_STEPS_PER_CELL = 20
"""Largest number of steps of the adaptive solve at a trial, as a multiple of the cells of the mesh: a trial that needs
more is refused."""

WRONG_CURVATURE_FACTOR = 10.0
"""Factor by which a Hessian has to misjudge how J bends along a step to be doubted. Where friction is regularised at
1e-6 m/s, it does so by 500, and halved cells change its entries by their own size; those of smooth models by 1e-6."""

_EvaluatedPoint = tuple[FloatArray, Evaluation[Any]]
"""A theta, and J with its derivatives there."""


class Follower:
    """Evaluates a problem at the points of a minimisation, on meshes that are made anew where they are too coarse.

    Parameters
    ----------
    evaluator : Evaluator
        On meshes for the first point.
    build : callable, optional
        Returns the evaluator on other meshes, where that is not the problem's own.

    Attributes
    ----------
    evaluator : Evaluator
        On the meshes of the last accepted point.
    """

    def __init__(self, evaluator: Evaluator, build: Callable[[Sequence[Mesh]], Evaluator] | None = None) -> None:
        self._build = build or (lambda meshes: Evaluator(evaluator.problem, meshes=meshes))
        self._trials: dict[bytes, Evaluator] = {}
        # A row of a mesh that meets rtol has an error of order 5 of that size, and an estimate of order 4.
        self._largest = [max(LARGEST_ROW_ERROR, 10.0 * evaluator.problem.rtol**0.8)] * len(evaluator.meshes)
        self._is_least_squares = all(each.has_only_residuals for each in evaluator.problem.structures)
        self._is_sharp = False
        self._seen: _EvaluatedPoint | None = None
        self._accepted: _EvaluatedPoint | None = None
        self._use(evaluator)

    def __reduce__(self) -> tuple[Any, ...]:
        """How it is copied and pickled: anew, on the meshes of the last accepted point."""
        return Follower, (self.evaluator,)

    def __call__(
        self, theta: FloatArray, side: int = 1, *, matrix: Matrix = "exact", arrow: bool = False
    ) -> Evaluation[Any]:
        """Evaluate as `Evaluator` does; with the Gauss-Newton matrix where the exact Hessian is not accurate."""

        def evaluate(evaluator: Evaluator) -> Evaluation[Any]:
            is_rough = matrix == "exact" and self.has_rough_hessian
            return evaluator(theta, side, matrix="gauss-newton" if is_rough else matrix, arrow=arrow)

        found = self._evaluate(theta, evaluate)
        # Kept, as its Hessian may be wrong, until its point is accepted. Only evaluations from the right of all kinks
        # are compared: each step then joins two of one kind.
        if self._doubts and side == 1 and matrix == "exact":
            self._seen = theta, found
            self._accepted = self._accepted or self._seen
        return found

    def constrained(self, theta: FloatArray, side: int, multipliers: FloatArray) -> Evaluation[FloatArray]:
        """Evaluate as `Evaluator.constrained` does."""
        return self._evaluate(theta, lambda evaluator: evaluator.constrained(theta, side, multipliers))

    @property
    def has_rough_hessian(self) -> bool:
        """Whether the exact Hessian is not accurate: of thin layers, and where a slope is infinite at a corner."""
        return self._is_sharp or (bool(self._splits) and any(split.has_steep_corners for split in self._splits))

    def get_accuracy(self) -> float:
        """Return the relative accuracy of J where steps pass thin layers; 0 where J is as accurate as rounding."""
        return COST_ACCURACY_IN_RTOL * self.evaluator.problem.rtol if self._is_sharp else 0.0

    def accept(self, theta: FloatArray, cost: float) -> None:
        """Keep the meshes of theta for the points after it, and judge the Hessian by the step that led to it."""
        last, seen = self._accepted, self._seen
        self._accepted = seen if seen is not None and seen[1].cost == cost else None
        if last is not None and self._accepted is not None and not self.has_rough_hessian:
            self._is_sharp = self._is_hessian_wrong(*last, *self._accepted)
        if self._trials:
            self._use(self._trials.get(theta.tobytes(), self.evaluator))
            self._trials.clear()

    def _use(self, evaluator: Evaluator) -> None:
        self.evaluator = evaluator.judge_rows()
        engines = evaluator.engines if self._is_least_squares else []
        self._splits = [engine for engine in engines if isinstance(engine, SplitEngine)]
        self._doubts = self._is_least_squares and any(mesh.is_sharp for mesh in evaluator.meshes)

    def _is_hessian_wrong(
        self, theta: FloatArray, found: Evaluation[Any], after: FloatArray, there: Evaluation[Any]
    ) -> bool:
        """Return whether the Hessian at theta misjudges the step to the point after it, and changes with the mesh.

        In curved valleys, and across samples, a Hessian that is right misjudges steps as well.
        """
        step = after - theta
        slope, curvature = found.gradient.dot(step), step.dot(found.hessian.dot(step))
        # J(theta + s) = J + g's + s'H s / 2 + ...: `bend` is the s'H s that would have been right, to lowest order.
        bend = 2.0 * (there.cost - found.cost - slope)
        # A step along which the model falls has s'H s <= -2 g's: another one does not come from this Hessian.
        proposed = abs(curvature) <= 2.0 * abs(slope)  # by the quadratic model
        if (
            not proposed
            or not abs(curvature - bend) > WRONG_CURVATURE_FACTOR * abs(bend)
            or self.evaluator.engine.name == "jax"
        ):
            return False
        # Halved cells change a Hessian of a smooth f by next to nothing, one of a thin layer by its own size.
        finer = self._build([mesh.divide(2) for mesh in self.evaluator.meshes])(theta)
        return bool(abs(step.dot(finer.hessian.dot(step)) - curvature) > abs(curvature) / WRONG_CURVATURE_FACTOR)

    def _evaluate(self, theta: FloatArray, evaluate: Callable[[Evaluator], Evaluation[Any]]) -> Evaluation[Any]:
        # A trial that was evaluated on a mesh of its own stays on it: both sides of a kink, and J and its derivatives,
        # agree.
        own = self._trials.get(theta.tobytes()) if self._trials else None
        if own is not None:
            return evaluate(own)
        found = evaluate(self.evaluator)
        coarse = self._list_coarse(found)
        if not coarse:
            return found
        try:
            own = self._trials[theta.tobytes()] = self._refine(theta, coarse)
        except (NotIntegrableError, ArithmeticError):
            return replace(found, cost=np.nan)
        found = evaluate(own)
        # Newton's method of an implicit row may not converge, although the adaptive solver's did in steps as long.
        if not np.isfinite(found.cost) and any(mesh.stiffness for mesh in own.meshes):
            own = self._trials[theta.tobytes()] = self._build([mesh.divide(2) for mesh in own.meshes]).judge_rows()
            found = evaluate(own)
        coarse = self._list_coarse(found) if np.isfinite(found.cost) else []
        for e in coarse:  # no mesh has less: it would be made anew for ever
            self._largest[e] = 2.0 * found.row_errors[e]
        # Coarse on a mesh made for this point: layers too thin for second derivatives. Once more, with the Gauss-Newton
        # matrix.
        if coarse and self._is_least_squares and not self.has_rough_hessian:
            self._is_sharp = True
            found = evaluate(own)
        return found

    def _list_coarse(self, found: Evaluation[Any]) -> list[int]:
        """Return the experiments in which the error of a row is too large; all if J is not a number."""
        if not math.isfinite(found.cost):
            return [e for e, error in enumerate(found.row_errors) if not np.isnan(error)]
        return [e for e, error in enumerate(found.row_errors) if error > self._largest[e]]

    def _refine(self, theta: FloatArray, coarse: list[int]) -> Evaluator:
        """Return the problem with meshes for theta (d,) in the `coarse` experiments."""
        runs, meshes = self.evaluator.runs, list(self.evaluator.meshes)
        for e in coarse:
            most, stiffness = MOST_STEPS_PER_CELL * meshes[e].cells, meshes[e].stiffness
            meshes[e] = refine_mesh_of_run(runs[e], theta, most=most, stiffness=stiffness)
        return self._build(meshes).judge_rows()

    def suits(self, theta: FloatArray) -> bool:
        """Return whether the errors of the rows at a point are small on the meshes there are."""
        return not self._list_coarse(self.evaluator(theta))
