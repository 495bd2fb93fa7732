"""The accepted times of the adaptive solver from t0 to tf: along the path through corners, or without regard to them.

A path is searched by adaptive solves that are repeated until no new branch turns up.
"""

from __future__ import annotations

from switchfit.arrays import FloatArray
from switchfit.discretization.mesh import Mesh
from switchfit.engine.adaptive.integrator import Integrator, SolveSettings
from switchfit.engine.corners.branches import MOST_AT_GUESS, Branches, BranchPath
from switchfit.engine.corners.course import BranchError, Course, SteepError, TooManyCrossingsError
from switchfit.engine.run import Run
from switchfit.runtime.errors import NotIntegrableError

USUAL_SETTINGS = SolveSettings()


def solve_adaptively(run: Run, theta: FloatArray, settings: SolveSettings = USUAL_SETTINGS) -> FloatArray:
    """Return the accepted times of the adaptive solver from t0 to tf, strictly increasing."""
    # In turn: along the path, without it, along it with more crossings, and without it after all.
    tau, p = run.vectors(theta)
    while True:
        branches, refused = run.branches, None
        if branches is not None:
            try:
                return find_path(run, branches, tau, p, run.coarse, settings)[0]
            except TooManyCrossingsError as error:
                if run.path is not None:  # a trial far from the guess
                    raise
                # Too many crossings at the guess: once more without following them, with short steps at each corner.
                run.branches, refused = None, error
        try:
            return Integrator(run, run.structure, run.coarse, settings)(tau, p)
        except NotIntegrableError as stuck:  # for it rests, or switches ever faster
            if branches is None or refused is None:
                raise
            run.branches = branches
            if branches.most == MOST_AT_GUESS:
                raise refused from stuck
            branches.most = MOST_AT_GUESS


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
