"""The JAX engine: evaluates and simulates one experiment on one mesh by the programs that JAX compiles."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import cached_property
from typing import Any

import jax
import numpy as np

from switchfit.arrays import FloatArray, IntArray, Traced
from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import Mesh, MeshRows, build_rows
from switchfit.discretization.signals import Piece
from switchfit.engine.evaluation import DenseEvaluation, Engine, Evaluation, Matrix
from switchfit.engine.jax.programs import (
    Method,
    call_model,
    compute_fields,
    derivatives,
    differentiate_in_states,
    simulate_rows,
)
from switchfit.engine.simulation import Costates, Simulation, Tangents, finish_simulation
from switchfit.problem.functions import use_float64
from switchfit.problem.padding import pad_length
from switchfit.problem.structure import Structure
from switchfit.runtime.cache import use_compilation_cache
from switchfit.runtime.work import CALL, count_work

ROW_ADDITIONS = 2000.0
"""Additions in the time that a row takes in a program of JAX, for each unknown."""


class JaxEngine:
    """Evaluates one experiment on one mesh with JAX programs.

    Parameters
    ----------
    structure : Structure
    arguments : Arguments
    mesh : Mesh
    reason : str, optional
        Why the experiment is not evaluated in machine code.
    """

    def __init__(self, structure: Structure, arguments: Arguments, mesh: Mesh, reason: str = "") -> None:
        self._structure, self._arguments, self._mesh = structure, arguments, mesh
        self._reason = reason
        self._compiled: set[Any] = set()

    @cached_property
    def _any_sequence(self) -> Structure:
        # All sequences of as many modes share a program, unless reset maps, guards or costs at transitions differ: a
        # search for the sequence would compile each of them for seconds.
        return replace(self._structure, mode_of_segment=())

    @property
    def engine(self) -> Engine:
        """JAX, with the reason."""
        return Engine("jax", self._reason, self._structure.list_implicit_modes())

    def judge_rows(self) -> None:
        """Do nothing: programs of JAX estimate no errors."""

    def cost(self, tau: FloatArray, p: FloatArray) -> float:
        """Return J alone."""
        return self.simulate(tau, p, tangents=False).cost

    def derivatives(
        self, tau: FloatArray, p: FloatArray, side: float, matrix: Matrix, method: Method = "discrete-adjoint"
    ) -> DenseEvaluation:
        """Return J and its derivatives, by one of the methods of `derivatives`."""
        J, g, H = self._run(derivatives, tau, p, float(side), method=method, matrix=matrix)
        return Evaluation(float(J), np.array(g), np.array(H))  # copies: arrays of JAX are read-only

    def _run(self, program: Callable[..., Any], *given: Traced, **settings: object) -> Any:
        """Return what a program yields for the experiment; only once it looks for it among the compiled ones."""
        # The persistent cache is asked once a program: to enter and leave it changes JAX's configuration. Shapes are
        # those of this experiment and mesh in all calls.
        key = program, *settings.values()
        with use_float64(), nullcontext() if key in self._compiled else use_compilation_cache():
            found = program(self._on_device, *given, structure=self._any_sequence, **settings)
        self._compiled.add(key)
        tau, p = given[:2]
        count_work(CALL + ROW_ADDITIONS * (1 + len(tau) + len(p)) * (self._mesh.cells + len(tau)))
        return found

    def constrained(self, tau: FloatArray, p: FloatArray, side: float, multipliers: FloatArray) -> DenseEvaluation:
        """Return J and the constraints, with the Hessian of ``J + multipliers . c``."""
        found = self._run(derivatives, tau, p, float(side), multipliers, method="discrete-adjoint")
        J, slope, H, c, A = map(np.array, found)
        return Evaluation(float(J), slope - multipliers @ A, H, c, A)

    def find_constraints(self, tau: FloatArray, p: FloatArray, side: float) -> DenseEvaluation:
        """Return J and the constraints with their derivatives, and those of J."""
        count = len(self._structure.guarded) + self._structure.terminal_constraint_count
        return self.constrained(tau, p, side, np.zeros(count))

    def costates(self, tau: FloatArray, p: FloatArray, multipliers: FloatArray) -> Costates:
        """Return the costates of ``J + multipliers . c`` at the starts of all rows."""
        found = self._run(differentiate_in_states, tau, p, multipliers)
        layout, rows = self._cut_rows(tau)
        states, costates = (np.asarray(values)[rows] for values in found)
        return Costates.of_rows(self._structure, layout.first_row, layout.start[rows], states, costates)

    def slopes(self, times: FloatArray, cells: IntArray, states: FloatArray, p: FloatArray) -> FloatArray:
        """Return the vector fields of all modes at given points."""
        # Padded by repeating points, which are inside the domain of the model.
        count, padded = len(times), pad_length(len(times))  # for few different programs
        pieces = Piece(self._arguments.nodes[cells], self._arguments.signals[cells])
        points = jax.tree.map(lambda a: np.resize(a, (padded, *a.shape[1:])), (times, states, pieces))
        with use_float64(), use_compilation_cache():
            given = self._arguments.without_mesh(), *points, p
            found = call_model(*given, structure=self._structure.functions, function=compute_fields)
        return np.asarray(found)[:count]

    def simulate(self, tau: FloatArray, p: FloatArray, *, tangents: bool) -> Simulation:
        """Return all rows, with their derivatives if `tangents`."""
        found = self._run(simulate_rows, tau, p, tangents=tangents)
        layout, rows = self._cut_rows(tau)
        J, late, values, derivatives = jax.tree.map(np.asarray, found)
        which = [k for k, sensor in enumerate(self._structure.measurements) if sensor.delay is not None]
        of_rows = (each[rows] for each in (layout.start, layout.end, *values))
        simulation = Simulation(float(J), self._mesh.times, layout.first_cell, *of_rows)
        if tangents:
            simulation = replace(simulation, tangents=Tangents(*(each[rows] for each in derivatives)))
        seen = dict(zip(which, late, strict=True))
        return finish_simulation(simulation, self._structure, self._arguments, seen)

    def _cut_rows(self, tau: FloatArray) -> tuple[MeshRows, slice]:
        """Return the rows at given transition times, and which of them are no padding of the mesh."""
        layout = build_rows(self._mesh.nodes, tau, self._structure.fix_sides(1.0, np), np)
        return layout, slice(self._mesh.cells + len(tau))

    @cached_property
    def _on_device(self) -> Arguments:
        with use_float64():
            sequence = np.array(self._structure.mode_of_segment)
            return jax.device_put(self._arguments._replace(sequence=sequence))  # type: ignore[arg-type]
