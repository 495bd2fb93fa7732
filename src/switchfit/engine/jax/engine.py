"""JAX as an engine: for any model, on any device."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from functools import cached_property

import jax
import numpy as np
from numpy.typing import NDArray

from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import Mesh, Rows, build_rows
from switchfit.discretization.model import Piece
from switchfit.engine.jax.programs import Method, derivatives, differentiate_constrained, differentiate_in_states
from switchfit.engine.jax.simulation import compute_slopes, simulate_rows
from switchfit.engine.protocol import Costates, Engine, Evaluation, Matrix, Simulation, Tangents, add_samples, cut_at_tf
from switchfit.problem.data import FloatArray
from switchfit.problem.functions import use_float64
from switchfit.problem.lengths import pad_length
from switchfit.problem.structure import Structure
from switchfit.runtime.cache import use_compilation_cache


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
        self._on_device: Arguments | None = None
        self._compiled: set[tuple[Method, Matrix]] = set()
        # The last simulation without tangents, since J and the trajectory are often requested at the same point.
        self._last: tuple[bytes, Simulation] | None = None

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
    ) -> Evaluation[FloatArray]:
        """Return J and its derivatives, by one of the methods of `derivatives`."""
        compiled = (method, matrix) in self._compiled
        with use_float64(), nullcontext() if compiled else use_compilation_cache():
            given = self._given(), tau, p, float(side)
            found = derivatives(*given, structure=self._any_sequence, method=method, matrix=matrix)
        self._compiled.add((method, matrix))
        J, g, H = found
        return Evaluation(float(J), np.array(g), np.array(H))  # copies: arrays of JAX are read-only

    def constrained(
        self, tau: FloatArray, p: FloatArray, side: float, multipliers: FloatArray
    ) -> Evaluation[FloatArray]:
        """Return J and the constraints, with the Hessian of ``J + multipliers . c``."""
        with use_float64(), use_compilation_cache():
            given = self._given(), tau, p, float(side), multipliers
            found = differentiate_constrained(*given, structure=self._any_sequence)
        J, slope, H, c, A = map(np.array, found)
        return Evaluation(float(J), slope - multipliers @ A, H, c, A)

    def costates(self, tau: FloatArray, p: FloatArray, multipliers: FloatArray) -> Costates:
        """Return the costates of ``J + multipliers . c`` at the starts of all rows."""
        with use_float64(), use_compilation_cache():
            found = differentiate_in_states(self._given(), tau, p, multipliers, structure=self._any_sequence)
        layout, rows = self._cut_rows(tau)
        states, costates = (np.asarray(values)[rows] for values in found)
        return Costates.of_rows(self._structure, layout.first_row, layout.start[rows], states, costates)

    def slopes(self, times: FloatArray, cells: NDArray[np.intp], states: FloatArray, p: FloatArray) -> FloatArray:
        """Return the vector fields of all modes at given points."""
        count, padded = len(times), pad_length(len(times))  # for few different programs
        pieces = Piece(self._arguments.nodes[cells], self._arguments.signals[cells])
        points = jax.tree.map(lambda a: np.resize(a, (padded, *a.shape[1:])), (times, states, pieces))
        with use_float64(), use_compilation_cache():
            given = self._arguments.without_mesh(), *points, p
            return np.asarray(compute_slopes(*given, structure=self._structure.functions))[:count]

    def trace(self, tau: FloatArray, p: FloatArray) -> tuple[FloatArray, FloatArray, list[int]]:
        """Return the ends of all rows."""
        found = self.simulate(tau, p, tangents=False)
        return found.end, found.after, [segment.start for segment in found.segments]

    def simulate(self, tau: FloatArray, p: FloatArray, *, tangents: bool) -> Simulation:
        """Return all rows, with their derivatives if `tangents`."""
        key = np.concatenate([tau, p]).tobytes()
        if not tangents and self._last is not None and self._last[0] == key:
            return self._last[1]
        with use_float64(), use_compilation_cache():
            found = simulate_rows(self._given(), tau, p, structure=self._any_sequence, tangents=tangents)
        layout, rows = self._cut_rows(tau)
        J, late, values, derivatives = jax.tree.map(np.asarray, found)
        before, after, y_before, y_after = (each[rows] for each in values)
        which = [k for k, sensor in enumerate(self._structure.measurements) if sensor.delay is not None]
        simulation = Simulation(
            float(J),
            self._mesh.times,
            layout.first_cell,
            layout.start[rows],
            layout.end[rows],
            before,
            after,
            y_before,
            y_after,
            tangents=Tangents(*(each[rows] for each in derivatives)) if tangents else None,
        )
        all_seen = add_samples(simulation, self._structure, self._arguments, dict(zip(which, late, strict=True)))
        simulation = cut_at_tf(all_seen, self._structure)
        if not tangents:
            self._last = key, simulation
        return simulation

    def _cut_rows(self, tau: FloatArray) -> tuple[Rows, slice]:
        """Return the rows at given transition times, and which of them are no padding of the mesh."""
        layout = build_rows(self._mesh.nodes, tau, self._structure.fix_sides(1.0, np), np)
        return layout, slice(self._mesh.cells + len(tau))

    def _given(self) -> Arguments:
        if self._on_device is None:
            with use_float64():
                sequence = np.array(self._structure.mode_of_segment)
                self._on_device = jax.device_put(self._arguments._replace(sequence=sequence))  # type: ignore[arg-type]
        return self._on_device
