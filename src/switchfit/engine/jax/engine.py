"""JAX as an engine: for any model, on any device."""

from __future__ import annotations

from contextlib import nullcontext

import jax
import numpy as np

from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import Mesh
from switchfit.engine.jax.programs import Method, derivatives, differentiate_constrained
from switchfit.engine.jax.simulation import simulate_by_jax
from switchfit.engine.protocol import Constrained, Derivatives, Engine, Matrix, Simulation
from switchfit.problem.data import FloatArray
from switchfit.problem.functions import use_float64
from switchfit.problem.structure import Structure
from switchfit.runtime.cache import use_compilation_cache


class JaxEngine:
    """Evaluates one experiment on one mesh with JAX programs.

    Attributes
    ----------
    reason : str
        Why the experiment is not evaluated in machine code.
    """

    def __init__(self, structure: Structure, arguments: Arguments, mesh: Mesh) -> None:
        self._structure, self._arguments, self._mesh = structure, arguments, mesh
        self._on_device: Arguments | None = None
        self._compiled: set[tuple[Method, Matrix]] = set()
        # The last simulation without tangents, since J and the trajectory are often requested at the same point.
        self._last: tuple[bytes, Simulation] | None = None
        self.reason = "engine='jax' is set"

    @property
    def engine(self) -> Engine:
        """JAX, with the reason."""
        return Engine("jax", self.reason)

    def cost(self, tau: FloatArray, p: FloatArray) -> float:
        """Return J alone."""
        return self.simulate(tau, p, tangents=False).cost

    def derivatives(
        self, tau: FloatArray, p: FloatArray, side: float, matrix: Matrix, method: Method = "discrete-adjoint"
    ) -> Derivatives:
        """Return J and its derivatives, by one of the methods."""
        compiled = (method, matrix) in self._compiled
        with use_float64(), nullcontext() if compiled else use_compilation_cache():
            given = self._given(), tau, p, float(side)
            found = derivatives(*given, structure=self._structure, method=method, matrix=matrix)
        self._compiled.add((method, matrix))
        J, g, H = found
        return Derivatives(float(J), np.array(g), np.array(H))  # copies: arrays of JAX are read-only

    def constrained(self, tau: FloatArray, p: FloatArray, side: float, multipliers: FloatArray) -> Constrained:
        """Return J and its constraints."""
        with use_float64(), use_compilation_cache():
            given = self._given(), tau, p, float(side), multipliers
            J, slope, H, c, A = differentiate_constrained(*given, structure=self._structure)
        return Constrained(float(J), np.array(slope), np.array(H), np.array(c), np.array(A))

    def simulate(self, tau: FloatArray, p: FloatArray, *, tangents: bool) -> Simulation:
        """Return all rows, with their derivatives if `tangents`."""
        key = np.concatenate([tau, p]).tobytes()
        if not tangents and self._last is not None and self._last[0] == key:
            return self._last[1]
        found = simulate_by_jax(self._structure, self._arguments, self._mesh, tau, p, tangents)
        if not tangents:
            self._last = key, found
        return found

    def _given(self) -> Arguments:
        if self._on_device is None:
            with use_float64():
                self._on_device = jax.device_put(self._arguments)
        return self._on_device
