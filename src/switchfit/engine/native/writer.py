"""Emit LLVM IR of a library: the table of pointers, calls of functions, loops that return when a budget is spent."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from switchfit.engine.native.kernels import Kernels
from switchfit.engine.native.lines import Lines, Operand, Value
from switchfit.engine.native.llvm import Module
from switchfit.engine.native.templates import Order, Sizes
from switchfit.engine.native.workspace import OF_SAMPLES, constraint_rows, pointers
from switchfit.problem.structure import Structure

Pointers = dict[str, Value]
"""Addresses by the names of the pointers of straight-line functions."""

WHOLE = "ptr %table, i64 %segment, ptr %progress"


class Writer(Lines):
    """Emits the functions of a library, one at a time.

    Attributes
    ----------
    library, sizes, order, kernels, module : as given
    names : list of str
        Names of the pointers in the table.
    rows : dict
        First row of each kind of constraints, see `workspace.constraint_rows`.
    work : int
        Work of the functions that were called in the current iteration, in additions.
    """

    def __init__(self, library: Structure, sizes: Sizes, order: Order, kernels: Kernels, module: Module) -> None:
        super().__init__()
        self.library, self.sizes, self.order, self.kernels, self.module = library, sizes, order, kernels, module
        self.names = pointers(library, sizes, order)
        self.rows = constraint_rows(library, sizes)
        self.work = 0

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
        self.work += self.module.work(name)

    def cases(self, which: Value, count: int) -> Iterator[int]:
        """Emit a switch to one of `count` blocks, each of which is what is emitted in an iteration; -1 skips them."""
        before, most, name = self.work, self.work, self.name_block()
        cases = " ".join(f"i64 {k}, label %{name}_{k}" for k in range(count))
        self.line(f"switch i64 {which}, label %{name}_end [{cases}]")
        for k in range(count):
            self.label(f"{name}_{k}")
            self.work = before
            yield k
            most = max(most, self.work)
            self.go_to(f"{name}_end")
        self.label(f"{name}_end")
        self.work = most

    @contextmanager
    def turns(self, count: Value) -> Iterator[Value]:
        """Emit the loop of a function, which begins where the last call left off and returns when the budget is spent.

        The body is what is emitted inside; the value is its counter, which ends at `count`. `progress` has the number
        of finished iterations and the rest of the budget.
        """
        finished, budget = self.at("%progress", 1), self.at("%progress", 2)
        self.work = 0
        with self.repeat() as leave:
            turn = self.load("i64", finished)
            yield turn
            turns, left = turn + 1, self.load("i64", budget) - self.work
            self.store(turns, finished)
            self.store(left, budget)
            done = turns >= count
            leave(done | (left <= 0))
        self.store(done.choose(0, turns), finished)
        self.line(f"ret i1 {done}")

    def zero(self, pointer: Value, count: Operand) -> None:
        """Write zeros to `count` doubles."""
        self.module.declare("llvm.memset.p0.i64", "declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)")
        self.line(f"call void @llvm.memset.p0.i64(ptr {pointer}, i8 0, i64 {8 * count}, i1 false)")

    def copy(self, target: Value, source: Operand, count: int) -> None:
        """Copy `count` doubles, or integers of 64 bits."""
        self.module.declare("llvm.memcpy.p0.p0.i64", "declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)")
        self.line(f"call void @llvm.memcpy.p0.p0.i64(ptr {target}, ptr {source}, i64 {8 * count}, i1 false)")
