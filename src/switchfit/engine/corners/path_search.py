"""Search the path of a trajectory through corners by adaptive solves, repeated until no new branch turns up."""

from __future__ import annotations

from switchfit.arrays import FloatArray
from switchfit.discretization.mesh import Mesh
from switchfit.engine.adaptive.integrator import Integrator, SolveSettings
from switchfit.engine.corners.branches import Branches, BranchPath
from switchfit.engine.corners.course import BranchError, Course, SteepError
from switchfit.engine.run import Run


def find_path(
    run: Run, branches: Branches, tau: FloatArray, p: FloatArray, coarse: Mesh, settings: SolveSettings
) -> tuple[FloatArray, BranchPath]:
    """Return what `solve_adaptively` does for an experiment whose modes have corners, and the path of the trajectory.

    Branches that no trajectory has run in before are solved in Python at first, so that machine code is compiled once
    for all of them.
    """
    # Each round ends with a path, or finds branches that are not compiled yet. Once no round adds a branch, the path
    # was followed with the final library, and its steps are those that machine code will take.
    while True:
        known = branches.get_structure(run.structure) if branches.count else run.structure
        smallest = run.problem.atol / run.problem.rtol
        course, count = Course(branches, known, run.build_arguments(coarse), p, smallest), branches.count
        steps = None
        try:
            steps = Integrator(run, known, coarse, settings, course)(tau, p)
        except SteepError:
            continue  # nothing is compiled yet with its margin
        except BranchError:
            pass
        branches.add(run.structure, course.path)
        if steps is not None and branches.count == count:
            return steps, course.path
