"""Machine code as an engine: a program for each requested order of derivatives; JAX where a finiteness check fails.

Machine code of an experiment as a foreign function in a JAX program, for fits that run in one program on a CPU.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Mapping
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from switchfit.discretization.mesh import Arguments, Mesh, count_passed
from switchfit.engine.native.experiment import NativeExperiment, find_directions, native_experiment, places_in_library
from switchfit.engine.native.llvm import Program
from switchfit.engine.native.program import program_of
from switchfit.engine.native.templates import Order, Sizes, constants_of
from switchfit.engine.native.writer import GIVEN, constraint_rows, memory, sums
from switchfit.engine.protocol import (
    Costates,
    Engine,
    Evaluation,
    ExperimentEngine,
    Matrix,
    Simulation,
    Tangents,
    add_samples,
    cut_at_tf,
)
from switchfit.problem.data import FloatArray
from switchfit.problem.structure import Structure

_registered: dict[str, Program] = {}
"""Programs whose addresses XLA keeps, by the names of their operations: they must stay alive."""
_one_at_a_time = threading.Lock()


@cache
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


def can_be_foreign(structure: Structure) -> bool:
    """Return whether a JAX program can call the machine code of an experiment: it must have no late samples."""
    return all(sensor.delay is None for sensor in structure.measurements)


def foreign_derivatives(
    structure: Structure, arguments: Arguments, tau: Any, p: Any, side: Any, places: Mapping[str, Any] | None = None
) -> Any:
    """Return cost, gradient (D,) and Hessian (D, D) of one experiment inside a JAX program that runs on a CPU.

    The experiment must satisfy `can_be_foreign` and have machine code. `side` is +1 or -1: the right or left
    derivative in a transition time that lies on a node.

    With `places`, the result of `places_in_library`, only the library of the structure is used. A JAX program that
    takes the places as arguments then serves all sequences of a library with the same number of transitions, and
    ``structure.library`` may be passed in place of the structure, as the key of that program.
    """
    sizes, library = Sizes.of(structure, arguments), structure.library
    name = _register(library, sizes)
    N, D, width = sizes.N, sizes.D, sizes.width
    idle = N - tau.shape[0]  # number of segments that the sequence does not need: they begin and end at tf
    places = places_in_library(structure) if places is None else places
    nodes = arguments.nodes
    cells = nodes.shape[0] - 1
    real_cells = jnp.sum(nodes[1:] > nodes[:-1])
    count_own = tau.shape[0]
    jumps = places.get("jumps", np.zeros(count_own, dtype=np.int64))[:count_own]
    side = jnp.where(jumps > 0, 1.0, side)  # as in `Structure.fix_sides`
    passed = count_passed(nodes, tau, side)
    begins = jnp.clip(passed - 1, 0, real_cells - 1)
    units, own, there = find_directions(sizes, jumps, jnp)
    count = max(constraint_rows(library, sizes)["count"], 1)
    given: dict[str, Any] = {
        "nodes": nodes,
        "signals": arguments.signals,
        "c": jnp.concatenate([*(jnp.ravel(a) for a in constants_of(arguments)), jnp.zeros(1)]),
        "p": jnp.append(p, 0.0),
        "bounds": jnp.concatenate([nodes[:1], tau, jnp.repeat(nodes[-1:], idle + 1)]),
        "first_cell": jnp.concatenate([jnp.zeros(1, int), begins, jnp.full(idle + 1, cells - 1)]),
        "multipliers": np.zeros(count),
        "units": units,
    }
    given |= places
    buffers = [given[key] for key in GIVEN]
    for samples in arguments.samples:
        buffers += [*samples, np.zeros(1, dtype=np.int64)]
    lengths = sums(library, sizes)
    of_memory = sum(length.at(cells + N) for length in memory(library, sizes, Order.HESSIAN).values())
    results = [jax.ShapeDtypeStruct((length,), np.float64) for length in (sum(lengths.values()), of_memory)]
    totals = jax.ffi.ffi_call(name, results, vmap_method="expand_dims")(*buffers)[0]
    ends = dict(zip(lengths, np.cumsum(list(lengths.values())).tolist(), strict=True))
    J, g, H = (totals[ends[key] - lengths[key] : ends[key]] for key in ("J", "g", "H"))
    cost = J[0] + totals[-1]  # NaN if a finiteness check failed: the finisher of a batch then falls back to JAX
    gradient, hessian = g[own], H.reshape(D, width)[own[:, None], own]
    return cost, jnp.where(there, gradient, 0.0), jnp.where(there[:, None] & there[None], hessian, 0.0)


class NativeEngine:
    """Evaluates one experiment on one mesh in machine code.

    Parameters
    ----------
    structure : Structure
    arguments : Arguments
    mesh : Mesh
    fallback : ExperimentEngine
        Evaluates where machine code cannot: a product with zero was left out whose other factor is not finite.
    """

    def __init__(self, structure: Structure, arguments: Arguments, mesh: Mesh, fallback: ExperimentEngine) -> None:
        self._structure, self._arguments, self._mesh, self._fallback = structure, arguments, mesh, fallback
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

    def cost(self, tau: FloatArray, p: FloatArray) -> float:
        """Return J alone."""
        native = self.at(Order.COST)
        found = None if native is None else native.cost(tau, p)
        return self._fallback.cost(tau, p) if found is None else found

    def derivatives(self, tau: FloatArray, p: FloatArray, side: float, matrix: Matrix) -> Evaluation[FloatArray]:
        """Return J and its derivatives."""
        native = self.at(Order.GAUSS_NEWTON if matrix == "gauss-newton" else Order.HESSIAN)
        found = None if native is None else native(tau, p, side)
        if found is None:
            return self._fallback.derivatives(tau, p, side, matrix)
        return (
            Evaluation(found.cost, found.gradient, np.full_like(found.hessian, np.nan)) if matrix == "none" else found
        )

    def constrained(
        self, tau: FloatArray, p: FloatArray, side: float, multipliers: FloatArray
    ) -> Evaluation[FloatArray]:
        """Return J and the constraints, with the Hessian of ``J + multipliers . c``."""
        native = self.at(Order.HESSIAN)
        found = None if native is None else native(tau, p, side, multipliers)
        return self._fallback.constrained(tau, p, side, multipliers) if found is None else found

    def costates(self, tau: FloatArray, p: FloatArray, multipliers: FloatArray) -> Costates:
        """Return the costates of ``J + multipliers . c`` at the starts of all rows."""
        native = self.at(Order.HESSIAN)
        found = None if native is None else native.simulate(tau, p, multipliers)
        if found is None:
            return self._fallback.costates(tau, p, multipliers)
        first_row, states = found.first_cell + np.arange(len(found.first_cell)), found.states[:-1].copy()
        resets = list(self._structure.resets)
        states[first_row[1:][resets]] = found.reset_states[resets]
        return Costates.of_rows(self._structure, first_row, found.times[:-1], states, found.costates)

    def slopes(self, times: FloatArray, cells: NDArray[np.intp], states: FloatArray, p: FloatArray) -> FloatArray:
        """Return the vector fields of all modes at given points."""
        native = self.at(Order.COST)
        found = None if native is None else native.slopes(times, cells, states, p)
        return self._fallback.slopes(times, cells, states, p) if found is None else found

    def trace(self, tau: FloatArray, p: FloatArray) -> tuple[FloatArray, FloatArray, list[int]]:
        """Return the ends of all rows."""
        native = self.at(Order.COST)
        found = None if native is None else native.simulate(tau, p)
        if found is None:
            return self._fallback.trace(tau, p)
        first_rows = (found.first_cell + np.arange(len(found.first_cell))).tolist()
        last = first_rows.pop() if self._structure.has_free_tf else len(found.times) - 1
        return found.times[1 : last + 1], found.states[1 : last + 1], first_rows

    def simulate(self, tau: FloatArray, p: FloatArray, *, tangents: bool) -> Simulation:
        """Return all rows, with their derivatives if `tangents`."""
        native, plain = self.at(Order.HESSIAN if tangents else Order.COST), self.at(Order.COST)
        found = None
        if native is not None and plain is not None:
            found = _simulate(self._structure, self._arguments, native, plain, tau, p, tangents)
        return self._fallback.simulate(tau, p, tangents=tangents) if found is None else found


def _simulate(
    structure: Structure,
    arguments: Arguments,
    native: NativeExperiment,
    plain: NativeExperiment,
    tau: FloatArray,
    p: FloatArray,
    tangents: bool,
) -> Simulation | None:
    """Return all rows; None if a finiteness check failed.

    Machine code has the derivatives at the ends of rows, which move with theta where they are transitions. The
    derivative at fixed time is this one minus dx/dt, in the column of the transition time. Those in the times of jumps,
    which are known, are 0.
    """
    found = native.simulate(tau, p)
    if found is None:
        return None
    first_cell, start, end = found.first_cell.astype(np.intp), found.times[:-1], found.times[1:]
    opening = first_cell[1:] + np.arange(1, len(first_cell))  # rows that begin at a transition
    resets, before = list(structure.resets), found.states[:-1].copy()
    before[opening[resets]] = found.reset_states[resets]
    fixed, before_d = found.tangents, found.tangents
    if tangents:
        before_d = found.tangents[:-1].copy()
        before_d[opening[resets]] = found.reset_tangents[resets]
        moving, modes = np.setdiff1d(np.arange(structure.N), structure.jumps), np.array(structure.mode_of_segment)
        for derivative, states, own in ((fixed, found.states, modes[:-1]), (before_d, before, modes[1:])):
            slopes = plain.slopes(tau, first_cell[1:], states[opening], p)
            if slopes is None:
                return None
            derivative[opening[moving], :, moving] -= slopes[moving, own[moving]]
    seen = native.outputs(found.times, found.states, p, fixed if tangents else None)
    behind = native.outputs(tau, before[opening], p, before_d[opening] if tangents else None)
    if seen is None or behind is None:
        return None
    y_before, y_before_d = seen[0][:-1].copy(), seen[1][:-1].copy()
    y_before[opening], y_before_d[opening] = behind
    simulation = Simulation(
        cost=found.cost,
        nodes=native.times,
        first_cell=first_cell,
        start=start,
        end=end,
        before=before,
        after=found.states[1:],
        y_before=y_before,
        y_after=seen[0][1:],
        tangents=Tangents(before_d, fixed[1:], y_before_d, seen[1][1:]) if tangents else None,
    )
    late = {k: native.outputs(times, states, p) for k, (times, states) in found.late.items()}
    if None in late.values():
        return None
    found_all = add_samples(simulation, structure, arguments, {k: y[0] for k, y in late.items() if y is not None})
    return cut_at_tf(found_all, structure)
