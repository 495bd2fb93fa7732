"""Traced functions of the user: each is a jaxpr, traced when its problem is built, and compared by content.

Functions with equal jaxprs are equal, whatever Python objects they came from, so that they share compiled programs. A
function that reads a value that has changed has another jaxpr and is another `Function`. `switchfit.problem.functions`
decides whether a trace can be reused without calling the user's function.

Contents of a Python function: its code, closure, defaults and globals, for comparison by value.

Two functions with equal `read_contents` have equal traces, so that a trace can be reused without calling the function:
a problem of the benchmark's vehicle is then built in 0.2 ms, and in 15 to 50 ms if it is traced anew.
Only plain values are compared by content: numbers, strings, arrays, tuples, lists, dicts, functions made of them.
Functions of the libraries in `TRUSTED`, and those that are defined in switchfit's own modules, do not change and are
compared by identity: what they read themselves is not looked at. For anything else (objects with state, modules of the
user, files, the time) `read_contents` returns None, and the caller has to trace.
"""

from __future__ import annotations

import builtins
import copy
import dis
import functools
import hashlib
import itertools
import threading
import types
from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import nullcontext
from functools import cached_property
from itertools import compress
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import partial_eval

from switchfit.problem.jaxprs import find_read_entries, list_jaxprs, refuse_wrong_constants
from switchfit.problem.validation import find_misfit, join_names

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

NUMBERS = (types.NoneType, bool, int, float, complex, str, bytes, types.EllipsisType)

JITTED = type(jax.jit(lambda: None))
"""Type of the result of `jax.jit`."""

FUNCTIONS = (types.FunctionType, types.BuiltinFunctionType, JITTED, type(jnp.add), jax.custom_jvp, jax.custom_vjp)
"""Types of a library's functions; instances of its classes may have state."""


class NotPlain(Exception):  # noqa: N818  # control flow: the caller traces
    """A function reads something that cannot be compared by content."""


def read_contents(function: Any) -> Hashable | None:
    """Return everything that a function reads, by content; None if it is unknown and the function has to be traced."""
    try:
        return _read(function)
    except (NotPlain, RecursionError):  # of what contains itself
        return None


def _read(value: Any) -> Hashable:
    kind = type(value)
    if kind in NUMBERS:
        return kind, repr(value) if kind in (float, complex) else value  # -0.0 is not 0.0, nan is nan
    if kind is np.ndarray or isinstance(value, (np.generic, jax.Array)):
        return _read_array(value)
    if kind in (tuple, list):
        return kind, tuple(map(_read, value))
    if kind in (dict, types.MappingProxyType):
        return dict, _read(list(value.items()))
    if kind is functools.partial:
        return kind, _read((value.func, value.args, value.keywords))
    if _is_trusted(value):
        return kind, id(value), value  # which is kept alive
    if kind is types.FunctionType and not vars(value):
        return _read_function(value)
    raise NotPlain  # also a jitted function: JAX caches a trace of its own, which the caller has to invalidate


def _read_array(value: Any) -> Hashable:
    if isinstance(value, jax.core.Tracer) or value.dtype.hasobject:
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
    found = {}
    for name in names:
        if name in scope:
            found[name] = scope[name]
        elif name in OPAQUE_BUILTINS or not hasattr(builtins, name):
            raise NotPlain
    return function.__code__, _read((function.__defaults__, function.__kwdefaults__, cells, found))


def _is_trusted(value: Any) -> bool:
    """Return whether a value is a module, function or class of a library that does not change."""
    if isinstance(value, (types.ModuleType, np.dtype, np.ufunc)):
        return isinstance(value, (np.dtype, np.ufunc)) or _is_library(value.__name__)
    if not isinstance(value, (type, *FUNCTIONS)):
        return False
    modules = {getattr(value, "__module__", None) or ""} - {"builtins"}
    if isinstance(value, types.BuiltinFunctionType) and not isinstance(value.__self__, types.ModuleType | None):
        return False  # a method of an object
    if isinstance(value, types.FunctionType):
        # A decorated function may have the name of the module of another one: where the code stands counts too.
        modules.add(value.__globals__.get("__name__") or "")
        if all(module.partition(".")[0] == OWN for module in modules):
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
            if name in ("LOAD_GLOBAL", "LOAD_NAME"):
                names.add(argument)
            elif (
                ("GLOBAL" in name or name == "LOAD_BUILD_CLASS")
                or (name in ("STORE_DEREF", "DELETE_DEREF") and argument in code.co_freevars)
                or (name == "IMPORT_NAME" and not _is_library(argument))
            ):
                return None
    return tuple(sorted(names))


Array = jax.Array
Shape = tuple[int, ...]


def use_float64() -> Any:
    """Return a context in which JAX computes in float64; the user's setting is restored at its end."""
    return jax.enable_x64(True)


UNTRACEABLE = (jax.errors.ConcretizationTypeError, jax.errors.TracerIntegerConversionError)
"""Exceptions of JAX when Python code needs the value of a traced number."""


class Function:
    """A function of ``(t, x, p)``, or of some of these and an input, as a jaxpr in float64.

    Parameters
    ----------
    closed : jaxpr with its constants
    parameters : tuple of str
        Names of the parameters that it reads, in the order of the jaxpr's arguments.

    Attributes
    ----------
    parameters : tuple of str
    shape : shape of its result
    jaxpr : its operations; the last arguments are the parameters that it reads
    consts : the constants of the jaxpr
    structs : shapes and types of the arguments of the jaxpr
    digest : str
        Hash of the jaxpr's content, the same in every process.
    """

    def __init__(self, closed: Any, parameters: tuple[str, ...]) -> None:
        self.parameters = parameters
        self.shape: Shape = tuple(closed.out_avals[0].shape)
        self.jaxpr, self.consts = closed.jaxpr, closed.consts
        self.structs = [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in closed.in_avals]
        content = _describe_content(closed)
        self.digest = hashlib.sha256("\n".join([repr(parameters), *content.lines]).encode()).hexdigest()
        self._opaque = tuple(content.opaque)  # compared by identity, therefore kept alive
        self._key = (self.digest, tuple(map(id, self._opaque)))

    def __call__(self, *arguments: Any) -> Array:
        """Evaluate for arguments in the order of the user's function, p being a mapping of names to arrays."""
        flat = [_as_float64(a) for a in arguments if not isinstance(a, Mapping)]
        named = next(argument for argument in arguments if isinstance(argument, Mapping))
        return self.evaluate([*flat, *(named[name] for name in self.parameters)])

    def evaluate(self, given: Sequence[Any]) -> Array:
        """Evaluate for the arguments of the jaxpr: the parameters are the last."""
        return jax.core.eval_jaxpr(self.jaxpr, self.consts, *given)[0]

    @cached_property
    def read(self) -> dict[str, tuple[int, ...]]:
        """Positions of the entries of each parameter that it may read."""
        variables = self.jaxpr.invars[len(self.jaxpr.invars) - len(self.parameters) :]
        return dict(zip(self.parameters, find_read_entries(self.jaxpr, variables), strict=True))

    @cached_property
    def takes_input(self) -> bool:
        """Whether it takes an input after t, the state and the parameters."""
        return len(self.structs) - len(self.parameters) > 2

    def derive(self, evaluate: Callable[..., Any]) -> Function:
        """Return another function of the same arguments, with its rate beside the input; `evaluate` takes those of the
        jaxpr.
        """
        structs = list(self.structs)
        if self.takes_input:
            structs[2] = jax.ShapeDtypeStruct((2, *structs[2].shape), structs[2].dtype)
        closed = jax.make_jaxpr(evaluate)(*structs)
        # Without what has no use: a corner does not take all of its mode, and is one in branches on its other sides.
        jaxpr, _ = partial_eval.dce_jaxpr(closed.jaxpr, [True], instantiate=True)
        return Function(closed.replace(jaxpr=jaxpr), self.parameters)

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Function) and self._key == other._key)


def _as_float64(value: Any) -> Any:
    """Return a value as a float64 array without weak type, which Python's numbers have, as the jaxpr requires."""
    is_double = getattr(value, "dtype", None) == np.float64 and not getattr(value, "weak_type", False)
    return value if is_double else jnp.asarray(value, jnp.float64)


_traces: dict[Any, Function] = {}
_lock = threading.Lock()

MOST_TRACES = 1024
"""Number of functions whose traces are cached; the oldest go first."""

_turn = itertools.count(1)
_retracing = jax.make_user_context(0)
"""With a new value, JAX does not reuse earlier traces of jitted functions inside a function."""


class Call(NamedTuple):
    """A function of the user, and how it is called.

    Attributes
    ----------
    function : callable
    arguments : tuple of shape or None
        Shapes of its arguments; None stands for the dict of parameters.
    shape : shape or None
        Required shape of its result; None for any.
    what, form : str
        Its name and signature for messages, such as "mode 'slip'" and "f(t, x, p)".
    inputs : tuple of str
        Names of the entries of the last argument, which is then passed as a dict; the `Function` takes an array.
    """

    function: Callable[..., Any]
    arguments: tuple[Shape | None, ...]
    shape: Shape | None
    what: str
    form: str
    inputs: tuple[str, ...] = ()


def trace_function(call: Call, parameters: Mapping[str, Shape]) -> Function:
    """Trace a function of the user, or return a cached trace that is still valid.

    Parameters
    ----------
    call : Call
    parameters : mapping of str to shape
        Names and shapes of the entries of its dict of parameters.

    Raises
    ------
    ValueError
        If it raises, returns another shape or dtype, or computes in less than double precision.
    """
    function = call.function
    while type(function) is JITTED and hasattr(function, "__wrapped__"):  # JAX would not trace it again
        function = function.__wrapped__
    content = read_contents(function)
    asked = (call.arguments, call.shape, call.inputs, tuple(parameters.items()))
    key = None if content is None else (content, asked)
    if (found := _traces.get(key)) is not None:
        return found
    call = call._replace(function=function)
    with use_float64(), nullcontext() if key is not None else _retracing(next(_turn)):
        traced = _trace(call, parameters)
    if key is not None:
        with _lock:
            _traces[key] = traced
            if len(_traces) > MOST_TRACES:
                del _traces[next(iter(_traces))]
    return traced


def _trace(call: Call, parameters: Mapping[str, Shape]) -> Function:
    """Trace a function with these parameters in its dict, and keep those on which its result depends."""
    position, count = call.arguments.index(None), len(call.arguments) - 1

    def evaluate(*given: Array) -> Array:
        flat: list[Any] = list(given[:count])
        if call.inputs:
            flat[-1] = {name: flat[-1][k] for k, name in enumerate(call.inputs)}
        named = dict(zip(parameters, given[count:], strict=True))
        return call_for_vector(call, (*flat[:position], named, *flat[position:]))

    shapes = [*(size for size in call.arguments if size is not None), *parameters.values()]
    closed = jax.make_jaxpr(evaluate)(*(jax.ShapeDtypeStruct(size, jnp.float64) for size in shapes))
    refuse_wrong_constants(closed, call.what)
    is_kept = [True] * count + [False] * len(parameters)
    jaxpr, is_read = partial_eval.dce_jaxpr(closed.jaxpr, [True], instantiate=is_kept)
    _copy_literals(jaxpr)
    consts = [np.array(const) if isinstance(const, np.ndarray) else const for const in closed.consts]
    closed = type(closed)(jaxpr.replace(debug_info=jaxpr.debug_info.with_unknown_names()), consts)
    return Function(closed, tuple(compress(parameters, is_read[count:])))


def _copy_literals(jaxpr: Any) -> None:
    """Copy the literals of a jaxpr: JAX keeps references to the user's arrays without axes, which may change."""
    for each in list_jaxprs(jaxpr):
        for atom in (*each.outvars, *(atom for equation in each.eqns for atom in equation.invars)):
            if isinstance(getattr(atom, "val", None), np.ndarray):
                atom.val = copy.deepcopy(atom.val)


# The content of a jaxpr

RULES = ("jvp_jaxpr_fun", "jvp_jaxpr_thunk", "fwd_jaxpr_thunk", "bwd", "out_trees", "name", "debug_info")
"""Parameters of operations that are not compared: names, and derivative rules, which show in the derivatives."""


def _describe_content(closed: Any) -> _Text:
    """Return a jaxpr as text, with the values of its constants, and the objects in it that have no text."""
    text = _Text(closed)
    if text.has_rules:
        try:
            text.lines += _Text(_differentiate_twice(closed)).lines
        except TypeError:  # functions with reverse-mode rules only have no forward derivative
            text.opaque.append(object())
    return text


def _differentiate_twice(closed: Any) -> Any:
    """Return the jaxpr of the first and second derivatives along all arguments, in which custom rules are applied."""

    def value(*arguments: Any) -> Any:
        return jax.core.eval_jaxpr(closed.jaxpr, closed.consts, *arguments)[0]

    def slope(*arguments: Any) -> Any:
        return jax.jvp(value, arguments, arguments)[1]

    return jax.make_jaxpr(lambda *a: (slope(*a), jax.jvp(slope, a, a)[1]))(*closed.in_avals)


class _Text:
    """Lines that describe a jaxpr, variables numbered in their order."""

    def __init__(self, closed: Any) -> None:
        self.lines: list[str] = []
        self.opaque: list[Any] = []
        self.has_rules = False
        self.add(closed.jaxpr, closed.consts)

    def add(self, jaxpr: Any, consts: Sequence[Any]) -> None:
        """Describe a jaxpr."""
        number: dict[Any, int] = {}

        def atom(a: Any) -> str:
            return self._array(a.val) if hasattr(a, "val") else f"%{number.setdefault(a, len(number))}"

        for variables in (jaxpr.constvars, jaxpr.invars):
            self.lines.append(" ".join(f"{atom(v)}:{v.aval.str_short()}" for v in variables))
        self.lines += [self._array(const) for const in consts]
        for equation in jaxpr.eqns:
            given = " ".join(map(atom, equation.invars))
            made = " ".join(f"{atom(v)}:{v.aval.str_short()}" for v in equation.outvars)
            self.lines.append(f"{made} = {equation.primitive.name} {given}")
            self.has_rules = self.has_rules or equation.primitive.name.startswith("custom_")
            for name, value in sorted(equation.params.items()):
                if name not in RULES:
                    self._parameter(name, value)
        self.lines.append("-> " + " ".join(map(atom, jaxpr.outvars)))

    def _parameter(self, name: str, value: Any) -> None:
        if hasattr(value, "eqns"):
            self.lines.append(f"{name}:")
            self.add(getattr(value, "jaxpr", value), getattr(value, "consts", ()))
        elif isinstance(value, (tuple, list)) and any(hasattr(v, "eqns") for v in value):
            for entry in value:
                self._parameter(name, entry)
        elif isinstance(value, (np.ndarray, jax.Array)):
            self.lines.append(f"{name}={self._array(value)}")
        else:
            text = repr(value)
            if " at 0x" in text or (callable(value) and not isinstance(value, type)):
                text = f"object {len(self.opaque)}"
                self.opaque.append(value)
            self.lines.append(f"{name}={text}")

    def _array(self, value: Any) -> str:
        array = np.asarray(value)
        digest = hashlib.blake2b(np.ascontiguousarray(array).tobytes(), digest_size=16).hexdigest()
        return f"{array.dtype}{list(array.shape)}{digest}"


# Calling a user's function while tracing


def _call_while_tracing(call: Call, arguments: tuple[Any, ...]) -> Array:
    """Call a user's function while tracing; turn any exception into one sentence that names the function."""
    function, what, form = call.function, call.what, call.form
    misfit = find_misfit(function, arguments)
    if misfit is not None:
        inputs = " Modes get an input u if and only if the experiment has inputs." if what.startswith("mode ") else ""
        raise ValueError(f"{what} is called as {form}, but takes the arguments {misfit}.{inputs}")
    try:
        value = function(*arguments)
    except KeyError as error:
        known = zip("pu", (given for given in arguments if isinstance(given, dict)), strict=False)
        there = "; ".join(f"{holder} has {join_names(given)}" for holder, given in known)
        raise ValueError(f"{what} reads {error}, which is not there: {there}.") from error
    except jax.errors.TracerArrayConversionError as error:
        raise ValueError(
            f"{what} calls a NumPy function on t, x or p, or indexes a NumPy array with them, which JAX traces "
            "and NumPy cannot take. Write it with jax.numpy, as jnp.array([...]) or jnp.sin(...)."
        ) from error
    except UNTRACEABLE as error:
        raise ValueError(
            f"{what} branches on the value of t, x or p (an `if`, a `while`, float() or math function), which JAX "
            "cannot differentiate. Write it with jax.numpy; if the dynamics change there, make it a mode with a "
            "transition time."
        ) from error
    except Exception as error:
        message = str(error).rstrip(".")
        if "u)" in form and "string indexing" in message:  # u["left"] of an array
            message += ". u has no names: give sf.Input a dict of name -> samples"
        raise ValueError(f"{what}: {form} raised {type(error).__name__}: {message}.") from error
    try:
        return jnp.asarray(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what}: {form} must return an array of numbers; got {value!r}.") from error


def call_for_vector(call: Call, arguments: tuple[Any, ...]) -> Array:
    """Return the result of a user's function, checked (while tracing) to be a float64 array of the required shape."""
    array, shape, what, form = _call_while_tracing(call, arguments), call.shape, call.what, call.form
    if shape is not None and array.shape != shape:
        if not array.size == int(np.prod(shape)) == 1:
            raise ValueError(f"{what}: {form} must return an array of shape {shape}; got shape {array.shape}.")
        array = array.reshape(shape)
    if array.dtype == jnp.bool_ and what.startswith("guard"):
        raise ValueError(f"{what}: {form} must return a number that is 0 at the transition: a - b, not a comparison.")
    if jnp.issubdtype(array.dtype, jnp.integer) or array.dtype == jnp.bool_:
        return array.astype(jnp.float64)
    if array.dtype != jnp.float64:
        raise ValueError(
            f"{what}: {form} must return float64; got {array.dtype}. Its arguments are float64: do not cast them."
        )
    return array
