"""A run: one experiment of a problem, prepared once, with what all its meshes, adaptive solves and engines share."""

from __future__ import annotations

import threading
from functools import cached_property

from switchfit.arrays import FloatArray
from switchfit.discretization.arguments import Arguments, build_common_arguments, put_on_mesh
from switchfit.discretization.mesh import Mesh
from switchfit.engine.corners.branches import Branches, BranchPath, find_branches, has_corners
from switchfit.problem.corners.times import find_corner_times
from switchfit.problem.experiment import Experiment
from switchfit.problem.problem import Problem, keep_with_problem
from switchfit.problem.structure import Structure


class Run:
    """One experiment of a problem, from 0.

    Attributes
    ----------
    structure : Structure
        With the steps that the problem's solver takes in each mode.
    branches : Branches or None
        Of its modes; None if they have no corners, or if its trajectory passes too many: its rows do not end there.
    path : BranchPath or None
        Of the last trajectory through corners, on any mesh.
    solvers : threading.local
        Machine code of adaptive solves, kept by each thread for the next ones.
    """

    def __init__(self, problem: Problem, e: int) -> None:
        self.problem, self.e = problem, e
        self.experiment: Experiment = problem.experiments[e]
        self.structure: Structure = problem.structures[e]
        self.branches: Branches | None = find_branches(self.structure.library) if has_corners(self.structure) else None
        self.path: BranchPath | None = None
        self.solvers = threading.local()  # a solver has one p at a time

    @cached_property
    def coarse(self) -> Mesh:
        """The nodes that every mesh of the experiment has."""
        return Mesh.of(self.experiment, self.corner_times)

    @cached_property
    def corner_times(self) -> FloatArray:
        """Known times of corners, whatever theta is."""
        nodes = Mesh.of(self.experiment).times
        return find_corner_times(self.structure, self.experiment, self._common.fixed, nodes)

    def vectors(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what its programs take at theta (d,): its times (N,) and its p (M,)."""
        return self.problem.vectors(theta, self.e)

    def build_arguments(self, mesh: Mesh) -> Arguments:
        """Return the arrays that its programs take on a mesh; those on the coarse one are kept."""
        # Adaptive solves ask for those of the coarse mesh, at each theta.
        if mesh is self.coarse:
            return self._coarse_arguments
        return put_on_mesh(self._common, self.experiment, mesh)

    @cached_property
    def _coarse_arguments(self) -> Arguments:
        return put_on_mesh(self._common, self.experiment, self.coarse)

    @cached_property
    def _common(self) -> Arguments:
        return build_common_arguments(self.problem, self.e)

    def get_structure(self, mesh: Mesh) -> Structure:
        """Return its structure with the method of the steps of each mode on a mesh."""
        return self.structure.take_implicit_steps([each.mode for each in mesh.stiffness])


@keep_with_problem
def runs_of(problem: Problem) -> tuple[Run, ...]:
    """Return the experiments of a problem, prepared once and kept with it."""
    return tuple(Run(problem, e) for e in range(len(problem.experiments)))
