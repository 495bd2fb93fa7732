"""The accepted times of the adaptive solver from t0 to tf."""

from __future__ import annotations

from switchfit.arrays import FloatArray
from switchfit.engine.adaptive.integrator import Integrator, SolveSettings
from switchfit.engine.corners import branches, course
from switchfit.engine.corners.path_search import find_path
from switchfit.engine.run import Run
from switchfit.runtime.errors import NotIntegrableError

USUAL_SETTINGS = SolveSettings()


def solve_adaptively(run: Run, theta: FloatArray, settings: SolveSettings = USUAL_SETTINGS) -> FloatArray:
    """Return the accepted times of the adaptive solver from t0 to tf, strictly increasing."""
    # In turn: along the path, without it, along it with more crossings, and without it after all.
    tau, p = run.vectors(theta)
    if run.branches is not None:
        try:
            return find_path(run, run.branches, tau, p, run.coarse, settings)[0]
        except course.TooManyCrossingsError as error:
            if run.path is not None:  # a trial far from the guess
                raise
            # Too many crossings at the guess: once more without following them, with short steps at each corner.
            known, run.branches = run.branches, None
            try:
                return Integrator(run, run.structure, run.coarse, settings)(tau, p)
            except NotIntegrableError as stuck:  # for it rests, or switches ever faster
                run.branches = known
                if known.most == branches.MOST_AT_GUESS:
                    raise error from stuck
                known.most = branches.MOST_AT_GUESS
                return solve_adaptively(run, theta, settings)
    return Integrator(run, run.structure, run.coarse, settings)(tau, p)
