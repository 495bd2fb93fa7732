"""What the compiled programs of many fits are written for: structures, sizes, and what differs from fit to fit.

A program serves all problems with the same `ProgramLayout`: their numbers are its arguments, those that differ from fit
to fit (`Varying`) with a leading axis.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax

from switchfit.engine.choice import runs_natively
from switchfit.meshes.evaluator import Evaluator, evaluator_of
from switchfit.problem.problem import Problem
from switchfit.problem.structure import Structure

CHUNK = 128
"""Fits of a chunk on a CPU: 20,000 fits of a short log took 6.9 s of the processor, with 64 in a chunk 8.6 s."""

CHUNK_IN_LOCKSTEP = 4096
"""The same in lockstep on a GPU: 8192 fits of the vehicle take 1.3 times as long as 1024, and 13 GB."""

Varying = Mapping[int, Any]
"""What differs from fit to fit: values (R, ...) of leaves of all `Arguments`, by their places in JAX's order."""


@dataclass(frozen=True)
class ProgramLayout:
    """What the compiled program depends on: structures, and where in theta each experiment's unknowns stand."""

    structures: tuple[Structure, ...]  # where machine code evaluates J, what their sequences have in common alone
    places: tuple[tuple[int, ...], ...]  # of the N transition times and M parameters, -1 where fixed
    varying: tuple[int, ...]
    lockstep: bool
    natively: bool  # whether machine code evaluates J

    @property
    def size(self) -> int:
        """Fits in a call of the program."""
        return CHUNK_IN_LOCKSTEP if self.lockstep else CHUNK


def has_gpu() -> bool:
    """Return whether JAX's default device is not a CPU."""
    return str(jax.default_backend()) != "cpu"


def choose_chunk_size(problem: Problem) -> int:
    """Return how many fits of a problem are a chunk."""
    # Without a GPU nothing runs in lockstep, and the layout need not be known.
    return choose_layout(evaluator_of(problem)).size if has_gpu() else CHUNK


def choose_layout(evaluator: Evaluator, varying: tuple[int, ...] = ()) -> ProgramLayout:
    """Return the layout of a program that evaluates a problem on given meshes, with its own numbers.

    Parameters
    ----------
    evaluator : Evaluator
        With the problem and the meshes.
    varying : tuple of int
        Leaves of the arguments that differ from fit to fit.
    """
    problem, structures = evaluator.problem, evaluator.structures
    natively = problem.engine != "jax" and runs_natively(structures, evaluator.arguments)
    return ProgramLayout(
        tuple(structure.library for structure in structures) if natively else structures,
        tuple(tuple(int(k) for k in places) for places in problem.places),
        varying=varying,
        lockstep=not natively and has_gpu(),
        natively=natively,
    )
