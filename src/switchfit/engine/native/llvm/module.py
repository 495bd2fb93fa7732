"""Modules of LLVM: expression graphs written as straight-line functions, and hand-written functions beside them."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from switchfit.engine.native.llvm.lines import Lines, Operand, Value, literal
from switchfit.engine.native.llvm.routines import count_doubles, write_factorize, write_solve
from switchfit.engine.native.scalars.graph import Node, list_needed
from switchfit.engine.native.scalars.operations import FROM_LIBM, OPERATIONS

LOOKUP = 3
"""Cost of a table lookup, in additions."""

_HEADER = re.compile(r"^define (\w+ @[\w.]+\(.*\))", re.MULTILINE)


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
        # Everything is computed before the first store: `x_after` may be `x`, and sums are read and written.
        for node in nodes:
            writer.value(node)
        # A vector counts as its parts of 4 doubles, which one register of AVX2 holds.
        self.work[name] = sum(_estimate_cost(node) * (1 + self.width // 4 if node.vector else 1) for node in nodes)
        for pointer, offset, node in stores:
            writer.used.add(pointer)
            writer.store(writer.value(node), writer.place(f"%{pointer}", offset, node))
        self.pointers[name] = tuple(sorted(writer.used))
        writer.begin(f"void @{self.prefix}{name}({', '.join(f'ptr %{pointer}' for pointer in self.pointers[name])})")
        self._functions.append(writer.end())

    def add(self, text: str) -> None:
        """Add a hand-written function; all function names in it, except LLVM's intrinsics, get the prefix."""
        # Orders of derivatives share a program: the prefix keeps `evaluate` of one apart from that of another.
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
            self.module.declare("lu_factorize", write_factorize())
            table, f_x = self._table(np.array(a).reshape(-1)), self._store_all(entries, node)
            self.invoke("lu_factorize", results, f_x, table, self.value(h), n, len(a))
        return results

    def _solve(self, node: Node) -> Value:
        """Call the solution of a linear system; return the address of its results."""
        factors, transposed, *right = node.args
        name = "lu_solve_vectors" if node.vector else "lu_solve_transposed" if transposed else "lu_solve"
        self.module.declare(name, write_solve(name, self.module.width))
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
        # Named by content: equal tables of a module are one, and its text stays the same in every process.
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
