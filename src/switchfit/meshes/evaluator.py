"""Evaluator: a problem on fixed meshes, with J and its exact derivatives as functions of theta alone.

It combines the experiments: the engine of each evaluates J in the experiment's own unknowns, and the sum is in theta,
as a full matrix or in the shape of an arrow. Priors are added here. On its meshes J is one smooth function between
kinks, since a mesh does not change with theta; other meshes are another evaluator (`halving`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, partial
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.arrays import FloatArray
from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import Mesh, pad_meshes
from switchfit.discretization.stiffness import Stiffness
from switchfit.engine.choice import engine_of, summarize
from switchfit.engine.corners.split_engine import SmoothEngine, SplitEngine
from switchfit.engine.evaluation import DenseEvaluation, Engine, Evaluation, Matrix
from switchfit.engine.native.native_engine import NativeEngine
from switchfit.engine.run import Run, runs_of
from switchfit.engine.simulation import Simulation
from switchfit.meshes.refinement import refine_mesh_of_run
from switchfit.optimize.arrow import Arrow, ArrowLayout
from switchfit.optimize.breakpoints import Breakpoints
from switchfit.paper_adjoint import evaluate_paper
from switchfit.problem.functions import use_float64
from switchfit.problem.priors import PriorTerms
from switchfit.problem.problem import Problem, keep_with_problem
from switchfit.problem.structure import Structure
from switchfit.runtime.cache import use_compilation_cache

Method = Literal["auto", "forward", "discrete-adjoint", "adjoint", "autodiff"]
"""By what the derivatives are evaluated; "discrete-adjoint" is JAX with a backward sweep for the Hessian, as the
fallback of "auto" takes it, and "autodiff" the same as "forward"."""


class Evaluator:
    """A problem on fixed meshes, one per experiment: cost, gradient and Hessian as functions of theta alone.

    Parameters
    ----------
    problem : Problem
    *thetas : (d,) arrays
        Points at which the meshes are refined; the problem's initial guess if left out.
    meshes : sequence of Mesh, optional
        Meshes to use instead of refined ones.
    arguments : sequence of Arguments, optional
        Data and constants on these meshes, where they are not the problem's own.
    finer : float
        Multiplies the number of cells of refined meshes.

    Attributes
    ----------
    meshes : list of Mesh
    arguments : list of Arguments
    engines : list of Engine
        One for each experiment.
    is_kept : bool
        Whether it is the problem's own (`evaluator_of`): what is made for it serves all fits from the initial guess.
    halved : Evaluator or None
        The same problem on halved cells, once `halve_cells` has been asked for it.
    """

    def __init__(
        self,
        problem: Problem,
        *thetas: FloatArray,
        meshes: Sequence[Mesh] | None = None,
        arguments: Sequence[Arguments] | None = None,
        finer: float = 1.0,
    ) -> None:
        self.problem = problem
        if meshes is None:
            meshes = [refine_mesh_of_run(run, *(thetas or (problem.initial_theta,)), finer=finer) for run in self.runs]
        self.meshes = list(meshes)
        if arguments is None:
            padded = pad_meshes(self.meshes, problem.alike)
            arguments = [run.build_arguments(mesh) for run, mesh in zip(self.runs, padded, strict=True)]
        self.arguments = list(arguments)
        self.engines = list(map(engine_of, self.runs, self.arguments, self.meshes))
        self.is_kept = False
        self.halved: Evaluator | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """How it is copied and pickled: on the same meshes, with programs of its own."""
        return partial(Evaluator, meshes=self.meshes), (self.problem,)

    @cached_property
    def runs(self) -> tuple[Run, ...]:
        """The experiments, as all evaluators of the problem share them."""
        return runs_of(self.problem)

    def divide(self, parts: int) -> Evaluator:
        """Return the same problem with every cell of its meshes cut into equal parts."""
        return Evaluator(self.problem, meshes=[mesh.divide(parts) for mesh in self.meshes])

    @cached_property
    def _priors(self) -> PriorTerms | None:
        return self.problem.unknowns.priors if self.problem.unknowns.priors.any else None

    def __call__(
        self, theta: FloatArray, side: int = 1, method: Method = "auto", matrix: Matrix = "exact", arrow: bool = False
    ) -> Evaluation[Any]:
        """Return the cost, gradient and Hessian; for a transition time on a node, the derivatives on its `side`.

        `matrix` selects the Hessian, the Gauss-Newton matrix in its place, or neither (NaN). As an `arrow`, it takes
        time and memory that are linear in the number of experiments.
        """
        whole = self._add_runs(self._evaluate_experiments(theta, side, method, matrix), len(theta), arrow)
        return self._add_priors(whole, theta, matrix)

    def constrained(self, theta: FloatArray, side: int = 1, multipliers: ArrayLike = 0.0) -> Evaluation[FloatArray]:
        """Return cost and constraints, with the Hessian of the Lagrangian for the multipliers, (m,) or ()."""
        multipliers = np.full(len(self.problem.constraint_names), multipliers, dtype=float)
        parts = np.split(multipliers, np.cumsum(self.problem.constraint_counts)[:-1])
        each = zip(self.engines, self._vectors(theta), parts, strict=True)
        results = [engine.constrained(*at, side, own) for engine, at, own in each]
        whole = self._add_runs(results, len(theta))
        return self._add_priors(whole, theta)

    def _add_runs(self, results: list[Evaluation[FloatArray]], d: int, arrow: bool = False) -> Evaluation[Any]:
        """Return the sum of the evaluations of all experiments, which are in their own unknowns, in theta (d,)."""
        if self.problem.one_to_one and not arrow:
            return results[0]
        size = self.layout.own.shape[1] + len(self.layout.shared) if arrow else d
        parts = np.zeros((len(results) if arrow else 1, size, size))
        cost, gradient, slopes = 0.0, np.zeros(d), []
        for e, (one, (own, mine)) in enumerate(zip(results, self.problem.own_places, strict=True)):
            cost += one.cost
            # Two names of the model may refer to one parameter: its index then occurs twice, and both count.
            np.add.at(gradient, mine, one.gradient[own])
            part, places = (parts[e], self._slots[e]) if arrow else (parts[0], mine)
            np.add.at(part, (places[:, None], places), one.hessian[own[:, None], own])
            slopes.append(np.zeros((len(one.constraints), d)))
            if len(one.constraints):
                np.add.at(slopes[-1].T, mine, one.jacobian[:, own].T)
        hessian = Arrow.of_runs(self.layout, parts) if arrow else parts[0]
        constraints, jacobian = np.concatenate([one.constraints for one in results]), np.concatenate(slopes)
        row_errors = tuple(one.row_errors[0] if one.row_errors else np.nan for one in results)
        return Evaluation(cost, gradient, hessian, constraints, jacobian, row_errors)

    def _add_priors(self, found: Evaluation[Any], theta: FloatArray, matrix: Matrix = "exact") -> Evaluation[Any]:
        """Return an evaluation with the priors in cost, gradient and Hessian."""
        if self._priors is None:
            return found
        J, g, h = self._priors.evaluate(theta, gauss_newton=matrix == "gauss-newton")
        hessian = found.hessian.plus_diagonal(h) if isinstance(found.hessian, Arrow) else found.hessian + np.diag(h)
        return replace(found, cost=found.cost + float(J), gradient=found.gradient + g, hessian=hessian)

    @cached_property
    def layout(self) -> ArrowLayout:
        """Layout of the arrow-shaped Hessian: the unknowns of each experiment, and shared ones."""
        return ArrowLayout.of(len(self.problem.theta_names), self.problem.places)

    @cached_property
    def _slots(self) -> list[NDArray[np.intp]]:
        return [self.layout.slots(e, mine) for e, (_, mine) in enumerate(self.problem.own_places)]

    @cached_property
    def structures(self) -> tuple[Structure, ...]:
        """The structure of each experiment, with the method of the steps of each mode on its mesh."""
        return tuple(run.get_structure(mesh) for run, mesh in zip(self.runs, self.meshes, strict=True))

    @property
    def stiffness(self) -> tuple[Stiffness, ...]:
        """The modes of each experiment in which ``solver="auto"`` has chosen implicit steps, and why."""
        return tuple(each for mesh in self.meshes for each in mesh.stiffness)

    @property
    def takes_implicit_steps(self) -> bool:
        """Whether a mode of an experiment takes implicit steps."""
        return any(any(structure.implicit) for structure in self.structures)

    def judge_rows(self) -> Evaluator:
        """Estimate the errors of rows in all evaluations from now on; return the evaluator."""
        for engine in self.engines:
            engine.judge_rows()
        return self

    def cost(self, theta: FloatArray) -> float:
        """Return J alone."""
        of_priors = 0.0 if self._priors is None else float(self._priors.evaluate(theta)[0])
        return sum((engine.cost(*at) for engine, at in zip(self.engines, self._vectors(theta), strict=True)), of_priors)

    @property
    def engine(self) -> Engine:
        """Engine of cost, gradient and exact Hessian by the method "auto": machine code, or JAX with the reason."""
        return summarize(self.engines, self.problem.run_names)

    @property
    def paths(self) -> list[tuple[Any, ...]]:
        """The path of the last trajectory of each experiment through the corners of its modes; empty without any."""
        return [engine.path if isinstance(engine, SplitEngine) else () for engine in self.engines]

    def simulate(self, theta: FloatArray, *, tangents: bool = False) -> list[Simulation]:
        """Simulate all experiments row by row, with the derivatives of rows if `tangents`."""
        each = zip(self.engines, self._vectors(theta), strict=True)
        return [engine.simulate(*at, tangents=tangents) for engine, at in each]

    def _vectors(self, theta: FloatArray) -> list[tuple[FloatArray, FloatArray]]:
        """Return the transition times (N,) and parameters (M,) of each experiment."""
        return [self.problem.vectors(theta, e) for e in range(len(self.engines))]

    def _evaluate_experiments(
        self, theta: FloatArray, side: int, method: Method, matrix: Matrix
    ) -> list[Evaluation[FloatArray]]:
        """Return the cost, gradient and Hessian of each experiment in its own unknowns."""
        theta = np.asarray(theta, dtype=np.float64)
        if method == "auto":
            find = self.problem.vectors
            return [engine.derivatives(*find(theta, e), side, matrix) for e, engine in enumerate(self.engines)]
        if method == "adjoint" and not is_covered_by_paper(self.problem):
            raise ValueError("the paper's equations have no TransitionCost: choose another method.")
        by: Any = "forward" if method == "autodiff" else method

        def evaluate(
            e: int, p: FloatArray, structure: Structure, engine: SmoothEngine, tau: FloatArray
        ) -> DenseEvaluation:
            if method == "adjoint":
                with use_float64(), use_compilation_cache():
                    J, g, H = evaluate_paper(self.arguments[e], tau, p, float(side), structure=structure)
                return Evaluation(float(J), np.array(g), np.array(H))
            by_jax = engine.fallback if isinstance(engine, NativeEngine) else engine
            return by_jax.derivatives(tau, p, side, matrix, by)

        found = []
        for e, (engine, (tau, p)) in enumerate(zip(self.engines, self._vectors(theta), strict=True)):
            if isinstance(engine, SplitEngine):
                found.append(engine.derivatives(tau, p, side, matrix, partial(evaluate, e, p)))
            else:
                found.append(evaluate(e, p, self.structures[e], engine, tau))
        return found

    @cached_property
    def sorted_breakpoints(self) -> Breakpoints:
        """The breakpoints of theta in the optimizer's form."""
        return Breakpoints.of(self.breakpoints())

    def breakpoints(self) -> list[FloatArray]:
        """Return the nodes at which derivatives may jump for each entry of theta: an empty array for parameters."""
        points = [np.zeros(0)] * len(self.problem.theta_names)
        for mesh, where in zip(self.meshes, self.problem.unknowns.times, strict=True):
            times = mesh.times
            for place in where[where >= 0].tolist():
                points[place] = times
        return points


def is_covered_by_paper(problem: Problem) -> bool:
    """Return whether the paper's equations cover all terms of the cost."""
    return not any(any(f is not None for f in s.transition_costs) for s in problem.structures)


@keep_with_problem
def evaluator_of(problem: Problem) -> Evaluator:
    """Return the problem's own evaluator, built once and cached; its meshes are refined at the initial guess."""
    evaluator = Evaluator(problem)
    evaluator.is_kept = True
    return evaluator
