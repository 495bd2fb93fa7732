"""The arguments of a compiled program of many fits, and the cost of a problem inside it.

Experiments that share a structure and all lengths are evaluated in one loop, so that the program does not grow with
them.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from switchfit.arrays import Traced
from switchfit.batch.layout import ProgramLayout
from switchfit.discretization.arguments import Arguments
from switchfit.engine.choice import derivatives_inside_program
from switchfit.engine.native.library_places import places_in_library
from switchfit.meshes.evaluator import Evaluator
from switchfit.optimize.traced_constraints import TracedConstraints
from switchfit.problem.priors import PriorTerms
from switchfit.problem.structure import Structure
from switchfit.problem.variables import Variables


class ProgramInputs(NamedTuple):
    """What a program is given beside its fits.

    Attributes
    ----------
    arguments : tuple of Arguments
        Of the problem itself, one an experiment.
    times : tuple of arrays
        First guesses of all transition times of each experiment, in whose place those in theta stand.
    sequences : tuple of dict
        What machine code reads at run time of the sequence of modes of each experiment; JAX is written for it.
    priors : PriorTerms
    variables : Variables
        Those that the optimiser has in place of theta.
    lower, upper : (d,), bounds of theta
    constraints : Constraints
        On the variables.
    """

    arguments: tuple[Arguments, ...]
    times: tuple[Any, ...]
    sequences: tuple[dict[str, Any], ...]
    priors: PriorTerms
    variables: Variables
    lower: Traced
    upper: Traced
    constraints: TracedConstraints

    @classmethod
    def of(cls, evaluator: Evaluator, layout: ProgramLayout) -> ProgramInputs:
        """Return those of a problem on the meshes of an evaluator."""
        problem, unknowns = evaluator.problem, evaluator.problem.unknowns
        variables = unknowns.variables
        times = tuple(experiment.initial_times_with_jumps for experiment in problem.experiments)
        sequences = tuple(places_in_library(each) if layout.natively else {} for each in evaluator.structures)
        limits: list[Any] = [variables.inward(unknowns.lower), variables.inward(unknowns.upper)]
        rows: list[Any] = [unknowns.A, unknowns.b, *limits, variables.sizes_inward(problem.sizes)]
        of_theta = unknowns.priors, variables, unknowns.lower, unknowns.upper
        return cls(tuple(evaluator.arguments), times, sequences, *of_theta, TracedConstraints(*rows))

    def find_theta(self, z: Traced) -> Traced:
        """Return theta (d,) at z, the variables of the optimiser."""
        return jnp.clip(self.variables.outward(z, jnp), self.lower, self.upper)

    def evaluate(
        self, layout: ProgramLayout, own: Sequence[Traced], theta: Traced, side: Traced
    ) -> tuple[Traced, Traced, Traced]:
        """Return cost, gradient and Hessian of a fit with its own data, inside a program.

        Experiments that share a structure and all lengths are taken in a loop, so that the program does not grow with
        them.
        """
        arguments, d = replace_leaves(self.arguments, layout.varying, own), theta.shape[0]
        J, g, curvature = self.priors.evaluate(theta, jnp)
        # One place more than theta: the index d reads 0 and, with mode="drop", writes nowhere.
        H, extended = jnp.diag(curvature), jnp.append(theta, 0.0)
        for group in _group_experiments(layout, arguments, self):
            structure, N = layout.structures[group[0]], len(self.times[group[0]])
            where = np.array([layout.places[e] for e in group])
            where = np.where(where < 0, d, where)  # what is fixed stands one past the last, and is dropped below
            fixed = jnp.stack([self.times[e] for e in group])
            tau = jnp.where(where[:, :N] < d, extended[where[:, :N]], fixed)
            given = jax.tree.map(lambda *leaves: jnp.stack(leaves), *((arguments[e], self.sequences[e]) for e in group))

            def one(given: Traced, structure: Structure = structure) -> tuple[jax.Array, jax.Array, jax.Array]:
                (own, sequence), tau, p = given
                return derivatives_inside_program(structure, own, tau, p, side, sequence)

            operands = (given, tau, extended[where[:, N:]])
            if len(group) == 1:
                J_e, g_e, H_e = (value[None] for value in one(jax.tree.map(lambda leaf: leaf[0], operands)))
            else:
                J_e, g_e, H_e = jax.vmap(one)(operands) if layout.lockstep else lax.map(one, operands)
            J = J + J_e.sum()
            g = g.at[where].add(g_e, mode="drop")
            H = H.at[where[:, :, None], where[:, None, :]].add(H_e, mode="drop")
        return J, g, H


def replace_leaves(
    arguments: Sequence[Arguments], places: Iterable[int], values: Sequence[Any]
) -> tuple[Arguments, ...]:
    """Return the arguments of all experiments with some of their leaves replaced."""
    leaves, tree = jax.tree.flatten(tuple(arguments))
    for place, value in zip(places, values, strict=True):
        leaves[place] = value
    return tuple(jax.tree.unflatten(tree, leaves))


def _group_experiments(
    layout: ProgramLayout, arguments: tuple[Arguments, ...], inputs: ProgramInputs
) -> list[list[int]]:
    """Return groups of experiments with the same structure and array shapes, which one loop can evaluate."""
    groups: dict[Any, list[int]] = {}
    for e, (structure, *own) in enumerate(
        zip(layout.structures, arguments, inputs.times, inputs.sequences, strict=True)
    ):
        leaves, tree = jax.tree.flatten(own)
        groups.setdefault((structure, tree, tuple(map(np.shape, leaves))), []).append(e)
    return list(groups.values())
