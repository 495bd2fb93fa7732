"""Sensitivities of states and outputs along a trajectory: exact derivatives of the discretized system.

The derivative of x at a *fixed* time t jumps where a transition time passes t. With X^i the jump of the vector field,
equation (8), it is 0 in tau_i just before the transition and -X^i just after. At a transition both are given, one with
the state before it and one with the state after it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.discretization.mesh import Mesh
from switchfit.engine.choice import engine_of
from switchfit.engine.run import runs_of
from switchfit.engine.simulation import Simulation, Tangents
from switchfit.fit.trajectory import select_visible
from switchfit.meshes.evaluator import Evaluator
from switchfit.problem.problem import Problem


class Points(NamedTuple):
    """Values and their derivatives at L times.

    Attributes
    ----------
    times : (L,)
    states, states_d : (L, n), (L, n, d)
    outputs, outputs_d : (L, Q), (L, Q, d)
        Outputs of the reference signals, then of the Measurements, in order.
    """

    times: FloatArray
    states: FloatArray
    states_d: FloatArray
    outputs: FloatArray
    outputs_d: FloatArray


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """States and outputs of one experiment and their derivatives in theta.

    Attributes
    ----------
    simulation : Simulation
        With derivatives in the experiment's own unknowns.
    places : (D,) int
        Indices of these unknowns in theta, -1 for fixed ones.
    theta : (d,)
        Where they are.
    """

    simulation: Simulation
    places: NDArray[np.intp]
    theta: FloatArray

    @property
    def nodes(self) -> Points:
        """Points at all nodes in order, as in `Trajectory`: each transition occurs twice, before and after it."""
        select = partial(select_visible, self.simulation)
        return self._collect(select(self.simulation.start, self.simulation.end), select)

    def at(self, times: FloatArray) -> Points:
        """Return the sensitivity at nodes (K,) of the mesh; at a transition, that just before it, as for a sample."""
        # Two rows meet at a node; that which ends there has the state before a transition, as a sample sees it.
        row = self.simulation.row_ending(np.searchsorted(self.simulation.nodes, times) - 1)

        def pick(before: FloatArray, after: FloatArray) -> FloatArray:
            # No row ends at t0: its state is that before the first row.
            first = (row < 0).reshape(-1, *[1] * (after.ndim - 1))
            return np.where(first, before[:1], after[row])

        return self._collect(np.asarray(times, dtype=np.float64), pick)

    def _collect(self, times: FloatArray, choose: Callable[[FloatArray, FloatArray], FloatArray]) -> Points:
        """Return the points at times (L,), which are chosen from what is known before and after all rows."""
        s, along = self.simulation, cast(Tangents, self.simulation.tangents)
        states, outputs = choose(s.before, s.after), choose(s.y_before, s.y_after)
        slopes = choose(along.before, along.after), choose(along.y_before, along.y_after)
        states_d, outputs_d = map(self._spread_over_theta, slopes)
        return Points(times, states, states_d, outputs, outputs_d)

    def _spread_over_theta(self, derivative: FloatArray) -> FloatArray:
        """Return derivatives in theta (..., d) from those in the experiment's own unknowns (..., D)."""
        own = self.places >= 0
        full = np.zeros((*derivative.shape[:-1], len(self.theta)))
        # Two names of the model may refer to one parameter: both count.
        np.add.at(np.moveaxis(full, -1, 0), self.places[own], np.moveaxis(derivative, -1, 0)[own])
        return full


def compute_sensitivity(problem: Problem, e: int, theta: FloatArray, mesh: Mesh) -> Sensitivity:
    """Return states and outputs of experiment e at theta, and their derivatives in theta, on the nodes of a mesh.

    Parameters
    ----------
    problem : Problem
    e : int
        Index of the experiment, from 0.
    theta : (d,)
    mesh : Mesh
        It must have all sample times and knots as nodes.
    """
    run = runs_of(problem)[e]
    # On a mesh of its own, which has the times that are asked for as nodes: an evaluator's mesh is not touched.
    engine = engine_of(run, run.build_arguments(mesh), mesh)
    simulation = engine.simulate(*run.vectors(theta), tangents=True)
    return Sensitivity(simulation, problem.places[e], theta)


def compute_sensitivities(evaluator: Evaluator, theta: FloatArray) -> tuple[Sensitivity, ...]:
    """Return the same of each experiment on the meshes of an evaluator.

    Parameters
    ----------
    evaluator : Evaluator
    theta : (d,)
    """
    each = zip(evaluator.simulate(theta, tangents=True), evaluator.problem.places, strict=True)
    return tuple(Sensitivity(simulation, places, theta) for simulation, places in each)
