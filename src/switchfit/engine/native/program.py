"""Write, compile and cache machine code for a library of modes.

A program runs through the segments forward, then through samples and terminal costs, then through the segments
backward. The mode of each segment is read at run time, so that all sequences of a library share a program.

Its loops call the straight-line functions of `switchfit.engine.native.kernels`, in hand-written LLVM IR. Rows are
numbered by ``cell + segment``: each transition cuts one cell in two. The mode of a segment, and the reset map and other
functions of a transition, are read at run time. Segments that a sequence does not need are idle: they begin and end at
tf.

The table of pointers, which calls from Python and from XLA share, holds, in the order of `Layout.names`, the
arguments, the accumulators and the scratch space. Sizes count doubles; those of the scratch space grow with the number
of rows.

The handler by which XLA calls machine code reads the arguments and results from XLA's call frame. Only a few fields of
the frame are read. Their offsets are fixed by XLA's C interface for foreign functions (``xla/ffi/api/c_api.h``).
"""

from __future__ import annotations

import logging
import threading
from collections import namedtuple
from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache
from itertools import chain
from typing import NamedTuple

import numpy as np

from switchfit.discretization import rows
from switchfit.discretization.model import AT_TRANSITIONS
from switchfit.discretization.rows import ADAPTIVE, STIFF, combine
from switchfit.engine.native.arrays import eliminate
from switchfit.engine.native.kernels import STAGES, Curvature, Kernels, count_kept, has_jumps
from switchfit.engine.native.llvm import Lines, Module, Operand, Program, Value, Variable, compile_modules
from switchfit.engine.native.scalars import CHECKED, Graph, Namespace, Objects, Template
from switchfit.engine.native.templates import ELL, ELL_X, F_X, F, Order, Sizes
from switchfit.engine.native.trace import Unsupported
from switchfit.problem.functions import use_float64
from switchfit.problem.structure import Structure
from switchfit.runtime.cache import stop_clock

GIVEN = (
    *("nodes", "signals", "c", "p", "bounds", "first_cell", "modes", "resets"),
    *AT_TRANSITIONS,
    *("multipliers", "units"),
)
"""Arguments: nodes (G + 1,), signals (G, 4, S), constants, p (M,); the transition times between t0 and tf (N + 2,);
the cell in which each segment begins, then the last cell (N + 2,); the mode of each segment (N + 1,); the index of the
reset map and of the function of each kind at each transition, -1 without one (N,); multipliers of all constraints; the
derivatives of the transition times, after a row of zeros (D + 1, width). Cells, modes and indices are 64-bit integers.
"""

OF_SAMPLES = ("cell", "time", "value", "weight", "segment", "seen")
"""Arguments of each Measurements: the cell at whose end a sample lies, or that holds a late sample, (K,); times (K,),
values (K, q), weights (K, q); the segment that holds a late sample, (K,); results: the time at which a late sample saw
the state, and this state, (K, 1 + n)."""


ZEROED = ("jump", "late")
"""Parts of the scratch space that start at zero, as the accumulators do; others are written before they are read."""


class Layout(NamedTuple):
    """Layout of the memory of a program.

    Attributes
    ----------
    constraint_rows : the rows of constraints: those of guards, one per transition, come first, "end" is the first
        terminal one, and "count" the number of all
    arguments : names of `GIVEN` and, with the number of each Measurements, of `OF_SAMPLES`
    sums : sizes of the accumulators, which start at zero: they are the results
    memory : sizes of the parts of the scratch space, each a fixed one and what every row adds; late samples have a row
        of their own behind all others
    """

    constraint_rows: dict[str, int]
    arguments: list[str]
    sums: dict[str, int]
    memory: dict[str, tuple[int, int]]

    @property
    def names(self) -> list[str]:
        """The names in its table."""
        return [*self.arguments, *self.sums, *self.memory]


@lru_cache(maxsize=64)
def layout_of(library: Structure, sizes: Sizes, order: Order) -> Layout:
    """Return the layout of the memory of a program with derivatives of an order."""
    n, N, width = sizes.n, sizes.N, sizes.width
    end = N if library.guards else 0
    count = end + sizes.m
    derivatives = int(order > Order.COST)
    resets, jumps = int(bool(library.reset_maps)), int(has_jumps(library))
    implicit = int(any(library.implicit))
    late = int(any(sensor.delay is not None for sensor in library.measurements))
    of_row = {"X": STAGES * n, "XZ": STAGES * n * width, "kept": count_kept(library, n, order)}
    sums = {"psi": n, "J": 1, "g": width, "H": sizes.D * width}
    sums |= {"constraints": count, "jacobian": count * width, "errors": n, CHECKED: 1}
    memory = {
        "x": (n + n * late, n),
        "reset_x": (N * n * resets, 0),
        "Z": (n * width * (1 + late), n * width * derivatives),
        "reset_Z": (N * n * width * resets, 0),
        **{name: (size * late, size * derivatives) for name, size in of_row.items()},
        "jump": (n, n * derivatives * jumps),
        "late": (0, n * derivatives * late),
        "costate": (0, n * derivatives),
        "increments": (len(STIFF.b) * n * implicit, 0),
        "newton": (2 * implicit, 0),
        "entries": (STAGES * (1 + n + sizes.M) ** 2, 0),
        "length": (width, 0),
    }
    of_samples = [f"{name} {k}" for k in range(len(library.measurements)) for name in OF_SAMPLES]
    return Layout({"end": end, "count": count}, [*GIVEN, *of_samples], sums, memory)


Pointers = dict[str, Value]
"""Addresses by the names of the pointers of straight-line functions."""


class Writer(Lines):
    """Emits the functions of a library, one at a time.

    Attributes
    ----------
    library, sizes, order, module : as given
    layout : Layout
    names : sequence of str
        Names of the pointers in the table.
    """

    def __init__(self, library: Structure, sizes: Sizes, order: Order, module: Module) -> None:
        super().__init__()
        self.library, self.sizes, self.order, self.module = library, sizes, order, module
        self.layout = layout_of(library, sizes, order)
        self.names: Sequence[str] = self.layout.names

    def pointers(self) -> Pointers:
        """Load all pointers of the table."""
        return {name: self.get("ptr", "%table", k) for k, name in enumerate(self.names)}

    def at_row(self, found: Pointers, row: Operand, *names: str, suffix: str = "") -> Pointers:
        """Emit the addresses of parts of the scratch space at a row, as names with a suffix."""
        return {f"{name}{suffix}": self.at(found[name], row, self.layout.memory[name][1]) for name in names}

    def at_sample(self, found: Pointers, k: int, sample: Value) -> Pointers:
        """Emit the addresses of the time, the values and the weights of a sample of the k-th Measurements."""
        lengths = {"time": 1} | dict.fromkeys(("value", "weight"), self.library.measurements[k].channels)
        return {name: self.at(found[f"{name} {k}"], sample, length) for name, length in lengths.items()}

    def into(self, pointer: Operand, offset: int) -> Value:
        """Emit an address, in bytes from a pointer."""
        return self.let("ptr", f"getelementptr inbounds i8, ptr {pointer}, i64 {offset}")

    def call(self, name: str, given: Pointers) -> None:
        """Emit the call of a straight-line function with its pointers."""
        self.invoke(name, *(given[key] for key in self.module.pointers[name]))

    def take_step(self, mode: int, name: str, given: Pointers, newton: str = "newton") -> None:
        """Emit the call of a step in a mode, behind that of `write_newton` which finds the increments of an implicit
        one.
        """
        if self.library.implicit[mode]:
            self.call(f"solve_{newton}_{mode}", given)
        self.call(f"{name}_{mode}", given)

    def cases(self, which: Value, count: int) -> Iterator[int]:
        """Emit a switch to one of `count` blocks, each of which is what is emitted in an iteration; -1 skips them."""
        name = self.name_block()
        cases = " ".join(f"i64 {k}, label %{name}_{k}" for k in range(count))
        self.line(f"switch i64 {which}, label %{name}_end [{cases}]")
        for k in range(count):
            self.label(f"{name}_{k}")
            yield k
            self.go_to(f"{name}_end")
        self.label(f"{name}_end")

    def call_one_of(self, which: Value, count: int, given: Pointers, *names: str) -> None:
        """Emit the calls of those of `count` functions that have a number, {} in their names; of none for -1."""
        for k in self.cases(which, count):
            for name in names:
                self.call(name.format(k), given)

    def zero(self, pointer: Value, count: Operand) -> None:
        """Write zeros to `count` doubles."""
        self.module.declare("llvm.memset.p0.i64", "declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)")
        self.line(f"call void @llvm.memset.p0.i64(ptr {pointer}, i8 0, i64 {8 * count}, i1 false)")

    def copy(self, target: Value, source: Operand, count: int) -> None:
        """Copy `count` doubles, or integers of 64 bits."""
        self.module.declare("llvm.memcpy.p0.p0.i64", "declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)")
        self.line(f"call void @llvm.memcpy.p0.p0.i64(ptr {target}, ptr {source}, i64 {8 * count}, i1 false)")


KINDS = "inner", "end"
"""Rows that do not move with theta, and those beside a transition, which do."""

OF_STAGES = "kept", "X", "XZ"
"""Parts of the scratch space that belong to the stages of a row."""


def start_row(writer: Writer, found: Pointers, segment: Value, cell: Value) -> Pointers:
    """Emit where the row of a segment in a cell starts: its time, the first node of the cell, the signals there.

    `first` says whether it is the first one of its segment, `begins` whether it begins with a transition; `opens` is
    the derivative of its start.
    """
    first = cell.equals(writer.get("i64", found["first_cell"], segment))
    begins, origin = first & (segment > 0), writer.get("double", found["nodes"], cell)
    return {
        "first": first,
        "begins": begins,
        "origin": origin,
        "start": first.choose(writer.get("double", found["bounds"], segment), origin),
        "opens": _units(writer, found, begins, segment),
        "signal": writer.at(found["signals"], cell, 4 * writer.sizes.signals),
    }


def _units(writer: Writer, found: Pointers, moves: Value, index: Value) -> Value:
    """Emit the address of the derivative of a transition time if it moves, else of zeros."""
    return writer.at(found["units"], moves.choose(index, 0), writer.sizes.width)


def row_pointers(writer: Writer, found: Pointers, segment: Value, cell: Value, last: Value) -> tuple[Pointers, Value]:
    """Emit the pointers of the row of a segment in a cell; return them with the case of `row_cases`."""
    # Rows are numbered by cell + segment, as in `mesh.build_rows`; states by the row that they are before, so that the
    # state after row r is state r + 1.
    place, row, ends = start_row(writer, found, segment, cell), cell + segment, cell.equals(last)
    # The last segment ends at tf, which is no transition: its last row does not move.
    closes, after = ends & (segment < writer.sizes.N), row + 1
    finishes = writer.get("double", found["bounds"], segment + 1)
    end = ends.choose(finishes, writer.get("double", found["nodes"], cell + 1))
    times = writer.allocate("double", 3)
    for k, value in enumerate((place["start"], end, place["origin"])):
        writer.put(value, times, k)
    pointers = place | {"row": times, "closes": _units(writer, found, closes, segment + 1)}
    # `jump` is read at the end of the row, `late` and `costate` belong to its start.
    pointers |= writer.at_row(found, after, "jump") | writer.at_row(found, row, "late", "costate", "x", "Z", *OF_STAGES)
    pointers |= writer.at_row(found, after, "x", "Z", suffix="_after")
    # Case 2 mode + kind: only rows beside a transition have the code for times that move.
    kind = (place["begins"] | closes).to("i64")
    return found | pointers, writer.get("i64", found["modes"], segment) * len(KINDS) + kind


def count_rows(writer: Writer, found: Pointers) -> Value:
    """Emit the number of rows."""
    return writer.get("i64", found["first_cell"], writer.sizes.N + 1) + (writer.sizes.N + 1)


def row_cases(writer: Writer, case: Value) -> Iterator[tuple[int, str]]:
    """Emit a switch among the modes and `KINDS` of rows."""
    for k in writer.cases(case, len(KINDS) * len(writer.library.modes)):
        yield k // len(KINDS), KINDS[k % len(KINDS)]


NEWTON_ITERATIONS = 15
"""Largest number of Newton's iterations; where it converges at all, the sharpest models take 10."""

USUAL_ITERATIONS = 5
"""Iterations that count for the work of a row."""


def write_newton(writer: Writer, name: str) -> str:
    """Write the loop over Newton's iterations, which are calls of a function; J is NaN too if it does not converge."""
    count, names = len(STIFF.b) * writer.sizes.n, (*writer.module.pointers[name], "J")
    parameters = writer.begin(f"void @solve_{name}({', '.join(f'ptr %{key}' for key in names)})")
    writer.module.pointers[f"solve_{name}"] = names
    given = dict(zip(names, parameters, strict=True))
    # k = 0 is X_j = x, so that the first iteration is a linearly implicit step.
    writer.zero(given["increments"], count)
    writer.store(1.0, given["newton"])
    with writer.loop(0, NEWTON_ITERATIONS):
        writer.call(name, given)
        with writer.when(writer.get("double", given["newton"], 1).differs(0.0)):
            writer.line("ret void")
    for pointer in (given["J"], *(writer.at(given["increments"], k) for k in range(count))):
        writer.store(float("nan"), pointer)
    return writer.end()


def estimate_row(writer: Writer, mode: int, curvature: Curvature) -> int:
    """Return the work of a row of a mode in an evaluation with second derivatives, in additions."""
    names = [f"forward_inner_{mode}", f"backward_inner_{mode}", *(curvature.name for _ in curvature.stages)]
    newton = USUAL_ITERATIONS * writer.module.work[f"newton_{mode}"] if writer.library.implicit[mode] else 0
    return newton + sum(writer.module.work[name] for name in names)


def add_curvature(writer: Writer, curvature: Curvature, given: Pointers, moving: bool) -> None:
    """Emit the calls that add the second derivatives of a row to H.

    For a row that moves, the derivative of its length is added too.
    """
    n, width = writer.sizes.n, writer.sizes.width
    # Gauss-Newton has no h' x V': V is linear in the costate and in ell, which are of the size of the residuals.
    if moving and writer.order == Order.HESSIAN:
        writer.call("length", given)
    for j in curvature.stages:
        entries, tangents = writer.at(given["entries"], j * curvature.size), writer.at(given["XZ"], j * n * width)
        writer.call(curvature.name, given | {"entries": entries, "XZ": tangents})


def find_reset(writer: Writer, found: Pointers, segment: Value, opens: Value) -> tuple[Value, Pointers]:
    """Emit the index of the reset map at the start of a segment, -1 without one; return it with its pointers."""
    n, width = writer.sizes.n, writer.sizes.width
    # Without a transition the index is 0: the load stays inside the array, and its value is not used.
    safe = opens.choose(segment - 1, 0)
    # The map of a transition is differentiated at the time of that transition: its unit vector is row `segment`.
    return opens.choose(writer.get("i64", found["resets"], safe), -1), {
        "time": writer.at(found["bounds"], segment),
        "moves": writer.at(found["units"], segment, width),
        "x_after": writer.at(found["reset_x"], safe, n),
        "Z_after": writer.at(found["reset_Z"], safe, n * width),
    }


def choose_state(which: Value, given: Pointers, state: Pointers) -> Pointers:
    """Emit the choice of the state behind a reset map, if there is one, else the one before."""
    there = which >= 0
    return {name: there.choose(given[f"{name}_after"], state[name]) for name in ("x", "Z")}


def write_forward(writer: Writer) -> str:
    """Write a segment forward: its reset map, its rows, and the functions at its end."""
    _, segment = writer.begin("void @forward(ptr %table, i64 %segment)")
    found = writer.pointers()
    first, last = (writer.get("i64", found["first_cell"], k) for k in (segment, segment + 1))
    start = writer.at_row(found, first + segment, "x", "Z")
    if writer.library.reset_maps:
        which, given = find_reset(writer, found, segment, segment > 0)
        writer.call_one_of(which, len(writer.library.reset_maps), found | start | given, "reset_{}")
        start = choose_state(which, given, start)
    # Behind the modes: 0 or less if nothing is judged, 1 for the errors of rows, 2 for jumps inside them too.
    flag = writer.get("i64", found["modes"], writer.sizes.N + 1)
    mode, modes = writer.get("i64", found["modes"], segment), len(writer.library.modes)
    with writer.loop(first, last + 1) as cell:
        given, case = row_pointers(writer, found, segment, cell, last)
        # The first row begins behind the reset map, whose state is not among those of the rows.
        given |= {name: given["first"].choose(start[name], given[name]) for name in ("x", "Z")}
        for k, kind in row_cases(writer, case):
            writer.take_step(k, f"forward_{kind}", given)
        for level, name in enumerate(("error_{}", "jump_{}") if writer.order > Order.COST else ()):
            writer.call_one_of((flag > level).choose(mode, -1), modes, given, name)
    after = last + segment + 1
    given = found | writer.at_row(found, after, "x", "Z")
    # Once per segment: what is not finite stays so to its end.
    writer.call("check_state", given)
    _call_transition_functions(writer, given, segment, last, after)
    return writer.end()


def _call_transition_functions(writer: Writer, found: Pointers, segment: Value, last: Value, after: Value) -> None:
    """Call the functions at the transition that ends a segment; behind the last one, the library has none."""
    next_ = segment + 1
    given = found | {
        "time": writer.at(found["bounds"], next_),
        "moves": writer.at(found["units"], next_, writer.sizes.width),
        "origin": writer.at(found["nodes"], last),
        "signal": writer.at(found["signals"], last, 4 * writer.sizes.signals),
        **writer.at_row(found, after, "jump"),
    }
    for kind in AT_TRANSITIONS:
        count = len(getattr(writer.library, kind))
        if kind == "guards" and count:
            given |= constraint_pointers(writer, found, segment)
        writer.call_one_of(writer.get("i64", found[kind], segment), count, given, f"{kind}_{{}}")


def constraint_pointers(writer: Writer, found: Pointers, row: Operand) -> Pointers:
    """Return pointers to the constraints from a row on."""
    return {
        "multiplier": writer.at(found["multipliers"], row),
        "constraint": writer.at(found["constraints"], row),
        "jacobian": writer.at(found["jacobian"], row, writer.sizes.width),
    }


def write_backward(writer: Writer, curvatures: Sequence[dict[str, Curvature]]) -> str:
    """Write a segment backward: its rows, then the reset map at its start; `curvatures` are those of `KINDS` for each
    mode.
    """
    _, segment = writer.begin("void @backward(ptr %table, i64 %segment)")
    found = writer.pointers()
    first, last = (writer.get("i64", found["first_cell"], k) for k in (segment, segment + 1))
    with writer.loop(0, last - first + 1) as turn:
        given, case = row_pointers(writer, found, segment, last - turn, last)
        for k, kind in row_cases(writer, case):
            writer.call(f"backward_{kind}_{k}", given)
            add_curvature(writer, curvatures[k][kind], given, moving=kind == "end")
    if writer.library.reset_maps:
        state = writer.at_row(found, first + segment, "x", "Z")
        which, given = find_reset(writer, found, segment, segment > 0)
        # psi(tau+), which the first row of the segment has left, becomes psi(tau-) for the last row of the one before.
        writer.call_one_of(which, len(writer.library.reset_maps), found | state | given, "reset_{}_back")
    return writer.end()


def write_samples(writer: Writer, k: int) -> str:
    """Write the loop over the samples of the k-th Measurements, which are at the ends of rows."""
    _, count = writer.begin(f"void @samples_{k}(ptr %table, i64 %count)")
    found = writer.pointers()
    # The state at the end of a cell is that of the last row inside it: cell + (segments begun in it or before) + 1.
    begins = [writer.get("i64", found["first_cell"], i) for i in range(1, writer.sizes.N + 1)]
    with writer.loop(0, count) as sample:
        cell = writer.get("i64", found[f"cell {k}"], sample)
        index = sum(((cell >= begin).to("i64") for begin in begins), cell + 1)
        given = found | writer.at_row(found, index, "x", "Z", "jump") | writer.at_sample(found, k, sample)
        # Samples at nodes have known times: `moves` is the row of zeros.
        writer.call(f"sample_{k}", given | {"moves": found["units"]})
    return writer.end()


def _write_late_row(writer: Writer, k: int, found: Pointers, sample: Value) -> tuple[Pointers, Value]:
    """Write the forward step of a late sample's row, which is behind all others in memory; return pointers and its
    mode.
    """
    cell, segment = (writer.get("i64", found[f"{name} {k}"], sample) for name in ("cell", "segment"))
    row, place, last = cell + segment, start_row(writer, found, segment, cell), count_rows(writer, found)
    times = writer.allocate("double", 3)
    for entry, name in ((0, "start"), (2, "origin")):
        writer.put(place[name], times, entry)
    state = writer.at_row(found, row, "x", "Z")
    if writer.library.reset_maps:
        state = choose_state(*find_reset(writer, found, segment, place["begins"]), state)
    psi = writer.allocate("double", writer.sizes.n)
    given = found | place | state | writer.at_sample(found, k, sample) | writer.at_row(found, last, *OF_STAGES)
    given |= writer.at_row(found, last + 1, "x", "Z", suffix="_after") | writer.at_row(found, row, "late")
    given |= {"row": times, "closes": writer.allocate("double", writer.sizes.width), "psi": psi, "jump": psi}
    given["J"] = writer.allocate("double")
    writer.call(f"late_time_{k}", given)
    mode = writer.get("i64", found["modes"], segment)
    for m in writer.cases(mode, len(writer.library.modes)):
        writer.take_step(m, "forward_late", given)
    return given, mode


def write_late_samples(writer: Writer, k: int, curvatures: Sequence[dict[str, Curvature]]) -> str:
    """Write the loop over the late samples of the k-th Measurements; each ends a row of its own.

    `curvatures` have for each mode what adds the second derivatives of such a row to H.
    """
    _, count = writer.begin(f"void @samples_{k}(ptr %table, i64 %count)")
    found = writer.pointers()
    with writer.loop(0, count) as sample:
        given, mode = _write_late_row(writer, k, found, sample)
        seen = writer.at(found[f"seen {k}"], sample, 1 + writer.sizes.n)
        time = writer.at(given["row"], 1)
        writer.copy(seen, time, 1)
        writer.copy(writer.at(seen, 1), given["x_after"], writer.sizes.n)
        # A late sample is forward and backward at once, as nothing follows it: psi = D_x l at its end, and what is left
        # at its start is added to `late`, where it waits for the backward step of the row around it.
        at_end = {"x": given["x_after"], "Z": given["Z_after"], "J": found["J"], "time": time, "moves": given["closes"]}
        writer.zero(given["psi"], writer.sizes.n)
        writer.call(f"sample_{k}", given | at_end)
        if writer.order > Order.COST:
            for m in writer.cases(mode, len(writer.library.modes)):
                writer.call(f"backward_late_{m}", given)
                add_curvature(writer, curvatures[m]["late"], given, moving=True)
    return writer.end()


MAJOR, MINOR = 0, 1
"""Version of the interface."""

EXTENSION, ARGUMENTS, RESULTS = 8, 72, 112
"""Byte offsets in the frame of the pointers to the first extension, to the arguments and to the results."""

DATA, DIMENSIONS = 24, 40
"""Byte offsets in a buffer of its data and its dimensions."""


def write_handler(writer: Writer) -> str:
    """Return the text of the handler, which fills the table of pointers and calls `evaluate`.

    Results are all accumulators in one array, and the scratch space.
    """
    names = writer.layout.arguments
    (frame,) = writer.begin("ptr @xla_handler(ptr %frame)")
    table = writer.allocate("ptr", len(writer.names))
    extension = writer.load("ptr", writer.into(frame, EXTENSION))
    with writer.when(extension.differs("null")), writer.when(writer.load("i32", writer.into(extension, 8)).equals(1)):
        metadata = writer.load("ptr", writer.into(extension, 24))  # XLA queries the version of the interface
        for offset, value in ((24, MAJOR), (28, MINOR), (32, 0)):
            writer.store(value, writer.into(metadata, offset), "i32")
        writer.line("ret ptr null")
    arguments, results = (writer.load("ptr", writer.into(frame, place)) for place in (ARGUMENTS, RESULTS))

    def of_buffer(buffers: Value, k: int, offset: int) -> Value:
        """Load the address of the data or of the dimensions of a buffer."""
        return writer.load("ptr", writer.into(writer.get("ptr", buffers, k), offset))

    found = {name: of_buffer(arguments, k, DATA) for k, name in enumerate(names)}
    totals, between = (of_buffer(results, k, DATA) for k in (0, 1))
    position = 0
    for name, length in writer.layout.sums.items():
        found[name] = writer.at(totals, position)
        position += length
    rows = count_rows(writer, found)
    place: Operand = 0
    for name, (fixed, each_row) in writer.layout.memory.items():
        found[name] = writer.at(between, place)
        place = rows * each_row + fixed + place
    for k, name in enumerate(writer.names):
        writer.put(found[name], table, k)
    of_cells = (k for k, name in enumerate(names) if name.startswith("cell "))
    writer.invoke("evaluate", table, *(writer.get("i64", of_buffer(arguments, k, DIMENSIONS), 0) for k in of_cells))
    return writer.end("ptr null")


def write_evaluation(writer: Writer) -> str:
    """Write `evaluate`: the segments forward, the samples of each Measurements, the terminal terms, and the segments
    backward.
    """
    N = writer.sizes.N
    of_samples = "".join(f", i64 %count_{k}" for k in range(len(writer.library.measurements)))
    table, *counts = writer.begin(f"void @evaluate(ptr %table{of_samples})")
    found, layout = writer.pointers(), writer.layout
    rows = count_rows(writer, found)
    # The sums are one block of memory, so that one call clears all of them.
    writer.zero(found[next(iter(layout.sums))], sum(layout.sums.values()))
    for name in ZEROED:
        fixed, each_row = layout.memory[name]
        writer.zero(found[name], rows * each_row + fixed)
    writer.call("start", found | writer.at_row(found, 0, "x", "Z", suffix="_after"))
    with writer.loop(0, N + 1) as segment:
        writer.invoke("forward", table, segment)
    for k, count in enumerate(counts):
        writer.invoke(f"samples_{k}", table, count)
    # No row follows the end: what the terminal terms add to the costate goes to psi itself.
    library, given = writer.library, found | writer.at_row(found, rows, "x", "Z") | {"jump": found["psi"]}
    given |= constraint_pointers(writer, found, layout.constraint_rows["end"])
    for name in ["end"] * bool(library.terminal) + ["end_constraint"] * bool(library.terminal_constraints):
        writer.call(name, given)
    if writer.order > Order.COST:
        # Behind the modes: -2 where J, the constraints and their derivatives are all that is asked for.
        with writer.when(writer.get("i64", found["modes"], N + 1) > -2):
            with writer.loop(0, N + 1) as turn:
                writer.invoke("backward", table, N - turn)
            writer.call("start_back", found)
    return writer.end()


TIMES = {False: [*ADAPTIVE.c.tolist(), 1.0], True: [0.0, *STIFF.c.tolist()]}
"""Times at which an explicit (False) or implicit step evaluates the mode, as fractions of it."""


Adaptive = namedtuple("Adaptive", "t step refused stuck end rtol atol low high")

AT = Adaptive(*range(9))
"""Offsets in the state of the adaptive solver, in doubles: t, step, refused and stuck are those of `Progress`, truth
values being 0 or 1; the end of the solve; rtol and atol of `Tolerances`; low and high, the times between which a signal
may be looked up.
"""


def write_slope(kernels: Kernels, mode: int, stage: Template) -> None:
    """Write f and ell of a mode at one time: the derivative of y = (x, running cost so far)."""
    graph = Graph()
    f, ell = _evaluate(kernels, graph, stage)(graph.loads("y", kernels.sizes.n), (F, ELL))
    stores = [("K", k, node) for k, node in enumerate([*f, ell.item()])]
    kernels.module.write_straight_line(f"slope_{mode}", stores + graph.check())


def _evaluate(
    kernels: Kernels, graph: Graph, stage: Template, number: str = "", checked: bool = True
) -> Callable[[Objects, Sequence[int]], list[Objects]]:
    """Return some outputs of a mode as a function of the state, at the time of a `moment` with this number."""
    t, origin = graph.loads(f"moment{number}", 2)
    at = kernels.take_inputs(graph, origin, f"signal{number}")
    return lambda x, only: stage(graph, *at(t, x), only=only, checked=checked)


@np.errstate(divide="ignore")  # the error of a mode at rest is the number zero
def write_step(kernels: Kernels, mode: int, stage: Template) -> None:
    """Write a step in a mode, with the error control behind it; an implicit one follows the iterations of Newton."""
    n, is_implicit = kernels.sizes.n, kernels.library.implicit[mode]
    graph, count = Graph(), len(TIMES[is_implicit])
    state, y = graph.loads("state", len(AT)), graph.loads("y", n + 1)
    # y is (x, running cost): the mesh has to resolve both.
    points = [_evaluate(kernels, graph, stage, str(j)) for j in range(count)]
    flags = (graph.apply("ne", state[k], 0.0) for k in (AT.refused, AT.stuck))
    progress = rows.Progress(state[AT.t], state[AT.step], *flags)
    given = progress, state[AT.end], rows.Tolerances(state[AT.rtol], state[AT.atol]), y
    h, xp = progress.step, Namespace(graph)
    if is_implicit:
        k, (at_start, *at_stages) = kernels.load_increments(graph), points
        f, f_x, ell, ell_x = at_start(y[:n], (F, F_X, ELL, ELL_X))
        # The running cost needs no iterations: its increments are h ell at the stages that the states have.
        densities = [each(y[:n] + combine(row, k), (ELL,))[0] for each, row in zip(at_stages, STIFF.a, strict=True)]
        k = [np.append(each, h * density.item()) for each, density in zip(k, densities, strict=True)]
        # d (x, cost) / dt = (f, ell) does not depend on the cost: its column is zero.
        jacobian = np.block([[f_x, np.zeros((n, 1))], [ell_x[None], 0.0]])
        error = rows.estimate_error(h, k, np.append(f, ell), jacobian, eliminate)
        now, y_now = rows.judge_error(*given, y + combine(STIFF.b, k), error, rows.STIFF_EXPONENT, xp)
    else:
        K: list[Objects] = []
        for row, evaluate in zip((*ADAPTIVE.a, ADAPTIVE.b), points, strict=True):
            after = y + h * combine(row, K)
            K.append(np.concatenate([np.ravel(value) for value in evaluate(after[:n], (F, ELL))]))
        now, y_now = rows.judge_error(*given, after, h * combine(rows.ADAPTIVE_ERROR, K), rows.EXPONENT, xp)
    stores = [("state", AT.t, now.t), ("state", AT.step, now.step), *(("y", k, node) for k, node in enumerate(y_now))]
    for place, flag in ((AT.refused, now.refused), (AT.stuck, now.stuck)):
        stores.append(("state", place, graph.apply("select", flag, 1.0, 0.0)))
    # The stages of a step that is rejected may be anywhere.
    for pointer, offset, node in graph.check():
        stores.append((pointer, offset, graph.apply("select", now.refused, graph.load(CHECKED, 0), node)))
    kernels.module.write_straight_line(f"step_{mode}", stores)
    if is_implicit:
        graph = Graph()
        stages = [_evaluate(kernels, graph, stage, str(j), checked=False) for j in range(1, count)]
        field = lambda j, X: stages[j](X, (F, F_X))  # noqa: E731
        found = kernels.correct(graph, graph.load("state", AT.step), graph.loads("y", n), field)
        kernels.module.write_straight_line(f"newton_step_{mode}", found)


def write_loop(writer: Writer, name: str) -> str:
    """Write the calls of a straight-line function at `count` points, from one to the next its pointers advance by
    given numbers of bytes.
    """
    keys = writer.module.pointers[name]
    pointers = "".join(f", ptr %{key}, i64 %{key}_step" for key in keys)
    count, *given = writer.begin(f"void @each_{name}(i64 %count{pointers})")
    with writer.loop(0, count) as k:
        each = zip(keys, given[::2], given[1::2], strict=True)
        writer.call(name, {key: writer.into(pointer, k * step) for key, pointer, step in each})
    return writer.end()


def _store_moment(writer: Writer, found: Pointers, cells: Value, time: Value, moment: Value) -> Value:
    """Store a time, and the first node of the cell that holds it, clipped to [low, high]; return the signals there."""
    S = writer.sizes.signals
    writer.store(time, moment)
    if not S:
        return found["signals"]
    low, high = (writer.get("double", found["state"], k) for k in (AT.low, AT.high))
    # At the ends of a stretch an input may jump: the time is kept inside [low, high], so that the cell is one of the
    # stretch.
    later = (time < low).choose(low, time)
    inside = (later > high).choose(high, later)
    left, right = Variable(writer, "i64", 0), Variable(writer, "i64", cells)
    with writer.repeat() as leave:  # nodes[left] <= time; time < nodes[right], or right is the last node
        one, other = left.value, right.value
        leave(other - one <= 1)
        middle = (one + other) >> 1
        is_before = writer.get("double", found["nodes"], middle) <= inside
        left.value, right.value = is_before.choose(middle, one), is_before.choose(other, middle)
    writer.put(writer.get("double", found["nodes"], left.value), moment, 1)
    return writer.at(found["signals"], left.value, 4 * S)


def write_adaptive_solve(writer: Writer, mode: int) -> str:
    """Write the loop over adaptive steps in one mode; it stores the times of accepted steps.

    It ends at the end time, after `most` accepted steps, or when the solver is stuck.
    """
    n = writer.sizes.n
    given = "i64 %cells, ptr %state, ptr %y, ptr %rows, i64 %most, ptr %count"
    _, cells, state, y, rows, most, count = writer.begin(f"void @adaptive_{mode}_steps(ptr %table, {given})")
    found = writer.pointers() | {"state": state, "y": y}
    lengths = {"increments": len(STIFF.b) * n, "newton": 2}
    found |= {name: writer.allocate("double", length) for name, length in lengths.items()}
    found["J"] = found["newton"]  # NaN if the iterations do not converge, as the increments are
    writer.store(0, count, "i64")
    with writer.repeat() as leave:
        t, end, stuck, step = (writer.get("double", state, k) for k in (AT.t, AT.end, AT.stuck, AT.step))
        # Go on while t < end, not stuck, and with room for accepted times.
        leave(((t < end) & stuck.equals(0.0) & (writer.load("i64", count) < most)).equals(False))
        for j, c in enumerate(TIMES[writer.library.implicit[mode]]):
            found[f"moment{j}"] = writer.allocate("double", 2)
            found[f"signal{j}"] = _store_moment(writer, found, cells, t + step * c, found[f"moment{j}"])
        writer.take_step(mode, "step", found, "newton_step")
        with writer.when(writer.get("double", state, AT.refused).equals(0.0)):
            accepted = writer.load("i64", count)
            row = writer.at(rows, accepted, 2 + n)
            writer.store(writer.get("double", state, AT.t), row)
            writer.copy(writer.at(row, 1), y, 1 + n)
            writer.store(accepted + 1, count)
    return writer.end()


_one_at_a_time = threading.Lock()

log = logging.getLogger("switchfit")

PREFIX = {Order.COST: "plain_", Order.GRADIENT: "first_", Order.HESSIAN: "", Order.GAUSS_NEWTON: "gauss_newton_"}
"""Prefix of the names of functions, by the order of their derivatives."""


def second_order(library: Structure) -> Order:
    """Return the order of the derivatives that fits of a library take their steps by."""
    return Order.GAUSS_NEWTON if library.has_rough_hessian else Order.HESSIAN


def program_of(library: Structure, sizes: Sizes, order: Order) -> Program | str:
    """Return machine code for a library with derivatives of an order, or the reason why it cannot be compiled.

    Functions that cannot be written as straight-line code have no machine code. A fit needs simulations and second
    derivatives: both are compiled into one program. Any other failure is a defect of this package: the caller falls
    back to JAX as well, and the reason begins with "internal: ".
    """
    both = (Order.COST, second_order(library))
    return compile_library(library, sizes, both if order in both else (order,), _write)


Write = Callable[[Structure, Sizes, Order, Module], Iterator[str]]
"""Writes functions of a library with derivatives of an order, in parts."""


def compile_library(library: Structure, sizes: Sizes, orders: tuple[Order, ...], write: Write) -> Program | str:
    """Return the machine code that a function writes, or the reason why there is none, as `program_of` does.

    The log has the reason too.
    """
    with _one_at_a_time, stop_clock():
        return _program_of(library, sizes, orders, write)


@lru_cache(maxsize=64)
def _program_of(library: Structure, sizes: Sizes, orders: tuple[Order, ...], write: Write) -> Program | str:
    modules = {order: Module(sizes.width, PREFIX[order]) for order in orders}
    try:
        if sizes.D == 0:
            raise Unsupported("an experiment has no unknowns")
        with use_float64():
            parts = (write(library, sizes, order, each) for order, each in modules.items())
            program = compile_modules(chain.from_iterable(parts))
    except Unsupported as error:
        reason = str(error)
        log.info("No machine code: %s.", reason)
    except Exception as error:
        reason = f"internal: {type(error).__name__}: {error}"
        log.info("No machine code: %s.", reason, exc_info=True)
    else:
        program.modules = modules
        return program
    return reason


def drop_programs() -> None:
    """Drop cached programs that are not in use, and what is known of their memory."""
    with _one_at_a_time:
        _program_of.cache_clear()
        layout_of.cache_clear()


def _write(library: Structure, sizes: Sizes, order: Order, module: Module) -> Iterator[str]:
    """Write all functions of a library with derivatives of an order, a part for each mode and one for the rest."""
    kernels = Kernels(library, sizes, order, module)
    writer = Writer(library, sizes, order, module)
    late = [k for k, sensor in enumerate(library.measurements) if sensor.delay is not None]
    curvatures = []
    for mode in range(len(library.modes)):
        curvatures.append(_write_mode(kernels, writer, mode, bool(late)))
        if order > Order.COST:
            module.row_work.append(estimate_row(writer, mode, curvatures[mode]["inner"]))
        yield module.take()
    kernels.nodes()
    for k in range(len(library.measurements)):
        if k in late:
            kernels.late_time(k)
            module.add(write_late_samples(writer, k, curvatures))
        else:
            module.add(write_samples(writer, k))
    for name in ["start", *(f"reset_{k}" for k in range(len(library.reset_maps)))] if order == Order.COST else ():
        module.add(write_loop(writer, name))
    kernels.state()
    if order != Order.GRADIENT:
        kernels.outputs()
        module.add(write_loop(writer, "outputs"))
    module.add(write_forward(writer))
    module.add(write_evaluation(writer))
    if order > Order.COST:
        module.add(write_backward(writer, curvatures))
    if order == Order.HESSIAN:
        module.add(write_handler(writer))
    yield module.take()


def _write_mode(kernels: Kernels, writer: Writer, mode: int, late: bool) -> dict[str, Curvature]:
    """Write the rows of a mode; return what adds the second derivatives of each kind of rows to H."""
    module, order, library = kernels.module, kernels.order, kernels.library
    running = bool(library.running or library.references) and not library.is_rest(mode)
    stage = kernels.templates.stage(mode, running=running)
    kinds = [("inner", stage, False, running, False), ("end", stage, True, running, False)]
    if late:
        # A late sample's row is beside the trajectory: it adds no running cost, which the row around it has.
        kinds.append(("late", kernels.templates.stage(mode, running=False) if running else stage, True, False, True))
    if library.implicit[mode]:
        kernels.newton(f"newton_{mode}", stage)
        module.add(write_newton(writer, f"newton_{mode}"))
    tableau, curvatures = kernels.tableau(mode), {}
    for kind, template, moving, costs, is_late in kinds:
        name = f"{kind}_{mode}"
        factors = kernels.forward_row(f"forward_{name}", template, moving, costs, tableau)
        if order > Order.COST:
            chosen = kernels.backward_row(f"backward_{name}", template, moving, costs, tableau, factors, is_late)
            curvatures[kind] = kernels.curvature(f"curvature_{name}", chosen, tableau)
    # The same for all modes: written once.
    if order == Order.HESSIAN and mode == 0:
        kernels.length()
    if order > Order.COST:
        kernels.judge_row(mode, stage, tableau)
    else:
        write_slope(kernels, mode, stage)
        module.add(write_loop(writer, f"slope_{mode}"))
        write_step(kernels, mode, stage)
        if library.implicit[mode]:
            module.add(write_newton(writer, f"newton_step_{mode}"))
        module.add(write_adaptive_solve(writer, mode))
    return curvatures
