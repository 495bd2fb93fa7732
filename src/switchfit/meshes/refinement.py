"""Refine the mesh of an experiment by adaptive solves at one or more thetas.

The step sizes of the solves determine into how many cells each interval between two required nodes is divided; the mesh
is then frozen while theta moves. With ``solver="auto"``, the modes that are stiff take implicit steps. Each mode thus
has the cells that its own method needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from switchfit.arrays import FloatArray
from switchfit.discretization.mesh import Mesh
from switchfit.discretization.stiffness import Stiffness
from switchfit.engine.adaptive.integrator import MAX_STEPS, PACE, SolveSettings
from switchfit.engine.adaptive.step_times import solve_adaptively
from switchfit.engine.adaptive.stiffness import TooManyStepsError, Watch
from switchfit.engine.run import Run, runs_of
from switchfit.meshes.implicit_modes import STEPS_BETWEEN_AFTER_FAILURE, ImplicitModes
from switchfit.problem.problem import Problem
from switchfit.runtime.errors import NotIntegrableError

MOST_TIMES_FEWEST_STEPS = 10
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
    choice = ImplicitModes(stiffness)
    solutions = _solve_at(run, thetas, choice, most)
    return run.coarse.refine(solutions, choice.stiffness, choice.has_limits, finer)


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
    stiffness: dict[str, Stiffness] = {}
    choices = []
    for run in runs:
        with suppress(NotIntegrableError):
            choices.append(ImplicitModes())
            # A choice for each problem: one with another guess may be stiff in another mode.
            solutions += _solve_at(run, (run.problem.initial_theta,), choices[-1])
            stiffness = choices[-1].found | stiffness  # as it was found first
    if not solutions:
        _solve_at(runs[0], (runs[0].problem.initial_theta,), ImplicitModes())  # it raises
    fewest = min(map(len, solutions))
    # `PACE` more than ten times: of a handful of steps ten times as many say nothing.
    kept = [steps for steps in solutions if len(steps) <= MOST_TIMES_FEWEST_STEPS * fewest + PACE]
    return runs[0].coarse.refine(kept, tuple(stiffness.values()), lambda: any(each.has_limits() for each in choices))


def refine_if_unstable(run: Run, mesh: Mesh, *thetas: FloatArray) -> Mesh | None:
    """Return a mesh that meets the tolerances at each theta, with implicit steps in the modes whose explicit ones are
    unstable.

    It is called after a fit on `mesh` has failed, at the last of the thetas. None if the problem sets the solver; if
    all explicit steps are stable; or if implicit ones take longer.
    """
    if run.problem.solver != "auto":
        return None
    # By explicit steps, as the mesh has them, to where the failure is; what is seen up to there is enough.
    watch, choice = Watch(between=STEPS_BETWEEN_AFTER_FAILURE), ImplicitModes(mesh.stiffness)
    with suppress(NotIntegrableError):
        # The eigenvalues at the theta of the failure are what is wanted: the watch has them even where the solve fails.
        solve_adaptively(run, thetas[-1], SolveSettings(choice.found, watch))
    if not choice.add(watch.find_unstable(mesh), watch, 0):
        return None
    try:
        found = _solve_at(run, thetas[::-1], choice)
    except NotIntegrableError:
        return None
    is_new = choice.found.keys() - {each.mode for each in mesh.stiffness}
    return run.coarse.refine(found, choice.stiffness, choice.has_limits) if is_new else None


def _solve_at(run: Run, thetas: Sequence[FloatArray], choice: ImplicitModes, most: int = MAX_STEPS) -> list[FloatArray]:
    """Return the accepted times of an adaptive solve at each theta, by the problem's solver.

    With ``solver="auto"``, a mode that is stiff at one of the thetas is solved by implicit steps at all of them, unless
    these fail or take longer: the `choice` has the modes that are, and why, and those known before.
    """
    if run.problem.solver != "auto":
        choice.watches = [Watch() for _ in thetas]
        return [
            solve_adaptively(run, theta, SolveSettings((), watch, most))
            for theta, watch in zip(thetas, choice.watches, strict=True)
        ]
    solutions: list[FloatArray] = []
    while len(solutions) < len(thetas):
        k = len(solutions)
        watch, failure = choice.watch(k), None
        try:
            solutions.append(solve_adaptively(run, thetas[k], SolveSettings(choice.found, watch, most)))
        except (NotIntegrableError, TooManyStepsError) as error:
            failure = error
        refused = failure is None and choice.count_steps(watch, k)
        # A mode that changes its method changes the steps at the thetas before, too: all of them are solved anew. Each
        # mode is added once and refused once at most, so that this ends.
        again = choice.add(watch.find_stiff(), watch, k) or refused
        if again or (failure is not None and choice.refuse(watch.current)):
            solutions = []  # again, with other steps in some mode
        elif failure is not None:
            raise failure
    return solutions
