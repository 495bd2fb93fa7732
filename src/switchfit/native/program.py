"""One experiment's cost, gradient and Hessian as one function of machine code.

Rows are numbered by ``cell + segment``: each transition cuts one cell in two. The driver goes through the segments
forward, then through samples and terminal costs, then backward. Whatever lies between calls lies in one workspace.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import numpy as np

from switchfit.data import FloatArray
from switchfit.model import Arguments, Samples, Structure, float64
from switchfit.native.kernels import (
    BACKWARD,
    CURVATURE,
    END,
    FORWARD,
    LENGTH,
    RESET,
    RESET_BACK,
    SAMPLE,
    STAGE_TIME,
    STAGES,
    Kernels,
    Sizes,
    constants_of,
)
from switchfit.native.llvm import Program, compiled
from switchfit.native.trace import Unsupported
from switchfit.rungekutta import EXPLICIT

POINTERS = (
    *("nodes", "signals", "c", "p", "tau", "first_cell", "states", "tangents", "stages", "stage_tangents", "jumps"),
    *("units", "psi", "J", "g", "H", "reset_states", "reset_tangents", "entries", "length"),
)
"""What the driver finds in its table of pointers; then four for each Measurements: cell, time, value, weight."""


_one_at_a_time = threading.Lock()


def program_of(structure: Structure, sizes: Sizes, second: bool) -> Program | None:
    """Machine code for a structure; None where JAX has to do its work.

    That is so for implicit steps, for delays that are estimated, and for functions that cannot be written as a straight
    line of scalars.
    """
    with _one_at_a_time:
        return _program_of(structure, sizes, second)


@lru_cache(maxsize=64)
def _program_of(structure: Structure, sizes: Sizes, second: bool) -> Program | None:
    if structure.tableau is not EXPLICIT or any(sensor.delay is not None for sensor in structure.measurements):
        return None
    try:
        with float64():
            text = _text(structure, sizes, second)
    except Unsupported:
        return None
    return compiled(text)


def _text(structure: Structure, sizes: Sizes, second: bool) -> str:
    kernels = Kernels(structure, sizes, second)
    driver = _Driver(structure, sizes, second)
    for mode in range(len(structure.modes)):
        stage = kernels.at_stage(mode)
        counts = []
        for kind in ("inner", "end"):
            kernels.forward_row(f"forward_{kind}_{mode}", stage, kind == "end")
            chosen = kernels.backward_row(f"backward_{kind}_{mode}", stage, kind == "end")
            if second:
                kernels.curvature_function(f"curvature_{kind}_{mode}", chosen)
            counts.append(len(chosen))
        kernels.module.add(driver.forward_segment(mode))
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
    if second:
        kernels.length_function()
        for j in range(STAGES):
            kernels.stage_time_function(j)
    kernels.module.add(driver.whole())
    return kernels.module.text


class _Driver:
    """The loops around the straight lines, written by hand."""

    def __init__(self, structure: Structure, sizes: Sizes, second: bool) -> None:
        self.structure, self.sizes, self.second = structure, sizes, second
        self.lines: list[str] = []
        self.count = 0

    def line(self, text: str) -> None:
        self.lines.append(f"  {text}")

    def let(self, text: str) -> str:
        self.count += 1
        self.line(f"%t{self.count} = {text}")
        return f"%t{self.count}"

    def at(self, pointer: str, *factors: Any) -> str:
        """Address of ``pointer[product of the factors]``, in doubles."""
        offset = str(factors[0])
        for factor in factors[1:]:
            offset = self.let(f"mul i64 {offset}, {factor}")
        return self.let(f"getelementptr inbounds double, ptr {pointer}, i64 {offset}")

    def pointers(self) -> dict[str, str]:
        """All pointers of the table, loaded."""
        found = {}
        for k, name in enumerate(POINTERS):
            found[name] = self.let(f"load ptr, ptr {self.at('%table', k)}")
        return found

    def call(self, name: str, order: tuple[str, ...], given: dict[str, str]) -> None:
        self.line(f"call void @{name}({', '.join(f'ptr {given[key]}' for key in order)})")

    def finished(self, signature: str) -> str:
        text = f"define {signature} {{\nentry:\n" + "\n".join(self.lines) + "\n  ret void\n}\n"
        self.lines, self.count = [], 0
        return text

    def _row(self, found: dict[str, str], cell: str) -> dict[str, str]:
        """Times, signals and directions of the row of a segment in a cell, and whether it is an end row."""
        N, S, width = self.sizes.N, self.sizes.signals, self.sizes.width
        first, last = self.let(f"icmp eq i64 {cell}, %first"), self.let(f"icmp eq i64 {cell}, %last")
        here = self.let(f"load double, ptr {self.at(found['nodes'], cell)}")
        after = self.let(f"add i64 {cell}, 1")
        there = self.let(f"load double, ptr {self.at(found['nodes'], after)}")
        start = self.let(f"select i1 {first}, double %begins, double {here}")
        end = self.let(f"select i1 {last}, double %finishes, double {there}")
        for k, value in enumerate((start, end, here)):
            self.line(f"store double {value}, ptr {self.at('%row', k)}")
        later, earlier = self.let("icmp sgt i64 %segment, 0"), self.let(f"icmp slt i64 %segment, {N}")
        opens, closes = self.let(f"and i1 {first}, {later}"), self.let(f"and i1 {last}, {earlier}")
        next_ = self.let("add i64 %segment, 1")
        opening, closing = (
            self.at(found["units"], self.let(f"select i1 {flag}, i64 {index}, i64 0"), width)
            for flag, index in ((opens, "%segment"), (closes, next_))
        )
        return {
            "row": "%row",
            "signal": self.at(found["signals"], cell, 4 * S),
            "opens": opening,
            "closes": closing,
            "first": first,
            "end row": self.let(f"or i1 {opens}, {closes}"),
        }

    def _at_row(self, found: dict[str, str], row: str) -> dict[str, str]:
        n, width = self.sizes.n, self.sizes.width
        return {
            "X": self.at(found["stages"], row, STAGES * n),
            "XZ": self.at(found["stage_tangents"], row, STAGES * n * width),
        }

    def forward_segment(self, mode: int) -> str:
        """All rows of a segment, forward."""
        n, width = self.sizes.n, self.sizes.width
        self.line("%row = alloca [3 x double]")
        found = self.pointers()
        self.line("br label %loop")
        self.lines.append("loop:")
        self.line("%cell = phi i64 [%first, %entry], [%more, %next]")
        place = self._row(found, "%cell")
        row = self.let("add i64 %cell, %segment")
        after = self.let(f"add i64 {row}, 1")
        x = self.let(f"select i1 {place['first']}, ptr %x, ptr {self.at(found['states'], row, n)}")
        Z = self.let(f"select i1 {place['first']}, ptr %Z, ptr {self.at(found['tangents'], row, n * width)}")
        given = found | place | self._at_row(found, row) | {"x": x, "Z": Z}
        given |= {
            "x_after": self.at(found["states"], after, n),
            "Z_after": self.at(found["tangents"], after, n * width),
        }
        self.line(f"br i1 {place['end row']}, label %is_end, label %is_inner")
        self.lines.append("is_end:")
        self.call(f"forward_end_{mode}", FORWARD, given)
        self.line("br label %next")
        self.lines.append("is_inner:")
        self.call(f"forward_inner_{mode}", FORWARD, given)
        self.line("br label %next")
        self.lines.append("next:")
        self.line("%more = add i64 %cell, 1")
        self.line("%done = icmp sgt i64 %more, %last")
        self.line("br i1 %done, label %out, label %loop")
        self.lines.append("out:")
        return self.finished(f"internal void @forward_{mode}({SEGMENT}, ptr %x, ptr %Z)")

    def backward_segment(self, mode: int, inner: int, end: int) -> str:
        """All rows of a segment, backward; with the numbers of entries of the second derivatives."""
        n, width = self.sizes.n, self.sizes.width
        self.line("%row = alloca [3 x double]")
        self.line(f"%Zt = alloca [{width} x double]")
        found = self.pointers()
        self.line("br label %loop")
        self.lines.append("loop:")
        self.line("%cell = phi i64 [%last, %entry], [%less, %next]")
        place = self._row(found, "%cell")
        row = self.let("add i64 %cell, %segment")
        after = self.let(f"add i64 {row}, 1")
        given = found | place | self._at_row(found, row) | {"jump": self.at(found["jumps"], after, n), "Zt": "%Zt"}
        self.line(f"br i1 {place['end row']}, label %is_end, label %is_inner")
        for kind, count in (("end", end), ("inner", inner)):
            self.lines.append(f"is_{kind}:")
            self.call(f"backward_{kind}_{mode}", BACKWARD, given)
            if self.second:
                if kind == "end":
                    self.call("length", LENGTH, given)
                for j in range(STAGES):
                    at_stage = {
                        "entries": self.at(found["entries"], j * count),
                        "Z": self.at(given["XZ"], j * n * width),
                    }
                    if kind == "end":
                        self.call(f"stage_time_{j}", STAGE_TIME, given)
                    self.call(f"curvature_{kind}_{mode}", CURVATURE, given | at_stage)
            self.line("br label %next")
        self.lines.append("next:")
        self.line("%less = sub i64 %cell, 1")
        self.line("%done = icmp slt i64 %less, %first")
        self.line("br i1 %done, label %out, label %loop")
        self.lines.append("out:")
        return self.finished(f"internal void @backward_{mode}({SEGMENT})")

    def samples(self, k: int, q: int) -> str:
        """All samples of the k-th Measurements."""
        n, N, width = self.sizes.n, self.sizes.N, self.sizes.width
        found = self.pointers()
        place = len(POINTERS) + 4 * k
        cells, times, values, weights = (self.let(f"load ptr, ptr {self.at('%table', place + m)}") for m in range(4))
        begins = [self.let(f"load i64, ptr {self.at(found['first_cell'], i)}") for i in range(1, N + 1)]
        self.line("br label %loop")
        self.lines.append("loop:")
        self.line("%sample = phi i64 [0, %entry], [%more, %loop]")
        cell = self.let(f"load i64, ptr {self.at(cells, '%sample')}")
        state = self.let(f"add i64 {cell}, 1")
        for begin in begins:
            beyond = self.let(f"icmp sge i64 {cell}, {begin}")
            state = self.let(f"add i64 {state}, {self.let(f'zext i1 {beyond} to i64')}")
        given = found | {
            "x": self.at(found["states"], state, n),
            "Z": self.at(found["tangents"], state, n * width),
            "jump": self.at(found["jumps"], state, n),
            "time": self.at(times, "%sample"),
            "value": self.at(values, "%sample", q),
            "weight": self.at(weights, "%sample", q),
        }
        self.call(f"sample_{k}", SAMPLE, given)
        self.line("%more = add i64 %sample, 1")
        self.line("%done = icmp sge i64 %more, %count")
        self.line("br i1 %done, label %out, label %loop")
        self.lines.append("out:")
        return self.finished(f"internal void @samples_{k}(ptr %table, i64 %count)")

    def whole(self) -> str:
        """Everything, in order."""
        structure, n, N, width = self.structure, self.sizes.n, self.sizes.N, self.sizes.width
        found = self.pointers()
        taus = [self.let(f"load double, ptr {self.at(found['tau'], i)}") for i in range(N)]
        bounds = ["%t0", *taus, "%tf"]
        firsts = [self.let(f"load i64, ptr {self.at(found['first_cell'], i)}") for i in range(N + 1)]
        lasts = [*firsts[1:], self.let("sub i64 %cells, 1")]
        spans = [
            f"ptr %table, i64 {i}, i64 {firsts[i]}, i64 {lasts[i]}, double {bounds[i]}, double {bounds[i + 1]}"
            for i in range(N + 1)
        ]
        befores = [{"x": found["states"], "Z": found["tangents"]}]
        for i in range(N):
            state = self.let(f"add i64 {lasts[i]}, {i + 1}")
            befores.append(
                {"x": self.at(found["states"], state, n), "Z": self.at(found["tangents"], state, n * width)}
            )
        self.call("start", ("c", "p", "x", "Z"), found | befores[0])
        for i, mode in enumerate(structure.mode_of_segment):
            x, Z = befores[i]["x"], befores[i]["Z"]
            if i - 1 in structure.resets:
                behind = {
                    "x_after": self.at(found["reset_states"], (i - 1) * n),
                    "Z_after": self.at(found["reset_tangents"], (i - 1) * n * width),
                }
                self.call(f"reset_{i - 1}", RESET, found | befores[i] | behind)
                x, Z = behind["x_after"], behind["Z_after"]
            self.line(f"call void @forward_{mode}({spans[i]}, ptr {x}, ptr {Z})")
        for k in range(len(structure.measurements)):
            self.line(f"call void @samples_{k}(ptr %table, i64 %count_{k})")
        if structure.terminal:
            state = self.let(f"add i64 %cells, {N}")
            last = {"x": self.at(found["states"], state, n), "Z": self.at(found["tangents"], state, n * width)}
            self.call("end", END, found | last)
        for i, mode in reversed(list(enumerate(structure.mode_of_segment))):
            self.line(f"call void @backward_{mode}({spans[i]})")
            if i - 1 in structure.resets:
                self.call(f"reset_back_{i - 1}", RESET_BACK, found | befores[i])
        self.call("start_back", ("c", "p", "psi", "jump", "g", "H"), found | {"jump": found["jumps"]})
        counts = "".join(f", i64 %count_{k}" for k in range(len(structure.measurements)))
        return self.finished(f"void @evaluate(ptr %table, i64 %cells, double %t0, double %tf{counts})")


SEGMENT = "ptr %table, i64 %segment, i64 %first, i64 %last, double %begins, double %finishes"


def native_experiment(
    structure: Structure, arguments: Arguments, times: FloatArray, second: bool
) -> NativeExperiment | None:
    """One experiment in machine code, on the mesh with the nodes `times`; None where JAX has to do it."""
    sizes = Sizes.of(structure, arguments)
    program = program_of(structure, sizes, second)
    return None if program is None else NativeExperiment(program, sizes, arguments, times, second)


class NativeExperiment:
    """Cost, gradient and, with `second`, Hessian of one experiment on one mesh, in machine code.

    Parameters
    ----------
    program : Program
    sizes : Sizes
    arguments : Arguments
        Padded or not.
    times : (G + 1,) array
        The nodes without the padding.
    second : bool
    """

    def __init__(self, program: Program, sizes: Sizes, arguments: Arguments, times: FloatArray, second: bool) -> None:
        self.sizes, self.second = sizes, second
        n, D, width, cells = sizes.n, sizes.D, sizes.width, len(times) - 1
        rows = cells + sizes.N
        counts = [_count(samples) for samples in arguments.samples]
        types = [ctypes.c_void_p, ctypes.c_int64, ctypes.c_double, ctypes.c_double, *[ctypes.c_int64] * len(counts)]
        self._program = program  # whose code must not go away
        self._evaluate = program.function("evaluate", *types)
        self._times = times
        self._scalars = (cells, float(times[0]), float(times[-1]), *counts)
        self._theta = np.zeros(D)
        self._first_cell = np.zeros(sizes.N + 1, dtype=np.int64)
        deep = rows if second else 0
        self._sums = np.zeros(n + 1 + width + D * width)
        self._jumps = np.zeros((rows + 1) * n) if counts else np.zeros(n)
        constants = [np.ravel(np.asarray(a, dtype=np.float64)) for a in constants_of(arguments)]
        units = np.zeros((D + 1, width))
        units[1:, :D] = np.eye(D)
        self._arrays: list[Any] = [
            np.ascontiguousarray(times),
            np.ascontiguousarray(np.asarray(arguments.signals)[:cells]),
            np.concatenate([*constants, np.zeros(1)]),
            self._theta[sizes.N :],
            self._theta,
            self._first_cell,
            np.zeros((rows + 1) * n),
            np.zeros((deep + 1) * n * width),
            np.zeros(rows * STAGES * n),
            np.zeros(deep * STAGES * n * width + 1),
            self._jumps,
            units,
            *self._parts(),
            np.zeros(sizes.N * n + 1),
            np.zeros(sizes.N * n * width + 1),
            np.zeros(STAGES * (1 + n + sizes.M) ** 2),
            np.zeros(width),
        ]
        for samples, count in zip(arguments.samples, counts, strict=True):
            for values, kind in zip(samples, (np.int64, float, float, float), strict=True):
                self._arrays.append(np.ascontiguousarray(np.asarray(values)[:count], dtype=kind))
        self._table = np.array([array.ctypes.data for array in self._arrays], dtype=np.uintp)
        self._address = self._table.ctypes.data
        self._result = self._sums[n + 1 : n + 1 + D], self._sums[n + 1 + width :].reshape(D, width)[:, :D]

    def _parts(self) -> Iterator[FloatArray]:
        """psi, J, g and H, which lie behind one another."""
        n, width = self.sizes.n, self.sizes.width
        ends = np.cumsum([0, n, 1, width])
        return (self._sums[end:] for end in ends)

    def __call__(self, tau: FloatArray, p: FloatArray, side: float) -> tuple[float, FloatArray, FloatArray]:
        """J, its gradient (D,) and its Hessian (D, D); as in `switchfit.evaluate.derivatives`."""
        N = self.sizes.N
        self._theta[:N] = tau
        self._theta[N:] = p
        if N:
            cells = self._scalars[0]
            passed = self._times.searchsorted(tau, "right" if side > 0 else "left")
            self._first_cell[1:] = np.minimum(np.maximum(passed - 1, 0), cells - 1)
        self._sums[:] = 0.0
        self._jumps[:] = 0.0
        self._evaluate(self._address, *self._scalars)
        g, H = self._result
        hessian = H.copy() if self.second else np.full(H.shape, np.nan)
        return float(self._sums[self.sizes.n]), g.copy(), hessian


def _count(samples: Samples) -> int:
    """Number of samples up to the last that has a value: what follows is padding."""
    there = np.flatnonzero(np.asarray(samples.weight).any(1))
    return int(there[-1]) + 1 if len(there) else 1
