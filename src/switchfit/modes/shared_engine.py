"""Engine of a mode sequence that uses meshes, data and machine code of all sequences of a library.

Arguments and experiments of machine code take longer to build than the problem of a sequence, and do not depend on it.
"""

from __future__ import annotations

from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import Mesh
from switchfit.engine.jax.jax_engine import JaxEngine
from switchfit.engine.native.library_places import places_in_library
from switchfit.engine.native.native_engine import NativeEngine
from switchfit.engine.native.native_experiment import NativeExperiment
from switchfit.engine.native.sizes import Order
from switchfit.problem.structure import Structure

ExperimentsByOrder = dict[Order, NativeExperiment | None]


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

    def __init__(self, structure: Structure, arguments: Arguments, mesh: Mesh, experiments: ExperimentsByOrder) -> None:
        super().__init__(structure, arguments, mesh, JaxEngine(structure, arguments, mesh))
        self._experiments = experiments

    def at(self, order: Order) -> NativeExperiment | None:
        """Return the experiment with derivatives of an order, set to this sequence."""
        found = super().at(order)
        # Sequences take turns in one experiment, whose arrays say which modes are active: they are set only where
        # another one was there before.
        if found is not None and found.structure is not self._structure:
            found.assign_sequence(self._structure, places_in_library(self._structure))
        return found
