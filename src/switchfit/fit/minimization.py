"""One run of the optimizer on a problem with given meshes, for fits, profiles and many fits.

It poses the minimization for `switchfit.optimize`: an evaluator or a follower as its function, in the variables of the
optimizer; idle unknowns of collapsed modes; the first trust region; and the arrow shape of the Hessian of many runs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.arrays import FloatArray
from switchfit.engine.evaluation import Matrix
from switchfit.engine.native.native_engine import NativeEngine
from switchfit.fit.change_of_variables import ChangeOfVariables, convert_constrained, convert_to_variables
from switchfit.fit.collapsed_modes import idle_unknowns
from switchfit.fit.hidden_switches import refuse_hidden_switches
from switchfit.fit.times_at_jumps import hold_at_jumps
from switchfit.meshes.evaluator import Evaluator
from switchfit.meshes.follower import Follower
from switchfit.optimize import IterationRecord, LinearConstraints, Result, minimize
from switchfit.optimize.minimization_problem import HessianKind
from switchfit.optimize.minimization_problem import MinimizationProblem as Minimization
from switchfit.optimize.threads import with_own_threads
from switchfit.problem.problem import Problem, keep_with_problem

MANY_RUNS = 16
"""Number of experiments from which the arrow shape of the Hessian is used; with fewer, the algebra of full matrices
takes no longer (the runs part of the benchmarks)."""

REACH, TIME_REACH = 0.1, 0.01
"""Largest change in the first trust-region step: of an unknown as a part of its size, of a transition time as a part of
the horizon."""


def minimize_cost(
    source: Evaluator | Follower,
    theta: ArrayLike,
    hessian: HessianKind,
    tolerance: float,
    max_iterations: int,
    callback: Callable[[IterationRecord], object] | None = None,
    constraints: LinearConstraints | None = None,
    multipliers: Sequence[float] | None = None,
) -> Result:
    """Run the optimizer once on the meshes of an evaluator; arguments as in `estimate`.

    With a follower of one in its place, meshes are made anew where they are too coarse: its own are then those of the
    result.

    `constraints` are by default those of the problem. The arrow shape of the Hessian of several runs is used where that
    is faster, and never with guards or terminal constraints, whose `multipliers` may be known from a fit on other
    meshes.
    """
    follower = source if isinstance(source, Follower) else None
    evaluator = source.evaluator if isinstance(source, Follower) else source
    problem = evaluator.problem
    names = problem.constraint_names
    unknowns = problem.unknowns
    # Block-diagonal and descent-first are made of the exact matrix, by labels and by the optimizer.
    matrix: Matrix = hessian if hessian in ("gauss-newton", "none") else "exact"
    many = len(problem.experiments) >= MANY_RUNS and not names
    # The arrow pays where more than half of the unknowns belong to one run alone.
    by_blocks = many and 2 * len(evaluator.layout.shared) < len(unknowns.names)
    constraints = problem.constraints if constraints is None else constraints
    # Most problems have no scales: their theta is the optimizer's own, to the last bit.
    change = None if unknowns.variables.identity else ChangeOfVariables.of(evaluator, constraints)
    seen: list[bool] = []
    seen_by: Matrix = "none" if by_blocks else matrix
    arrow = by_blocks and hessian not in ("none", "descent-first")

    def evaluate(z: FloatArray, side: int, multipliers: FloatArray | None = None) -> Any:
        theta = z if change is None else change.to_theta(z)
        if multipliers is not None:
            here = source.constrained(theta, side, multipliers)
        else:
            here = source(theta, side, matrix=matrix, arrow=arrow)
            if not seen:
                seen.append(True)
                # Unknowns that their bounds hold are not estimated: a search holds what acts in no mode.
                refuse_hidden_switches(evaluator, theta, np.where(constraints.movable, here.gradient, 1.0), seen_by)
        return here if change is None else convert_to_variables(change.variables, theta, here, multipliers)

    def idle(z: FloatArray, everything: bool) -> NDArray[np.bool_]:
        return idle_unknowns(evaluator, z if change is None else change.to_theta(z), everything)

    def report(record: IterationRecord) -> object:
        record = record if change is None else change.convert_record(record)
        if follower is not None:
            # Here and not at each evaluation: a mesh made for a trial point is kept only if the point is.
            follower.accept(record.theta, record.cost)
        return None if callback is None else with_own_threads(callback)(record)

    natively = all(isinstance(engine, NativeEngine) for engine in evaluator.engines)  # calls no functions of the user
    posed = Minimization(
        evaluate=evaluate if natively else with_own_threads(evaluate),
        constraints=constraints if change is None else change.convert_constraints(problem.sizes),
        breakpoints=evaluator.sorted_breakpoints if change is None else change.breakpoints,
        hessian="exact" if by_blocks and hessian == "auto" else hessian,  # a trust region's one radius suits no run
        labels=unknowns.is_time.astype(float) if hessian == "block-diagonal" else None,  # of (4)
        tolerance=tolerance,
        max_iterations=max_iterations,
        size=unknowns.variables.sizes_inward(problem.sizes),
        idle=None if names else idle if natively else with_own_threads(idle),
        reach=_compute_reach(problem),
        equalities=names,
        accuracy=None if follower is None else follower.get_accuracy,
    )
    start = unknowns.variables.inward(np.asarray(theta, dtype=float))
    result = minimize(posed, start, None if follower is None and callback is None else report, multipliers)
    # Where a measured state jumps, J falls towards one side of a sample and rises behind it: such a time is held
    # between.
    if any(structure.has_resets for structure in evaluator.structures):
        result = hold_at_jumps(posed, result)
    if change is None:
        return result
    converted = change.convert_result(result)
    return converted if not names else convert_constrained(evaluator, converted)


@keep_with_problem
def _compute_reach(problem: Problem) -> FloatArray:
    """Return how far each variable may move in the optimizer's first trust-region step, (d,).

    This is a part of the horizon for a transition time, and a part of the first guess for any other unknown; if the
    guess is zero, of the range between its bounds.
    """
    unknowns = problem.unknowns
    width = unknowns.upper - unknowns.lower
    guess = np.abs(unknowns.initial)
    reach = REACH * np.where(guess > 0, guess, np.where(np.isfinite(width) & (width > 0), width, 1.0))
    reach = unknowns.put_at_times(reach, [TIME_REACH * run.initial_length for run in problem.experiments])
    return np.where(unknowns.variables.log, REACH, reach / unknowns.variables.size)
