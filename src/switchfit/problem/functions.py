"""Traced functions of the user: each is a jaxpr, traced when its problem is built, and compared by content.

Functions with equal jaxprs are equal, whatever Python objects they came from, so that they share compiled programs. A
function that reads a value that has changed has another jaxpr and is another `Function`. `switchfit.problem.reads`
decides whether a trace can be reused without calling the user's function.
"""

from __future__ import annotations

import copy
import hashlib
import inspect
import itertools
import threading
import weakref
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.interpreters import partial_eval

from switchfit.problem.indices import refuse_indices_out_of_range
from switchfit.problem.precision import refuse_single_precision_in
from switchfit.problem.reads import JITTED, read_contents
from switchfit.problem.validation import join_names

Array = jax.Array
Shape = tuple[int, ...]


def use_float64() -> Any:
    """Return a context in which JAX computes in float64; the user's setting is restored at its end."""
    return jax.enable_x64(True)


UNTRACEABLE = (
    jax.errors.ConcretizationTypeError,
    jax.errors.TracerArrayConversionError,
    jax.errors.TracerIntegerConversionError,
)
"""Exceptions of JAX when Python code needs the value of a traced number."""


class Function:
    """A function of ``(t, x, p)``, or of some of these and an input, as a jaxpr in float64.

    Attributes
    ----------
    parameters : tuple of str
        Names of the parameters that it reads, in the order of the jaxpr's arguments.
    shape : shape of its result
    digest : str
        Hash of the jaxpr's content, the same in every process.
    """

    def __init__(self, closed: Any, parameters: tuple[str, ...], digest: str, opaque: tuple[Any, ...]) -> None:
        self.parameters, self.digest = parameters, digest
        self.shape: Shape = tuple(closed.out_avals[0].shape)
        self._closed = closed
        self._opaque = opaque  # compared by identity, therefore kept alive
        self._key = (digest, tuple(map(id, opaque)))

    def __call__(self, *arguments: Any) -> Array:
        """Evaluate for arguments in the order of the user's function, p being a mapping of names to arrays."""
        flat = [_as_float64(a) for a in arguments if not isinstance(a, Mapping)]
        named = next(argument for argument in arguments if isinstance(argument, Mapping))
        return self.evaluate([*flat, *(named[name] for name in self.parameters)])

    def evaluate(self, given: Sequence[Any]) -> Array:
        """Evaluate for the arguments of the jaxpr: the parameters are the last."""
        return jax.core.eval_jaxpr(self.jaxpr, self.consts, *given)[0]

    @property
    def jaxpr(self) -> Any:
        """Its operations; the last arguments are the parameters that it reads."""
        return self._closed.jaxpr

    @property
    def consts(self) -> Sequence[Any]:
        """The constants of the jaxpr."""
        return self._closed.consts

    @property
    def structs(self) -> list[Any]:
        """Shapes and types of the arguments of the jaxpr."""
        return [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in self._closed.in_avals]

    @cached_property
    def takes_input(self) -> bool:
        """Whether it takes an input after t, the state and the parameters."""
        return len(self._closed.in_avals) - len(self.parameters) > 2

    def derive(self, evaluate: Callable[..., Any]) -> Function:
        """Return another function of the same arguments; `evaluate` takes those of the jaxpr."""
        closed = jax.make_jaxpr(evaluate)(*self.structs)
        text, opaque = _describe_content(closed)
        digest = hashlib.sha256("\n".join([repr(self.parameters), *text]).encode()).hexdigest()
        return Function(closed, self.parameters, digest, opaque)

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Function) and self._key == other._key)


def _as_float64(value: Any) -> Any:
    """Return a value as a float64 array without weak type, which Python's numbers have, as the jaxpr requires."""
    if (
        isinstance(value, (np.ndarray, jax.Array))
        and value.dtype == np.float64
        and not getattr(value, "weak_type", False)
    ):
        return value
    return jnp.asarray(value, jnp.float64)


_known: weakref.WeakValueDictionary[Any, Function] = weakref.WeakValueDictionary()
_traces: OrderedDict[Any, Function] = OrderedDict()
_lock = threading.Lock()

MOST_TRACES = 1024
"""Number of functions whose traces are cached."""

_turn = itertools.count(1)
_retracing = jax.make_user_context(0)
"""With a new value, JAX does not reuse earlier traces of jitted functions inside a function."""


def trace_function(
    function: Callable[..., Any],
    arguments: Sequence[Shape | None],
    parameters: Mapping[str, Shape],
    hidden: frozenset[str] = frozenset(),
    *,
    what: str,
    form: str,
    shape: Shape | None,
    inputs: tuple[str, ...] = (),
) -> Function:
    """Trace a function of the user, or return a cached trace that is still valid.

    Parameters
    ----------
    function : callable
    arguments : sequence of shape or None
        Shapes of its arguments; None stands for the dict of parameters.
    parameters : mapping of str to shape
        Names and shapes of the entries of that dict.
    hidden : set of str
        Those among them that are in the dict only if the function reads them by name.
    what, form : str
        Its name and signature for messages, such as "mode 'slip'" and "f(t, x, p)".
    shape : shape, optional
        Required shape of its result; any if left out.
    inputs : tuple of str, optional
        Names of the entries of the last argument, which is then passed as a dict; the `Function` takes an array.

    Raises
    ------
    ValueError
        If it raises, returns another shape or dtype, or computes in less than double precision.
    """
    function = _without_jit(function)
    read = read_contents(function)
    key = None if read is None else (read, tuple(arguments), tuple(parameters.items()), hidden, shape, inputs)
    if key is not None:
        with _lock:
            found = _traces.get(key)
            if found is not None:
                _traces.move_to_end(key)
                return found
    given = _Call(arguments, parameters, hidden, what, form, shape, inputs)
    with use_float64(), nullcontext() if key is not None else _retracing(next(_turn)):
        traced = _trace(function, given)
    with _lock:
        traced = _known.setdefault(traced._key, traced)
        if key is not None:
            _traces[key] = traced
            if len(_traces) > MOST_TRACES:
                _traces.popitem(last=False)
    return traced


def _without_jit(function: Any) -> Any:
    """Return the function inside `jax.jit`, which would not trace it again."""
    while type(function) is JITTED and hasattr(function, "__wrapped__"):
        function = function.__wrapped__
    return function


class _Call(NamedTuple):
    """Arguments with which a function is called, and the shape that it must return: those of `trace_function`."""

    arguments: Sequence[Shape | None]
    parameters: Mapping[str, Shape]
    hidden: frozenset[str]
    what: str
    form: str
    shape: Shape | None
    inputs: tuple[str, ...]


def _trace(function: Callable[..., Any], given: _Call) -> Function:
    """Trace with a dict that records which names are read; with an ordinary dict if the function accepts no other.

    An error of the first attempt is not lost: if the function is wrong, the next one raises it too.
    """
    shown = tuple(name for name in given.parameters if name not in given.hidden)
    try:
        return _trace_with(function, given, tuple(given.parameters), watch=True)
    except Exception:
        pass
    try:
        return _trace_with(function, given, shown, watch=False)
    except ValueError:
        if not given.hidden:
            raise
    # The function may read a hidden parameter; if it does not, this raises the error.
    return _trace_with(function, given, tuple(given.parameters), watch=False)


def _trace_with(function: Callable[..., Any], given: _Call, names: tuple[str, ...], watch: bool) -> Function:
    asked: set[str] = set()
    position = list(given.arguments).index(None)

    def call(flat: list[Array], values: list[Array]) -> Array:
        named = dict(zip(names, values, strict=True))
        if watch:
            shown = {name: value for name, value in named.items() if name not in given.hidden}
            named = WatchedParameters(shown, {name: named[name] for name in names if name in given.hidden}, asked)
        arguments: tuple[Any, ...] = (*flat[:position], named, *flat[position:])
        if given.inputs:
            arguments = (*arguments[:-1], {name: arguments[-1][k] for k, name in enumerate(given.inputs)})
        return call_for_vector(function, arguments, given.shape, given.what, given.form)

    flat = [jax.ShapeDtypeStruct(shape, jnp.float64) for shape in given.arguments if shape is not None]
    values = [jax.ShapeDtypeStruct(given.parameters[name], jnp.float64) for name in names]
    closed = jax.make_jaxpr(call)(flat, values)
    used = names
    if watch:
        read = _list_read_variables(closed.jaxpr)  # methods of dict, such as pop, read entries without asking
        variables = zip(names, closed.jaxpr.invars[len(flat) :], strict=True)
        used = tuple(name for name, variable in variables if name in asked or variable in read)
    return _build_function(closed, len(flat), names, used, function, given)


def _list_read_variables(jaxpr: Any) -> set[Any]:
    """Return the variables that the operations and results of a jaxpr read."""
    atoms = [*jaxpr.outvars, *(atom for equation in jaxpr.eqns for atom in equation.invars)]
    return {atom for atom in atoms if not hasattr(atom, "val")}


def _build_function(
    closed: Any, count: int, names: tuple[str, ...], used: tuple[str, ...], function: Any, given: _Call
) -> Function:
    """Return the jaxpr with the parameters that it uses; its constants are copied, since the user may change them."""
    refuse_single_precision_in(closed, function, given.what)
    refuse_indices_out_of_range(closed, given.what)
    invars = closed.jaxpr.invars
    kept = [*invars[:count], *(v for name, v in zip(names, invars[count:], strict=True) if name in used)]
    _copy_literals(closed.jaxpr)
    consts = [np.array(const) if isinstance(const, np.ndarray) else const for const in closed.consts]
    debug = closed.jaxpr.debug_info.with_unknown_names()
    jaxpr = closed.jaxpr.replace(invars=kept, debug_info=debug)
    closed = type(closed)(jaxpr, consts)
    text, opaque = _describe_content(closed)
    return Function(closed, used, hashlib.sha256("\n".join([repr(used), *text]).encode()).hexdigest(), opaque)


def _copy_literals(jaxpr: Any) -> None:
    """Copy the literals of a jaxpr: JAX keeps references to the user's arrays without axes, which may change."""
    for equation in jaxpr.eqns:
        for atom in equation.invars:
            _copy_literal(atom)
        for value in equation.params.values():
            for entry in value if isinstance(value, (tuple, list)) else (value,):
                if hasattr(entry, "eqns"):
                    _copy_literals(getattr(entry, "jaxpr", entry))
    for atom in jaxpr.outvars:
        _copy_literal(atom)


def _copy_literal(atom: Any) -> None:
    if isinstance(getattr(atom, "val", None), np.ndarray):
        atom.val = copy.deepcopy(atom.val)


# The content of a jaxpr

RULES = ("jvp_jaxpr_fun", "jvp_jaxpr_thunk", "fwd_jaxpr_thunk", "bwd", "out_trees", "name", "debug_info")
"""Parameters of operations that are not compared: names, and derivative rules, which show in the derivatives."""


def _describe_content(closed: Any) -> tuple[list[str], tuple[Any, ...]]:
    """Return a jaxpr as text, with the values of its constants, and the objects in it that have no text."""
    text, opaque = _Text.of(closed)
    if text.has_rules:
        try:
            more = _Text.of(_differentiate_twice(closed))[0].lines
        except TypeError:  # functions with reverse-mode rules only have no forward derivative
            return text.lines, (*opaque, object())
        return text.lines + more, opaque
    return text.lines, opaque


def describe_outputs(closed: Any) -> list[str]:
    """Return a text for each output of a jaxpr: equal for outputs that are computed in the same way."""
    texts = []
    for k in range(len(closed.jaxpr.outvars)):
        needed = [k == other for other in range(len(closed.jaxpr.outvars))]
        one, _ = partial_eval.dce_jaxpr(closed.jaxpr, needed, instantiate=True)
        texts.append("\n".join(_Text.of(type(closed)(one, closed.consts))[0].lines))
    return texts


def _differentiate_twice(closed: Any) -> Any:
    """Return the jaxpr of the first and second derivatives along all arguments, in which custom rules are applied."""

    def value(*arguments: Any) -> Any:
        return jax.core.eval_jaxpr(closed.jaxpr, closed.consts, *arguments)[0]

    def slope(*arguments: Any) -> Any:
        return jax.jvp(value, arguments, arguments)[1]

    return jax.make_jaxpr(lambda *a: (slope(*a), jax.jvp(slope, a, a)[1]))(*closed.in_avals)


class _Text:
    """Lines that describe a jaxpr, variables numbered in their order."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.opaque: list[Any] = []
        self.has_rules = False

    @classmethod
    def of(cls, closed: Any) -> tuple[_Text, tuple[Any, ...]]:
        text = cls()
        text.add(closed.jaxpr, closed.consts)
        return text, tuple(text.opaque)

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
        elif callable(value) and not isinstance(value, type):
            self.lines.append(f"{name}=object {len(self.opaque)}")
            self.opaque.append(value)
        else:
            text = repr(value)
            if " at 0x" in text:
                text = f"object {len(self.opaque)}"
                self.opaque.append(value)
            self.lines.append(f"{name}={text}")

    def _array(self, value: Any) -> str:
        array = np.asarray(value)
        digest = hashlib.blake2b(np.ascontiguousarray(array).tobytes(), digest_size=16).hexdigest()
        return f"{array.dtype}{list(array.shape)}{digest}"


# Calling a user's function while tracing


class WatchedParameters(dict[str, Array]):
    """Dict of parameters that records which ones a user's function reads.

    Parameters
    ----------
    shown : entries of the dict
    others : entries that are found by name only, and are not listed: the targets of parameter maps
    asked : set of str, to which every name that is read is added
    """

    def __init__(self, shown: Mapping[str, Array], others: Mapping[str, Array], asked: set[str]) -> None:
        super().__init__(shown)
        self.others = others
        self.asked = asked

    def __getitem__(self, name: str) -> Array:
        value = super().__getitem__(name) if name in self.list_keys() else self.others[name]
        self.asked.add(name)
        return value

    def __contains__(self, name: object) -> bool:
        there = name in self.list_keys()
        if there:
            self.asked.add(str(name))
        return there

    def get(self, name: str, default: Any = None) -> Any:
        return self[name] if name in self.list_keys() or name in self.others else default

    def list_keys(self) -> Any:
        """Return the names without recording them as read."""
        return super().keys()

    def __iter__(self) -> Iterator[str]:
        return iter(self.read_all())

    def __len__(self) -> int:
        return len(self.read_all())

    def keys(self) -> Any:
        return self.read_all().keys()

    def values(self) -> Any:
        return self.read_all().values()

    def items(self) -> Any:
        return self.read_all().items()

    def read_all(self) -> dict[str, Array]:
        """Return all listed entries as a plain dict, and record them as read."""
        self.asked.update(self.list_keys())
        return {name: super(WatchedParameters, self).__getitem__(name) for name in self.list_keys()}


def call_while_tracing(function: Callable[..., Any], arguments: tuple[Any, ...], what: str, form: str) -> Array:
    """Call a user's function while tracing; turn any exception into one sentence that names the function."""
    _check_signature(function, arguments, what, form)
    try:
        value = function(*arguments)
    except KeyError as error:
        raise ValueError(f"{what} {_describe_missing_name(error.args[0] if error.args else '', arguments)}") from error
    except UNTRACEABLE as error:
        raise ValueError(
            f"{what} branches on the value of t, x or p (an `if`, a `while`, float() or numpy function), which JAX "
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


def _describe_missing_name(name: Any, arguments: tuple[Any, ...]) -> str:
    """Return the end of the sentence about a name that is neither in p nor, if u is a dict, in u."""
    parameters, *inputs = [given for given in arguments if isinstance(given, dict)]
    lacks = f"the parameter {name!r}, which the problem lacks; it has {join_names(parameters)}"
    if not inputs or name in inputs[0]:
        return f"reads {lacks}."
    lacks_input = f"the input {name!r}, which the experiment lacks; it has {join_names(inputs[0])}"
    if name in parameters:
        return f"reads {lacks_input}."
    known = f"a parameter ({join_names(parameters)}) nor an input ({join_names(inputs[0])})"
    return f"reads {name!r}, which is neither {known}."


def _check_signature(function: Callable[..., Any], arguments: tuple[Any, ...], what: str, form: str) -> None:
    """Raise ValueError if a function does not take as many arguments as it is called with."""
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # it has no signature
        return
    try:
        signature.bind(*arguments)
    except TypeError as error:
        inputs = " Modes get an input u if and only if the experiment has inputs." if what.startswith("mode ") else ""
        raise ValueError(f"{what} is called as {form}, but takes the arguments {signature}.{inputs}") from error


def call_for_vector(
    function: Callable[..., Any], arguments: tuple[Any, ...], shape: Shape | None, what: str, form: str
) -> Array:
    """Return the result of a user's function, checked (while tracing) to be a float64 array of the given shape.

    Without a shape, any shape is accepted.
    """
    array = call_while_tracing(function, arguments, what, form)
    if shape is not None and array.shape != shape:
        if not array.size == int(np.prod(shape)) == 1:
            raise ValueError(f"{what}: {form} must return an array of shape {shape}; got shape {array.shape}.")
        array = array.reshape(shape)
    if jnp.issubdtype(array.dtype, jnp.integer) or array.dtype == jnp.bool_:
        return array.astype(jnp.float64)
    if array.dtype != jnp.float64:
        raise ValueError(
            f"{what}: {form} must return float64; got {array.dtype}. Its arguments are float64: do not cast them."
        )
    return array
