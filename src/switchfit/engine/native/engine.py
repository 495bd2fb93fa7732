"""Machine code as an engine: a program for each requested order of derivatives; JAX where a finiteness check fails.

Machine code of an experiment as a foreign function in a JAX program, for fits that run in one program on a CPU.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import sequential_vmap
from numpy.typing import NDArray

from switchfit.discretization.mesh import Arguments, Mesh, count_passed
from switchfit.engine.jax import JaxEngine
from switchfit.engine.native.experiment import FailedCheckError, NativeExperiment, find_directions, native_experiment
from switchfit.engine.native.llvm import Program
from switchfit.engine.native.program import program_of, second_order
from switchfit.engine.native.templates import Order, Sizes, constants_of
from switchfit.engine.native.writer import GIVEN, layout_of
from switchfit.engine.protocol import Costates, Engine, Evaluation, Matrix, Simulation, Tangents, add_samples, cut_at_tf
from switchfit.problem.data import FloatArray
from switchfit.problem.structure import Structure

Found = TypeVar("Found")

_registered: dict[str, Program] = {}
"""Programs whose addresses XLA keeps, by the names of their operations: they must stay alive."""
_one_at_a_time = threading.Lock()


def _register(library: Structure, sizes: Sizes) -> str:
    """Register the operation of a library with XLA; return its name.

    XLA takes a name once. Models with the same machine code, which may differ in the names of their parameters, share
    the operation of the first.
    """
    program = program_of(library, sizes, Order.HESSIAN)
    if isinstance(program, str):
        raise ValueError(f"the experiment has no machine code: {program}")
    name = f"switchfit_{program.key[:32]}"
    with _one_at_a_time:
        if name not in _registered:
            jax.ffi.register_ffi_target(
                name, jax.ffi.pycapsule(program.function("xla_handler", ctypes.c_void_p)), platform="cpu"
            )
            _registered[name] = program
    return name


def foreign_derivatives(
    structure: Structure, arguments: Arguments, tau: Any, p: Any, side: Any, places: Mapping[str, Any]
) -> Any:
    """Return cost, gradient (D,) and Hessian (D, D) of one experiment inside a JAX program that runs on a CPU.

    The experiment must have machine code, and no late samples. `side` is +1 or -1: the right or left derivative in a
    transition time that lies on a node.

    `places` are the result of `places_in_library`: only the library of the structure is used. A JAX program that takes
    the places as arguments serves all sequences of a library with the same number of transitions, and
    ``structure.library`` may be passed in place of the structure, as the key of that program.
    """
    sizes, library = Sizes.of(structure, arguments), structure.library
    name = _register(library, sizes)
    N, D, width = sizes.N, sizes.D, sizes.width
    idle = N - tau.shape[0]  # number of segments that the sequence does not need: they begin and end at tf
    nodes = arguments.nodes
    cells = nodes.shape[0] - 1
    real_cells = jnp.sum(nodes[1:] > nodes[:-1])
    count_own = tau.shape[0]
    jumps = places.get("jumps", np.zeros(count_own, dtype=np.int64))[:count_own]
    side = jnp.where(jumps > 0, 1.0, side)  # as in `Structure.fix_sides`
    passed = count_passed(nodes, tau, side)
    begins = jnp.clip(passed - 1, 0, real_cells - 1)
    units, own, there = find_directions(sizes, jumps, jnp)
    layout = layout_of(library, sizes, Order.HESSIAN)
    given: dict[str, Any] = {
        "nodes": nodes,
        "signals": arguments.signals,
        "c": jnp.concatenate([*(jnp.ravel(a) for a in constants_of(arguments)), jnp.zeros(1)]),
        "p": jnp.append(p, 0.0),
        "bounds": jnp.concatenate([nodes[:1], tau, jnp.repeat(nodes[-1:], idle + 1)]),
        "first_cell": jnp.concatenate([jnp.zeros(1, int), begins, jnp.full(idle + 1, cells - 1)]),
        "multipliers": np.zeros(max(layout.constraint_rows["count"], 1)),
        "units": units,
    }
    given |= places
    buffers = [given[key] for key in GIVEN]
    for samples in arguments.samples:
        buffers += [*samples, np.zeros(1, dtype=np.int64), np.zeros(1)]  # none is late
    lengths = layout.sums
    of_memory = sum(length.at(cells + N) for length in layout.memory.values())
    results = [jax.ShapeDtypeStruct((length,), np.float64) for length in (sum(lengths.values()), of_memory)]
    # A batch is a loop: all of its entries use one scratch space, which stays in the CPU caches.
    totals = sequential_vmap(lambda *given: jax.ffi.ffi_call(name, results)(*given)[0])(*buffers)
    parts = dict(zip(lengths, jnp.split(totals, np.cumsum([*lengths.values()])[:-1].tolist()), strict=True))
    J, g, H = parts["J"], parts["g"], parts["H"]
    cost = J[0] + totals[-1]  # NaN if a finiteness check failed: the finisher of a batch then falls back to JAX
    gradient, hessian = g[own], H.reshape(D, width)[own[:, None], own]
    return cost, jnp.where(there, gradient, 0.0), jnp.where(there[:, None] & there[None], hessian, 0.0)


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
        self._structure, self._arguments, self._mesh, self._fallback = structure, arguments, mesh, fallback
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
            made = native_experiment(self._structure, self._arguments, self._mesh.times, order)
            if made is not None and self._judges_rows:
                made.judge_rows(jumps=self._mesh.is_sharp)
            self._experiments[order] = made
        return self._experiments[order]

    def judge_rows(self) -> None:
        """Estimate the errors of rows in all evaluations from now on."""
        if not self._judges_rows:
            self._judges_rows = True
            for each in filter(None, self._experiments.values()):
                each.judge_rows(jumps=self._mesh.is_sharp)

    def _try(self, order: Order, use: Callable[[NativeExperiment], Found], fall_back: Callable[[], Found]) -> Found:
        """Return what one function finds in machine code of an order, or what another finds by JAX."""
        native = self.at(order)
        try:
            return fall_back() if native is None else use(native)
        except FailedCheckError:
            return fall_back()

    def cost(self, tau: FloatArray, p: FloatArray) -> float:
        """Return J alone."""
        return self._try(Order.COST, lambda native: native.cost(tau, p), lambda: self._fallback.cost(tau, p))

    def derivatives(self, tau: FloatArray, p: FloatArray, side: float, matrix: Matrix) -> Evaluation[FloatArray]:
        """Return J and its derivatives."""
        return self._try(
            ORDERS[matrix],
            lambda native: native(tau, p, side),
            lambda: self._fallback.derivatives(tau, p, side, matrix),
        )

    def constrained(
        self, tau: FloatArray, p: FloatArray, side: float, multipliers: FloatArray
    ) -> Evaluation[FloatArray]:
        """Return J and the constraints, with the Hessian of ``J + multipliers . c``."""
        given = tau, p, side, multipliers
        return self._try(self._second, lambda native: native(*given), lambda: self._fallback.constrained(*given))

    def costates(self, tau: FloatArray, p: FloatArray, multipliers: FloatArray) -> Costates:
        """Return the costates of ``J + multipliers . c`` at the starts of all rows."""

        def simulate(native: NativeExperiment) -> Costates:
            found, costates, _ = native.simulate(tau, p, multipliers)
            return Costates.of_rows(self._structure, found.first_row, found.start, found.before, costates)

        return self._try(self._second, simulate, lambda: self._fallback.costates(tau, p, multipliers))

    def slopes(self, times: FloatArray, cells: NDArray[np.intp], states: FloatArray, p: FloatArray) -> FloatArray:
        """Return the vector fields of all modes at given points."""
        given = times, cells, states, p
        return self._try(Order.COST, lambda native: native.slopes(*given), lambda: self._fallback.slopes(*given))

    def trace(self, tau: FloatArray, p: FloatArray) -> Simulation:
        """Return all rows, without outputs."""
        return self._try(
            Order.COST,
            lambda native: cut_at_tf(native.simulate(tau, p)[0], self._structure),
            lambda: self._fallback.trace(tau, p),
        )

    def simulate(self, tau: FloatArray, p: FloatArray, *, tangents: bool) -> Simulation:
        """Return all rows, with their derivatives if `tangents`."""
        return self._try(
            self._second if tangents else Order.COST,
            lambda native: self._simulate(native, tau, p),
            lambda: self._fallback.simulate(tau, p, tangents=tangents),
        )

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
            for derivative, states, rows, own in beside:
                slopes = self.slopes(tau, found.first_cell[1:], states[rows], p)
                derivative[rows[moving], :, moving] -= slopes[moving, own[moving]]
        y_before, y_before_d = native.outputs(found.start, found.before, p, before_d)
        y_after, y_after_d = native.outputs(found.end, found.after, p, after_d)
        tangents = None if found.tangents is None else Tangents(before_d, after_d, y_before_d, y_after_d)
        simulation = replace(found, y_before=y_before, y_after=y_after, tangents=tangents)
        seen = {k: native.outputs(each[:, 0], each[:, 1:], p, np.zeros(0))[0] for k, each in late.items()}
        return cut_at_tf(add_samples(simulation, structure, self._arguments, seen), structure)
