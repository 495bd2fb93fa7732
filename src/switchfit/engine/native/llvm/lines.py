"""Emit LLVM IR: values with arithmetic, addresses, loads and stores, loops and conditions."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

Operand = Any
"""A `Value`, or a number of the type that the other operand has."""

CONVERSIONS = {("i64", "double"): "sitofp", ("double", "i64"): "fptosi", ("i1", "i64"): "zext"}


def literal(number: float) -> str:
    """Return a double as LLVM's hexadecimal literal, which is exact."""
    return f"0x{struct.unpack('<Q', struct.pack('<d', number))[0]:016X}"


def _operator(of_integers: str, of_doubles: str, swapped: bool = False) -> Callable[[Any, Operand], Any]:
    """Return the method of a value that emits an instruction with another operand, or the other way round."""

    def method(self: Value, other: Operand) -> Value:
        instruction, given = of_doubles if "double" in self.kind else of_integers, (self, other)
        one, two = (self.lines.write(a, self.kind) for a in (given[::-1] if swapped else given))
        return self.lines.let("i1" if "cmp" in instruction else self.kind, f"{instruction} {self.kind} {one}, {two}")

    method.__doc__ = f"Return the result of an instruction with another value: {of_integers or of_doubles}."
    return method


class Value:
    """The name of a value in emitted code and its type; arithmetic with it emits instructions."""

    __slots__ = ("kind", "lines", "name")

    def __init__(self, lines: Lines, kind: str, name: str) -> None:
        self.lines, self.kind, self.name = lines, kind, name

    def __str__(self) -> str:
        return self.name

    __add__ = __radd__ = _operator("add", "fadd")
    __sub__, __rsub__ = _operator("sub", "fsub"), _operator("sub", "fsub", swapped=True)
    __mul__ = __rmul__ = _operator("mul", "fmul")
    __truediv__, __rtruediv__ = _operator("", "fdiv"), _operator("", "fdiv", swapped=True)
    __rshift__ = _operator("lshr", "")
    __and__, __or__ = _operator("and", ""), _operator("or", "")
    __lt__, __le__ = _operator("icmp slt", "fcmp olt"), _operator("icmp sle", "fcmp ole")
    __gt__, __ge__ = _operator("icmp sgt", "fcmp ogt"), _operator("icmp sge", "fcmp oge")
    equals, differs = _operator("icmp eq", "fcmp oeq"), _operator("icmp ne", "fcmp une")

    def choose(self, yes: Operand, no: Operand) -> Value:
        """Return one of two values, by a condition."""
        kind = (yes if isinstance(yes, Value) else no).kind
        one, other = (f"{kind} {self.lines.write(a, kind)}" for a in (yes, no))
        return self.lines.let(kind, f"select i1 {self}, {one}, {other}")

    def to(self, kind: str) -> Value:
        """Return the value as another type."""
        return self.lines.let(kind, f"{CONVERSIONS[self.kind, kind]} {self.kind} {self} to {kind}")


class Variable:
    """Memory of one value that changes while a function runs."""

    def __init__(self, lines: Lines, kind: str, initial: Operand) -> None:
        self._lines, self._kind, self._place = lines, kind, lines.allocate(kind)
        self.value = initial

    @property
    def value(self) -> Value:
        """What it is now."""
        return self._lines.load(self._kind, self._place)

    @value.setter
    def value(self, value: Operand) -> None:
        self._lines.store(value, self._place, self._kind)


class Lines:
    """Emits functions, one at a time.

    Attributes
    ----------
    lines : list of str
        Lines of the current function.
    """

    def __init__(self) -> None:
        self._reset()

    def _reset(self) -> None:
        self.lines: list[str] = []
        self._allocated: list[str] = []
        self.count, self._block, self._signature = 0, "entry", ""

    def begin(self, signature: str) -> list[Value]:
        """Begin a function, such as ``void @name(i64 %count)``; return its parameters."""
        # `internal void @name(ptr %A, i64 %m)` yields a value for %A and one for %m.
        self._signature, given = signature, signature[signature.index("(") + 1 : -1].split(", ")
        return [Value(self, *each.split()) for each in given if each]

    def end(self, result: str = "void") -> str:
        """End the function with a result; return its text."""
        ends = [] if self._has_ended else [f"  ret {result}"]
        body = "\n".join(["entry:", *self._allocated, *self.lines, *ends])
        text = f"define {self._signature} {{\n{body}\n}}\n"
        self._reset()
        return text

    def line(self, text: str) -> None:
        """Emit a line."""
        self.lines.append(f"  {text}")

    def label(self, name: str) -> None:
        """Emit a label: the start of a block, to which the one before leads if it has not ended."""
        self.go_to(name)
        self.lines.append(f"{name}:")
        self._block = name

    def go_to(self, name: str) -> None:
        """Emit a jump to a block, if the current one has not ended."""
        if not self._has_ended:
            self.line(f"br label %{name}")

    @property
    def _has_ended(self) -> bool:
        # LLVM refuses instructions behind a jump or a return, the last ones of their block.
        return bool(self.lines) and self.lines[-1].startswith(("  br ", "  ret ", "  switch "))

    def let(self, kind: str, text: str) -> Value:
        """Emit an instruction whose value has this type."""
        self.count += 1
        self.line(f"%t{self.count} = {text}")
        return Value(self, kind, f"%t{self.count}")

    def write(self, operand: Operand, kind: str) -> str:
        """Return an operand of a type as text."""
        if isinstance(operand, Value):
            return operand.name
        # Decimal numbers would be rounded on the way; truth values are `true` and `false`.
        return literal(operand) if kind == "double" else str(operand).lower()

    def allocate(self, kind: str, count: int = 1) -> Value:
        """Emit memory of the function for so many values."""
        name = f"%memory{len(self._allocated)}"
        # It goes to the start of the function, wherever it is asked for: in the body of a loop, an alloca would take
        # new memory of the stack in each iteration.
        self._allocated.append(f"  {name} = alloca [{count} x {kind}], align 8")
        return Value(self, "ptr", name)

    def load(self, kind: str, pointer: Operand) -> Value:
        """Emit a load from a pointer. Vectors are aligned as doubles are."""
        return self.let(kind, f"load {kind}, ptr {pointer}, align 8")

    def store(self, value: Operand, pointer: Operand, kind: str = "double") -> None:
        """Emit a store to a pointer of a value, or of a number of this type."""
        kind = value.kind if isinstance(value, Value) else kind
        self.line(f"store {kind} {self.write(value, kind)}, ptr {pointer}, align 8")

    def at(self, pointer: Operand, *factors: Operand) -> Value:
        """Emit the address of ``pointer[product of the factors]``, in doubles."""
        offset = factors[0]
        for factor in factors[1:]:
            offset = offset * factor
        return self.let("ptr", f"getelementptr inbounds double, ptr {pointer}, i64 {offset}")

    def get(self, kind: str, pointer: Operand, *factors: Operand) -> Value:
        """Emit the load of ``pointer[product of the factors]``."""
        return self.load(kind, self.at(pointer, *factors))

    def put(self, value: Operand, pointer: Operand, *factors: Operand) -> None:
        """Emit the store of a value at ``pointer[product of the factors]``."""
        self.store(value, self.at(pointer, *factors))

    def spread(self, value: Operand, width: int) -> Value:
        """Emit the vector with this value in all entries."""
        # LLVM's idiom of a broadcast: into entry 0 of an undefined vector, then entry 0 to all.
        kind, zeros = f"<{width} x double>", f"<{width} x i32> zeroinitializer"
        one = self.let(kind, f"insertelement {kind} poison, double {value}, i64 0")
        return self.let(kind, f"shufflevector {kind} {one}, {kind} poison, {zeros}")

    def invoke(self, name: str, *given: Operand) -> None:
        """Emit the call of a function with values and integers."""
        arguments = ", ".join(f"{a.kind} {a}" if isinstance(a, Value) else f"i64 {a}" for a in given)
        self.line(f"call void @{name}({arguments})")

    def name_block(self) -> str:
        """Return a new name for blocks."""
        self.count += 1
        return f"block{self.count}"

    @contextmanager
    def loop(self, start: Operand, stop: Operand, step: int = 1) -> Iterator[Value]:
        """Emit a loop whose body is what is emitted inside; the value is its counter."""
        # The counter is a phi: it has one value if the loop is entered from the block before, another at the end of an
        # iteration. The body may end in another block than the one it begins in, so that the counter increases in a
        # block of its own, `_end`, whose name is known in advance.
        name, before = self.name_block(), self._block
        k = Value(self, "i64", f"%{name}_k")
        self.label(name)
        self.line(f"{k} = phi i64 [{start}, %{before}], [{k}_next, %{name}_end]")
        self.line(f"br i1 {k < stop}, label %{name}_body, label %{name}_out")
        self.label(f"{name}_body")
        yield k
        self.label(f"{name}_end")
        self.line(f"{k}_next = add i64 {k}, {step}")
        self.go_to(name)
        self.label(f"{name}_out")

    @contextmanager
    def repeat(self) -> Iterator[Callable[[Value], None]]:
        """Emit an endless loop; the value is a function that emits its end where a condition holds."""
        # The caller may leave at several places of the body, each of which begins a new block.
        name = self.name_block()

        def leave(condition: Value) -> None:
            on = self.name_block()
            self.line(f"br i1 {condition}, label %{name}_out, label %{on}")
            self.label(on)

        self.label(name)
        yield leave
        self.go_to(name)
        self.label(f"{name}_out")

    @contextmanager
    def when(self, condition: Value) -> Iterator[None]:
        """Emit what is emitted inside for a condition that holds."""
        name = self.name_block()
        self.line(f"br i1 {condition}, label %{name}, label %{name}_end")
        self.label(name)
        yield
        self.label(f"{name}_end")
