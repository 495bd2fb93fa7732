"""One experiment on one mesh, evaluated and simulated by machine code."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.discretization.arguments import Arguments, Samples
from switchfit.discretization.nodes import AT_TRANSITIONS, list_constrained_transitions
from switchfit.engine.native.adaptive import SLOPE
from switchfit.engine.native.kernels import RESET, START
from switchfit.engine.native.llvm import BUDGET, Program
from switchfit.engine.native.program import PREFIX, program_of
from switchfit.engine.native.scalars import CHECKED
from switchfit.engine.native.templates import Order, Sizes, constants_of
from switchfit.engine.native.workspace import (
    GIVEN,
    OF_SAMPLES,
    WHOLE_OF_SAMPLES,
    ZEROED,
    Layout,
    list_place_lengths,
)
from switchfit.engine.protocol import Evaluation
from switchfit.problem.data import FloatArray
from switchfit.problem.structure import Structure


def native_experiment(
    structure: Structure, arguments: Arguments, times: FloatArray, order: Order
) -> NativeExperiment | None:
    """Return one experiment in machine code on the mesh with the nodes `times`; None if it cannot be compiled."""
    sizes = Sizes.of(structure, arguments)
    program = program_of(structure.library, sizes, order)
    return None if isinstance(program, str) else NativeExperiment(program, structure, sizes, arguments, times, order)


def reason_for_jax(structure: Structure, arguments: Arguments, order: Order) -> str | None:
    """Return why an experiment cannot be compiled with derivatives of an order; None if it can."""
    program = program_of(structure.library, Sizes.of(structure, arguments), order)
    return program if isinstance(program, str) else None


def places_in_library(structure: Structure) -> dict[str, NDArray[np.int64]]:
    """Return the index in the library of the mode of each segment, and of the functions of each transition.

    Transitions without a function of a kind have -1. If there are jumps at known times, "jumps" is 1 for these. Idle
    segments, which the sequence does not need, have its last mode and no functions. Each array ends with an unused -1,
    so that it is never empty.
    """
    library, idle = structure.library, structure.transitions - structure.N

    def find(own: Sequence[Any], available: Sequence[Any]) -> list[int]:
        return [-1 if f is None else available.index(f) for f in own] + [-1] * idle

    modes = list(structure.mode_of_segment)
    found = {"modes": modes + modes[-1:] * idle, "resets": find(structure.reset_maps, library.reset_maps)}
    for kind in AT_TRANSITIONS:
        found[kind.name] = find(getattr(structure, kind.name), getattr(library, kind.name))
    if structure.jumps:
        found["jumps"] = [int(i in structure.jumps) for i in range(structure.N)] + [0] * idle
    return {name: np.array([*which, -1], dtype=np.int64) for name, which in found.items()}


def join_places(modes: Sequence[int], functions: Sequence[Sequence[int]], N: int) -> NDArray[np.int64]:
    """Return what is active where in one array, for `NativeExperiment.costs`.

    Parameters
    ----------
    modes : sequence of int
        Index in the library of the mode of each segment.
    functions : sequence of sequences of int
        For each transition the index of its reset map, then of its functions of each kind, -1 without one.
    N : int
        Transitions of the program.
    """
    lengths = list_place_lengths(N)
    found = np.full(sum(lengths.values()), -1, dtype=np.int64)
    found[: N + 1] = modes[-1]
    found[: len(modes)] = modes
    if functions:
        found[N + 1 :].reshape(-1, N)[:, : len(functions)] = np.transpose(functions)
    return found


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
    free = xp.concatenate([1 - are_jumps, np.ones(sizes.N - N, dtype=np.int64)])
    order = xp.maximum(xp.cumsum(free) - 1, 0)
    units = xp.where((order[:, None] == np.arange(sizes.width)[None]) & (free[:, None] == 1), 1.0, 0.0)
    places = xp.concatenate([order[:N], sizes.T + np.arange(sizes.M)])
    there = xp.concatenate([free[:N] == 1, np.ones(sizes.M, dtype=bool)])
    return xp.concatenate([np.zeros((1, sizes.width)), units]), places, there


@lru_cache(maxsize=64)
def _find_own_directions(
    sizes: Sizes, N: int, jumps: tuple[int, ...]
) -> tuple[FloatArray, NDArray[np.int64], NDArray[np.bool_]]:
    """Return what `find_directions` does for N transitions with these jumps: read-only, shared by all meshes."""
    are_jumps = np.isin(np.arange(N), jumps).astype(np.int64)
    found: tuple[FloatArray, NDArray[np.int64], NDArray[np.bool_]] = find_directions(sizes, are_jumps, np)
    for array in found:
        array.setflags(write=False)
    return found


class Simulated(NamedTuple):
    """A simulation: R = cells + N rows, one after the other.

    Attributes
    ----------
    cost : J
    first_cell : (N + 1,) int, cell in which each segment begins
    times, states, tangents : (R + 1,), (R + 1, n), (R + 1, n, D)
        At t0, then at the end of each row, before a jump. The tangents, in second order, are derivatives at an end that
        moves with theta where it is a transition.
    reset_states, reset_tangents : (N, n), (N, n, D), after the reset maps; undefined at transitions without one
    late : for each late Measurements, by its index, the times at which its samples saw the state, and the states then
    """

    cost: float
    first_cell: NDArray[np.int64]
    times: FloatArray
    states: FloatArray
    reset_states: FloatArray
    tangents: FloatArray
    reset_tangents: FloatArray
    late: dict[int, tuple[FloatArray, FloatArray]]


class NativeExperiment:
    """Arrays of one experiment on one mesh, and calls of its machine code.

    Parameters
    ----------
    program : Program
    structure : Structure
    sizes : Sizes
    arguments : Arguments
        Padded or not.
    times : (G + 1,) array
        The nodes without the padding.
    order : Order
    """

    def __init__(
        self,
        program: Program,
        structure: Structure,
        sizes: Sizes,
        arguments: Arguments,
        times: FloatArray,
        order: Order,
    ) -> None:
        library = structure.library
        self.structure, self.sizes, self.order = structure, sizes, order
        self._prefix, self._has_hessian = PREFIX[order], order >= Order.HESSIAN
        self._workspace = program.workspace
        N, D, width, cells = sizes.N, sizes.D, sizes.width, len(times) - 1
        self._channels = sum(channels for _, channels in structure.outputs)
        places = places_in_library(structure)
        units, self._places, self._there = _find_own_directions(sizes, structure.N, structure.jumps)
        self._has_all = len(self._places) == D
        counts = [count_samples(samples) for samples in arguments.samples]
        pointer, number = ctypes.c_void_p, ctypes.c_int64
        self._program = program  # keeps its code alive
        self.row_work = program.row_work
        self._evaluate = program.function(f"{self._prefix}evaluate", pointer, pointer, *[number] * len(counts))
        self.times, self._inner_nodes, self._cells, self._counts = times, times[1:-1], cells, counts
        constants = [np.ravel(np.asarray(a, dtype=np.float64)) for a in constants_of(arguments)]
        self._bounds = np.concatenate([times[:1], np.full(N + 1, times[-1])])
        self._first_cell = np.full(N + 2, cells - 1, dtype=np.int64)
        self._first_cell[0] = 0
        self._p = np.zeros(max(sizes.M, 1))
        self._own_p, self._tau = self._p[: sizes.M], self._bounds[1 : structure.N + 1]
        self._begins = self._first_cell[1 : structure.N + 1]
        if order not in program.layouts:
            program.layouts[order] = Layout.of(library, sizes, order)
        layout: Layout = program.layouts[order]
        rows, lengths = layout.constraint_rows, layout.sums
        self._rows = rows
        own_rows = [rows[kind.name] + i for kind, i in list_constrained_transitions(structure)]
        self._constraint_rows = np.array([*own_rows, *range(rows["end"], rows["count"])], dtype=np.intp)
        self._multipliers = np.zeros(max(rows["count"], 1))
        self._sums = np.zeros(sum(lengths.values()))
        arrays: dict[str, Any] = {
            "nodes": np.ascontiguousarray(times),
            "signals": np.ascontiguousarray(np.asarray(arguments.signals)[:cells]),
            "c": np.concatenate([*constants, np.zeros(1)]),
            "p": self._p,
            "bounds": self._bounds,
            "first_cell": self._first_cell,
            "multipliers": self._multipliers,
            "units": units,
        }
        arrays |= places
        arrays |= _split_array(self._sums, lengths)
        self._check, self._J = arrays[CHECKED], arrays["J"]
        self._lengths = {name: length.at(cells + N) for name, length in layout.memory.items()}
        self._size = sum(self._lengths.values())
        self._zeroed: list[FloatArray] = []
        self._size_of_states: FloatArray | None = None
        self._judged = -1
        self._memory = np.zeros(0)  # the workspace that the table points to
        self._named: dict[str, Any] = arrays
        self._arrays = [arrays[name] for name in GIVEN]
        self._late: list[tuple[int, str, FloatArray, Any, Any]] = []
        for k, (samples, count) in enumerate(zip(arguments.samples, counts, strict=True)):
            given: dict[str, Any] = {}
            for name, values in zip(OF_SAMPLES, [*samples, np.zeros(count)], strict=True):
                kind = np.int64 if name in WHOLE_OF_SAMPLES else np.float64
                given[name] = np.array(np.asarray(values)[:count], dtype=kind, order="C")
            delay = structure.measurements[k].delay
            if delay is not None:
                self._late.append((k, delay, given["time"], given["cell"], given["segment"]))
            self._arrays += given.values()
        addresses = [get_address(a) for a in self._arrays]
        own, of_samples = addresses[: len(GIVEN)], addresses[len(GIVEN) :]
        self._addresses = dict(zip(GIVEN, own, strict=True))
        of_memory = [0] * len(self._lengths)  # until `_bind`
        self._table = np.array([*own, *_list_addresses(self._sums, lengths), *of_memory, *of_samples], dtype=np.uintp)
        self._in_memory = slice(len(GIVEN) + len(lengths), len(self._table) - len(of_samples))
        self._address = self._table.ctypes.data
        self._progress = (ctypes.c_int64 * 3)()
        self._progress_address = ctypes.addressof(self._progress)
        self._result = self._named["g"][:D], self._named["H"].reshape(D, width)[:, :D]
        self._constraints, self._jacobian = self._named["constraints"], self._named["jacobian"].reshape(-1, width)
        self._delays = _find_delays(structure, arguments) if self._late else {}

    def assign_sequence(self, structure: Structure) -> None:
        """Evaluate another sequence of the same library from now on; its transition times are the next call's.

        Parameters
        ----------
        structure : Structure
            Equal to that of the experiment but for the modes and the functions at transitions; without jumps.
        """
        N = structure.N
        self.structure = structure
        _, self._places, self._there = _find_own_directions(self.sizes, N, ())
        self._has_all = len(self._places) == self.sizes.D
        self._bounds[1:] = self.times[-1]
        self._first_cell[1:] = self._cells - 1
        self._tau, self._begins = self._bounds[1 : N + 1], self._first_cell[1 : N + 1]
        self._write_places()
        rows = self._rows
        own_rows = [rows[kind.name] + i for kind, i in list_constrained_transitions(structure)]
        self._constraint_rows = np.array([*own_rows, *range(rows["end"], rows["count"])], dtype=np.intp)

    def __call__(self, tau: FloatArray, p: FloatArray, side: float) -> Evaluation[FloatArray] | None:
        """Return J, its gradient (D,) and its Hessian (D, D), which is NaN at orders below the second.

        None if a finiteness check failed: the caller falls back to JAX.
        """
        with self._workspace.lock:
            self._run(tau, p, side)
            if self._has_failed_check:
                return None
            g, H = self._read_derivatives()
            hessian = H if self._has_hessian else np.full(H.shape, np.nan)
            return Evaluation(self._J.item(0), g, hessian, row_errors=self._read_errors())

    def judge_rows(self, *, jumps: bool) -> None:
        """Estimate the errors of rows in all evaluations with second derivatives; look for `jumps` of f inside, too."""
        self._judged = self._named["modes"][-1] = 1 + jumps

    def _read_errors(self) -> tuple[float, ...]:
        """Return the largest error of a row of the evaluation, relative to the states of the first on this mesh."""
        if self._judged < 0 or not self._has_hessian:
            return ()
        if self._size_of_states is None:
            states = self._named["states"].reshape(-1, self.sizes.n)[: self._cells + self.structure.N + 1]
            largest = np.abs(states).max(axis=0)
            is_known = (largest > 0.0) & np.isfinite(largest)
            self._size_of_states = np.where(is_known, largest, np.finfo(float).max)  # a state that stays 0 has no error
        return (max((self._named["errors"] / self._size_of_states).tolist()),)

    def _read_derivatives(self) -> tuple[FloatArray, FloatArray]:
        """Return copies of the gradient (D,) and the Hessian (D, D) in the experiment's times and parameters.

        They are 0 in the times of jumps, which are no unknowns.
        """
        g, H = self._result
        if self._has_all:
            return g.copy(), H.copy()
        every = np.where(self._there[:, None], self._spread(H)[self._places], 0.0)
        return self._spread(g), every

    def _spread(self, values: FloatArray) -> FloatArray:
        """Return derivatives along the last axis in the experiment's times and parameters, 0 in the times of jumps."""
        found: FloatArray = values[..., self._places]
        return found if self._has_all else np.where(self._there, found, 0.0)

    def constrained(
        self, tau: FloatArray, p: FloatArray, side: float, multipliers: FloatArray
    ) -> Evaluation[FloatArray] | None:
        """Return J and the constraints, with the Hessian of ``J + multipliers . c``; the multipliers are (m,).

        None if a finiteness check failed.
        """
        where = self._constraint_rows
        with self._workspace.lock:
            self._multipliers[where] = multipliers
            try:
                self._run(tau, p, side)
            finally:
                self._multipliers[:] = 0.0
            if self._has_failed_check:
                return None
            g, H = self._read_derivatives()
            c = self._constraints[where]
            A = self._spread(self._jacobian[where])
            return Evaluation(self._J.item(0), g - multipliers.dot(A), H, c, A, self._read_errors())

    def program_at(self, tau: FloatArray, p: FloatArray) -> Callable[[], object]:
        """Return a function that runs the machine code alone, for benchmarks."""
        self(tau, p, 1.0)
        return lambda: self._call_in_pieces(self._evaluate, *self._counts)

    @property
    def _has_failed_check(self) -> bool:
        """Whether a product with zero was left out whose other factor was not finite.

        If the cost is not finite, it is returned without fallback: the caller rejects the point anyway.
        """
        check = self._check.item(0)
        return check != check and math.isfinite(self._J.item(0))

    def cost(self, tau: FloatArray, p: FloatArray) -> float | None:
        """Return J alone; None if a finiteness check failed."""
        with self._workspace.lock:
            self._run(tau, p, 1.0)
            return None if self._has_failed_check else self._J.item(0)

    def costs(self, places: NDArray[np.int64], times: FloatArray, p: FloatArray) -> FloatArray | None:
        """Return J of B schedules: (B,); NaN where a finiteness check failed, None if samples come late.

        Parameters
        ----------
        places : (B, P) int64 array
            For each what `join_places` returns.
        times : (B, N) array
            Transition times, tf for those that a schedule does not need.
        p : (M,) array
        """
        if self._late:
            return None
        B = len(times)
        bounds = np.empty((B, self.sizes.N + 2))
        bounds[:, 0], bounds[:, 1:-1], bounds[:, -1] = self.times[0], times, self.times[-1]
        first_cell = np.zeros(bounds.shape, dtype=np.int64)
        first_cell[:, 1:-1] = self._inner_nodes.searchsorted(times, "right")
        first_cell[:, -1] = self._cells - 1
        places, found, done = np.ascontiguousarray(places), np.empty((B, 2)), np.zeros(1, dtype=np.int64)
        pointer, number = ctypes.c_void_p, ctypes.c_int64
        types = pointer, pointer, number, *[pointer] * 4, *[number] * len(self._counts)
        function = self._program.function(f"{self._prefix}all_costs", *types)
        kept = self._named["bounds"].copy(), self._named["first_cell"].copy()
        with self._workspace.lock:
            self._own_p[:] = p
            self._workspace.reserve(self._size)
            if self._memory is not self._workspace.memory:
                self._bind(self._workspace.memory)
            before = 0
            while before < B:  # Ctrl-C is handled after each call
                given = [get_address(a[before:]) for a in (places, bounds, first_cell, found)]
                function(self._address, get_address(done), B - before, *given, *self._counts)
                before += int(done[0])
            self._named["bounds"][:], self._named["first_cell"][:] = kept
            self._write_places()
        return np.where(np.isfinite(found[:, 0]) & np.isnan(found[:, 1]), np.nan, found[:, 0])

    def _write_places(self) -> None:
        """Write the modes of the sequence, and the functions at its transitions, into the workspace."""
        for name, which in places_in_library(self.structure).items():
            self._named[name][:] = which
        self._named["modes"][-1] = self._judged

    def simulate(self, tau: FloatArray, p: FloatArray) -> Simulated | None:
        """Return the states at the ends of all rows, at second order with tangents; None if a check failed."""
        with self._workspace.lock:
            return self._simulate(tau, p)

    def _simulate(self, tau: FloatArray, p: FloatArray) -> Simulated | None:
        self._run(tau, p, 1.0)
        if self._has_failed_check:
            return None
        n, N, cells = self.sizes.n, self.structure.N, self._cells
        first_cell = self._first_cell[: N + 1].copy()
        firsts, lasts = first_cell.tolist(), [*first_cell[1:].tolist(), cells - 1]
        ends = zip(firsts, lasts, [*tau.tolist(), self.times[-1]], strict=True)
        inside = [np.append(self.times[first + 1 : last + 1], end) for first, last, end in ends]

        def of_rows(name: str, count: int, *shape: int) -> FloatArray:
            values = self._named[name].reshape(-1, *shape)[:count]
            return self._spread(values) if len(shape) > 1 else np.array(values)

        behind = N if self.structure.library.reset_maps else 0
        with_tangents = cells + N + 1 if self.order >= Order.HESSIAN else 0
        return Simulated(
            self._J.item(0),
            first_cell,
            np.concatenate([self.times[:1], *inside]),
            of_rows("states", cells + N + 1, n),
            of_rows("reset_states", behind, n),
            of_rows("tangents", with_tangents, n, self.sizes.width),
            of_rows("reset_tangents", behind, n, self.sizes.width),
            {k: self._late_states(k, len(times)) for k, _, times, _, _ in self._late},
        )

    def sweep_back(
        self, tau: FloatArray, p: FloatArray, multipliers: FloatArray
    ) -> tuple[Simulated, FloatArray] | None:
        """Return a simulation, and the costate of ``J + multipliers . c`` at the start of each row, (R, n).

        None if a finiteness check failed.
        """
        with self._workspace.lock:
            self._multipliers[self._constraint_rows] = multipliers
            try:
                found = self._simulate(tau, p)
            finally:
                self._multipliers[:] = 0.0
            if found is None:
                return None
            return found, np.array(self._named["costates"].reshape(-1, self.sizes.n)[: len(found.times) - 1])

    def slopes(
        self, times: FloatArray, cells: NDArray[np.intp], states: FloatArray, p: FloatArray
    ) -> FloatArray | None:
        """Return f of all modes of the library at times (L,) in cells (L,) and states (L, n): (L, modes, n).

        None if a finiteness check failed.
        """
        count, n, modes = len(times), self.sizes.n, len(self.structure.modes)
        slopes = np.zeros((count, modes, n + 1))
        if count:
            self._own_p[:] = p
            pointer = ctypes.c_void_p
            function = self._program.function(
                f"{self._prefix}all_slopes", pointer, pointer, ctypes.c_int64, *[pointer] * 4
            )
            given = np.ascontiguousarray(times), cells.astype(np.int64), np.column_stack([states, np.zeros(count)])
            self._check[0] = 0.0
            self._call_in_pieces(function, count, *(a.ctypes.data for a in (*given, slopes)))
            if np.isnan(self._check[0]):
                return None
        return slopes[..., :-1]

    def _late_states(self, k: int, count: int) -> tuple[FloatArray, FloatArray]:
        """Return the times (K,) at which late samples of the k-th Measurements saw the state, and the states (K, n)."""
        times, states = np.zeros(count), np.zeros((count, self.sizes.n))
        pointer = ctypes.c_void_p
        types = [pointer, ctypes.c_int64, pointer, pointer]
        find = self._program.function(f"{self._prefix}late_states_{k}", *types)
        find(self._address, count, times.ctypes.data, states.ctypes.data)
        return times, states

    def outputs(
        self, times: FloatArray, states: FloatArray, p: FloatArray, tangents: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray] | None:
        """Return the outputs of all sensors (L, q), and their tangents if those of the states (L, n, D) are given.

        None if a finiteness check failed.
        """
        count, (n, width) = len(times), (self.sizes.n, self.sizes.width)
        y, Y = np.zeros((count, self._channels)), np.zeros((count, self._channels, width))
        Z = np.zeros((count, n, width) if tangents is not None else 0)
        if tangents is not None:
            Z[..., self._places[self._there]] = tangents[..., self._there]
        if count:
            self._own_p[:] = p
            pointer = ctypes.c_void_p
            types = [pointer, pointer, ctypes.c_int64, *[pointer] * 5]
            function = self._program.function(f"{self._prefix}all_outputs", *types)
            given = [np.ascontiguousarray(times), np.ascontiguousarray(states), Z, y, Y]
            self._check[0] = 0.0
            self._call_in_pieces(function, count, *(a.ctypes.data for a in given))
            if np.isnan(self._check[0]):
                return None
        return y, self._spread(Y)

    def initial_state(self, p: FloatArray) -> FloatArray:
        """Return x(t0): (n,); NaN if a finiteness check failed."""
        self._own_p[:] = p
        x = np.zeros(self.sizes.n)
        return x + self._call("start", START, {"x": x})

    def after_reset(self, i: int, t: float, x: FloatArray, p: FloatArray) -> FloatArray:
        """Return the state after the reset map of transition i (from 0): (n,); NaN if a finiteness check failed."""
        self._own_p[:] = p
        which = int(self._named["resets"][i])
        given = {"time": np.array([t]), "x": np.array(x, dtype=float), "x_after": np.zeros(self.sizes.n)}
        given |= {"moves": self._named["units"][i + 1]}
        return given["x_after"] + self._call(f"reset_{which}", RESET, given)

    def slope(self, mode: int, t: float, y: FloatArray, p: FloatArray, cell: int | None = None) -> FloatArray:
        """Return f and ell at t, y = (x, running cost so far): (n + 1,); NaN if a finiteness check failed.

        The signals are those of `cell`; by default, of the cell that holds t (at a node, of the later one).
        """
        self._own_p[:] = p
        if cell is None:
            cell = min(max(int(self.times.searchsorted(t, "right")) - 1, 0), len(self.times) - 2)
        moment, slope = np.array([t, self.times[cell]]), np.zeros(len(y))
        signal = self._named["signals"][cell]
        return slope + self._call(f"slope_{mode}", SLOPE, {"moment": moment, "signal": signal, "y": y, "K": slope})

    def adaptive_steps(
        self, mode: int, state: FloatArray, y: FloatArray, p: FloatArray, most: int
    ) -> tuple[FloatArray, FloatArray]:
        """Take up to `most` adaptive steps from `state` and y, which are updated; return the accepted times (L,) and
        states (L, n).

        y is NaN if a finiteness check failed. If the budget is spent, it returns early, possibly without a step: call
        it again.

        Parameters
        ----------
        state : array
            See `Adaptive`.
        y : (n + 1,) array
            State and running cost so far.
        """
        self._own_p[:] = p
        rows, count = np.empty((most, 1 + len(y))), np.zeros(1, dtype=np.int64)
        pointer, number = ctypes.c_void_p, ctypes.c_int64
        types = [pointer, number, pointer, pointer, pointer, number, pointer]
        solve = self._program.function(f"{self._prefix}adaptive_{mode}_steps", *types)
        addresses = [a.ctypes.data for a in (state, y, rows, count)]
        self._check[0] = 0.0
        solve(self._address, self._cells, *addresses[:3], most, addresses[3])
        y += self._check[0]
        return rows[: count[0], 0], rows[: count[0], 1:-1]

    def _call(self, name: str, order: tuple[str, ...], given: dict[str, FloatArray]) -> float:
        """Call a straight-line function; pointers that are not given are those of the arguments.

        Return 0, or NaN if a finiteness check failed.
        """
        check = np.zeros(1)
        addresses = [get_address(given[key]) if key in given else self._addresses.get(key) for key in order[:-1]]
        addresses.append(get_address(check))
        self._program.function(f"{self._prefix}{name}", *[ctypes.c_void_p] * len(order))(*addresses)
        return float(check[0])

    def _run(self, tau: FloatArray, p: FloatArray, side: float) -> None:
        self._tau[:] = tau
        self._own_p[:] = p
        self._find_first_cells(tau, side)
        self._workspace.reserve(self._size)
        if self._memory is not self._workspace.memory:
            self._bind(self._workspace.memory)
        self._sums[:] = 0.0
        for part in self._zeroed:
            part[:] = 0.0
        if self._late:
            self._find_late_cells(p)
        self._call_in_pieces(self._evaluate, *self._counts)

    def _call_in_pieces(self, function: Callable[..., object], *given: Any) -> None:
        """Call a function of the driver until it has finished; Ctrl-C is handled after each call."""
        progress = self._progress
        progress[0] = progress[1] = 0
        while progress[0] >= 0:
            progress[2] = BUDGET
            function(self._address, self._progress_address, *given)

    def _bind(self, workspace: FloatArray) -> None:
        """Store the addresses of another workspace in the table."""
        self._memory = workspace
        found = _split_array(workspace, self._lengths)
        self._zeroed = [found[name] for name in ZEROED if found[name].size]
        self._named |= found
        self._table[self._in_memory] = _list_addresses(workspace, self._lengths)

    def _find_first_cells(self, tau: FloatArray, side: float) -> None:
        """Find the cells in which segments begin, as in `switchfit.discretization.mesh.rows`."""
        if len(tau):
            nodes = self._inner_nodes
            begins = nodes.searchsorted(tau, "right" if side > 0 else "left")
            if side <= 0 and self.structure.jumps:  # as in `Structure.fix_sides` and `count_passed`
                jumps = list(self.structure.jumps)
                begins[jumps] = nodes.searchsorted(tau[jumps], "right")
                begins = np.maximum.accumulate(begins)
            self._begins[:] = begins

    def _find_late_cells(self, p: FloatArray) -> None:
        """Find the cells and segments of the late samples: those of the rows with ``start < t - delay <= end``."""
        for _, name, times, cell, segment in self._late:
            place, value = self._delays[name]
            seen = times - (value if place is None else p[place])
            cell[:] = np.clip(self.times.searchsorted(seen, "left") - 1, 0, self._cells - 1)
            segment[:] = self._tau.searchsorted(seen, "left")


def _split_array(whole: FloatArray, lengths: dict[str, int]) -> dict[str, FloatArray]:
    """Return consecutive parts of an array by their names and lengths."""
    ends = accumulate(lengths.values())
    return {name: whole[end - length : end] for (name, length), end in zip(lengths.items(), ends, strict=True)}


def _list_addresses(whole: FloatArray, lengths: dict[str, int]) -> list[int]:
    """Return the addresses of consecutive parts of an array."""
    first, begins = get_address(whole), accumulate(lengths.values(), initial=0)
    return [first + whole.itemsize * begin for _, begin in zip(lengths, begins, strict=False)]


def get_address(array: NDArray[Any]) -> int:
    """Return the address of the first entry of an array."""
    return int(array.ctypes.data)  # half of the time of `__array_interface__`


def _find_delays(structure: Structure, arguments: Arguments) -> dict[str, tuple[int | None, float]]:
    """Return the position in p of each scalar parameter, or its value if it is fixed."""
    found: dict[str, tuple[int | None, float]] = {}
    fixed, position = iter(arguments.fixed), 0
    for name, shape, free in structure.parameters:
        value = np.nan if free else np.asarray(next(fixed))
        if shape == ():
            found[name] = (position if free else None, float(value))
        position += int(np.prod(shape)) if free else 0
    return found


def count_samples(samples: Samples) -> int:
    """Return the number of samples up to the last with a nonzero weight, at least 1; the rest is padding."""
    there = np.flatnonzero(np.asarray(samples.weight).any(1))
    return int(there[-1]) + 1 if len(there) else 1
