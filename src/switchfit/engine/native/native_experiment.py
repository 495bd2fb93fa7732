"""One experiment on one mesh, evaluated and simulated by machine code with derivatives of one order."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.discretization.arguments import Arguments, count_samples
from switchfit.discretization.model import read_parameters
from switchfit.engine.evaluation import DenseEvaluation, Evaluation
from switchfit.engine.native.layout import get_address, layout_of
from switchfit.engine.native.library_places import find_own_directions, places_in_library
from switchfit.engine.native.llvm.compilation import Program
from switchfit.engine.native.program import program_of
from switchfit.engine.native.scalars.graph import CHECKED
from switchfit.engine.native.sizes import Order, Sizes, constants_of
from switchfit.engine.simulation import Simulation, Tangents
from switchfit.problem.structure import Structure
from switchfit.runtime.work import CALL, count_work


def native_experiment(
    structure: Structure, arguments: Arguments, times: FloatArray, order: Order
) -> NativeExperiment | None:
    """Return one experiment in machine code on the mesh with the nodes `times`; None if it cannot be compiled."""
    program = program_of(structure.library, Sizes.of(structure, arguments), order)
    return None if isinstance(program, str) else NativeExperiment(program, structure, arguments, times, order)


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
        self._work = CALL + (cells + N) * max(self._module.row_work, default=0.0)
        places = places_in_library(structure)
        given: dict[str, Any] = {
            "nodes": times,
            "signals": np.asarray(arguments.signals)[:cells],
            "c": np.concatenate([*constants_of(arguments), np.zeros(1)], axis=None),
            "p": np.zeros(max(sizes.M, 1)),
            "bounds": np.full(N + 2, times[0]),
            "first_cell": np.zeros(N + 2, dtype=np.int64),
            "multipliers": np.zeros(max(self._rows["count"], 1)),
            "units": find_own_directions(sizes, structure.N, structure.jumps)[0],
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
        # One block, which the driver clears by one call.
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
        _, self._places, self._there = find_own_directions(self.sizes, N, structure.jumps)
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
        # -2: the driver leaves the backward sweep out; see `loops.driver`.
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
                    # Row first_cell + segment begins with transition `segment`: its start is what the reset map left.
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
            See `switchfit.engine.native.loops.adaptive_steps.AT`.
        y : (n + 1,) array
            State and running cost so far.
        """
        self._own_p[:] = p
        rows, count = np.empty((most, 1 + len(y))), np.zeros(1, dtype=np.int64)
        # The steps add to the check, and nothing else clears it: `evaluate` clears the sums, a single function does
        # not.
        self._check[0] = 0.0
        given = self._address, self._cells, *map(get_address, (state, y, rows)), most, get_address(count)
        self._find(f"adaptive_{mode}_steps", len(given))(*given)
        count_work(CALL + count.item(0) * self.row_work[mode])
        # 0, or NaN: the solver's caller sees a state that is not finite.
        y += self._check[0]
        return rows[: count[0], 0], rows[: count[0], 1:-1]

    def _find(self, name: str, count: int) -> Callable[..., None]:
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
        count_work(self._work)
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


def _find_delay(structure: Structure, arguments: Arguments, name: str) -> tuple[int | None, float]:
    """Return the position in p of a scalar parameter, or its value if it is fixed."""
    positions = np.arange(float(structure.M))
    value = float(read_parameters(structure, arguments, positions)[name])
    is_free = any(read for other, _, read in structure.parameters if other == name)
    return (int(value), 0.0) if is_free else (None, value)
