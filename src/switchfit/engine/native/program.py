"""Machine code for a structure, and what evaluates and simulates one experiment on one mesh with it.

The driver goes through the segments forward, then through samples and terminal costs, then backward. Whatever lies
between the parts of an evaluation lies in one workspace, which is made once a mesh.
"""

from __future__ import annotations

import ctypes
import logging
import math
import threading
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.discretization.arguments import Arguments, Samples
from switchfit.discretization.tableaus import EXPLICIT, tableau_of
from switchfit.engine.native.driver import POINTERS, Driver
from switchfit.engine.native.frame import handler
from switchfit.engine.native.kernels import END, RESET, SAMPLE, SLOPE, STAGES, START, Kernels, Sizes, constants_of
from switchfit.engine.native.llvm import BUDGET, Module, Program, compiled
from switchfit.engine.native.scalars import CHECKED
from switchfit.engine.native.trace import Unsupported
from switchfit.problem.data import FloatArray
from switchfit.problem.functions import float64
from switchfit.problem.structure import Structure

_one_at_a_time = threading.Lock()

log = logging.getLogger("switchfit")


PREFIX = {0: "plain_", 1: "first_", 2: ""}
"""What the names of functions begin with, by the order of their derivatives."""


def program_of(structure: Structure, sizes: Sizes, order: int) -> Program | str:
    """Machine code for a structure, with derivatives of an order; or the reason why JAX has to do its work.

    That is so for implicit steps, for delays that are estimated, and for functions that cannot be written as a straight
    line of scalars. A fit needs simulations and second derivatives: they are one program. Whatever else goes wrong is a
    defect of this package: JAX then does the work as well, and the reason begins with "internal: ".
    """
    with _one_at_a_time:
        return _program_of(structure, sizes, (1,) if order == 1 else (0, 2))


@lru_cache(maxsize=64)
def _program_of(structure: Structure, sizes: Sizes, orders: tuple[int, ...]) -> Program | str:
    try:
        return _compiled(structure, sizes, orders)
    except Unsupported as error:
        reason = str(error)
        log.info("Evaluated by JAX: %s.", reason)
    except Exception as error:
        reason = f"internal: {type(error).__name__}: {error}"
        log.info("Evaluated by JAX: %s.", reason, exc_info=True)
    return reason


def _compiled(structure: Structure, sizes: Sizes, orders: tuple[int, ...]) -> Program:
    if tableau_of(structure.solver) is not EXPLICIT:
        raise Unsupported(f"solver={structure.solver!r} takes implicit steps")
    if any(sensor.delay is not None for sensor in structure.measurements):
        raise Unsupported("a delay is estimated")
    if sizes.D == 0:
        raise Unsupported("an experiment has no unknowns")
    module = Module(sizes.width)
    with float64():
        for order in orders:
            module.prefix = PREFIX[order]
            _write(module, structure, sizes, order)
    return compiled(module.text)


def forget_programs() -> None:
    """Let go of all machine code that nothing works with."""
    with _one_at_a_time:
        _program_of.cache_clear()


def _write(module: Module, structure: Structure, sizes: Sizes, order: int) -> None:
    """All functions of a structure with derivatives of an order."""
    kernels = Kernels(structure, sizes, order, module)
    driver = Driver(structure, sizes, order, module)
    if order == 0:
        kernels.adaptive_functions()
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
        module.add(driver.forward_segment(mode))
        if order == 0:
            kernels.slope_function(f"slope_{mode}", stage)
            module.add(driver.slope_at(mode))
            module.add(driver.adaptive(mode))
        if order > 0:
            module.add(driver.backward_segment(mode, *counts))
    for k in range(len(structure.measurements)):
        template = kernels.at_sample(k)
        q = structure.measurements[k].channels

        def sample(graph: Any, x: Any, p: Any, constants: Any, template: Any = template, q: int = q) -> Any:
            given = graph.load("time", 0), graph.loads("value", q), graph.loads("weight", q)
            return template(graph, *given, x, p, *constants, checked=True)

        kernels.cost_function(f"sample_{k}", SAMPLE, sample, "jump")
        module.add(driver.samples(k, q))
    if structure.terminal:
        end = kernels.at_end()

        def at_end(graph: Any, x: Any, p: Any, constants: Any) -> Any:
            return end(graph, x, p, *constants, checked=True)

        kernels.cost_function("end", END, at_end, "psi")
    for i in structure.resets:
        kernels.reset_functions(i)
    kernels.start_functions()
    kernels.state_function()
    if order == 2:
        kernels.length_function()
    if order != 1:
        kernels.output_function()
        module.add(driver.outputs())
    module.add(driver.whole())
    if order == 2:
        module.add(handler(driver))


def native_experiment(
    structure: Structure, arguments: Arguments, times: FloatArray, order: int
) -> NativeExperiment | None:
    """One experiment in machine code, on the mesh with the nodes `times`; None if there is a `reason_for_jax`."""
    sizes = Sizes.of(structure, arguments)
    program = program_of(structure, sizes, order)
    return None if isinstance(program, str) else NativeExperiment(program, structure, sizes, arguments, times, order)


def reason_for_jax(structure: Structure, arguments: Arguments, order: int) -> str | None:
    """Why JAX has to evaluate an experiment with derivatives of an order; None if machine code does."""
    program = program_of(structure, Sizes.of(structure, arguments), order)
    return program if isinstance(program, str) else None


class Simulated(NamedTuple):
    """A simulation: R = cells + N rows, one after the other.

    Attributes
    ----------
    cost : J
    first_cell : (N + 1,) int, cell in which each segment begins
    times, states, tangents : (R + 1,), (R + 1, n), (R + 1, n, D)
        At t0, then at the end of each row, before a jump. The tangents, in second order, are derivatives at an end that
        moves with theta where it is a transition.
    reset_states, reset_tangents : (N, n), (N, n, D), behind the reset maps; meaningless where there is none
    """

    cost: float
    first_cell: NDArray[np.int64]
    times: FloatArray
    states: FloatArray
    reset_states: FloatArray
    tangents: FloatArray
    reset_tangents: FloatArray


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
        self._prefix = PREFIX[order]
        self._workspace = program.workspace
        n, N, D, width, cells = sizes.n, sizes.N, sizes.D, sizes.width, len(times) - 1
        rows = cells + N
        self._channels = sum(channels for _, channels in structure.outputs)
        counts = [_count(samples) for samples in arguments.samples]
        pointer, number = ctypes.c_void_p, ctypes.c_int64
        types = [pointer, pointer, number, ctypes.c_double, ctypes.c_double, *[number] * len(counts)]
        self._program = program  # whose code must not go away
        self._evaluate = program.function(f"{self._prefix}evaluate", *types)
        self._times = times
        self._scalars = (cells, float(times[0]), float(times[-1]), *counts)
        constants = [np.ravel(np.asarray(a, dtype=np.float64)) for a in constants_of(arguments)]
        units = np.zeros((D + 1, width))
        units[1:, :D] = np.eye(D)
        first, second = (rows if kept else 0 for kept in (order > 0, order == 2))
        self._theta, self._first_cell = np.zeros(D), np.zeros(N + 1, dtype=np.int64)
        self._sums = np.zeros(n + 2 + width + D * width)
        lengths = {
            "states": (rows + 1) * n,
            "reset_states": N * n,  # behind the states
            "tangents": (second + 1) * n * width,
            "reset_tangents": N * n * width,
            "stages": first * STAGES * n,
            "stage_tangents": second * STAGES * n * width,
            "jumps": (first + 1) * n if counts else n,
            "entries": STAGES * (1 + n + sizes.M) ** 2,
            "length": width,
        }
        ends = np.cumsum(list(lengths.values())).tolist()
        self._spans = {
            name: slice(end - length, end) for (name, length), end in zip(lengths.items(), ends, strict=True)
        }
        self._size = ends[-1]
        self._memory = np.zeros(0)  # the workspace that the table points to
        arrays: dict[str, Any] = {
            "nodes": np.ascontiguousarray(times),
            "signals": np.ascontiguousarray(np.asarray(arguments.signals)[:cells]),
            "c": np.concatenate([*constants, np.zeros(1)]),
            "p": self._theta[N:],
            "tau": self._theta,
            "first_cell": self._first_cell,
            "units": units,
            "psi": self._sums,
            "J": self._sums[n:],
            "g": self._sums[n + 1 :],
            "H": self._sums[n + 1 + width : -1],
            CHECKED: self._sums[-1:],
        }
        self._named: dict[str, Any] = arrays
        self._arrays = [arrays.get(name, self._memory) for name in POINTERS]
        for samples, count in zip(arguments.samples, counts, strict=True):
            for values, kind in zip(samples, (np.int64, float, float, float), strict=True):
                self._arrays.append(np.ascontiguousarray(np.asarray(values)[:count], dtype=kind))
        self._table = np.array([a.__array_interface__["data"][0] for a in self._arrays], dtype=np.uintp)
        self._address = self._table.ctypes.data
        self._progress = (ctypes.c_int64 * 3)()
        self._result = self._sums[n + 1 : n + 1 + D], self._sums[n + 1 + width : -1].reshape(D, width)[:, :D]

    def __call__(self, tau: FloatArray, p: FloatArray, side: float) -> tuple[float, FloatArray, FloatArray] | None:
        """J, its gradient (D,) and its Hessian (D, D), NaN without it; as in `switchfit.fit.evaluator.derivatives`.

        None if a presumption was wrong: then JAX has to do it.
        """
        with self._workspace.lock:
            self._run(tau, p, side)
            if self._presumed_wrongly:
                return None
            g, H = self._result
            hessian = H.copy() if self.order == 2 else np.full(H.shape, np.nan)
            return float(self._sums[self.sizes.n]), g.copy(), hessian

    def program_at(self, tau: FloatArray, p: FloatArray) -> Callable[[], object]:
        """The machine code alone, to be measured."""
        self(tau, p, 1.0)
        return lambda: self._in_pieces(self._evaluate, *self._scalars)

    @property
    def _presumed_wrongly(self) -> bool:
        """Whether a product with zero was left out whose other factor was not finite.

        A cost that is not finite says enough as it is.
        """
        check = self._sums.item(-1)
        return check != check and math.isfinite(self._sums.item(self.sizes.n))

    def cost(self, tau: FloatArray, p: FloatArray) -> float | None:
        """J alone; None if a presumption was wrong."""
        with self._workspace.lock:
            self._run(tau, p, 1.0)
            return None if self._presumed_wrongly else float(self._sums[self.sizes.n])

    def simulated(self, tau: FloatArray, p: FloatArray) -> Simulated | None:
        """States at all ends of rows, in second order with their derivatives; None if a presumption was wrong."""
        with self._workspace.lock:
            return self._simulated(tau, p)

    def _simulated(self, tau: FloatArray, p: FloatArray) -> Simulated | None:
        self._run(tau, p, 1.0)
        if self._presumed_wrongly:
            return None
        n, D, cells = self.sizes.n, self.sizes.D, self._scalars[0]
        firsts, lasts = self._first_cell.tolist(), [*self._first_cell[1:].tolist(), cells - 1]
        ends = zip(firsts, lasts, [*tau.tolist(), self._times[-1]], strict=True)
        inside = [np.append(self._times[first + 1 : last + 1], end) for first, last, end in ends]
        tangents, behind = (
            self._named[name].reshape(-1, n, self.sizes.width) for name in ("tangents", "reset_tangents")
        )
        return Simulated(
            float(self._sums[n]),
            self._first_cell.copy(),
            np.concatenate([self._times[:1], *inside]),
            self._named["states"].reshape(-1, n).copy(),
            self._named["reset_states"].reshape(-1, n).copy(),
            tangents[..., :D].copy(),
            behind[..., :D].copy(),
        )

    def outputs(
        self, times: FloatArray, states: FloatArray, p: FloatArray, tangents: FloatArray | None = None
    ) -> tuple[FloatArray, FloatArray] | None:
        """What all sensors see, (L, q), and, where the derivatives (L, n, D) of the states are given, its own.

        None if a presumption was wrong.
        """
        count, (n, D, width) = len(times), (self.sizes.n, self.sizes.D, self.sizes.width)
        y, Y = np.zeros((count, self._channels)), np.zeros((count, self._channels, width))
        Z = np.zeros((count, n, width) if tangents is not None else 0)
        if tangents is not None:
            Z[..., :D] = tangents
        if count:
            self._theta[self.sizes.N :] = p
            pointer = ctypes.c_void_p
            types = [pointer, pointer, ctypes.c_int64, *[pointer] * 5]
            function = self._program.function(f"{self._prefix}all_outputs", *types)
            given = [np.ascontiguousarray(times), np.ascontiguousarray(states), Z, y, Y]
            self._sums[-1] = 0.0
            self._in_pieces(function, count, *(a.ctypes.data for a in given))
            if np.isnan(self._sums[-1]):
                return None
        return y, Y[..., :D]

    def initial_state(self, p: FloatArray) -> FloatArray:
        """x(t0): (n,); NaN if a presumption was wrong."""
        self._theta[self.sizes.N :] = p
        x = np.zeros(self.sizes.n)
        return x + self._call("start", START, {"x": x})

    def after_reset(self, i: int, t: float, x: FloatArray, p: FloatArray) -> FloatArray:
        """State after the reset map of transition i (from 0): (n,); NaN if a presumption was wrong."""
        self._theta[i], self._theta[self.sizes.N :] = t, p
        before, after = np.array(x, dtype=float), np.zeros(self.sizes.n)
        return after + self._call(f"reset_{i}", RESET, {"x": before, "x_after": after})

    def slope(self, mode: int, t: float, y: FloatArray, p: FloatArray, cell: int | None = None) -> FloatArray:
        """f and ell at t, y = (x, running cost so far): (n + 1,); NaN if a presumption was wrong.

        With the signals of a cell; left out, of the one that holds t, or begins there.
        """
        self._theta[self.sizes.N :] = p
        if cell is None:
            cell = min(max(int(self._times.searchsorted(t, "right")) - 1, 0), len(self._times) - 2)
        moment, slope = np.array([t, self._times[cell]]), np.zeros(len(y))
        signal = self._named["signals"][cell]
        return slope + self._call(f"slope_{mode}", SLOPE, {"moment": moment, "signal": signal, "y": y, "K": slope})

    def adaptive_steps(self, mode: int, state: FloatArray, y: FloatArray, p: FloatArray, most: int) -> FloatArray:
        """Up to `most` steps of SciPy's RK45, from `state` and y, which change: the moments reached.

        y is NaN if a presumption was wrong.

        They may be fewer, even none: after some work that takes milliseconds it returns, to be called again.

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
        solve = self._program.function(f"{self._prefix}adaptive_{mode}_steps", *types)
        addresses = [a.ctypes.data for a in (state, y, times, count)]
        self._sums[-1] = 0.0
        solve(self._address, self._scalars[0], *addresses[:3], most, addresses[3])
        y += self._sums[-1]
        return times[: count[0]]

    def _call(self, name: str, order: tuple[str, ...], given: dict[str, FloatArray]) -> float:
        """One of the straight lines; what is not given it finds where the driver does.

        Returns 0, or NaN if a presumption was wrong.
        """
        check = np.zeros(1)
        arrays = [given[key] if key in given else self._named.get(key) for key in order[:-1]]
        addresses = [None if a is None else a.ctypes.data for a in (*arrays, check)]
        self._program.function(f"{self._prefix}{name}", *[ctypes.c_void_p] * len(order))(*addresses)
        return float(check[0])

    def _run(self, tau: FloatArray, p: FloatArray, side: float) -> None:
        N = self.sizes.N
        self._theta[:N] = tau
        self._theta[N:] = p
        self._place(tau, side)
        self._workspace.reserve(self._size)
        if self._memory is not self._workspace.memory:
            self._bind(self._workspace.memory)
        self._sums[:] = 0.0
        self._named["jumps"][:] = 0.0
        self._in_pieces(self._evaluate, *self._scalars)

    def _in_pieces(self, function: Callable[..., object], *given: Any) -> None:
        """Call a function of the driver until it is at its end; Ctrl-C is heard after each call."""
        progress, address = self._progress, ctypes.addressof(self._progress)
        progress[0] = progress[1] = 0
        while progress[0] >= 0:
            progress[2] = BUDGET
            function(self._address, address, *given)

    def _bind(self, memory: FloatArray) -> None:
        """Let the table point to another workspace."""
        self._memory = memory
        for name, span in self._spans.items():
            self._named[name] = memory[span]
            if name in POINTERS:
                self._table[POINTERS.index(name)] = memory.ctypes.data + 8 * span.start

    def _place(self, tau: FloatArray, side: float) -> None:
        """The cells in which segments begin, as in `switchfit.discretization.mesh.rows`."""
        if self.sizes.N:
            passed = self._times.searchsorted(tau, "right" if side > 0 else "left")
            self._first_cell[1:] = np.minimum(np.maximum(passed - 1, 0), self._scalars[0] - 1)


def _count(samples: Samples) -> int:
    """Number of samples up to the last that has a value: what follows is padding."""
    there = np.flatnonzero(np.asarray(samples.weight).any(1))
    return int(there[-1]) + 1 if len(there) else 1
