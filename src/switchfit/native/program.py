"""One experiment's cost, gradient and Hessian as one function of machine code.

Rows are numbered by ``cell + segment``: each transition cuts one cell in two. The driver goes through the segments
forward, then through samples and terminal costs, then backward. Whatever lies between calls lies in one workspace.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.data import FloatArray
from switchfit.model import Arguments, Samples, Structure, float64
from switchfit.native.driver import POINTERS, Driver
from switchfit.native.frame import handler
from switchfit.native.kernels import END, RESET, SAMPLE, SLOPE, STAGES, START, Kernels, Sizes, constants_of
from switchfit.native.llvm import Program, compiled
from switchfit.native.trace import Unsupported
from switchfit.rungekutta import EXPLICIT

_one_at_a_time = threading.Lock()


def program_of(structure: Structure, sizes: Sizes, order: int) -> Program | None:
    """Machine code for a structure, with derivatives up to an order of 2; None where JAX has to do its work.

    That is so for implicit steps, for delays that are estimated, and for functions that cannot be written as a straight
    line of scalars.
    """
    with _one_at_a_time:
        return _program_of(structure, sizes, order)


@lru_cache(maxsize=64)
def _program_of(structure: Structure, sizes: Sizes, order: int) -> Program | None:
    late = any(sensor.delay is not None for sensor in structure.measurements)
    if structure.tableau is not EXPLICIT or late or sizes.D == 0:
        return None
    try:
        with float64():
            text = _text(structure, sizes, order)
    except Unsupported:
        return None
    return compiled(text)


def _text(structure: Structure, sizes: Sizes, order: int) -> str:
    kernels = Kernels(structure, sizes, order)
    driver = Driver(structure, sizes, order)
    for mode in range(len(structure.modes)):
        stage = kernels.at_stage(mode)
        counts = []
        for kind in ("inner", "end"):
            kernels.forward_row(f"forward_{kind}_{mode}", stage, kind == "end")
            if order > 0:
                chosen = kernels.backward_row(f"backward_{kind}_{mode}", stage, kind == "end")
                counts.append(len(chosen))
            if order == 2:
                kernels.curvature_function(f"curvature_{kind}_{mode}", chosen, kind == "end")
        kernels.module.add(driver.forward_segment(mode))
        if order == 0:
            kernels.slope_function(f"slope_{mode}", stage)
            kernels.module.add(driver.slope_at(mode))
            kernels.module.add(driver.adaptive(mode))
        if order > 0:
            kernels.module.add(driver.backward_segment(mode, *counts))
    for k in range(len(structure.measurements)):
        template = kernels.at_sample(k)
        q = structure.measurements[k].channels

        def sample(graph: Any, x: Any, p: Any, constants: Any, template: Any = template, q: int = q) -> Any:
            given = graph.load("time", 0), graph.loads("value", q), graph.loads("weight", q)
            return template(graph, *given, x, p, *constants)

        kernels.cost_function(f"sample_{k}", SAMPLE, sample, "jump")
        kernels.module.add(driver.samples(k, q))
    if structure.terminal:
        end = kernels.at_end()
        kernels.cost_function("end", END, lambda graph, x, p, constants: end(graph, x, p, *constants), "psi")
    for i in structure.resets:
        kernels.reset_functions(i)
    kernels.start_functions()
    if order == 2:
        kernels.length_function()
    if order == 0:
        kernels.output_function()
        kernels.adaptive_functions()
        kernels.module.add(driver.outputs())
    kernels.module.add(driver.whole())
    if order == 2:
        kernels.module.add(handler(driver))
    return kernels.module.text


def native_experiment(
    structure: Structure, arguments: Arguments, times: FloatArray, order: int
) -> NativeExperiment | None:
    """One experiment in machine code, on the mesh with the nodes `times`; None where JAX has to do it."""
    sizes = Sizes.of(structure, arguments)
    program = program_of(structure, sizes, order)
    return None if program is None else NativeExperiment(program, structure, sizes, arguments, times, order)


class Simulated(NamedTuple):
    """States and outputs of a simulation.

    Attributes
    ----------
    cost : J
    first_cell : (N + 1,) int, cell in which each segment begins
    states, outputs : (R + 1, n), (R + 1, q)
        Of R = cells + N rows: at t0, then at the end of each row, before a jump.
    reset_states, reset_outputs : (N, n), (N, q), behind the reset maps; meaningless where there is none
    """

    cost: float
    first_cell: NDArray[np.int64]
    states: FloatArray
    outputs: FloatArray
    reset_states: FloatArray
    reset_outputs: FloatArray


class NativeExperiment:
    """One experiment on one mesh in machine code.

    Parameters
    ----------
    program : Program
    structure : Structure
    sizes : Sizes
    arguments : Arguments
        Padded or not.
    times : (G + 1,) array
        The nodes without the padding.
    order : int
        Of the derivatives: 0 for `cost` and `simulated`, 1 and 2 for calls.
    """

    def __init__(
        self,
        program: Program,
        structure: Structure,
        sizes: Sizes,
        arguments: Arguments,
        times: FloatArray,
        order: int,
    ) -> None:
        self.sizes, self.order = sizes, order
        n, N, D, width, cells = sizes.n, sizes.N, sizes.D, sizes.width, len(times) - 1
        rows = cells + N
        q = sum(channels for _, channels in structure.outputs)
        counts = [_count(samples) for samples in arguments.samples]
        types = [ctypes.c_void_p, ctypes.c_int64, ctypes.c_double, ctypes.c_double, *[ctypes.c_int64] * len(counts)]
        self._program = program  # whose code must not go away
        self._evaluate = program.function("evaluate", *types)
        self._all_outputs = program.function("all_outputs", *types[:2]) if order == 0 else None
        self._times = times
        self._scalars = (cells, float(times[0]), float(times[-1]), *counts)
        constants = [np.ravel(np.asarray(a, dtype=np.float64)) for a in constants_of(arguments)]
        units = np.zeros((D + 1, width))
        units[1:, :D] = np.eye(D)
        seen, first, second = (rows if kept else 0 for kept in (order == 0, order > 0, order == 2))
        self._theta, self._first_cell = np.zeros(D), np.zeros(N + 1, dtype=np.int64)
        self._sums = np.zeros(n + 1 + width + D * width)
        self._states = np.zeros((rows + 1 + N, n))
        self._jumps = np.zeros((first + 1) * n if counts else n)
        self._moments, self._outputs = np.zeros(seen + 1 + N), np.zeros((seen + 1 + N, q))
        arrays: dict[str, Any] = {
            "nodes": np.ascontiguousarray(times),
            "signals": np.ascontiguousarray(np.asarray(arguments.signals)[:cells]),
            "c": np.concatenate([*constants, np.zeros(1)]),
            "p": self._theta[N:],
            "tau": self._theta,
            "first_cell": self._first_cell,
            "states": self._states,
            "tangents": np.zeros((second + 1) * n * width),
            "stages": np.zeros(first * STAGES * n),
            "stage_tangents": np.zeros(second * STAGES * n * width),
            "jumps": self._jumps,
            "units": units,
            "psi": self._sums,
            "J": self._sums[n:],
            "g": self._sums[n + 1 :],
            "H": self._sums[n + 1 + width :],
            "reset_states": self._states[rows + 1 :],
            "reset_tangents": np.zeros(N * n * width),
            "entries": np.zeros(STAGES * (1 + n + sizes.M) ** 2),
            "length": np.zeros(width),
            "times": self._moments,
            "y": self._outputs,
        }
        self._named: dict[str, Any] = arrays
        self._arrays = [arrays[name] for name in POINTERS]
        for samples, count in zip(arguments.samples, counts, strict=True):
            for values, kind in zip(samples, (np.int64, float, float, float), strict=True):
                self._arrays.append(np.ascontiguousarray(np.asarray(values)[:count], dtype=kind))
        self._table = np.array([a.__array_interface__["data"][0] for a in self._arrays], dtype=np.uintp)
        self._address = self._table.ctypes.data
        self._result = self._sums[n + 1 : n + 1 + D], self._sums[n + 1 + width :].reshape(D, width)[:, :D]

    def __call__(self, tau: FloatArray, p: FloatArray, side: float) -> tuple[float, FloatArray, FloatArray]:
        """J, its gradient (D,) and its Hessian (D, D), NaN without it; as in `switchfit.evaluate.derivatives`."""
        self._run(tau, p, side)
        g, H = self._result
        hessian = H.copy() if self.order == 2 else np.full(H.shape, np.nan)
        return float(self._sums[self.sizes.n]), g.copy(), hessian

    def program_at(self, tau: FloatArray, p: FloatArray) -> Callable[[], object]:
        """The machine code alone, to be measured."""
        self(tau, p, 1.0)
        return lambda: self._evaluate(self._address, *self._scalars)

    def cost(self, tau: FloatArray, p: FloatArray) -> float:
        """J alone."""
        self._run(tau, p, 1.0)
        return float(self._sums[self.sizes.n])

    def simulated(self, tau: FloatArray, p: FloatArray) -> Simulated:
        """States and outputs at all ends of rows."""
        cells = self._scalars[0]
        rows = cells + self.sizes.N
        self._place(tau, 1.0)
        ends = np.append(self._first_cell[1:], cells - 1)
        self._moments[: rows + 1] = np.concatenate(
            [self._times[:1]]
            + [
                np.append(self._times[first + 1 : last + 1], end)
                for first, last, end in zip(self._first_cell, ends, [*tau, self._times[-1]], strict=True)
            ]
        )
        self._moments[rows + 1 :] = tau
        self._run(tau, p, 1.0)
        if self._all_outputs is not None:
            self._all_outputs(self._address, cells)
        of_states, of_outputs = ((a[: rows + 1].copy(), a[rows + 1 :].copy()) for a in (self._states, self._outputs))
        return Simulated(
            float(self._sums[self.sizes.n]),
            self._first_cell.copy(),
            of_states[0],
            of_outputs[0],
            of_states[1],
            of_outputs[1],
        )

    def initial_state(self, p: FloatArray) -> FloatArray:
        """x(t0): (n,)."""
        self._theta[self.sizes.N :] = p
        self._call("start", START, {"x": self._states})
        return self._states[0].copy()

    def after_reset(self, i: int, t: float, x: FloatArray, p: FloatArray) -> FloatArray:
        """State after the reset map of transition i (from 0): (n,)."""
        self._theta[i], self._theta[self.sizes.N :] = t, p
        before, after = np.array(x, dtype=float), np.zeros(self.sizes.n)
        self._call(f"reset_{i}", RESET, {"x": before, "x_after": after})
        return after

    def slope(self, mode: int, t: float, y: FloatArray, p: FloatArray) -> FloatArray:
        """f and ell at t, y = (x, running cost so far): (n + 1,). At a knot that of the signal from there on."""
        self._theta[self.sizes.N :] = p
        cell = min(max(int(self._times.searchsorted(t, "right")) - 1, 0), len(self._times) - 2)
        moment, slope = np.array([t, self._times[cell]]), np.zeros(len(y))
        signal = self._named["signals"][cell]
        self._call(f"slope_{mode}", SLOPE, {"moment": moment, "signal": signal, "y": y, "K": slope})
        return slope

    def adaptive_steps(self, mode: int, state: FloatArray, y: FloatArray, p: FloatArray, most: int) -> FloatArray:
        """Up to `most` steps of SciPy's RK45, from `state` and y, which change: the moments reached.

        Parameters
        ----------
        state : array
            See `Adaptive`.
        y : (n + 1,) array
            State and running cost so far.
        """
        self._theta[self.sizes.N :] = p
        times, count = np.zeros(most), np.zeros(1, dtype=np.int64)
        pointer, number = ctypes.c_void_p, ctypes.c_int64
        types = [pointer, number, pointer, pointer, pointer, number, pointer]
        solve = self._program.function(f"adaptive_{mode}_steps", *types)
        addresses = [a.ctypes.data for a in (state, y, times, count)]
        solve(self._address, self._scalars[0], *addresses[:3], most, addresses[3])
        return times[: count[0]]

    def _call(self, name: str, order: tuple[str, ...], given: dict[str, FloatArray]) -> None:
        """One of the straight lines; what is not given it finds where the driver does."""
        arrays = [given[key] if key in given else self._named.get(key) for key in order]
        addresses = [None if a is None else a.ctypes.data for a in arrays]
        self._program.function(name, *[ctypes.c_void_p] * len(order))(*addresses)

    def _run(self, tau: FloatArray, p: FloatArray, side: float) -> None:
        N = self.sizes.N
        self._theta[:N] = tau
        self._theta[N:] = p
        self._place(tau, side)
        self._sums[:] = 0.0
        self._jumps[:] = 0.0
        self._evaluate(self._address, *self._scalars)

    def _place(self, tau: FloatArray, side: float) -> None:
        """The cells in which segments begin, as in `switchfit.mesh.rows`."""
        if self.sizes.N:
            passed = self._times.searchsorted(tau, "right" if side > 0 else "left")
            self._first_cell[1:] = np.minimum(np.maximum(passed - 1, 0), self._scalars[0] - 1)


def _count(samples: Samples) -> int:
    """Number of samples up to the last that has a value: what follows is padding."""
    there = np.flatnonzero(np.asarray(samples.weight).any(1))
    return int(there[-1]) + 1 if len(there) else 1
