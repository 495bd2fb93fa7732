"""Compile LLVM modules to machine code, and cache it.

Object code is cached in the folder of `switchfit.runtime.cache`; the next process loads it from there.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import hashlib
import sys
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import llvmlite
import llvmlite.binding as llvm
import numpy as np

from switchfit.engine.native.llvm.module import Module
from switchfit.engine.native.scalars.operations import FROM_LIBM
from switchfit.runtime.cache import get_usable_folder, read_code, write_code

Found = TypeVar("Found")

NEEDED_NEXT = "scipy.linalg.lapack", "scipy.special"
"""What a fit and its report will import, which takes a few tenths of a second."""


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

    def __init__(self, engine: llvm.ExecutionEngine, key: str) -> None:
        self._engine, self.key = engine, key
        self.lock, self.memory = threading.Lock(), np.zeros(0)
        self.modules: dict[Any, Module] = {}
        self._functions: dict[str, Any] = {}

    def reserve(self, size: int) -> None:
        """Allocate at least `size` doubles; the contents may be lost."""
        if len(self.memory) < size:
            self.memory = np.zeros(size)

    def function(self, name: str, count: int) -> Callable[..., None]:
        """Return a Python callable for a void function of so many integers and addresses."""
        if name not in self._functions:
            # All parameters are 64-bit integers, addresses too. ctypes releases the GIL during a call, so that others
            # may run; whoever shares `memory` holds `lock`.
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


def _create_machine() -> llvm.TargetMachine:
    name, features = _get_processor()
    # opt=2 is that of the code generator. No pass over the text runs before it: zeros and repetitions are gone
    # already.
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
    # LLVM makes one call of sincos of a sine and a cosine of the same number.
    libm = ctypes.CDLL("ucrtbase" if sys.platform == "win32" else ctypes.util.find_library("m"))
    for name in (*FROM_LIBM, "sincos"):
        if hasattr(libm, name):
            llvm.add_symbol(name, ctypes.cast(getattr(libm, name), ctypes.c_void_p).value)
