"""Write expression graphs as LLVM functions, and compile LLVM modules to machine code.

Object code is cached in the folder of `switchfit.runtime.cache`; the next process loads it from there.

Emit LLVM IR: values with arithmetic, addresses, loads and stores, loops and conditions.

Routines that straight-line code calls: LU with partial pivoting of the coupled equations of an implicit row.

A node of a graph is a call (`scalars.Graph.call`), whose results are in memory:

    factors     (n, a, place, h, entries of f_x): L and U of ``I - h a_jl f_x[j]`` (m, m), m = s n, in rows of m and
                `LANES` doubles, then the row that each pivot is in, (m,). They lie at this place
                behind `kept`, if it is not None; without h and f_x they are there already
    solution    (factors, transposed, right-hand side): m scalars or vectors
    entry       (solution, k): the k-th of them
"""

from __future__ import annotations

import ctypes
import ctypes.util
import hashlib
import re
import struct
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import llvmlite
import llvmlite.binding as llvm
import numpy as np
from numpy.typing import NDArray

from switchfit.engine.native.scalars import FROM_LIBM, OPERATIONS, Node, list_needed
from switchfit.runtime.cache import get_usable_folder, read_code, write_code

Found = TypeVar("Found")

Operand = Any
"""A `Value`, or a number of the type that the other operand has."""


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


CONVERSIONS = {("i64", "double"): "sitofp", ("double", "i64"): "fptosi", ("i1", "i64"): "zext"}


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
        return literal(operand) if kind == "double" else str(operand).lower()

    def allocate(self, kind: str, count: int = 1) -> Value:
        """Emit memory of the function for so many values."""
        name = f"%memory{len(self._allocated)}"
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


LANES = 8
"""Entries of a row that are computed together."""


def count_doubles(m: int) -> int:
    """Return the size of the factors of m equations."""
    return m * (m + LANES) + m


class _Matrix(Lines):
    """Emits the code of a routine for a matrix `%A` of `%m` rows, which have room for `LANES` entries behind them."""

    def set_rows(self, A: Value, m: Value) -> None:
        """Emit what all routines begin with."""
        self.A, self.columns = A, m + LANES
        self.pivots = self.at(A, m, self.columns)

    def entry(self, row: Value, column: Value) -> Value:
        """Emit the address of an entry of the matrix."""
        return self.at(self.at(self.A, row, self.columns), column)

    def subtract_multiple(self, kind: str, target: Value, factor: Value, source: Value) -> None:
        """Emit ``target -= factor * source`` for values of a kind in memory."""
        self.store(self.load(kind, target) - factor * self.load(kind, source), target)

    def exchange(self, kind: str, one: Value, other: Value) -> None:
        """Emit the exchange of two values in memory."""
        values = self.load(kind, one), self.load(kind, other)
        self.store(values[0], other)
        self.store(values[1], one)


def _write_factorize() -> str:
    w, lanes = _Matrix(), f"<{LANES} x double>"
    A, f_x, a, h, n, s = w.begin("internal void @lu_factorize(ptr %A, ptr %f_x, ptr %a, double %h, i64 %n, i64 %s)")
    m = n * s
    w.set_rows(A, m)
    largest, place = Variable(w, "double", 0.0), Variable(w, "i64", 0)
    # Room behind each row, which is zero, lets all loops over columns take LANES at a time.
    with w.loop(0, m) as row, w.loop(0, w.columns) as column:
        w.store(0.0, w.entry(row, column))
    # Block (j, l) is -h a_jl f_x[j], and 1 is added on the diagonal.
    with w.loop(0, s) as j, w.loop(0, n) as row:
        line = j * n + row
        with w.loop(0, s) as block:
            factor = h * w.get("double", a, j * s + block)
            target, source = w.entry(line, block * n), w.at(f_x, line, n)
            with w.loop(0, n) as column:
                w.subtract_multiple("double", w.at(target, column), factor, w.at(source, column))
        diagonal = w.entry(line, line)
        w.store(w.load("double", diagonal) + 1.0, diagonal)
    with w.loop(0, m) as k:
        # Row k is exchanged with the one that has the largest entry of column k, as in LAPACK's dgetrf; then W_i -=
        # L_ik W_k.
        largest.value, place.value = -1.0, k
        with w.loop(k, m) as row:
            entry = w.load("double", w.entry(row, k))
            size = (entry < 0.0).choose(0.0 - entry, entry)
            is_larger = size > largest.value
            largest.value, place.value = is_larger.choose(size, largest.value), is_larger.choose(row, place.value)
        pivot = place.value
        w.put(pivot, w.pivots, k)
        with w.loop(0, m, LANES) as column:
            w.exchange(lanes, w.entry(k, column), w.entry(pivot, column))
        inverse = 1.0 / w.load("double", w.entry(k, k))
        with w.loop(k + 1, m) as row:
            target = w.entry(row, k)
            factor = inverse * w.load("double", target)
            w.store(factor, target)
            factors = w.spread(factor, LANES)
            with w.loop(k + 1, m, LANES) as column:
                w.subtract_multiple(lanes, w.entry(row, column), factors, w.entry(k, column))
    return w.end()


def _write_solve(name: str, width: int) -> str:
    """Write the solution for a right-hand side `%b`, column by column of the factors, or of their transposes."""
    w, transposed = _Matrix(), name == "lu_solve_transposed"
    lanes = width if name == "lu_solve_vectors" else 1
    kind = f"<{lanes} x double>" if lanes > 1 else "double"
    A, b, m = w.begin(f"internal void @{name}(ptr %A, ptr %b, i64 %m)")

    def value(row: Value) -> Value:
        return w.at(b, row, lanes)

    def factor(row: Value, column: Value) -> Value:
        found = w.load("double", w.entry(column, row) if transposed else w.entry(row, column))
        return w.spread(found, lanes) if lanes > 1 else found

    def exchange(k: Value) -> None:
        w.exchange(kind, value(k), value(w.get("i64", w.pivots, k)))

    def subtract_column(column: Value, first: Operand, last: Value) -> None:
        with w.loop(first, last) as row:
            w.subtract_multiple(kind, value(row), factor(row, column), value(column))

    def divide(row: Value) -> None:
        w.store(w.load(kind, value(row)) / factor(row, row), value(row))

    # P A = L U. A x = b: exchange, L forward, U backward. A' x = b: U' forward, L' backward, exchange in the other
    # order.
    w.set_rows(A, m)
    if not transposed:
        with w.loop(0, m) as k:
            exchange(k)
    with w.loop(0, m) as column:
        if transposed:
            divide(column)
        subtract_column(column, column + 1, m)
    with w.loop(0, m) as k:
        column = m - 1 - k
        if not transposed:
            divide(column)
        subtract_column(column, 0, column)
    if transposed:
        with w.loop(0, m) as k:
            exchange(m - 1 - k)
    return w.end()


NEEDED_NEXT = "scipy.linalg.lapack", "scipy.special"
"""What a fit and its report will import, which takes a few tenths of a second."""

LOOKUP = 3
"""Cost of a table lookup, in additions."""


class Module:
    """Text of LLVM functions, collected one by one and taken in parts.

    Parameters
    ----------
    width : int
        Number of entries of a vector.
    prefix : str
        Prefix of the names of all functions.

    Attributes
    ----------
    work, pointers : dict
        Cost of each straight-line function, in additions, and the pointers that it takes.
    row_work : list of int
        Work of a row of each mode, if there are derivatives.
    """

    def __init__(self, width: int, prefix: str = "") -> None:
        self.width, self.prefix = width, prefix
        self.vector = f"<{width} x double>"
        self._functions: list[str] = []
        self._declared: dict[str, str] = {}
        self._written: list[str] = []
        self.work: dict[str, int] = {}
        self.row_work: list[int] = []
        self.pointers: dict[str, tuple[str, ...]] = {}

    def write_straight_line(self, name: str, stores: Sequence[tuple[str, int, Node]]) -> None:
        """Write a function that loads, computes, and then stores each ``(pointer, offset, node)``.

        All loads come before the first store. Offsets count doubles, or vectors if the node is a vector. The arguments
        are the pointers that it uses.
        """
        writer = _Writer(self)
        nodes = list_needed([node for _, _, node in stores])
        for node in nodes:
            writer.value(node)
        self.work[name] = sum(_estimate_cost(node) * (1 + self.width // 4 if node.vector else 1) for node in nodes)
        for pointer, offset, node in stores:
            writer.used.add(pointer)
            writer.store(writer.value(node), writer.place(f"%{pointer}", offset, node))
        self.pointers[name] = tuple(sorted(writer.used))
        writer.begin(f"void @{self.prefix}{name}({', '.join(f'ptr %{pointer}' for pointer in self.pointers[name])})")
        self._functions.append(writer.end())

    def add(self, text: str) -> None:
        """Add a hand-written function; all function names in it, except LLVM's intrinsics, get the prefix."""
        self._functions.append(re.sub(r"@(?!llvm\.)(\w+)\(", rf"@{self.prefix}\1(", text))

    def declare(self, name: str, signature: str) -> None:
        """Declare an external function or a constant."""
        self._declared[name] = signature

    def take(self) -> str:
        """Return the text of the functions written since the last call, as a module of its own.

        Its functions may call those taken before: `compile_modules` compiles one part while the next is written.
        """
        written, declared = "\n".join(self._functions), [*self._declared.values(), *self._written]
        self._functions, self._declared = [], {}
        # A later module needs the declarations of those that it calls in earlier ones.
        self._written += [f"declare {header}" for header in _HEADER.findall(written)]
        return "\n".join([*declared, written])


def _estimate_cost(node: Node) -> int:
    """Return the cost of a node, in additions, so that rows of 7 to 10 states have about the work of their time."""
    if node.op == "factors":
        m = int(node.args[0]) * len(node.args[1])
        return m**3 // 3 + 10 * m**2 if len(node.args) > 3 else 1
    if node.op == "solution":
        return 2 * len(node.args) ** 2
    operation = OPERATIONS.get(node.op)
    return LOOKUP if node.op == "lookup" else 1 if operation is None else operation.effort


_HEADER = re.compile(r"^define (\w+ @[\w.]+\(.*\))", re.MULTILINE)


class _Writer(Lines):
    """Emits the instructions of one function, one for each operation; `used` are the names of its pointers."""

    def __init__(self, module: Module) -> None:
        super().__init__()
        self.module, self.used = module, set[str]()
        self._values: dict[int, Value] = {}
        self._splats: dict[int, Value] = {}

    def value(self, node: Node) -> Value:
        """Return the value of a node; emit it first if needed."""
        value = self._values.get(node.index)
        if value is None:
            value = self._values[node.index] = self._emit_node(node)
        return value

    def kind(self, node: Node) -> str:
        """Return the type of a node."""
        return self.module.vector if node.vector else "i1" if node.truth else "double"

    def place(self, pointer: Operand, offset: int, node: Node) -> Operand:
        """Emit an address; the offset counts values of the type of a node."""
        return self.at(pointer, offset * (self.module.width if node.vector else 1)) if offset else pointer

    def _emit_node(self, node: Node) -> Value:
        op, args, kind = node.op, node.args, self.kind(node)
        if op == "const":
            return Value(self, kind, self.write(args[0], kind))
        if op == "load":
            self.used.add(args[0])
            return self.load(kind, self.place(f"%{args[0]}", args[1], node))
        if op == "unit":
            entries = (f"double {literal(float(k == args[0]))}" for k in range(self.module.width))
            return Value(self, kind, "<" + ", ".join(entries) + ">")
        if op == "table":
            return self._table(node.values)
        if op == "lookup":
            return self.get(kind, self.value(args[0]), self.value(args[1]).to("i64"))
        if op == "entry":
            return self.load(kind, self.place(self.value(args[0]), args[1], node))
        if op == "factors":
            return self._factorize(node)
        if op == "solution":
            return self._solve(node)
        operation = OPERATIONS[op]
        if operation.function is not None:
            operands = ", ".join(["double"] * operation.operands)
            # C functions have no side effects that matter.
            memory = " memory(none) nounwind willreturn" if operation.function in FROM_LIBM else ""
            self.module.declare(operation.function, f"declare double @{operation.function}({operands}){memory}")
        return self.let(kind, operation.code.format(*(self._as(a, node.vector) for a in args), type=kind))

    def _factorize(self, node: Node) -> Value:
        """Call the factorization, if the factors are not there already; return their address."""
        n, a, place, *given = node.args
        if place is None:
            results = self.allocate("double", count_doubles(n * len(a)))
        else:
            self.used.add("kept")
            results = self.at("%kept", place)
        if given:
            h, *entries = given
            self.module.declare("lu_factorize", _write_factorize())
            table, f_x = self._table(np.array(a).reshape(-1)), self._store_all(entries, node)
            self.invoke("lu_factorize", results, f_x, table, self.value(h), n, len(a))
        return results

    def _solve(self, node: Node) -> Value:
        """Call the solution of a linear system; return the address of its results."""
        factors, transposed, *right = node.args
        name = "lu_solve_vectors" if node.vector else "lu_solve_transposed" if transposed else "lu_solve"
        self.module.declare(name, _write_solve(name, self.module.width))
        results = self._store_all(right, node)
        self.invoke(name, self.value(factors), results, len(right))
        return results

    def _store_all(self, values: Sequence[Node], node: Node) -> Value:
        """Store values in new memory, each of the type of a node; return its address."""
        memory = self.allocate("double", len(values) * (self.module.width if node.vector else 1))
        for k, value in enumerate(values):
            self.store(self._as(value, node.vector), self.place(memory, k, node))
        return memory

    def _table(self, values: NDArray[np.float64]) -> Value:
        """Declare a constant array, which the functions of a module share; return its name."""
        name = f"table.{hashlib.sha256(values.tobytes()).hexdigest()[:16]}"
        entries = ", ".join(f"double {literal(value)}" for value in values.tolist())
        kind = f"[{len(values)} x double]"
        self.module.declare(name, f"@{name} = private unnamed_addr constant {kind} [{entries}], align 8")
        return Value(self, "ptr", f"@{name}")

    def _as(self, node: Node, vector: bool) -> Value:
        """Return a value as an operand: a scalar is broadcast for an operation on vectors."""
        if not vector or node.vector or node.truth:
            return self.value(node)
        if node.index not in self._splats:
            self._splats[node.index] = self.spread(self.value(node), self.module.width)
        return self._splats[node.index]


class Program:
    """Machine code of a module; it is freed with this object.

    Attributes
    ----------
    key : str
        Hash of the module, the same in every process.
    lock : held during a call, since ctypes releases the GIL
    memory : array of doubles
        Scratch space. Calls share it, one at a time, so that it stays in the CPU caches.
    modules : dict of order to Module
        Of whose text it is made; that with the highest derivatives is the last.
    """

    def __init__(self, engine: Any, key: str) -> None:
        self._engine, self.key = engine, key
        self.lock, self.memory = threading.Lock(), np.zeros(0)
        self.modules: dict[Any, Module] = {}
        self._functions: dict[str, Any] = {}

    def reserve(self, size: int) -> None:
        """Allocate at least `size` doubles; the contents may be lost."""
        if len(self.memory) < size:
            self.memory = np.zeros(size)

    def function(self, name: str, count: int) -> Any:
        """Return a Python callable for a void function of so many integers and addresses."""
        if name not in self._functions:
            kind = ctypes.CFUNCTYPE(None, *[ctypes.c_int64] * count)
            self._functions[name] = kind(self._engine.get_function_address(name))
        return self._functions[name]


def compile_modules(texts: Iterable[str]) -> Program:
    """Compile modules for this processor into one program, or load their code from the cache.

    Parameters
    ----------
    texts : iterable of str
        Each may call functions of the others. While one is compiled, the next is asked for: writing takes about as long
        as compiling.
    """
    _initialize_llvm()
    folder, codes, keys = get_usable_folder(), [], []
    executor = ThreadPoolExecutor(1)  # LLVM does one thing at a time
    try:
        for text in texts:
            keys.append(hashlib.sha256("\n".join([text, llvmlite.__version__, *_get_processor()]).encode()).hexdigest())
            # The key has all that the code depends on: text, version of llvmlite, processor.
            path = None if folder is None else folder / f"native-{keys[-1]}"
            known = None if path is None else read_code(path)
            codes.append(executor.submit(_compile_to_object_code, text, path) if known is None else known)
        if any(isinstance(code, Future) for code in codes):
            for name in NEEDED_NEXT:  # Python would only wait for LLVM
                import_module(name)
        found = [wait_for(code) if isinstance(code, Future) else code for code in codes]
    finally:
        executor.shutdown(wait=False, cancel_futures=True)  # Ctrl-C does not wait for LLVM
    # One engine links the objects of all modules: addresses of functions in others are known only then.
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), _create_machine())
    for code in found:
        engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    return Program(engine, hashlib.sha256("\n".join(keys).encode()).hexdigest())


def _create_machine() -> Any:
    name, features = _get_processor()
    return llvm.Target.from_default_triple().create_target_machine(cpu=name, features=features, opt=2)


def _compile_to_object_code(text: str, path: Path | None) -> bytes:
    """Compile a module, which takes seconds for long functions; keep its code."""
    code = bytes(_create_machine().emit_object(llvm.parse_assembly(text)))
    if path is not None:
        write_code(path, code)
    return code


def wait_for(future: Future[Found]) -> Found:
    """Wait for a result so that Ctrl-C can interrupt."""
    while not wait([future], timeout=0.1).done:  # on Windows, a wait without timeout cannot be interrupted
        pass
    return future.result()


@cache
def _get_processor() -> tuple[str, str]:
    return llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten()


@cache
def _initialize_llvm() -> None:
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    libm = ctypes.CDLL("ucrtbase" if sys.platform == "win32" else ctypes.util.find_library("m"))
    for name in (*FROM_LIBM, "sincos"):
        if hasattr(libm, name):
            llvm.add_symbol(name, ctypes.cast(getattr(libm, name), ctypes.c_void_p).value)
