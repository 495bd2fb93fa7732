"""Emit LLVM IR of a library: the table of pointers, and calls of functions.

Layout of the memory that machine code reads and writes, shared by calls from Python and from XLA.

The table of pointers holds, in the order of `pointers`, the arguments, the accumulators and the scratch space, then for
each Measurements what `OF_SAMPLES` lists. Sizes count doubles; those of the scratch space grow with the number of rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

from switchfit.discretization.model import AT_TRANSITIONS
from switchfit.discretization.rows import STIFF
from switchfit.engine.native.kernels import STAGES, count_kept, has_jumps
from switchfit.engine.native.llvm import Lines, Module, Operand, Value
from switchfit.engine.native.scalars import CHECKED
from switchfit.engine.native.templates import Order, Sizes
from switchfit.problem.structure import Structure

GIVEN = (
    *("nodes", "signals", "c", "p", "bounds", "first_cell", "modes", "resets"),
    *AT_TRANSITIONS,
    *("multipliers", "units"),
)
"""Arguments: nodes (G + 1,), signals (G, 4, S), constants, p (M,); the transition times between t0 and tf (N + 2,);
the cell in which each segment begins, then the last cell (N + 2,); the mode of each segment (N + 1,); the index of the
reset map and of the function of each kind at each transition, -1 without one (N,); multipliers of all constraints; the
derivatives of the transition times, after a row of zeros (D + 1, width)."""

WHOLE_NUMBERS = ("first_cell", "modes", "resets", *AT_TRANSITIONS)
"""Arguments that are 64-bit integers."""

OF_SAMPLES = ("cell", "time", "value", "weight", "segment", "seen")
"""Arguments of each Measurements: the cell at whose end a sample lies, or that holds a late sample, (K,); times (K,),
values (K, q), weights (K, q); the segment that holds a late sample, (K,); results: the time at which a late sample saw
the state, and this state, (K, 1 + n)."""


class Length(NamedTuple):
    """A size, in doubles, that grows with the number of rows."""

    fixed: int
    each_row: int = 0

    def at(self, rows: int) -> int:
        """Return the size for a number of rows."""
        return self.fixed + self.each_row * rows


ZEROED = ("jumps", "late")
"""Parts of the scratch space that start at zero, as the accumulators do; others are written before they are read."""


class Layout(NamedTuple):
    """Layout of the memory of a program.

    Attributes
    ----------
    constraint_rows : the rows of constraints: those of guards, one per transition, come first, "end" is the first
        terminal one, and "count" the number of all
    sums : sizes of the accumulators, which start at zero: they are the results
    memory : sizes of the parts of the scratch space; late samples have a row of their own behind all others
    """

    constraint_rows: dict[str, int]
    sums: dict[str, int]
    memory: dict[str, Length]

    @property
    def pointers(self) -> tuple[str, ...]:
        """The names in its table, except those of the samples."""
        return (*GIVEN, *self.sums, *self.memory)


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
    of_row = {"stages": STAGES * n, "stage_tangents": STAGES * n * width, "kept": count_kept(library, n, order)}
    sums = {"psi": n, "J": 1, "g": width, "H": sizes.D * width}
    sums |= {"constraints": count, "jacobian": count * width, "errors": n, CHECKED: 1}
    memory = {
        "states": Length(n + n * late, n),
        "reset_states": Length(N * n * resets),
        "tangents": Length(n * width * (1 + late), n * width * derivatives),
        "reset_tangents": Length(N * n * width * resets),
        **{name: Length(size * late, size * derivatives) for name, size in of_row.items()},
        "jumps": Length(n, n * derivatives * jumps),
        "late": Length(0, n * derivatives * late),
        "costates": Length(0, n * derivatives),
        "increments": Length(len(STIFF.b) * n * implicit),
        "newton": Length(2 * implicit),
        "entries": Length(STAGES * (1 + n + sizes.M) ** 2),
        "length": Length(width),
    }
    return Layout({"end": end, "count": count}, sums, memory)


Pointers = dict[str, Value]
"""Addresses by the names of the pointers of straight-line functions."""


class Writer(Lines):
    """Emits the functions of a library, one at a time.

    Attributes
    ----------
    library, sizes, order, module : as given
    layout : Layout
    names : tuple of str
        Names of the pointers in the table.
    """

    def __init__(self, library: Structure, sizes: Sizes, order: Order, module: Module) -> None:
        super().__init__()
        self.library, self.sizes, self.order, self.module = library, sizes, order, module
        self.layout = layout_of(library, sizes, order)
        self.names = self.layout.pointers

    def pointers(self) -> Pointers:
        """Load all pointers of the table."""
        return {name: self.get("ptr", "%table", k) for k, name in enumerate(self.names)}

    def samples_of(self, k: int) -> Pointers:
        """Load the pointers of the k-th Measurements."""
        first = len(self.names) + len(OF_SAMPLES) * k
        return {name: self.get("ptr", "%table", first + m) for m, name in enumerate(OF_SAMPLES)}

    def into(self, pointer: Operand, offset: int) -> Value:
        """Emit an address, in bytes from a pointer."""
        return self.let("ptr", f"getelementptr inbounds i8, ptr {pointer}, i64 {offset}")

    def call(self, name: str, given: Pointers) -> None:
        """Emit the call of a straight-line function with its pointers."""
        self.invoke(name, *(given[key] for key in self.module.pointers[name]))

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

    def zero(self, pointer: Value, count: Operand) -> None:
        """Write zeros to `count` doubles."""
        self.module.declare("llvm.memset.p0.i64", "declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)")
        self.line(f"call void @llvm.memset.p0.i64(ptr {pointer}, i8 0, i64 {8 * count}, i1 false)")

    def copy(self, target: Value, source: Operand, count: int) -> None:
        """Copy `count` doubles, or integers of 64 bits."""
        self.module.declare("llvm.memcpy.p0.p0.i64", "declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)")
        self.line(f"call void @llvm.memcpy.p0.p0.i64(ptr {target}, ptr {source}, i64 {8 * count}, i1 false)")
