"""Choose the mesh from an adaptive solve at one or more thetas.

The step sizes of the solve (`switchfit.engine.adaptive_solve`) determine into how many cells each interval between two
required nodes is divided; the mesh is then frozen while theta moves. With ``solver="auto"``, the modes that are stiff
(`switchfit.engine.stiffness`) take implicit steps. Each mode thus has the cells that its own method needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from switchfit.discretization.mesh import Mesh, Stiffness, merge_stiffness, sort_distinct
from switchfit.engine.adaptive_solve import MAX_STEPS, PACE, Settings, solve_adaptively
from switchfit.engine.branches import list_free_modes
from switchfit.engine.stiffness import STEPS_BETWEEN_AFTER_FAILURE, Choice, TooManyStepsError, Watch
from switchfit.problem.data import FloatArray, Measurements
from switchfit.problem.experiment import Experiment, list_signals
from switchfit.problem.problem import Problem
from switchfit.runtime.errors import NotIntegrableError

MOST_TIMES = 10
"""Times the fewest steps of several problems beyond which a problem is left out of their common mesh."""


def list_fixed_nodes(experiment: Experiment) -> FloatArray:
    """Return the times that must be nodes: t0, tf, and samples and knots of signals inside the horizon.

    If tf is free, its upper bound is the last node.
    """
    t0, tf = experiment.t0, experiment.end
    times = [np.array([t0, tf])]
    times += [item.seen_times for item in experiment.data if isinstance(item, Measurements)]
    times += [signal.knots for signal in list_signals(experiment)]
    nodes = sort_distinct(np.concatenate(times))
    return nodes[(nodes >= t0) & (nodes <= tf)]


def refine_mesh(
    problem: Problem,
    e: int,
    *thetas: FloatArray,
    finer: float = 1.0,
    most: int = MAX_STEPS,
    stiffness: Sequence[Stiffness] = (),
) -> Mesh:
    """Return a mesh of experiment e that meets the problem's tolerances at each of the given thetas.

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
    coarse = Mesh.from_times(list_fixed_nodes(problem.experiments[e]))
    return _build_mesh(coarse, *_solve_at(problem, e, thetas, coarse, Choice(stiffness), most), finer)


def refine_mesh_of_many(problems: Sequence[Problem], e: int) -> Mesh:
    """Return a mesh of experiment e that meets the tolerances at the guess of each of several problems.

    They have the same data. Problems that cannot be integrated to the end are left out, unless none can, and those
    that need far more steps than another one: they grow without bound.

    Raises
    ------
    NotIntegrableError
        If none can be integrated; the error is that of the first.
    """
    coarse = Mesh.from_times(list_fixed_nodes(problems[0].experiments[e]))
    solutions: list[FloatArray] = []
    failure: NotIntegrableError | None = None
    stiffness: tuple[Stiffness, ...] = ()
    for problem in problems:
        try:
            found, stiff = _solve_at(problem, e, (problem.initial_theta,), coarse, Choice())
        except NotIntegrableError as error:
            failure = failure or error
            continue
        solutions += found
        stiffness = merge_stiffness(stiffness, stiff)
    if not solutions and failure is not None:
        raise failure
    fewest = min(map(len, solutions))
    return _build_mesh(coarse, [steps for steps in solutions if len(steps) <= MOST_TIMES * fewest + PACE], stiffness)


def refine_if_unstable(problem: Problem, e: int, mesh: Mesh, *thetas: FloatArray) -> Mesh | None:
    """Return a mesh that meets the tolerances at each theta, with implicit steps in the modes whose explicit ones are
    unstable.

    It is called after a fit on `mesh` has failed, at the last of the thetas. None if the problem sets the solver; if
    all explicit steps are stable; or if implicit ones take longer.
    """
    if problem.solver != "auto":
        return None
    coarse = Mesh.from_times(list_fixed_nodes(problem.experiments[e]))
    watch, choice = Watch(between=STEPS_BETWEEN_AFTER_FAILURE), Choice(mesh.stiffness)
    with suppress(NotIntegrableError):
        solve_adaptively(problem, e, thetas[-1], coarse, Settings(choice.found, watch))
    choice.refuse_all(list_free_modes(problem, e))
    if not choice.add(watch.find_unstable(mesh), watch, 0):
        return None
    try:
        found = _solve_at(problem, e, thetas[::-1], coarse, choice)
    except NotIntegrableError:
        return None
    return _build_mesh(coarse, *found) if choice.found.keys() - {each.mode for each in mesh.stiffness} else None


def _build_mesh(
    coarse: Mesh, solutions: list[FloatArray], stiffness: tuple[Stiffness, ...], finer: float = 1.0
) -> Mesh:
    """Return the mesh with the nodes of `coarse` and between them those that the steps of some solutions need."""
    nodes, steps = coarse.times, _Steps.from_solutions(solutions)
    pieces = np.maximum(np.ceil(finer * np.diff(steps.up_to(nodes)) - 0.05).astype(int), 1)
    inside = [_grade_nodes(nodes[k : k + 2], steps, int(pieces[k])) for k in np.flatnonzero(pieces > 1)]
    return Mesh.from_times(np.concatenate([nodes, *inside]), stiffness)


def _solve_at(
    problem: Problem, e: int, thetas: Sequence[FloatArray], coarse: Mesh, choice: Choice, most: int = MAX_STEPS
) -> tuple[list[FloatArray], tuple[Stiffness, ...]]:
    """Return the accepted times of an adaptive solve at each theta, by the problem's solver.

    With ``solver="auto"``, a mode that is stiff at one of the thetas is solved by implicit steps at all of them, unless
    these fail or take longer, or a slope of the mode is infinite at a corner, where Newton's method does not
    converge; the modes that are, and why, are returned too. `choice` has those known before.
    """
    if problem.solver != "auto":
        return [solve_adaptively(problem, e, theta, coarse, Settings(most=most)) for theta in thetas], ()
    solutions: list[FloatArray] = []
    while len(solutions) < len(thetas):
        k = len(solutions)
        watch, failure = choice.watch(k), None
        try:
            solutions.append(solve_adaptively(problem, e, thetas[k], coarse, Settings(choice.found, watch, most)))
        except (NotIntegrableError, TooManyStepsError) as error:
            failure = error
        refused = choice.refuse_all(list_free_modes(problem, e)) or (failure is None and choice.count_steps(watch, k))
        again = choice.add(watch.find_stiff(), watch, k) or refused
        if again or (failure is not None and choice.refuse(watch.current)):
            solutions = []  # again, with other steps in some mode
        elif failure is not None:
            raise failure
    choice.report()
    return solutions, choice.stiffness


class _Steps(NamedTuple):
    """Number of solver steps up to each time: `counts` (K,) at `times` (K,), linear in between."""

    times: FloatArray
    counts: FloatArray

    @classmethod
    def from_solutions(cls, solutions: list[FloatArray]) -> _Steps:
        """Combine the step times of several solutions: at each time, the smallest step of any of them counts."""
        times = sort_distinct(np.concatenate(solutions))
        middles = times[:-1] + 0.5 * np.diff(times)
        lengths = [np.diff(steps)[np.searchsorted(steps, middles) - 1] for steps in solutions]
        return cls(times, np.concatenate([[0.0], np.cumsum(np.diff(times) / np.min(lengths, axis=0))]))

    def up_to(self, t: FloatArray) -> FloatArray:
        """Return the number of steps up to times t."""
        return np.interp(t, self.times, self.counts)


def _grade_nodes(ends: FloatArray, steps: _Steps, pieces: int) -> FloatArray:
    """Return the nodes between two ends: half of them follow the density of the solver's steps, half are even.

    The steps are short in the layers of a stiff mode, which evenly spaced nodes would miss; but layers move with the
    transition times, and the mesh does not.
    """
    first, last = np.searchsorted(steps.times, ends[0], "right"), np.searchsorted(steps.times, ends[1], "left")
    times = np.concatenate([ends[:1], steps.times[first:last], ends[1:]])
    count = steps.up_to(times)
    density = 0.5 * (count - count[0]) / (count[-1] - count[0]) + 0.5 * (times - ends[0]) / (ends[1] - ends[0])
    return np.interp(np.arange(1, pieces) * (1.0 / pieces), density, times)
