"""Evaluators of mode sequences: on meshes, data and machine code that all sequences share.

Arguments and experiments of machine code take longer to build than the problem of a sequence, and do not depend on it.
"""

from __future__ import annotations

from collections.abc import Sequence

from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import Mesh
from switchfit.engine.jax.engine import JaxEngine
from switchfit.engine.native.engine import NativeEngine
from switchfit.engine.native.experiment import NativeExperiment
from switchfit.engine.native.templates import Order
from switchfit.fit.evaluator import Evaluator
from switchfit.problem.problem import Problem
from switchfit.problem.structure import Structure

Experiments = dict[Order, NativeExperiment | None]


class SharedEngine(NativeEngine):
    """Evaluates one sequence of a library in an experiment that other sequences use too.

    Parameters
    ----------
    structure : Structure
        Of the sequence, without jumps.
    arguments : Arguments
    mesh : Mesh
    experiments : dict of Order to NativeExperiment
        That all of them share; filled as needed.
    """

    def __init__(self, structure: Structure, arguments: Arguments, mesh: Mesh, experiments: Experiments) -> None:
        super().__init__(structure, arguments, mesh, JaxEngine(structure, arguments, mesh))
        self._experiments = experiments

    def at(self, order: Order) -> NativeExperiment | None:
        """Return the experiment with derivatives of an order, set to this sequence."""
        found = super().at(order)
        if found is not None and found.structure is not self._structure:
            found.assign_sequence(self._structure)
        return found


def share_evaluator(evaluator: Evaluator, problem: Problem, experiments: Sequence[Experiments]) -> Evaluator:
    """Return the evaluator of a problem with other sequences, without guards, terminal constraints and jumps.

    Parameters
    ----------
    evaluator : Evaluator
        Whose data and meshes it has.
    problem : Problem
        By `Problem.with_sequences`.
    experiments : sequence of dict
        Of `SharedEngine`, one for each experiment.
    """
    found = object.__new__(Evaluator)
    found.problem, found.meshes, found.arguments = problem, evaluator.meshes, evaluator.arguments
    given = zip(problem.structures, found.arguments, found.meshes, experiments, strict=True)
    found.engines = [SharedEngine(*each) for each in given]
    return found
