"""Integration error of a fit: what halving all steps changes in J, in the guards and in the terminal constraints.

Each output is compared at the same theta on the meshes of the fit and on meshes with every step halved. The change is
divided by a scale of that output:

- J: J itself, or 1e-3 of its first value if that is more (a cost that vanishes has no relative error).
- A guard or terminal constraint c is zero at the solution, so that its own value is no scale. The integration error
  enters it through the states. Its scale is therefore ``sum_j |D_j c| range_j``, where range_j is the difference
  between the largest and the smallest value of state j in the run. This scale depends neither on the origins of time
  and of the states, nor on how long the run continues after the states have settled. A constraint in which no state
  varies has an absolute error.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.discretization.arguments import Arguments
from switchfit.discretization.model import Model
from switchfit.engine.protocol import Simulation
from switchfit.fit.evaluator import Evaluator
from switchfit.fit.trajectory import SimulatedProblem
from switchfit.problem.data import FloatArray
from switchfit.problem.functions import use_float64
from switchfit.problem.problem import Problem
from switchfit.problem.structure import Structure
from switchfit.runtime.cache import use_compilation_cache

PERFECT_FIT = 1e-3
"""If J has fallen below this part of its first value, the integration error is relative to that part, since a cost that
vanishes has no relative error."""

COST = "J"
"""Name of the cost among the outputs."""


class IntegrationError(NamedTuple):
    """Relative integration error of one output: J, a guard or a terminal constraint."""

    error: float
    output: str


def cost_error(problem: Problem, fine_cost: float, cost: float, first_cost: float) -> float:
    """Return the change of J by halving all steps, relative to the size of J."""
    size = max(abs(fine_cost), PERFECT_FIT * abs(first_cost), problem.smallest_cost)
    return abs(fine_cost - cost) / size


def worst_error(
    fine: SimulatedProblem,
    *,
    cost: float,
    first_cost: float,
    constraints: Sequence[float],
) -> IntegrationError:
    """Return the output of a problem with the largest relative integration error.

    Parameters
    ----------
    fine : SimulatedProblem
        At theta, on the meshes of the fit with every step halved.
    cost, first_cost : float
        J on the meshes of the fit, at theta and at the first guess.
    constraints : (m,)
        Guards and terminal constraints on the meshes of the fit at theta.

    Returns
    -------
    IntegrationError
        NaN counts as the largest error.
    """
    problem = fine.evaluator.problem
    errors: list[IntegrationError] = []
    if problem.constraint_names:
        values, scales = constraint_values(fine.evaluator, fine.theta, fine.simulations)
        changes = np.abs(values - constraints) / np.where(scales > 0, scales, 1.0)
        errors += map(IntegrationError, changes.tolist(), problem.constraint_names)
    errors = [IntegrationError(cost_error(problem, fine.cost, cost, first_cost), COST), *errors]
    return max(errors, key=lambda found: np.inf if np.isnan(found.error) else found.error)


def constraint_values(
    evaluator: Evaluator, theta: FloatArray, simulations: Sequence[Simulation]
) -> tuple[FloatArray, FloatArray]:
    """Return the guards and terminal constraints of a simulation and their scales: (m,) each.

    They are computed from the states alone, so that nothing is compiled for the meshes of `evaluator`.
    """
    problem = evaluator.problem
    values, scales = [np.zeros(0)], [np.zeros(0)]
    given = zip(problem.structures, evaluator.arguments, simulations, strict=True)
    for e, (structure, arguments, simulation) in enumerate(given):
        if structure.constrained:
            tau, p = problem.vectors(theta, e)
            ends = np.stack([simulation.after[rows][-1] for rows in simulation.segments])
            states = np.concatenate([simulation.before, simulation.after])
            # Entering the cache takes longer than the call, and programs that are compiled do not need it.
            compiled = problem.__dict__.setdefault("compiled_constraints", set())
            with use_float64(), nullcontext() if e in compiled else use_compilation_cache():
                found = _evaluate_constraints(arguments.without_mesh(), tau, ends, p, structure=structure)
            compiled.add(e)
            values.append(np.asarray(found[0]))
            scales.append(np.abs(found[1]) @ np.ptp(states, axis=0))
    return np.concatenate(values), np.concatenate(scales)


@partial(jax.jit, static_argnames=("structure",))
def _evaluate_constraints(
    arguments: Arguments, tau: jax.Array, ends: jax.Array, p: jax.Array, *, structure: Structure
) -> tuple[jax.Array, jax.Array]:
    """Return guards, then terminal constraints c (m,) at the ends (N + 1, n) of the segments; and D c, (m, n)."""
    model = Model(structure, arguments)
    values, slopes = [], []
    for i in structure.guarded:
        value, slope = jax.value_and_grad(model.guard(i), argnums=1)(tau[i], ends[i], p)
        values.append(value[None])
        slopes.append(slope[None])
    if structure.terminal_constraints:
        values.append(model.terminal_constraint(ends[-1], p))
        slopes.append(jax.jacfwd(model.terminal_constraint)(ends[-1], p))
    return jnp.concatenate(values), jnp.concatenate(slopes)
