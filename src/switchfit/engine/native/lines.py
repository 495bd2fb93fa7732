"""Emit LLVM IR line by line: names of values, addresses, loads, loops."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any


class Lines:
    """Emits functions, one at a time.

    Attributes
    ----------
    lines : list of str
        Lines of the current function.
    """

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.count = 0
        self._block = "entry"

    def line(self, text: str) -> None:
        """Emit a line."""
        self.lines.append(f"  {text}")

    def label(self, name: str) -> None:
        """Emit a label: the start of a block."""
        self.lines.append(f"{name}:")
        self._block = name

    def let(self, text: str) -> str:
        """Emit an instruction; return the name of its value."""
        self.count += 1
        self.line(f"%t{self.count} = {text}")
        return f"%t{self.count}"

    def load(self, kind: str, pointer: str) -> str:
        """Emit a load from a pointer; return the name of the value. Vectors are aligned as doubles are."""
        return self.let(f"load {kind}, ptr {pointer}, align 8")

    def store(self, kind: str, value: str, pointer: str) -> None:
        """Emit a store to a pointer."""
        self.line(f"store {kind} {value}, ptr {pointer}, align 8")

    def at(self, pointer: str, *factors: Any) -> str:
        """Emit the address of ``pointer[product of the factors]``, in doubles."""
        offset = str(factors[0])
        for factor in factors[1:]:
            offset = self.let(f"mul i64 {offset}, {factor}")
        return self.let(f"getelementptr inbounds double, ptr {pointer}, i64 {offset}")

    def spread(self, value: str, width: int) -> str:
        """Emit the vector with this value in all entries."""
        one = self.let(f"insertelement <{width} x double> poison, double {value}, i64 0")
        zeros = f"<{width} x i32> zeroinitializer"
        return self.let(f"shufflevector <{width} x double> {one}, <{width} x double> poison, {zeros}")

    @contextmanager
    def loop(self, start: str, stop: str, step: int = 1) -> Iterator[str]:
        """Emit a loop whose body is what is emitted inside; the value is the name of its counter."""
        self.count += 1
        name, before = f"loop{self.count}", self._block
        self.line(f"br label %{name}")
        self.label(name)
        self.line(f"%{name}_k = phi i64 [{start}, %{before}], [%{name}_next, %{name}_end]")
        goes_on = self.let(f"icmp slt i64 %{name}_k, {stop}")
        self.line(f"br i1 {goes_on}, label %{name}_body, label %{name}_out")
        self.label(f"{name}_body")
        yield f"%{name}_k"
        self.line(f"br label %{name}_end")
        self.label(f"{name}_end")
        self.line(f"%{name}_next = add i64 %{name}_k, {step}")
        self.line(f"br label %{name}")
        self.label(f"{name}_out")

    def end_function(self, signature: str, returns: bool = True) -> str:
        """Wrap the emitted lines into one LLVM function and reset; `returns` adds a return at its end."""
        end = "\n  ret void" if returns else ""
        text = f"define {signature} {{\nentry:\n" + "\n".join(self.lines) + f"{end}\n}}\n"
        self.lines, self.count, self._block = [], 0, "entry"
        return text
