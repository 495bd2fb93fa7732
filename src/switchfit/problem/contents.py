"""Contents of a Python function: its code, closure, defaults and globals, for comparison by value.

Two functions with equal `read_contents` have equal traces, so that a trace can be reused without calling the function:
a problem of the benchmark's vehicle is then built in 0.2 ms, and in 15 to 50 ms if it is traced anew.
Only plain values are compared by content: numbers, strings, arrays, tuples, lists, dicts, functions made of them.
Functions of the libraries in `TRUSTED`, and those that are defined in switchfit's own modules, do not change and are
compared by identity: what they read themselves is not looked at. For anything else (objects with state, modules of the
user, files, the time) `read_contents` returns None, and the caller has to trace.
"""

from __future__ import annotations

import builtins
import dis
import functools
import hashlib
import types
from collections.abc import Hashable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.runtime.jax_internals import is_tracer

TRUSTED = frozenset(
    {"jax", "jaxlib", "numpy", "scipy", "math", "cmath", "functools", "operator", "itertools", "typing"}
)
"""Libraries whose functions, classes and constants do not change."""

OWN_PACKAGE = __name__.partition(".")[0]
"""The package of the built-in models. Its functions are trusted too, but not those that a function returns: there is a
new one for each model, and they are compared by content."""

OPAQUE_BUILTINS = frozenset(
    {"__import__", "compile", "delattr", "eval", "exec", "getattr", "globals", "id", "input", "locals", "next", "open"}
    | {"setattr", "vars"}
)
"""Builtins by which a function reads values that its code does not name."""

PLAIN_TYPES = (types.NoneType, bool, int, float, complex, str, bytes, types.EllipsisType)

JITTED = type(jax.jit(lambda: None))
"""Type of the result of `jax.jit`."""

LIBRARY_FUNCTION_TYPES = (
    types.FunctionType,
    types.BuiltinFunctionType,
    JITTED,
    type(jnp.add),
    jax.custom_jvp,
    jax.custom_vjp,
)
"""Types of a library's functions; instances of its classes may have state."""


class NotPlain(Exception):  # noqa: N818  # control flow: the caller traces
    """A function reads something that cannot be compared by content."""


def read_contents(function: object) -> Hashable | None:
    """Return everything that a function reads, by content; None if it is unknown and the function has to be traced."""
    try:
        return _read(function)
    except (NotPlain, RecursionError):  # of what contains itself
        return None


def _read(value: Any) -> Hashable:
    kind = type(value)
    # The type counts: 1, 1.0 and True are equal in Python, and are different constants of a trace.
    if kind in PLAIN_TYPES:
        return kind, repr(value) if kind in (float, complex) else value  # -0.0 is not 0.0, nan is nan
    if kind is np.ndarray or isinstance(value, (np.generic, jax.Array)):
        return _read_array(value)
    if kind in (tuple, list):
        return kind, tuple(map(_read, value))
    # In its order: a function may iterate over it.
    if kind in (dict, types.MappingProxyType):
        return dict, _read(list(value.items()))
    # How the built-in models bind their constants to their modes.
    if kind is functools.partial:
        return kind, _read((value.func, value.args, value.keywords))
    if _is_trusted(value):
        return kind, id(value), value  # which is kept alive
    if kind is types.FunctionType and not vars(value):
        return _read_function(value)
    raise NotPlain  # also a jitted function: JAX caches a trace of its own, which the caller has to invalidate


def _read_array(value: Any) -> Hashable:
    # A function made inside another trace has no value yet; arrays of objects may hold anything.
    if is_tracer(value) or value.dtype.hasobject:
        raise NotPlain
    array = np.asarray(value)
    digest = hashlib.blake2b(array.tobytes(), digest_size=16).digest()
    weak = bool(getattr(value, "weak_type", False))
    return "array", isinstance(value, jax.Array), weak, str(array.dtype), array.shape, digest


def _read_function(function: types.FunctionType) -> Hashable:
    names, scope = _list_globals(function.__code__), function.__globals__
    if names is None:
        raise NotPlain
    try:
        cells = [cell.cell_contents for cell in function.__closure__ or ()]
    except ValueError as error:  # a cell that is still empty
        raise NotPlain from error
    # A global is looked up when the function runs, so that its value of today counts. A name that is neither a global
    # nor a builtin raises NameError when it is traced, and not here.
    found = {}
    for name in names:
        if name in scope:
            found[name] = scope[name]
        elif name in OPAQUE_BUILTINS or not hasattr(builtins, name):
            raise NotPlain
    # The code object compares bytecode, names and constants: equal for two runs of one cell of a notebook.
    return function.__code__, _read((function.__defaults__, function.__kwdefaults__, cells, found))


def _is_trusted(value: Any) -> bool:
    """Return whether a value is a module, function or class of a library that does not change."""
    if isinstance(value, (types.ModuleType, np.dtype, np.ufunc)):
        return isinstance(value, (np.dtype, np.ufunc)) or _is_library(value.__name__)
    if not isinstance(value, (type, *LIBRARY_FUNCTION_TYPES)):
        return False
    modules = {getattr(value, "__module__", None) or ""} - {"builtins"}
    # `[].append` is a builtin whose list may change; `math.sin` belongs to its module.
    if isinstance(value, types.BuiltinFunctionType) and not isinstance(value.__self__, types.ModuleType | None):
        return False  # a method of an object
    if isinstance(value, types.FunctionType):
        # A decorated function may have the name of the module of another one: where the code stands counts too.
        modules.add(value.__globals__.get("__name__") or "")
        if all(module.partition(".")[0] == OWN_PACKAGE for module in modules):
            return "<locals>" not in value.__code__.co_qualname
    return all(map(_is_library, modules))


def _is_library(module: str) -> bool:
    return module.partition(".")[0] in TRUSTED


@functools.lru_cache(maxsize=1024)
def _list_globals(code: types.CodeType) -> tuple[str, ...] | None:
    """Return the globals that a code object, and those inside it, read; None if it reads anything in another way."""
    names, pending = set[str](), [code]
    while pending:
        each = pending.pop()
        pending += [constant for constant in each.co_consts if isinstance(constant, types.CodeType)]
        for instruction in dis.get_instructions(each):
            name, argument = instruction.opname, instruction.argval
            # Attributes of what is loaded need no look: of trusted modules they do not change, and other modules are
            # not plain.
            if name in ("LOAD_GLOBAL", "LOAD_NAME"):
                names.add(argument)
            elif (
                ("GLOBAL" in name or name == "LOAD_BUILD_CLASS")
                or (name in ("STORE_DEREF", "DELETE_DEREF") and argument in code.co_freevars)
                or (name == "IMPORT_NAME" and not _is_library(argument))
            ):
                return None
    return tuple(sorted(names))
