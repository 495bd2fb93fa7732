"""Integration error at a theta: what halving all steps changes in J, guards and terminal constraints.

Each output is compared at the same theta on the meshes of the fit and on meshes with every step halved. The change is
divided by a scale of that output:

- J: J itself, or 1e-3 of its first value if that is more (a cost that vanishes has no relative error).
- A guard or terminal constraint c is zero at the solution, so that its own value is no scale. The integration error
  enters it through the states. Its scale is therefore ``sum_j |D_j c| range_j``, where range_j is the difference
  between the largest and the smallest value of state j in the run. This scale depends neither on the origins of time
  and of the states, nor on how long the run continues after the states have settled. A constraint in which no state
  varies has an absolute error.

By how much the error is above `LARGEST_INTEGRATION_ERROR` says which finer meshes come next
(`switchfit.meshes.halving.refine_meshes`).
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.arrays import FloatArray
from switchfit.discretization.arguments import Arguments
from switchfit.discretization.model import Model, list_transition_functions
from switchfit.engine.simulation import Simulation
from switchfit.meshes.evaluator import Evaluator
from switchfit.meshes.halving import halve_cells, halve_rows
from switchfit.problem.functions import use_float64
from switchfit.problem.problem import Problem
from switchfit.problem.structure import Structure
from switchfit.runtime.cache import use_compilation_cache

LARGEST_INTEGRATION_ERROR = 1e-8
"""Relative error of J, a guard or a terminal constraint (by halving all steps) above
which the mesh is refined again, unless rtol allows more."""

LARGE_INTEGRATION_ERROR = 1e-6
"""Relative change of J or of a constraint by halving the steps, above which it counts as inaccurate."""

PERFECT_FIT = 1e-3
"""If J has fallen below this part of its first value, the integration error is relative to that part, since a cost that
vanishes has no relative error."""


def judge_meshes(
    evaluator: Evaluator,
    theta: FloatArray,
    cost: float,
    first_cost: float,
    constraints: Sequence[float],
) -> tuple[Evaluator, float, float, str]:
    """Return the problem with all steps at theta halved, J there, the largest integration error and its output.

    The first meshes are mostly too coarse. Halved cells show this as well as halved rows do: they are tried first on
    the problem's own meshes, for whose halved cells there is an evaluator that is kept for the next fit.

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
    cost, constraints : float, (m,)
        J, guards and terminal constraints of the evaluator at theta.
    first_cost : float
        J at the start of the fit.
    """
    problem = evaluator.problem
    outputs = ("J", *problem.constraint_names)
    for halve in (halve_cells, partial(halve_rows, theta=theta))[not evaluator.is_kept :]:
        fine = halve(evaluator)
        fine_cost = fine.cost(theta)
        # The errors of constraints are computed from the states alone, so that nothing is compiled for these meshes.
        states = fine.simulate(theta) if problem.constraint_names else []
        errors = [
            cost_error(problem, fine_cost, cost, first_cost),
            *_measure_constraint_errors(fine, theta, states, constraints),
        ]
        worst = int(np.argmax(errors))  # NaN counts as the largest
        error, output = float(errors[worst]), outputs[worst]
        if error > max(LARGEST_INTEGRATION_ERROR, problem.rtol):
            break
    return fine, fine_cost, error, output


def cost_error(problem: Problem, fine_cost: float, cost: float, first_cost: float) -> float:
    """Return the change of J by halving all steps, relative to the size of J."""
    size = max(abs(fine_cost), PERFECT_FIT * abs(first_cost), problem.smallest_cost)
    return abs(fine_cost - cost) / size


def _measure_constraint_errors(
    fine: Evaluator, theta: FloatArray, simulations: Sequence[Simulation], constraints: Sequence[float]
) -> FloatArray:
    """Return the changes of the guards and terminal constraints at theta by halving all steps, by their scales: (m,).

    Parameters
    ----------
    fine : Evaluator
        On the meshes of the fit with every step halved.
    theta : (d,)
    simulations : sequence of Simulation
        Of `fine` at theta.
    constraints : (m,)
        On the meshes of the fit.
    """
    problem = fine.problem
    if not simulations:
        return np.zeros(0)
    values, scales = [np.zeros(0)], [np.zeros(0)]
    given = zip(problem.structures, fine.arguments, simulations, strict=True)
    for e, (structure, arguments, simulation) in enumerate(given):
        if problem.constraint_counts[e]:
            tau, p = problem.vectors(theta, e)
            ends = np.stack([simulation.after[rows][-1] for rows in simulation.segments])
            states = np.concatenate([simulation.before, simulation.after])
            # Entering the cache takes longer than the call, and programs that are compiled do not need it.
            compiled = problem.__dict__.setdefault("compiled_constraints", set())
            with use_float64(), nullcontext() if e in compiled else use_compilation_cache():
                found = _evaluate_constraints(arguments.without_mesh(), tau, ends, p, structure=structure)
            compiled.add(e)
            values.append(np.asarray(found[0]))
            scales.append((np.abs(found[1]) @ np.ptp(states, axis=0)).sum(axis=1))
    scale = np.concatenate(scales)
    return np.abs(np.concatenate(values) - constraints) / np.where(scale > 0, scale, 1.0)


@partial(jax.jit, static_argnames=("structure",))
def _evaluate_constraints(
    arguments: Arguments, tau: jax.Array, ends: jax.Array, p: jax.Array, *, structure: Structure
) -> tuple[jax.Array, jax.Array]:
    """Return guards, then terminal constraints c (m,) at the ends (N + 1, n) of segments; and D c, (m, N + 1, n)."""
    model = Model(structure, arguments)

    def evaluate(ends: jax.Array) -> jax.Array:
        values = [guard(tau[i], ends[i], p)[None] for i, guard in list_transition_functions(model, "guards")]
        values += [model.terminal_constraint(ends[-1], p)] if structure.terminal_constraints else []
        return jnp.concatenate(values)

    return evaluate(ends), jax.jacfwd(evaluate)(ends)
