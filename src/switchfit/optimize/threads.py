"""One thread for the optimizer's own linear algebra; the caller's functions run with the caller's number of threads.

OpenBLAS wakes its threads for systems that one thread solves in a microsecond (``dtrtrs`` with several right-hand sides
at any size, ``eigh`` from 30 unknowns on), and waits for all of them: for a millisecond where another process has their
core. The number of threads is a setting of the whole process, so that it is 1 while any thread is in the optimizer, and
restored when the last one leaves. threadpoolctl is not used: each of its limits restores what it found itself, so that
after two that overlap in two threads one thread remains, and it takes five times as long.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache, wraps
from importlib import import_module
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

BLAS_MODULES = "numpy.linalg._umath_linalg", "scipy.linalg._flapack"
"""Extension modules that are linked with the BLAS of NumPy and of SciPy."""

Library = tuple[Callable[[], int], Callable[[int], None]]
"""Functions that read and set the number of threads of one BLAS."""

_lock = threading.Lock()
_inside = 0

_before: list[tuple[Callable[[int], None], int]] = []
"""How many threads are inside the optimizer, and the caller's settings while there are any."""


@cache
def find_libraries() -> tuple[Library, ...]:
    """Return the OpenBLAS of NumPy and that of SciPy; none where these are linked with another BLAS.

    A symbol is looked up in a module and in the libraries that it is linked with. SciPy's is loaded now if it is not
    yet: the optimizer needs it in any case.
    """
    found = []
    for name in BLAS_MODULES:
        with suppress(ImportError, OSError, TypeError):  # a build without this module, or with it in the interpreter
            module = ctypes.CDLL(import_module(name).__file__)
            # Names of the wheels of NumPy and SciPy (their own build of OpenBLAS, with 64-bit integers or not), then
            # those of a system's library.
            for affixes in ("scipy_{}64_", "scipy_{}", "{}64_", "{}"):
                get, put = (affixes.format(f"openblas_{verb}_num_threads") for verb in ("get", "set"))
                if hasattr(module, put):
                    found.append((getattr(module, get), getattr(module, put)))
                    break
    return tuple(found)


def _count(change: int) -> None:
    """Count a thread that enters, +1, or leaves, -1; set one thread before the first and restore after the last."""
    global _inside
    libraries = find_libraries()
    with _lock:
        if change > 0 and _inside == 0:
            # Only those that are not at one thread already: nothing is to be restored then, and no call made.
            _before[:] = [(put, count) for get, put in libraries if (count := get()) != 1]
            for put, _ in _before:
                put(1)
        _inside += change
        if _inside == 0:
            for put, count in _before:
                put(count)


@contextmanager
def one_thread() -> Iterator[None]:
    """Use one thread for linear algebra until the end of the block; as a decorator, in each call of a function."""
    _count(+1)
    try:
        yield
    finally:
        _count(-1)


def with_own_threads(function: Callable[P, R]) -> Callable[P, R]:
    """Return a caller's function that is called inside `one_thread`, but runs with the caller's number of threads."""

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        _count(-1)
        try:
            return function(*args, **kwargs)
        finally:
            _count(+1)

    return call
