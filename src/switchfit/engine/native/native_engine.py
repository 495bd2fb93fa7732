"""Machine code as an engine: a program for each requested order of derivatives, and JAX where a check fails."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import Mesh
from switchfit.engine.evaluation import DenseEvaluation, Engine, Matrix
from switchfit.engine.jax.jax_engine import JaxEngine
from switchfit.engine.native.native_experiment import FailedCheckError, NativeExperiment, native_experiment
from switchfit.engine.native.program import second_order
from switchfit.engine.native.sizes import Order
from switchfit.engine.simulation import Costates, Simulation, Tangents, finish_simulation
from switchfit.problem.structure import Structure

Found = TypeVar("Found")
ORDERS: dict[Matrix, Order] = {"exact": Order.HESSIAN, "gauss-newton": Order.GAUSS_NEWTON, "none": Order.GRADIENT}


class NativeEngine:
    """Evaluates one experiment on one mesh in machine code.

    Parameters
    ----------
    structure : Structure
    arguments : Arguments
    mesh : Mesh
    fallback : JaxEngine
        Evaluates where machine code cannot: a product with zero was left out whose other factor is not finite.
    """

    def __init__(self, structure: Structure, arguments: Arguments, mesh: Mesh, fallback: JaxEngine) -> None:
        self._structure, self._arguments, self._mesh, self.fallback = structure, arguments, mesh, fallback
        self._second = second_order(structure)
        self._experiments: dict[Order, NativeExperiment | None] = {}
        self._judges_rows = False

    @property
    def engine(self) -> Engine:
        """Machine code."""
        return Engine("native", implicit_modes=self._structure.list_implicit_modes())

    def at(self, order: Order) -> NativeExperiment | None:
        """Return the experiment with derivatives of an order; None if that order alone has no machine code."""
        if order not in self._experiments:
            # Made on demand: a fit that never asks for J alone does not lay out the memory for it.
            made = native_experiment(self._structure, self._arguments, self._mesh.times, order)
            if made is not None and self._judges_rows:
                made.judge_rows(jumps=self._mesh.is_sharp)
            self._experiments[order] = made
        return self._experiments[order]

    def judge_rows(self) -> None:
        """Estimate the errors of rows in all evaluations from now on."""
        self._judges_rows = True
        for each in filter(None, self._experiments.values()):
            each.judge_rows(jumps=self._mesh.is_sharp)

    def _try(self, order: Order, use: Callable[..., Found], fall_back: Callable[..., Found], *given: Any) -> Found:
        """Return what one function finds in machine code of an order, or what another finds by JAX."""
        # JAX computes 0 * inf as NaN, where machine code has left the product out: its result is the right one.
        native = self.at(order)
        try:
            return fall_back(*given) if native is None else use(native, *given)
        except FailedCheckError:
            return fall_back(*given)

    def cost(self, tau: FloatArray, p: FloatArray) -> float:
        """Return J alone."""
        return self._try(Order.COST, NativeExperiment.cost, self.fallback.cost, tau, p)

    def derivatives(self, tau: FloatArray, p: FloatArray, side: float, matrix: Matrix) -> DenseEvaluation:
        """Return J and its derivatives."""
        by_jax = partial(self.fallback.derivatives, matrix=matrix)
        return self._try(ORDERS[matrix], NativeExperiment.__call__, by_jax, tau, p, side)

    def constrained(self, tau: FloatArray, p: FloatArray, side: float, multipliers: FloatArray) -> DenseEvaluation:
        """Return J and the constraints, with the Hessian of ``J + multipliers . c``."""
        given = tau, p, side, multipliers
        return self._try(self._second, NativeExperiment.__call__, self.fallback.constrained, *given)

    def find_constraints(self, tau: FloatArray, p: FloatArray, side: float) -> DenseEvaluation:
        """Return J and the constraints with their derivatives; those of J are of no meaning."""
        given = tau, p, side
        return self._try(self._second, NativeExperiment.find_constraints, self.fallback.find_constraints, *given)

    def costates(self, tau: FloatArray, p: FloatArray, multipliers: FloatArray) -> Costates:
        """Return the costates of ``J + multipliers . c`` at the starts of all rows."""

        def find(native: NativeExperiment, *given: FloatArray) -> Costates:
            found, costates, _ = native.simulate(*given)
            return Costates.of_rows(self._structure, found.first_row, found.start, found.before, costates)

        return self._try(self._second, find, self.fallback.costates, tau, p, multipliers)

    def slopes(self, times: FloatArray, cells: NDArray[np.intp], states: FloatArray, p: FloatArray) -> FloatArray:
        """Return the vector fields of all modes at given points."""
        return self._try(Order.COST, NativeExperiment.slopes, self.fallback.slopes, times, cells, states, p)

    def simulate(self, tau: FloatArray, p: FloatArray, *, tangents: bool) -> Simulation:
        """Return all rows, with their derivatives if `tangents`."""
        by_jax = partial(self.fallback.simulate, tangents=tangents)
        return self._try(self._second if tangents else Order.COST, self._simulate, by_jax, tau, p)

    def _simulate(self, native: NativeExperiment, tau: FloatArray, p: FloatArray) -> Simulation:
        """Return all rows by machine code.

        It has the derivatives at the ends of rows, which move with theta where they are transitions. The derivative at
        fixed time is this one minus dx/dt, in the column of the transition time. Those in the times of jumps, which
        are known, are 0.
        """
        structure, (found, _, late) = self._structure, native.simulate(tau, p)
        before_d = after_d = np.zeros(0)
        if found.tangents is not None:
            before_d, after_d, opening = found.tangents.before, found.tangents.after, found.first_row[1:]
            moving, modes = np.setdiff1d(np.arange(structure.N), structure.jumps), np.array(structure.mode_of_segment)
            beside = (after_d, found.after, opening - 1, modes[:-1]), (before_d, found.before, opening, modes[1:])
            # x(tau-) ends the row before a transition, in the mode before it; x(tau+) begins the row behind it, in the
            # next mode.
            for derivative, states, rows, own in beside:
                slopes = self.slopes(tau, found.first_cell[1:], states[rows], p)
                derivative[rows[moving], :, moving] -= slopes[moving, own[moving]]
        y_before, y_before_d = native.outputs(found.start, found.before, p, before_d)
        y_after, y_after_d = native.outputs(found.end, found.after, p, after_d)
        tangents = None if found.tangents is None else Tangents(before_d, after_d, y_before_d, y_after_d)
        simulation = replace(found, y_before=y_before, y_after=y_after, tangents=tangents)
        seen = {k: native.outputs(each[:, 0], each[:, 1:], p, np.zeros(0))[0] for k, each in late.items()}
        return finish_simulation(simulation, structure, self._arguments, seen)
