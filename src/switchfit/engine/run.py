"""An experiment of a problem, prepared once: what all its meshes, adaptive solves and engines share."""

from __future__ import annotations

import threading
from dataclasses import replace
from functools import cached_property

from switchfit.discretization.arguments import Arguments, build_common_arguments, put_on_mesh
from switchfit.discretization.mesh import Mesh
from switchfit.engine.branches import Branches, Path, find_branches, has_corners
from switchfit.problem.data import FloatArray
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
    path : Path or None
        Of the last trajectory through corners, on any mesh.
    solvers : threading.local
        Machine code of adaptive solves, kept by each thread for the next ones.
    """

    def __init__(self, problem: Problem, e: int) -> None:
        self.problem, self.e = problem, e
        self.experiment: Experiment = problem.experiments[e]
        self.structure: Structure = problem.structures[e]
        self.branches: Branches | None = find_branches(self.structure.library) if has_corners(self.structure) else None
        self.path: Path | None = None
        self.solvers = threading.local()  # a solver has one p at a time

    @cached_property
    def coarse(self) -> Mesh:
        """The nodes that every mesh of the experiment has."""
        return Mesh.of(self.experiment)

    @cached_property
    def coarse_arguments(self) -> Arguments:
        """The arrays that its programs take on these nodes."""
        return self.build_arguments(self.coarse)

    def vectors(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what its programs take at theta (d,): its times (N,) and its p (M,)."""
        return self.problem.vectors(theta, self.e)

    def build_arguments(self, mesh: Mesh) -> Arguments:
        """Return the arrays that its programs take on a mesh."""
        return put_on_mesh(self._common, self.experiment, mesh)

    @cached_property
    def _common(self) -> Arguments:
        return build_common_arguments(self.problem, self.e)

    def get_structure(self, mesh: Mesh) -> Structure:
        """Return its structure with the method of the steps of each mode on a mesh."""
        stiff = {each.mode for each in mesh.stiffness}
        if not stiff:
            return self.structure
        methods = zip(self.structure.mode_names, self.structure.implicit, strict=True)
        return replace(self.structure, implicit=tuple(implicit or name in stiff for name, implicit in methods))


@keep_with_problem
def runs_of(problem: Problem) -> tuple[Run, ...]:
    """Return the experiments of a problem, prepared once and kept with it."""
    return tuple(Run(problem, e) for e in range(len(problem.experiments)))
