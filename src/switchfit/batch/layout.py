"""What the compiled programs of many fits are written for, and the cost of a problem inside them.

A program serves all problems with the same `Layout`: their numbers are its arguments, those that differ from fit to fit
(`Varying`) with a leading axis.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import Mesh
from switchfit.engine.choice import derivatives_inside_program, runs_natively
from switchfit.engine.native.experiment import places_in_library
from switchfit.fit.evaluator import Evaluator
from switchfit.problem.data import FloatArray
from switchfit.problem.functions import use_float64
from switchfit.problem.priors import PriorTerms
from switchfit.problem.problem import Problem
from switchfit.problem.structure import Structure
from switchfit.runtime.cache import use_compilation_cache

CHUNK = 64
"""Fits of a chunk on a CPU."""

CHUNK_IN_LOCKSTEP = 1024
"""The same on a GPU, where they go in lockstep."""

MOST_CHUNKS = 4
"""Chunks that one call takes at most on a CPU ..."""

MOST_BYTES = 2**24
"""... if the data of so many fits, and their Hessians, are not more than this."""

ONE_BY_ONE = (
    {"xla_cpu_scheduler_type": "CPU_SCHEDULER_TYPE_MEMORY_OPTIMIZED"} if jax.__version_info__ >= (0, 10) else {}
)
"""Options of XLA with which the operations of a program run one after another. They take a microsecond each; to hand
some of them to other threads takes an eighth of the time of all fits."""

compile_for_layout = partial(jax.jit, static_argnames=("layout",), compiler_options=ONE_BY_ONE)


class Varying(NamedTuple):
    """What differs from fit to fit, each with a leading axis: the leaves of all `Arguments`, in JAX's order.

    Attributes
    ----------
    places : tuple of int
        Which leaves.
    values : tuple of arrays, (R, ...) each
    """

    places: tuple[int, ...]
    values: tuple[Any, ...]


@dataclass(frozen=True)
class Layout:
    """What the compiled program depends on: structures, and where in theta each experiment's unknowns stand."""

    structures: tuple[Structure, ...]  # where machine code evaluates J, what their sequences have in common alone
    transitions: tuple[int, ...]
    places: tuple[tuple[int, ...], ...]  # of the N transition times and M parameters, -1 where fixed
    varying: tuple[int, ...]
    lockstep: bool
    natively: bool  # whether machine code evaluates J


def uses_lockstep() -> bool:
    """Return whether fits go in lockstep: where JAX's default device is not a CPU."""
    return str(jax.default_backend()) != "cpu"


def choose_chunk_size() -> int:
    """Return how many fits are a chunk."""
    return CHUNK_IN_LOCKSTEP if uses_lockstep() else CHUNK


def count_chunks_together(problem: Problem, meshes: Sequence[Mesh], varying: Varying) -> int:
    """Return how many chunks one call of the program of a problem may take.

    Only one where machine code does not evaluate J: a function that calls back into Python may raise an error for one
    fit, which ends the program for all of its call.

    Parameters
    ----------
    problem : Problem
    meshes : one an experiment
    varying : Varying
        Of any number of fits.
    """
    own = sum(np.asarray(value)[0].nbytes for value in varying.values) + 8 * len(problem.theta_names) ** 2
    if own * MOST_CHUNKS * CHUNK > MOST_BYTES or uses_lockstep():
        return 1
    return MOST_CHUNKS if choose_layout(Evaluator(problem, meshes=meshes)).natively else 1


def choose_layout(evaluator: Evaluator, varying: tuple[int, ...] = ()) -> Layout:
    """Return the layout of a program that evaluates a problem on given meshes, with its own numbers.

    Parameters
    ----------
    evaluator : Evaluator
        With the problem and the meshes.
    varying : tuple of int
        Leaves of the arguments that differ from fit to fit.
    """
    problem, structures = evaluator.problem, evaluator.structures
    lockstep = uses_lockstep()
    natively = not lockstep and problem.engine != "jax" and runs_natively(structures, evaluator.arguments)
    return Layout(
        tuple(structure.library for structure in structures) if natively else structures,
        tuple(structure.N for structure in structures),
        tuple(tuple(int(k) for k in places) for places in problem.places),
        varying=varying,
        lockstep=lockstep,
        natively=natively,
    )


class Inputs(NamedTuple):
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
    """

    arguments: tuple[Arguments, ...]
    times: tuple[Any, ...]
    sequences: tuple[dict[str, Any], ...]
    priors: PriorTerms

    @classmethod
    def of(cls, evaluator: Evaluator, layout: Layout) -> Inputs:
        """Return those of a problem on the meshes of an evaluator."""
        experiments, natively = evaluator.problem.experiments, layout.natively
        times = tuple(experiment.initial_times_with_jumps for experiment in experiments)
        sequences = tuple(places_in_library(structure) if natively else {} for structure in evaluator.structures)
        return cls(tuple(evaluator.arguments), times, sequences, evaluator.problem.unknowns.priors)

    def evaluate(self, layout: Layout, own: Sequence[Any], theta: Any, side: Any) -> tuple[Any, Any, Any]:
        """Return cost, gradient and Hessian of a fit with its own data, inside a program."""
        arguments = replace_leaves(self.arguments, layout.varying, own)
        J, g, H = evaluate_total(layout, arguments, self.times, self.sequences, theta, side)
        prior, slope, curvature = self.priors.evaluate(theta, jnp)
        return J + prior, g + slope, H + jnp.diag(curvature)


def give_data(evaluator: Evaluator, base: tuple[Arguments, ...], varying: Varying, k: int) -> None:
    """Replace the data of an evaluator by those of the k-th fit; `base` are the arguments of the problem itself."""
    with use_float64():
        values = [jnp.asarray(value[k]) for value in varying.values]
        evaluator.replace_arguments(replace_leaves(base, varying.places, values))


def replace_leaves(
    arguments: Sequence[Arguments], places: tuple[int, ...], values: Sequence[Any]
) -> tuple[Arguments, ...]:
    """Return the arguments of all experiments with some of their leaves replaced."""
    leaves, tree = jax.tree.flatten(tuple(arguments))
    for place, value in zip(places, values, strict=True):
        leaves[place] = value
    return tuple(jax.tree.unflatten(tree, leaves))


def evaluate_total(
    layout: Layout,
    arguments: tuple[Arguments, ...],
    times: tuple[jax.Array, ...],
    sequences: tuple[dict[str, jax.Array], ...],
    theta: jax.Array,
    side: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the cost, gradient and Hessian of all experiments together.

    Those that share a structure and all lengths are taken in a loop, so that the program does not grow with them.
    """
    d = theta.shape[0]
    J, g, H = jnp.zeros(()), jnp.zeros(d), jnp.zeros((d, d))
    extended = jnp.append(theta, 0.0)
    for group in _group_experiments(layout, arguments, sequences):
        structure, N = layout.structures[group[0]], layout.transitions[group[0]]
        where = np.array([layout.places[e] for e in group])
        where = np.where(where < 0, d, where)  # what is fixed stands one past the last, and is dropped below
        fixed = jnp.stack([times[e] for e in group])
        tau = jnp.where(where[:, :N] < d, extended[where[:, :N]], fixed)
        given = jax.tree.map(lambda *leaves: jnp.stack(leaves), *((arguments[e], sequences[e]) for e in group))

        def one(
            given: tuple[tuple[Arguments, dict[str, jax.Array]], jax.Array, jax.Array],
            structure: Structure = structure,
        ) -> tuple[jax.Array, jax.Array, jax.Array]:
            (own, sequence), tau, p = given
            found: tuple[jax.Array, jax.Array, jax.Array] = derivatives_inside_program(
                structure, own, tau, p, side, natively=layout.natively, places=sequence or None
            )
            return found

        operands = (given, tau, extended[where[:, N:]])
        if len(group) == 1:
            J_e, g_e, H_e = (value[None] for value in one(jax.tree.map(lambda leaf: leaf[0], operands)))
        else:
            J_e, g_e, H_e = jax.vmap(one)(operands) if layout.lockstep else lax.map(one, operands)
        J = J + J_e.sum()
        g = g.at[where].add(g_e, mode="drop")
        H = H.at[where[:, :, None], where[:, None, :]].add(H_e, mode="drop")
    return J, g, H


def _group_experiments(
    layout: Layout, arguments: tuple[Arguments, ...], sequences: Sequence[Mapping[str, Any]]
) -> list[list[int]]:
    """Return groups of experiments with the same structure and array shapes, which one loop can evaluate."""
    groups: dict[Any, list[int]] = {}
    given = zip(layout.structures, layout.transitions, arguments, sequences, strict=True)
    for e, (structure, N, own, sequence) in enumerate(given):
        shapes = tuple(np.shape(leaf) for leaf in jax.tree.leaves(own))
        groups.setdefault((structure, N, shapes, tuple(sorted(sequence))), []).append(e)
    return list(groups.values())


_known: set[Any] = set()
_lock = threading.Lock()


@contextmanager
def compile_once(layout: Layout, given: Any) -> Iterator[None]:
    """Compile the program in the first call that needs it, using the compilation cache; other threads wait."""
    key = (layout, tuple(np.shape(leaf) for leaf in jax.tree.leaves(given)))
    with _lock:
        if key not in _known:
            with use_compilation_cache():
                yield
            _known.add(key)
            return
    yield


def pad_fits(values: Any, size: int) -> FloatArray:
    """Repeat the last of `values` (R, ...) up to `size`: the number of fits must not shape the program."""
    array = np.asarray(values)
    return np.concatenate([array, np.repeat(array[-1:], size - len(array), axis=0)]) if len(array) < size else array
