"""Emit LLVM IR of a library: the table of pointers, calls of functions, loops that return when a budget is spent."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from switchfit.engine.native.kernels import Kernels
from switchfit.engine.native.lines import Lines
from switchfit.engine.native.llvm import Module
from switchfit.engine.native.templates import Order, Sizes
from switchfit.engine.native.workspace import OF_SAMPLES, constraint_rows, pointers
from switchfit.problem.structure import Structure

TABLE = "ptr %table"
WHOLE = f"{TABLE}, i64 %segment, ptr %progress"


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

    def pointers(self) -> dict[str, str]:
        """Load all pointers of the table."""
        return {name: self.load("ptr", self.at("%table", k)) for k, name in enumerate(self.names)}

    def samples_of(self, k: int) -> dict[str, str]:
        """Load the pointers of the k-th Measurements."""
        first = len(self.names) + len(OF_SAMPLES) * k
        return {name: self.load("ptr", self.at("%table", first + m)) for m, name in enumerate(OF_SAMPLES)}

    def into(self, pointer: str, offset: int) -> str:
        """Emit an address, in bytes from a pointer."""
        return self.let(f"getelementptr inbounds i8, ptr {pointer}, i64 {offset}")

    def call(self, name: str, order: tuple[str, ...], given: dict[str, str]) -> int:
        """Emit the call of a straight-line function with its pointers in order; return its cost."""
        self.line(f"call void @{name}({', '.join(f'ptr {given[key]}' for key in order)})")
        self.work += self.module.work(name)
        return self.module.work(name)

    def cases(self, which: str, count: int, name: str) -> Iterator[int]:
        """Emit a switch to one of `count` blocks, each of which is what is emitted in an iteration; -1 skips them."""
        before, most = self.work, self.work
        cases = " ".join(f"i64 {k}, label %{name}_{k}" for k in range(count))
        self.line(f"switch i64 {which}, label %{name}_end [{cases}]")
        for k in range(count):
            self.label(f"{name}_{k}")
            self.work = before
            yield k
            most = max(most, self.work)
            self.line(f"br label %{name}_end")
        self.label(f"{name}_end")
        self.work = most

    @contextmanager
    def turns(self, count: str) -> Iterator[str]:
        """Emit the loop of a function, which begins where the last call left off and returns when the budget is spent.

        The body is what is emitted inside; the value is the name of its counter, which ends at `count`.
        """
        before, left = self.load_progress()
        self.line("br label %loop")
        self.label("loop")
        self.line(f"%turn = phi i64 [{before}, %entry], [%more, %next]")
        self.line(f"%budget = phi i64 [{left}, %entry], [%left, %next]")
        self.work = 0
        yield "%turn"
        self.line("br label %next")
        self.label("next")
        self.line(f"%left = sub i64 %budget, {self.work}")
        self.line("%more = add i64 %turn, 1")
        self.line(f"%done = icmp sge i64 %more, {count}")
        self.next_turn("%turn", "%done")

    def load_progress(self) -> tuple[str, str]:
        """Load from `progress` the number of finished iterations of a loop, and the rest of the budget."""
        places = (self.let(f"getelementptr inbounds i64, ptr %progress, i64 {k}") for k in (1, 2))
        turns, left = (self.load("i64", place) for place in places)
        return turns, left

    def next_turn(self, turns: str, done: str) -> None:
        """End an iteration: save the progress and return if the loop is `done` or the budget spent, else continue.

        The label of the loop is `loop`. `%left` is the budget after this iteration.
        """
        self.line(f"%turns = add i64 {turns}, 1")
        self.line("%spent = icmp sle i64 %left, 0")
        self.line(f"%stop = or i1 {done}, %spent")
        self.line("br i1 %stop, label %out, label %loop")
        self.label("out")
        self.line(f"%place = select i1 {done}, i64 0, i64 %turns")
        for k, value in ((1, "%place"), (2, "%left")):
            place = self.let(f"getelementptr inbounds i64, ptr %progress, i64 {k}")
            self.line(f"store i64 {value}, ptr {place}")
        self.line(f"ret i1 {done}")


def zero(writer: Writer, pointer: str, count: str) -> None:
    """Write zeros to `count` doubles."""
    writer.module.declare("llvm.memset.p0.i64", "declare void @llvm.memset.p0.i64(ptr, i8, i64, i1)")
    size = writer.let(f"mul i64 {count}, 8")
    writer.line(f"call void @llvm.memset.p0.i64(ptr {pointer}, i8 0, i64 {size}, i1 false)")


def copy(writer: Writer, target: str, source: str, count: int) -> None:
    """Copy `count` doubles, or integers of 64 bits."""
    writer.module.declare("llvm.memcpy.p0.p0.i64", "declare void @llvm.memcpy.p0.p0.i64(ptr, ptr, i64, i1)")
    writer.line(f"call void @llvm.memcpy.p0.p0.i64(ptr {target}, ptr {source}, i64 {8 * count}, i1 false)")
