"""The writer of loops: emits functions that call straight-line functions, given the pointers of a program's table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from switchfit.engine.native.layout import layout_of
from switchfit.engine.native.llvm.lines import Lines, Operand, Value
from switchfit.engine.native.llvm.module import Module
from switchfit.engine.native.sizes import Order, Sizes
from switchfit.problem.structure import Structure

Pointers = dict[str, Value]
"""Addresses by the names of the pointers of straight-line functions."""


class Writer(Lines):
    """Emits the functions of a library, one at a time.

    Attributes
    ----------
    library, sizes, order, module : as given
    layout : MemoryLayout
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
        # All of them, whatever the function uses: LLVM drops the loads that nothing reads.
        return {name: self.get("ptr", "%table", k) for k, name in enumerate(self.names)}

    def at_row(self, found: Pointers, row: Operand, *names: str, suffix: str = "") -> Pointers:
        """Emit the addresses of parts of the scratch space at a row, as names with a suffix."""
        # The step is 0 for a part that has no room for each row: the same address for all of them.
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
        # `write_straight_line` sorts its pointers by name: so does every call of it.
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
        # A switch jumps to the end by default: -1, for no function at all, is none of the cases.
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


def write_loop(writer: Writer, name: str) -> str:
    """Write the calls of a straight-line function at `count` points, from one to the next its pointers advance by
    given numbers of bytes.
    """
    keys = writer.module.pointers[name]
    pointers = "".join(f", ptr %{key}, i64 %{key}_step" for key in keys)
    count, *given = writer.begin(f"void @each_{name}(i64 %count{pointers})")
    with writer.loop(0, count) as k:
        # A step of 0 bytes keeps a pointer where it is: p and the constants are the same at all points.
        each = zip(keys, given[::2], given[1::2], strict=True)
        writer.call(name, {key: writer.into(pointer, k * step) for key, pointer, step in each})
    return writer.end()
