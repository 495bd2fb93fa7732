"""Choose the mesh from an adaptive solve at one or more thetas.

The step sizes of the solve (`switchfit.engine.adaptive_solve`) determine into how many cells each interval between two
required nodes is divided; the mesh is then frozen while theta moves. With ``solver="auto"``, the modes that are stiff
(`switchfit.engine.stiffness`) take implicit steps. Each mode thus has the cells that its own method needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from switchfit.discretization.mesh import Mesh, Stiffness, merge_stiffness
from switchfit.engine.adaptive_solve import MAX_STEPS, PACE, Settings, solve_adaptively
from switchfit.engine.run import Run, runs_of
from switchfit.engine.stiffness import STEPS_BETWEEN_AFTER_FAILURE, Choice, TooManyStepsError, Watch
from switchfit.problem.data import FloatArray
from switchfit.problem.problem import Problem
from switchfit.runtime.errors import NotIntegrableError

MOST_TIMES = 10
"""Times the fewest steps of several problems beyond which a problem is left out of their common mesh."""


def refine_mesh(problem: Problem, e: int, *thetas: FloatArray, **settings: Any) -> Mesh:
    """Return a mesh of experiment e of a problem, as `refine_mesh_of_run` does."""
    return refine_mesh_of_run(runs_of(problem)[e], *thetas, **settings)


def refine_mesh_of_run(
    run: Run, *thetas: FloatArray, finer: float = 1.0, most: int = MAX_STEPS, stiffness: Sequence[Stiffness] = ()
) -> Mesh:
    """Return a mesh of an experiment that meets the problem's tolerances at each of the given thetas.

    Parameters
    ----------
    finer : float
        Multiplies the number of cells.
    most : int
        Largest number of steps of the adaptive solve in a mode.
    stiffness : sequence of Stiffness
        Modes that take implicit steps as on an earlier mesh, if ``solver="auto"`` decides.

    Raises
    ------
    ValueError
        If a mode returns a value that is not finite, or the trajectory cannot be integrated to its end.
    """
    solutions, found = _solve_at(run, thetas, Choice(stiffness), most)
    return run.coarse.refine(solutions, found, finer)


def refine_mesh_of_many(problems: Sequence[Problem], e: int) -> Mesh:
    """Return a mesh of experiment e that meets the tolerances at the guess of each of several problems.

    They have the same data. Problems that cannot be integrated to the end are left out, unless none can, and those
    that need far more steps than another one: they grow without bound.

    Raises
    ------
    NotIntegrableError
        If none can be integrated; the error is that of the first.
    """
    runs = [runs_of(problem)[e] for problem in problems]
    solutions: list[FloatArray] = []
    failure: NotIntegrableError | None = None
    stiffness: tuple[Stiffness, ...] = ()
    for run in runs:
        try:
            found, stiff = _solve_at(run, (run.problem.initial_theta,), Choice())
        except NotIntegrableError as error:
            failure = failure or error
            continue
        solutions += found
        stiffness = merge_stiffness(stiffness, stiff)
    if not solutions and failure is not None:
        raise failure
    fewest = min(map(len, solutions))
    kept = [steps for steps in solutions if len(steps) <= MOST_TIMES * fewest + PACE]
    return runs[0].coarse.refine(kept, stiffness)


def refine_if_unstable(run: Run, mesh: Mesh, *thetas: FloatArray) -> Mesh | None:
    """Return a mesh that meets the tolerances at each theta, with implicit steps in the modes whose explicit ones are
    unstable.

    It is called after a fit on `mesh` has failed, at the last of the thetas. None if the problem sets the solver; if
    all explicit steps are stable; or if implicit ones take longer.
    """
    if run.problem.solver != "auto":
        return None
    watch, choice = Watch(between=STEPS_BETWEEN_AFTER_FAILURE), Choice(mesh.stiffness)
    with suppress(NotIntegrableError):
        solve_adaptively(run, thetas[-1], Settings(choice.found, watch))
    if not choice.add(watch.find_unstable(mesh), watch, 0):
        return None
    try:
        found = _solve_at(run, thetas[::-1], choice)
    except NotIntegrableError:
        return None
    return run.coarse.refine(*found) if choice.found.keys() - {each.mode for each in mesh.stiffness} else None


def _solve_at(
    run: Run, thetas: Sequence[FloatArray], choice: Choice, most: int = MAX_STEPS
) -> tuple[list[FloatArray], tuple[Stiffness, ...]]:
    """Return the accepted times of an adaptive solve at each theta, by the problem's solver.

    With ``solver="auto"``, a mode that is stiff at one of the thetas is solved by implicit steps at all of them, unless
    these fail or take longer; the modes that are, and why, are returned too. `choice` has those known before.
    """
    if run.problem.solver != "auto":
        return [solve_adaptively(run, theta, Settings(most=most)) for theta in thetas], ()
    solutions: list[FloatArray] = []
    while len(solutions) < len(thetas):
        k = len(solutions)
        watch, failure = choice.watch(k), None
        try:
            solutions.append(solve_adaptively(run, thetas[k], Settings(choice.found, watch, most)))
        except (NotIntegrableError, TooManyStepsError) as error:
            failure = error
        refused = failure is None and choice.count_steps(watch, k)
        again = choice.add(watch.find_stiff(), watch, k) or refused
        if again or (failure is not None and choice.refuse(watch.current)):
            solutions = []  # again, with other steps in some mode
        elif failure is not None:
            raise failure
    choice.report()
    return solutions, choice.stiffness
