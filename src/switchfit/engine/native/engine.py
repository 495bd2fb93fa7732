"""Machine code as an engine: one experiment on one mesh, with a program for each requested order of derivatives.

JAX evaluates where a finiteness check fails. Fits that run in one JAX program on a CPU call the machine code of an
experiment as a foreign function.
"""

from __future__ import annotations

import ctypes
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import sequential_vmap
from numpy.typing import NDArray

from switchfit.discretization.mesh import Arguments, Mesh, Samples, build_rows
from switchfit.discretization.model import AT_TRANSITIONS, read_parameters
from switchfit.engine.jax import JaxEngine
from switchfit.engine.native.llvm import Program
from switchfit.engine.native.program import layout_of, program_of, second_order
from switchfit.engine.native.scalars import CHECKED
from switchfit.engine.native.templates import Order, Sizes, constants_of
from switchfit.engine.protocol import (
    Costates,
    DenseEvaluation,
    Engine,
    Evaluation,
    Matrix,
    Simulation,
    Tangents,
    finish_simulation,
)
from switchfit.problem.data import FloatArray
from switchfit.problem.structure import Structure

Found = TypeVar("Found")


def native_experiment(
    structure: Structure, arguments: Arguments, times: FloatArray, order: Order
) -> NativeExperiment | None:
    """Return one experiment in machine code on the mesh with the nodes `times`; None if it cannot be compiled."""
    program = program_of(structure.library, Sizes.of(structure, arguments), order)
    return None if isinstance(program, str) else NativeExperiment(program, structure, arguments, times, order)


def reason_for_jax(structure: Structure, arguments: Arguments) -> str | None:
    """Return why an experiment cannot be compiled with second derivatives; None if it can."""
    program = program_of(structure.library, Sizes.of(structure, arguments), second_order(structure))
    return program if isinstance(program, str) else None


def places_in_library(structure: Structure) -> dict[str, NDArray[np.int64]]:
    """Return the index in the library of the mode of each segment, and of the functions of each transition.

    Transitions without a function of a kind have -1. If there are jumps at known times, "jumps" is 1 for these. Idle
    segments, which the sequence does not need, have its last mode and no functions. Each array ends with an unused -1,
    so that it is never empty.
    """
    # A program of the library has room for more transitions than the sequence: those left over are at tf.
    library, idle = structure.library, structure.transitions - structure.N

    def find(own: Sequence[Any], available: Sequence[Any]) -> list[int]:
        return [-1 if f is None else available.index(f) for f in own] + [-1] * idle

    modes = list(structure.mode_of_segment)
    found = {"modes": modes + modes[-1:] * idle, "resets": find(structure.reset_maps, library.reset_maps)}
    for kind in AT_TRANSITIONS:
        found[kind] = find(getattr(structure, kind), getattr(library, kind))
    if structure.jumps:
        found["jumps"] = [int(i in structure.jumps) for i in range(structure.N)] + [0] * idle
    return {name: np.array([*which, -1], dtype=np.int64) for name, which in found.items()}


def find_directions(sizes: Sizes, are_jumps: Any, xp: Any) -> tuple[Any, Any, Any]:
    """Return the derivatives of the times in the unknowns of a program, and where an experiment finds its derivatives.

    Times of jumps are known: they are no unknowns of the program.

    Parameters
    ----------
    sizes : Sizes
    are_jumps : int array, of length N of the experiment
        1 for each transition that is a jump. May be traced.
    xp : module
        NumPy or jax.numpy.

    Returns
    -------
    units : (N + 1, width), N that of the program
        Row i + 1 is the derivative of time i: a unit vector, 0 for a jump. Row 0 is 0.
    places, there : int array, bool array
        For each time and parameter of the experiment its position among the unknowns of the program, and whether it is
        one.
    """
    N = are_jumps.shape[0]
    # Unknowns of the program are numbered by the transitions that are no jumps: `order` is the place of each among
    # them.
    free = xp.concatenate([1 - are_jumps, np.ones(sizes.N - N, dtype=np.int64)])
    order = xp.maximum(xp.cumsum(free) - 1, 0)
    units = xp.where((order[:, None] == np.arange(sizes.width)[None]) & (free[:, None] == 1), 1.0, 0.0)
    places = xp.concatenate([order[:N], sizes.T + np.arange(sizes.M)])
    there = xp.concatenate([free[:N] == 1, np.ones(sizes.M, dtype=bool)])
    return xp.concatenate([np.zeros((1, sizes.width)), units]), places, there


@lru_cache(maxsize=64)
def _find_own_directions(sizes: Sizes, N: int, jumps: tuple[int, ...]) -> tuple[Any, Any, Any]:
    """Return what `find_directions` does for N transitions with these jumps, shared by all meshes."""
    return find_directions(sizes, np.isin(np.arange(N), jumps).astype(np.int64), np)


class FailedCheckError(Exception):
    """A product with a structural zero was left out whose other factor is not finite: the caller falls back to JAX."""


class NativeExperiment:
    """Arrays of one experiment on one mesh, and calls of its machine code.

    Methods that evaluate raise `FailedCheckError`, or return NaN, if a finiteness check failed.

    Parameters
    ----------
    program : Program
    structure : Structure
    arguments : Arguments
        Padded or not.
    times : (G + 1,) array
        The nodes without the padding.
    order : Order
    """

    def __init__(
        self, program: Program, structure: Structure, arguments: Arguments, times: FloatArray, order: Order
    ) -> None:
        self.sizes = sizes = Sizes.of(structure, arguments)
        self.order, self.times, self.row_work = order, times, [*program.modules.values()][-1].row_work
        self._program, self._module = program, program.modules[order]
        N, cells = sizes.N, len(times) - 1
        self._inner_nodes, self._cells = times[1:-1], cells
        self._channels = sum(channels for _, channels in structure.outputs)
        self._counts = [count_samples(samples) for samples in arguments.samples]
        self._function = self._find("evaluate", 1 + len(self._counts))
        layout = layout_of(structure.library, sizes, order)
        self._rows = layout.constraint_rows
        self._lengths = {name: fixed + each * (cells + N) for name, (fixed, each) in layout.memory.items()}
        self._size = sum(self._lengths.values())
        places = places_in_library(structure)
        given: dict[str, Any] = {
            "nodes": times,
            "signals": np.asarray(arguments.signals)[:cells],
            "c": np.concatenate([*constants_of(arguments), np.zeros(1)], axis=None),
            "p": np.zeros(max(sizes.M, 1)),
            "bounds": np.full(N + 2, times[0]),
            "first_cell": np.zeros(N + 2, dtype=np.int64),
            "multipliers": np.zeros(max(self._rows["count"], 1)),
            "units": _find_own_directions(sizes, structure.N, structure.jumps)[0],
        } | places
        for k, (samples, count) in enumerate(zip(arguments.samples, self._counts, strict=True)):
            given |= {f"{name} {k}": np.asarray(values)[:count] for name, values in samples._asdict().items()}
            is_late = structure.measurements[k].delay is not None
            given |= {f"segment {k}": np.zeros(count, int), f"seen {k}": np.zeros(is_late * count * (1 + sizes.n))}
        self._named: dict[str, Any] = {}
        self._addresses: dict[str, int] = {}
        # One block of memory per type: the addresses of its parts follow from one that is looked up.
        for kind in np.int64, np.float64:
            arrays = {name: a for name, a in given.items() if a.dtype.kind == np.dtype(kind).kind}
            block = np.concatenate(list(arrays.values()), axis=None, dtype=kind)
            self._divide(block, {name: a.size for name, a in arrays.items()})
        self._divide(np.zeros(sum(layout.sums.values())), layout.sums)
        self._pointers = layout.names
        self._memory = np.zeros(0)  # the scratch space that the table points to, after the first call
        self._table = np.array([self._addresses.get(name, 0) for name in self._pointers], dtype=np.uintp)
        self._address = get_address(self._table)
        delays = {k: sensor.delay for k, sensor in enumerate(structure.measurements) if sensor.delay is not None}
        self._delays = {k: _find_delay(structure, arguments, name) for k, name in delays.items()}
        self._size_of_states: FloatArray | None = None
        self._judged = -1
        self._own_p, self._check, self._J = self._named["p"][: sizes.M], self._named[CHECKED], self._named["J"]
        self._multipliers = self._named["multipliers"]
        self._g = self._named["g"][: sizes.D]
        self._H, self._jacobian = (
            self._named[each].reshape(-1, sizes.width)[:, : sizes.D] for each in ("H", "jacobian")
        )
        self.assign_sequence(structure, places)

    def assign_sequence(self, structure: Structure, places: dict[str, NDArray[np.int64]]) -> None:
        """Evaluate another sequence of the same library from now on; its transition times are the next call's.

        Parameters
        ----------
        structure : Structure
            Equal to that of the experiment but for the modes and the functions at transitions; without jumps.
        places : dict
            Its `places_in_library`.
        """
        N, rows, self.structure = structure.N, self._rows, structure
        # All transition times at tf, and all segments but the first in the last cell, until `_evaluate` writes those of
        # a call.
        self._named["bounds"][1:] = self.times[-1]
        self._named["first_cell"][1:] = self._cells - 1
        for name, which in places.items():
            self._named[name][:] = which
        self._named["modes"][-1] = self._judged
        _, self._places, self._there = _find_own_directions(self.sizes, N, structure.jumps)
        # No jumps and no idle transitions: the unknowns of the program are those of the experiment, in their order.
        self._has_all = len(self._places) == self.sizes.D and not structure.jumps
        self._tau, self._begins = self._named["bounds"][1 : N + 1], self._named["first_cell"][1 : N + 1]
        self._constraint_rows = np.array([*structure.guarded, *range(rows["end"], rows["count"])], dtype=np.intp)

    def __call__(
        self, tau: FloatArray, p: FloatArray, side: float, multipliers: FloatArray | None = None
    ) -> DenseEvaluation:
        """Return J, its gradient (D,) and its Hessian (D, D), NaN at order GRADIENT.

        With multipliers (m,) the constraints too, and the Hessian of ``J + multipliers . c``.
        """
        with self._program.lock:
            self._evaluate(tau, p, side, multipliers)
            g, H = self._spread(self._g), self._spread(self._spread(self._H).T)
            if multipliers is None:
                hessian = H if self.order > Order.GRADIENT else np.full_like(H, np.nan)
                return Evaluation(self._J.item(0), g, hessian, row_errors=self._read_errors())
            where = self._constraint_rows
            # The backward sweep has lam . c in it like a cost: g is that of the Lagrangian, and that of J is g - A'
            # lam.
            c, A = self._named["constraints"][where], self._spread(self._jacobian[where])
            with np.errstate(invalid="ignore", over="ignore"):  # a point that is not finite is refused
                gradient = g - multipliers.dot(A)
            return Evaluation(self._J.item(0), gradient, H, c, A, self._read_errors())

    def find_constraints(self, tau: FloatArray, p: FloatArray, side: float) -> DenseEvaluation:
        """Return J and the constraints with their derivatives; those of J are of no meaning."""
        self._named["modes"][-1] = -2
        try:
            return self(tau, p, side, np.zeros(len(self._constraint_rows)))
        finally:
            self._named["modes"][-1] = self._judged

    def judge_rows(self, *, jumps: bool) -> None:
        """Estimate the errors of rows in all evaluations with second derivatives; look for `jumps` of f inside, too."""
        self._judged = self._named["modes"][-1] = 1 + jumps

    def _read_errors(self) -> tuple[float, ...]:
        """Return the largest error of a row of the evaluation, relative to the states of the first on this mesh."""
        if self._judged < 0:
            return ()
        if self._size_of_states is None:
            states = self._named["x"].reshape(-1, self.sizes.n)[: self._cells + self.structure.N + 1]
            largest = np.abs(states).max(axis=0)
            is_known = (largest > 0.0) & np.isfinite(largest)
            # Fixed at the first point: errors of later ones are compared with the same sizes.
            self._size_of_states = np.where(is_known, largest, np.finfo(float).max)  # a state that stays 0 has no error
        with np.errstate(over="ignore"):  # an infinite error is too large
            return (max((self._named["errors"] / self._size_of_states).tolist()),)

    def _spread(self, values: FloatArray) -> FloatArray:
        """Return a copy of derivatives along the last axis, in the experiment's times and parameters.

        They are 0 in the times of jumps, which are no unknowns of the program.
        """
        return values.copy() if self._has_all else np.where(self._there, values[..., self._places], 0.0)

    def cost(self, tau: FloatArray, p: FloatArray) -> float:
        """Return J alone."""
        with self._program.lock:
            self._evaluate(tau, p, 1.0)
            return self._J.item(0)

    def simulate(
        self, tau: FloatArray, p: FloatArray, multipliers: FloatArray | None = None
    ) -> tuple[Simulation, FloatArray, dict[int, FloatArray]]:
        """Return all rows, without outputs and up to the last node, what is known with derivatives, and late samples.

        Returns
        -------
        rows : Simulation
            Its tangents are those at starts and ends that move with theta where they are transitions.
        costates : (R, n)
            With derivatives: those of ``J + multipliers . c`` in the state at each start.
        late : for each late Measurements, by its index, the times at which its samples saw the state, and the states
            then, (K, 1 + n)
        """
        with self._program.lock:
            self._evaluate(tau, p, 1.0, multipliers)
            n, N, cells, width = self.sizes.n, self.structure.N, self._cells, self.sizes.width
            first_cell = self._named["first_cell"][: N + 1].astype(np.intp)
            times = np.sort(np.append(self.times, tau))  # a cell that a transition cuts has two rows

            def of_rows(name: str, count: int, *shape: int) -> FloatArray:
                values = self._named[name].reshape(-1, *shape)[:count]
                return self._spread(values[..., : self.sizes.D]) if len(shape) > 1 else np.array(values)

            def beside_rows(name: str, *shape: int) -> tuple[FloatArray, FloatArray]:
                """Return the values at the starts of rows, those before or of reset maps, and at their ends."""
                ends, resets = of_rows(name, cells + N + 1, *shape), list(self.structure.resets)
                starts = ends[:-1].copy()
                if resets:
                    after = of_rows(f"reset_{name}", N, *shape)
                    starts[(first_cell[1:] + np.arange(1, N + 1))[resets]] = after[resets]
                return starts, ends[1:]

            none, derives = np.zeros((cells + N, 0)), self.order > Order.COST
            rows = times[:-1], times[1:], *beside_rows("x", n), none, none
            tangents = Tangents(*beside_rows("Z", n, width), none, none) if derives else None
            simulation = Simulation(self._J.item(0), self.times, first_cell, *rows, tangents=tangents)
            late = {k: self._named[f"seen {k}"].reshape(-1, 1 + n).copy() for k in self._delays}
            return simulation, of_rows("costate", cells + N if derives else 0, n), late

    def slopes(self, times: FloatArray, cells: NDArray[np.intp], states: FloatArray, p: FloatArray) -> FloatArray:
        """Return f of all modes of the library at times (L,) in cells (L,) and states (L, n): (L, modes, n)."""
        y = np.column_stack([states, np.zeros(len(times))])
        slopes = np.stack([self.slopes_in(k, times, y, p, cells) for k in range(len(self.structure.modes))], axis=1)
        if np.isnan(slopes[..., -1]).any():
            raise FailedCheckError
        return slopes[..., :-1]

    def slopes_in(
        self, mode: int, times: FloatArray, y: FloatArray, p: FloatArray, cells: NDArray[np.intp] | None = None
    ) -> FloatArray:
        """Return f and ell at times (L,) and y = (x, running cost so far), (L, n + 1): (L, n + 1).

        They are NaN where a finiteness check failed. The signals are those of `cells`; by default, of those that hold
        the times (at a node, of the later one).
        """
        if cells is None:
            cells = np.clip(self.times.searchsorted(times, "right") - 1, 0, self._cells - 1)
        slopes = np.zeros(y.shape)
        signals = self._named["signals"].reshape(self._cells, 4 * self.sizes.signals)[cells]
        given = {"moment": np.column_stack([times, self.times[cells]]), "signal": signals}
        checks = self._call(f"slope_{mode}", given | {"y": y, "K": slopes}, p, len(times))
        return slopes + checks[:, None]

    def outputs(
        self, times: FloatArray, states: FloatArray, p: FloatArray, tangents: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the outputs of all sensors (L, q), and their tangents from those of the states (L, n, D), or empty."""
        L, width = len(times), self.sizes.width
        y, Y = np.zeros((L, self._channels)), np.zeros((L, self._channels, width))
        Z = np.zeros((L, self.sizes.n, width) if tangents.size else 0)
        if tangents.size:
            Z[..., self._places[self._there]] = tangents[..., self._there]
        given = {"time": times, "x": np.ascontiguousarray(states), "Z": Z, "y": y, "Y": Y}
        if np.isnan(self._call("outputs", given, p, L)).any():
            raise FailedCheckError
        return y, self._spread(Y[..., : self.sizes.D])

    def initial_state(self, p: FloatArray) -> FloatArray:
        """Return x(t0): (n,)."""
        x = np.zeros(self.sizes.n)
        return x + self._call("start", {"x_after": x}, p)

    def after_reset(self, i: int, t: float, x: FloatArray, p: FloatArray) -> FloatArray:
        """Return the state after the reset map of transition i (from 0): (n,)."""
        after, moves = np.zeros(self.sizes.n), self._named["units"].reshape(-1, self.sizes.width)[i + 1]
        given = {"time": np.array([t]), "x": np.array(x, dtype=float), "x_after": after, "moves": moves}
        return after + self._call(f"reset_{int(self._named['resets'][i])}", given, p)

    def adaptive_steps(
        self, mode: int, state: FloatArray, y: FloatArray, p: FloatArray, most: int
    ) -> tuple[FloatArray, FloatArray]:
        """Take up to `most` adaptive steps from `state` and y, which are updated; return the accepted times (L,) and
        states (L, n).

        y is NaN if a finiteness check failed.

        Parameters
        ----------
        state : array
            See `switchfit.engine.native.program.AT`.
        y : (n + 1,) array
            State and running cost so far.
        """
        self._own_p[:] = p
        rows, count = np.empty((most, 1 + len(y))), np.zeros(1, dtype=np.int64)
        self._check[0] = 0.0
        given = self._address, self._cells, *map(get_address, (state, y, rows)), most, get_address(count)
        self._find(f"adaptive_{mode}_steps", len(given))(*given)
        # 0, or NaN: the solver's caller sees a state that is not finite.
        y += self._check[0]
        return rows[: count[0], 0], rows[: count[0], 1:-1]

    def _find(self, name: str, count: int) -> Any:
        """Return a function of the driver with a number of arguments: integers and addresses."""
        return self._program.function(f"{self._module.prefix}{name}", count)

    def _call(self, name: str, given: Mapping[str, FloatArray], p: FloatArray, count: int = 1) -> FloatArray:
        """Call a straight-line function at `count` points, with an array for each pointer that is not an argument.

        Return 0 for each point, or NaN if a finiteness check failed there: (count,).
        """
        self._own_p[:] = p
        checks, arguments = np.zeros(count), [count]
        arrays = {CHECKED: checks, **given}
        for key in self._module.pointers[name]:
            array = arrays.get(key)
            arguments += (self._addresses[key], 0) if array is None else (get_address(array), array.strides[0])
        self._find(f"each_{name}", len(arguments))(*arguments)
        return checks

    def _evaluate(self, tau: FloatArray, p: FloatArray, side: float, multipliers: FloatArray | None = None) -> None:
        """Evaluate J and, of a program with derivatives, those of ``J + multipliers . c``."""
        self._own_p[:], self._tau[:] = p, tau
        # The scratch space is shared by all experiments of a program, under its lock; it may have moved since the last
        # call.
        self._program.reserve(self._size)
        if self._memory is not self._program.memory:
            self._memory = self._program.memory
            self._divide(self._memory, self._lengths)
            self._table[:] = [self._addresses[name] for name in self._pointers]
        self._find_first_cells(tau, side)
        self._find_late_cells(p)
        if multipliers is not None:
            self._multipliers[self._constraint_rows] = multipliers
        try:
            self._function(self._address, *self._counts)
        finally:
            if multipliers is not None:
                self._multipliers[:] = 0.0
        check = self._check.item(0)
        # If the cost is not finite, it is returned without fallback: the caller rejects the point anyway.
        if check != check and math.isfinite(self._J.item(0)):
            raise FailedCheckError

    def _divide(self, block: NDArray[Any], lengths: Mapping[str, int]) -> None:
        """Name consecutive parts of a block of memory. Finding an address takes as long as all the rest."""
        address, begin = get_address(block), 0
        for name, length in lengths.items():
            self._named[name], self._addresses[name] = block[begin : begin + length], address + 8 * begin
            begin += length

    def _find_first_cells(self, tau: FloatArray, side: float) -> None:
        """Find the cells in which segments begin, as in `switchfit.discretization.mesh.build_rows`."""
        nodes = self._inner_nodes
        # A time on a node is past it on its right side, and not yet on its left.
        begins = nodes.searchsorted(tau, "right" if side > 0 else "left")
        if side <= 0 and self.structure.jumps:  # as in `Structure.fix_sides` and `build_rows`
            jumps = list(self.structure.jumps)
            begins[jumps] = nodes.searchsorted(tau[jumps], "right")
            begins = np.maximum.accumulate(begins)
        self._begins[:] = begins

    def _find_late_cells(self, p: FloatArray) -> None:
        """Find the cells and segments of the late samples: those of the rows with ``start < t - delay <= end``."""
        for k, (place, value) in self._delays.items():
            times, cell, segment = (self._named[f"{name} {k}"] for name in ("time", "cell", "segment"))
            seen = times - (value if place is None else p[place])
            # start < t - delay <= end: a state at a node, or at a transition, is that of the row which ends there.
            cell[:] = np.clip(self.times.searchsorted(seen, "left") - 1, 0, self._cells - 1)
            segment[:] = self._tau.searchsorted(seen, "left")


def get_address(array: NDArray[Any]) -> int:
    """Return the address of the first entry of an array."""
    buffer: Any = array
    try:
        return ctypes.addressof(ctypes.c_char.from_buffer(buffer))  # a quarter of the time of `ctypes.data`
    except (TypeError, ValueError):  # it is read-only, not contiguous, or empty
        return int(array.ctypes.data)


def _find_delay(structure: Structure, arguments: Arguments, name: str) -> tuple[int | None, float]:
    """Return the position in p of a scalar parameter, or its value if it is fixed."""
    positions = np.arange(float(structure.M))
    value = float(read_parameters(structure, arguments, positions)[name])
    is_free = any(read for other, _, read in structure.parameters if other == name)
    return (int(value), 0.0) if is_free else (None, value)


def count_samples(samples: Samples) -> int:
    """Return the number of samples up to the last with a nonzero weight, at least 1; the rest is padding."""
    there = np.flatnonzero(np.asarray(samples.weight).any(1))
    return int(there[-1]) + 1 if len(there) else 1


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
            for derivative, states, rows, own in beside:
                slopes = self.slopes(tau, found.first_cell[1:], states[rows], p)
                derivative[rows[moving], :, moving] -= slopes[moving, own[moving]]
        y_before, y_before_d = native.outputs(found.start, found.before, p, before_d)
        y_after, y_after_d = native.outputs(found.end, found.after, p, after_d)
        tangents = None if found.tangents is None else Tangents(before_d, after_d, y_before_d, y_after_d)
        simulation = replace(found, y_before=y_before, y_after=y_after, tangents=tangents)
        seen = {k: native.outputs(each[:, 0], each[:, 1:], p, np.zeros(0))[0] for k, each in late.items()}
        return finish_simulation(simulation, structure, self._arguments, seen)


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
            handler = jax.ffi.pycapsule(program.function("xla_handler", 1))
            jax.ffi.register_ffi_target(name, handler, platform="cpu")
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
    nodes, count_own = jnp.asarray(arguments.nodes), tau.shape[0]
    cells, idle = nodes.shape[0] - 1, N - count_own  # idle: segments that the sequence does not need, from tf to tf
    jumps = places.get("jumps", np.zeros(count_own, dtype=np.int64))[:count_own]
    side = jnp.where(jumps > 0, 1.0, side)  # as in `Structure.fix_sides`
    first_cell = build_rows(nodes, tau, side).first_cell
    units, own, there = find_directions(sizes, jumps, jnp)
    layout = layout_of(library, sizes, Order.HESSIAN)
    given: dict[str, Any] = {
        "nodes": nodes,
        "signals": arguments.signals,
        "c": jnp.concatenate([*(jnp.ravel(a) for a in constants_of(arguments)), jnp.zeros(1)]),
        "p": jnp.append(p, 0.0),
        "bounds": jnp.concatenate([nodes[:1], tau, jnp.repeat(nodes[-1:], idle + 1)]),
        "first_cell": jnp.concatenate([first_cell, jnp.full(idle + 1, cells - 1)]),
        "multipliers": np.zeros(max(layout.constraint_rows["count"], 1)),
        "units": units,
    }
    given |= places
    for k, samples in enumerate(arguments.samples):
        given |= {f"{name} {k}": values for name, values in samples._asdict().items()}
        given |= {f"segment {k}": np.zeros(1, dtype=np.int64), f"seen {k}": np.zeros(1)}  # none is late
    buffers = [given[name] for name in layout.arguments]
    of_memory = sum(fixed + each * (cells + N) for fixed, each in layout.memory.values())
    results = [jax.ShapeDtypeStruct((length,), np.float64) for length in (sum(layout.sums.values()), of_memory)]
    # A batch is a loop: all of its entries use one scratch space, which stays in the CPU caches.
    totals = sequential_vmap(lambda *given: jax.ffi.ffi_call(name, results)(*given)[0])(*buffers)
    _, J, g, H, *_ = jnp.split(totals, np.cumsum([*layout.sums.values()])[:-1].tolist())
    cost = J[0] + totals[-1]  # NaN if a finiteness check failed: the finisher of a batch then falls back to JAX
    gradient, hessian = g[own], H.reshape(D, width)[own[:, None], own]
    return cost, jnp.where(there, gradient, 0.0), jnp.where(there[:, None] & there[None], hessian, 0.0)
