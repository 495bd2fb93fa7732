"""Write expression graphs as LLVM functions, and compile LLVM modules to machine code.

Object code is cached in the folder of `switchfit.runtime.cache`; the next process loads it from there.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import hashlib
import re
import sys
import threading
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import llvmlite
import llvmlite.binding as llvm
import numpy as np
from numpy.typing import NDArray

from switchfit.engine.native import routines
from switchfit.engine.native.lines import Lines, Operand, literal
from switchfit.engine.native.operations import FROM_LIBM, OPERATIONS, Operation
from switchfit.engine.native.scalars import Node, list_needed
from switchfit.runtime.cache import get_usable_folder, read_code, write_code

NEEDED_NEXT = "scipy.linalg.lapack", "scipy.special"
"""What a fit and its report will import, which takes a few tenths of a second."""

LOOKUP = 3
"""Cost of a table lookup, in additions."""

BUDGET = 20_000_000
"""Work, in additions, after which a loop returns to Python, which then handles Ctrl-C. Measured: 2 to 10 ms."""


class Module:
    """Text of LLVM functions, collected one by one and taken in parts.

    Parameters
    ----------
    width : int
        Number of entries of a vector.
    prefix : str
        Prefix of the names of all functions.
    """

    def __init__(self, width: int, prefix: str = "") -> None:
        self.width, self.prefix = width, prefix
        self.vector = f"<{width} x double>"
        self._functions: list[str] = []
        self._declared: dict[str, str] = {}
        self._written: dict[str, str] = {}
        self._work: dict[str, int] = {}
        self.pointers: dict[str, tuple[str, ...]] = {}

    def write_straight_line(
        self, name: str, stores: Sequence[tuple[str, int, Node]], pointers: Sequence[str] = ()
    ) -> None:
        """Write a function that loads, computes, and then stores each ``(pointer, offset, node)``.

        All loads come before the first store. Offsets count doubles, or vectors if the node is a vector. The arguments
        are the `pointers`; by default those that it uses, which the module lists by the name of the function.
        """
        writer = _Writer(self)
        nodes = list_needed([node for _, _, node in stores])
        for node in nodes:
            writer.value(node)
        self._work[name] = sum(self._estimate_cost(node) for node in nodes)
        for pointer, offset, node in stores:
            if node.truth:
                raise TypeError(f"a truth value cannot be stored at {pointer}[{offset}], which is a double")
            writer.used.add(pointer)
            writer.store_node(node, writer.value(node), writer.place(f"%{pointer}", offset, node))
        self.pointers[name] = tuple(pointers or sorted(writer.used))
        writer.begin(f"void @{self.prefix}{name}({', '.join(f'ptr %{pointer}' for pointer in self.pointers[name])})")
        self._functions.append(writer.end())

    def work(self, name: str) -> int:
        """Return the cost of a straight-line function, in additions."""
        return self._work[name]

    def _estimate_cost(self, node: Node) -> int:
        if node.op in routines.OPERATIONS:
            return routines.estimate_cost(node) * (1 + self.width // 4 if node.vector else 1)
        operation = OPERATIONS.get(node.op)
        effort = LOOKUP if node.op == "lookup" else 1 if operation is None else operation.effort
        return effort * (1 + self.width // 4 if node.vector else 1)

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
        written, self._functions = "\n".join(self._functions), []
        declared, self._declared = self._declared, {}
        called = {name: self._written[name] for name in _CALLED.findall(written) if name in self._written}
        # A later module needs the declarations of those that it calls in earlier ones.
        self._written |= {name: f"declare {header}" for header, name in _HEADER.findall(written)}
        return "\n".join([*declared.values(), *called.values(), written])


_CALLED = re.compile(r"call \w+ @([\w.]+)\(")
_HEADER = re.compile(r"^define (\w+ @([\w.]+)\(.*\))", re.MULTILINE)


def _write_declaration(operation: Operation) -> str:
    """Return the declaration of the function that an operation calls; C functions are declared without side effects."""
    operands = ", ".join(["double"] * operation.operands)
    memory = " memory(none) nounwind willreturn" if operation.function in FROM_LIBM else ""
    return f"declare double @{operation.function}({operands}){memory}"


class _Writer(Lines):
    """Emits the instructions of one function, one for each operation; `used` are the names of its pointers."""

    def __init__(self, module: Module) -> None:
        super().__init__()
        self.module, self.used = module, set[str]()
        self._names: dict[int, str] = {}
        self._splats: dict[int, str] = {}

    def value(self, node: Node) -> str:
        """Return the name of the value of a node, or its literal; emit it first if needed."""
        name = self._names.get(node.index)
        if name is None:
            name = self._names[node.index] = self._emit_node(node)
        return name

    def kind(self, node: Node) -> str:
        """Return the type of a node."""
        return self.module.vector if node.vector else "i1" if node.truth else "double"

    def place(self, pointer: Operand, offset: int, node: Node) -> Operand:
        """Emit an address; the offset counts values of the type of a node."""
        return self.at(pointer, offset * (self.module.width if node.vector else 1)) if offset else pointer

    def load_node(self, node: Node, place: Operand) -> str:
        """Emit the load of a node."""
        return self.load(self.kind(node), place).name

    def store_node(self, node: Node, value: str, place: Operand) -> None:
        """Emit the store of a value of the type of a node."""
        self.line(f"store {self.kind(node)} {value}, ptr {place}, align 8")

    def _emit_node(self, node: Node) -> str:
        op, args = node.op, node.args
        if op == "const":
            return str(args[0]).lower() if isinstance(args[0], bool) else literal(args[0])
        if op == "load":
            self.used.add(args[0])
            return self.load_node(node, self.place(f"%{args[0]}", args[1], node))
        if op == "unit":
            entries = (f"double {literal(float(k == args[0]))}" for k in range(self.module.width))
            return "<" + ", ".join(entries) + ">"
        if op == "zeros":
            return "zeroinitializer"
        if op == "table":
            return self._table(node.values)
        if op == "lookup":
            index = self.assign(f"fptosi double {self.value(args[1])} to i64")
            return self.load_node(node, self.at(self.value(args[0]), index))
        if op == "entry":
            return self.load_node(node, self.place(self.value(args[0]), args[1], node))
        if op in routines.OPERATIONS:
            return self._call_routine(node)
        operation = OPERATIONS[op]
        if operation.function is not None:
            self.module.declare(operation.function, _write_declaration(operation))
        return self.assign(operation.code.format(*(self._as(a, node.vector) for a in args), type=self.kind(node)))

    def _call_routine(self, node: Node) -> str:
        """Call the routine of a node; return the address of its results."""
        name = routines.find_name(node)
        given = [a for a in node.args if isinstance(a, Node) and a.op != "factors"]
        kept = ""
        if node.op == "factors" and node.args[2] is not None:
            self.used.add("kept")
            kept = self.at("%kept", node.args[2]).name
        if not given:
            return kept
        self.module.declare(name, routines.write(name, self.module.width))
        if node.op == "solution":
            results = self._store_all(given, node)
            self.line(f"call void @{name}(ptr {self.value(node.args[0])}, ptr {results}, i64 {len(given)})")
            return results
        (n, a), (h, *entries) = node.args[:2], given
        table = self._table(np.array(a).reshape(-1))
        numbers = f"ptr {table}, double {self.value(h)}, i64 {n}, i64 {len(a)}"
        results = kept or self.allocate("double", routines.count_doubles(n * len(a))).name
        self.line(f"call void @{name}(ptr {results}, ptr {self._store_all(entries, node)}, {numbers})")
        return results

    def _store_all(self, values: Sequence[Node], node: Node) -> str:
        """Store values in new memory, each of the type of a node; return its address."""
        memory = self.allocate("double", len(values) * (self.module.width if node.vector else 1))
        for k, value in enumerate(values):
            self.store_node(node, self._as(value, node.vector), self.place(memory, k, node))
        return memory.name

    def _table(self, values: NDArray[np.float64]) -> str:
        """Declare a constant array, which the functions of a module share; return its name."""
        name = f"table.{hashlib.sha256(values.tobytes()).hexdigest()[:16]}"
        entries = ", ".join(f"double {literal(value)}" for value in values.tolist())
        kind = f"[{len(values)} x double]"
        self.module.declare(name, f"@{name} = private unnamed_addr constant {kind} [{entries}], align 8")
        return f"@{name}"

    def _as(self, node: Node, vector: bool) -> str:
        """Return a value as an operand: a scalar is broadcast for an operation on vectors."""
        if not vector or node.vector or node.truth:
            return self.value(node)
        if node.index not in self._splats:
            self._splats[node.index] = self.spread(self.value(node), self.module.width).name
        return self._splats[node.index]


class Workspace:
    """Scratch space of a program. Calls share it, one at a time, so that it stays in the CPU caches.

    Attributes
    ----------
    lock : held during a call, since ctypes releases the GIL
    memory : array of doubles
    """

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.memory = np.zeros(0)

    def reserve(self, size: int) -> None:
        """Allocate at least `size` doubles; the contents may be lost."""
        if len(self.memory) < size:
            self.memory = np.zeros(size)


class Program:
    """Machine code of a module; it is freed with this object.

    Attributes
    ----------
    key : str
        Hash of the module, the same in every process.
    workspace : Workspace
    layouts : dict
        Layout of the memory that each order of derivatives works on, built by its first experiment.
    row_work : list of int
        Work of a row of each mode in an evaluation with second derivatives, in additions, if it has them.
    pointers : dict
        Names of the pointers that each straight-line function takes.
    """

    def __init__(self, engine: Any, key: str) -> None:
        self._engine, self.key = engine, key
        self.workspace = Workspace()
        self.layouts: dict[int, Any] = {}
        self.row_work: list[int] = []
        self.pointers: dict[str, tuple[str, ...]] = {}
        self._functions: dict[str, Any] = {}

    def address(self, name: str) -> int:
        """Return the address of a function."""
        return int(self._engine.get_function_address(name))

    def function(self, name: str, *types: Any) -> Any:
        """Return a Python callable for a void function with arguments of these ctypes."""
        if name not in self._functions:
            self._functions[name] = ctypes.CFUNCTYPE(None, *types)(self.address(name))
        return self._functions[name]


def compile_module(text: str) -> Program:
    """Compile a module for this processor, or load its code from the cache."""
    return compile_modules([text])


def compile_modules(texts: Iterable[str]) -> Program:
    """Compile modules into one program, or load their code from the cache.

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
            codes.append((path, executor.submit(_compile_to_object_code, text) if known is None else known))
        if any(isinstance(code, Future) for _, code in codes):
            for name in NEEDED_NEXT:  # Python would only wait for LLVM
                import_module(name)
        found = [_wait_for(code, path) if isinstance(code, Future) else code for path, code in codes]
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


def _compile_to_object_code(text: str) -> bytes:
    return bytes(_create_machine().emit_object(llvm.parse_assembly(text)))


def _wait_for(future: Future[bytes], path: Path | None) -> bytes:
    """Wait for a compilation, which takes seconds for long functions, so that Ctrl-C can interrupt; keep its code."""
    while not wait([future], timeout=0.1).done:  # on Windows, a wait without timeout cannot be interrupted
        pass
    code = future.result()
    if path is not None:
        write_code(path, code)
    return code


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
