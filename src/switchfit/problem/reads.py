"""Contents of a Python function: its code, closure, defaults and globals, for comparison by value.

Two functions with equal `read_contents` have equal traces, so that a trace can be reused without calling the function.
Only plain values are compared by content: numbers, strings, arrays, tuples, lists, dicts, functions made of them.
Functions of the libraries in `TRUSTED`, and those that are defined in switchfit's own modules, do not change and are
compared by identity: what they read themselves is not looked at. For anything else (objects with state, modules of the
user, files, the time) `read_contents` returns None, and the caller has to trace.
"""

from __future__ import annotations

import builtins
import contextlib
import dis
import functools
import hashlib
import types
from collections.abc import Hashable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

TRUSTED = frozenset(
    {"jax", "jaxlib", "numpy", "scipy", "math", "cmath", "functools", "operator", "itertools", "typing"}
)
"""Libraries whose functions, classes and constants do not change."""

OWN = __name__.partition(".")[0]
"""The package of the built-in models. Its functions are trusted too, but not those that a function returns: there is a
new one for each model, and they are compared by content."""

OPAQUE_BUILTINS = frozenset(
    {"__import__", "compile", "delattr", "eval", "exec", "getattr", "globals", "id", "input", "locals", "next", "open"}
    | {"setattr", "vars"}
)
"""Builtins by which a function reads values that its code does not name."""

CONSTANTS = (types.NoneType, bool, int, bytes, types.EllipsisType)

JITTED = type(jax.jit(lambda: None))
"""Type of the result of `jax.jit`."""

FUNCTIONS = (types.FunctionType, JITTED, type(jnp.add), jax.custom_jvp, jax.custom_vjp)
"""Types of a library's functions; instances of its classes may have state."""

DEPTH = 20
"""Depth of nesting above which a structure is not compared."""


class NotPlain(Exception):  # noqa: N818  # control flow: the caller traces
    """A function reads something that cannot be compared by content."""


def read_contents(function: Any) -> Hashable | None:
    """Return everything that a function reads, by content; None if it is unknown and the function has to be traced."""
    try:
        return _read(function, DEPTH)
    except NotPlain:
        return None


def find_named_values(function: Any) -> dict[str, Any]:
    """Return the values that a function reads, by name: defaults, globals, its closure, attributes of its object,
    entries of its dicts.

    Only entries and attributes that the code names are included: keys that are constants in it, attributes that it
    loads.
    """
    if isinstance(function, functools.partial):
        given = {f"argument {k + 1}": value for k, value in enumerate(function.args)} | function.keywords
        return find_named_values(function.func) | given
    owner = getattr(function, "__self__", None)
    if owner is None and not isinstance(function, (types.FunctionType, JITTED, type)):
        owner, function = function, vars(type(function)).get("__call__")
    plain = getattr(function, "__func__", getattr(function, "__wrapped__", function))
    if not isinstance(plain, types.FunctionType):
        return {}
    code, reads = plain.__code__, _find_reads(plain.__code__)
    arguments = code.co_varnames[: code.co_argcount]
    defaults = plain.__defaults__ or ()
    found = dict(zip(arguments[len(arguments) - len(defaults) :], defaults, strict=True)) | (plain.__kwdefaults__ or {})
    found |= {name: plain.__globals__[name] for name in reads.names if name in plain.__globals__}
    for name, cell in zip(code.co_freevars, plain.__closure__ or (), strict=True):
        with contextlib.suppress(ValueError):  # a cell that is still empty
            found[name] = cell.cell_contents
    if owner is not None:
        found["self"] = owner
    for name, value in list(found.items()):
        if isinstance(value, dict):
            found |= {f"{name}[{key!r}]": entry for key, entry in value.items() if key in reads.constants}
        elif name == "self" or (hasattr(value, "__dict__") and not callable(value)):
            found |= {f"{name}.{key}": entry for key, entry in vars(value).items() if key in reads.attributes}
    return found


def _read(value: Any, depth: int) -> Hashable:
    if depth == 0:
        raise NotPlain
    kind = type(value)
    if kind is str:
        return value  # nothing else is described by a string alone
    if kind is float or kind is complex:
        return kind, repr(value)  # -0.0 is not 0.0, nan is nan
    if kind in CONSTANTS:
        return kind, value
    if kind is np.ndarray or isinstance(value, (np.generic, jax.Array)):
        return _read_array(value)
    if kind in (tuple, list):
        return kind, tuple([_read(entry, depth - 1) for entry in value])
    if kind is dict or kind is types.MappingProxyType:
        names, entries = list(value), list(value.values())
        return dict, tuple([each if type(each) is str else _read(each, depth - 1) for each in (*names, *entries)])
    if kind is slice:
        return kind, _read((value.start, value.stop, value.step), depth)
    if kind is functools.partial:
        return kind, _read((value.func, value.args, value.keywords), depth - 1)
    if _is_trusted(value):
        return _Same(value)
    if kind is JITTED and hasattr(value, "__wrapped__"):
        raise NotPlain  # JAX caches a trace of its own, which the caller has to invalidate
    if kind is types.FunctionType:
        return _read_function(value, depth)
    raise NotPlain


def _read_array(value: Any) -> Hashable:
    if isinstance(value, jax.core.Tracer):
        raise NotPlain
    array = np.asarray(value)
    if array.dtype.hasobject:
        raise NotPlain
    digest = hashlib.blake2b(np.ascontiguousarray(array).tobytes(), digest_size=16).digest()
    weak = bool(getattr(value, "weak_type", False))
    return "array", isinstance(value, jax.Array), weak, str(array.dtype), array.shape, digest


def _read_function(function: types.FunctionType, depth: int) -> Hashable:
    if vars(function):
        raise NotPlain
    code = function.__code__
    reads = _find_reads(code)
    if not reads.plain:
        raise NotPlain
    try:
        cells = [cell.cell_contents for cell in function.__closure__ or ()]
    except ValueError as error:  # a cell that is still empty
        raise NotPlain from error
    scope = function.__globals__
    found: list[Hashable] = [code, _read(function.__defaults__, depth - 1), _read(function.__kwdefaults__, depth - 1)]
    found += [_read(cell, depth - 1) for cell in cells]
    for name in reads.names:
        if name in scope:
            found.append((name, _read(scope[name], depth - 1)))
        elif name in OPAQUE_BUILTINS or not hasattr(builtins, name):
            raise NotPlain
    return tuple(found)


def _is_trusted(value: Any) -> bool:
    """Return whether a value is a module, function or class of a library that does not change."""
    if isinstance(value, types.ModuleType):
        return _is_library(value.__name__)
    if isinstance(value, types.BuiltinFunctionType):
        owner = value.__self__
        return owner is None or (isinstance(owner, types.ModuleType) and (owner is builtins or _is_trusted(owner)))
    if isinstance(value, (np.dtype, np.ufunc)):
        return True
    if isinstance(value, type):
        return value.__module__ == "builtins" or _is_library(value.__module__)
    if type(value) not in FUNCTIONS:
        return False
    modules = {getattr(value, "__module__", None) or ""}
    if type(value) is types.FunctionType:
        # A decorated function may have the name of the module of another one: where the code stands counts too.
        modules.add(value.__globals__.get("__name__") or "")
        if all(module.partition(".")[0] == OWN for module in modules):
            return "<locals>" not in value.__code__.co_qualname
    return all(map(_is_library, modules))


def _is_library(module: str) -> bool:
    return module.partition(".")[0] in TRUSTED


class _Same:
    """Compares a value by identity; keeps it alive."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __hash__(self) -> int:
        return id(self.value)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Same) and other.value is self.value


class _Reads:
    """Names and constants that a code object, and those inside it, read.

    Attributes
    ----------
    names, attributes : of globals, and of attributes
    constants : set of hashable constants
    plain : bool
        Whether nothing is read except by these names.
    """

    def __init__(self, code: types.CodeType) -> None:
        names: set[str] = set()
        self.attributes: set[str] = set()
        self.constants: set[Any] = set()
        self.plain = True
        pending = [code]
        while pending:
            each = pending.pop()
            self.attributes.update(each.co_names)
            self.constants.update(constant for constant in each.co_consts if isinstance(constant, (str, int)))
            pending += [constant for constant in each.co_consts if isinstance(constant, types.CodeType)]
            for instruction in dis.get_instructions(each):
                if instruction.opname in ("LOAD_GLOBAL", "LOAD_NAME"):
                    names.add(instruction.argval)
                elif instruction.opname == "IMPORT_NAME":
                    self.plain = self.plain and instruction.argval.partition(".")[0] in TRUSTED
                elif instruction.opname in ("STORE_DEREF", "DELETE_DEREF"):
                    self.plain = self.plain and instruction.argval not in code.co_freevars
                elif "GLOBAL" in instruction.opname or instruction.opname == "LOAD_BUILD_CLASS":
                    self.plain = False
        self.names = tuple(sorted(names))


@functools.lru_cache(maxsize=1024)
def _find_reads(code: types.CodeType) -> _Reads:
    return _Reads(code)
