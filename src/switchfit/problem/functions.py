"""Traced functions of the user: each is a jaxpr, traced when its problem is built, and compared by content.

Functions with equal jaxprs are equal, whatever Python objects they came from, so that they share compiled programs. A
function that reads a value that has changed has another jaxpr and is another `Function`. `switchfit.problem.contents`
decides whether a trace can be reused without calling the user's function.
"""

from __future__ import annotations

import hashlib
import itertools
import threading
from collections.abc import Callable, Hashable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import cached_property
from itertools import compress
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.arrays import Traced
from switchfit.problem.contents import JITTED, read_contents
from switchfit.problem.jaxpr_text import describe_jaxpr
from switchfit.problem.jaxprs import find_read_entries, list_jaxprs
from switchfit.problem.traced_constants import refuse_wrong_constants
from switchfit.problem.validation.messages import join_names
from switchfit.problem.validation.objects import find_misfit
from switchfit.runtime.jax_internals import (
    ClosedJaxpr,
    copy_constants,
    copy_literals,
    drop_unused,
    evaluate_jaxpr,
    forget_names,
)

Array = jax.Array
Shape = tuple[int, ...]

UNTRACEABLE = (jax.errors.ConcretizationTypeError, jax.errors.TracerIntegerConversionError)
"""Exceptions of JAX when Python code needs the value of a traced number."""

_traces: dict[Hashable, Function] = {}
_lock = threading.Lock()

MOST_TRACES = 1024
"""Number of functions whose traces are cached; the oldest go first."""

_turn = itertools.count(1)

_retracing = jax.make_user_context(0)
"""With a new value, JAX does not reuse earlier traces of jitted functions inside a function."""


def use_float64() -> AbstractContextManager[object]:
    """Return a context in which JAX computes in float64; the user's setting is restored at its end."""
    return jax.enable_x64(True)


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

    def __init__(self, closed: ClosedJaxpr, parameters: tuple[str, ...]) -> None:
        self.parameters = parameters
        self.shape: Shape = tuple(closed.out_avals[0].shape)
        self.jaxpr, self.consts = closed.jaxpr, closed.consts
        self.structs = [jax.ShapeDtypeStruct(a.shape, a.dtype) for a in closed.in_avals]
        content = describe_jaxpr(closed)
        self.digest = hashlib.sha256("\n".join([repr(parameters), *content.lines]).encode()).hexdigest()
        # Objects without text, such as a callback: two of them are equal if they are one object. While this function
        # holds it, no other object can get its id.
        self._opaque = tuple(content.opaque)  # compared by identity, therefore kept alive
        self._key = (self.digest, tuple(map(id, self._opaque)))

    def __call__(self, *arguments: Traced) -> Array:
        """Evaluate for arguments in the order of the user's function, p being a mapping of names to arrays."""
        flat = [_as_float64(a) for a in arguments if not isinstance(a, Mapping)]
        named = next(argument for argument in arguments if isinstance(argument, Mapping))
        return self.evaluate([*flat, *(named[name] for name in self.parameters)])

    def evaluate(self, given: Sequence[Traced]) -> Array:
        """Evaluate for the arguments of the jaxpr: the parameters are the last."""
        return evaluate_jaxpr(self.jaxpr, self.consts, *given)[0]

    @cached_property
    def read(self) -> dict[str, tuple[int, ...]]:
        """Positions of the entries of each parameter that it may read."""
        variables = self.jaxpr.invars[len(self.jaxpr.invars) - len(self.parameters) :]
        return dict(zip(self.parameters, find_read_entries(self.jaxpr, variables), strict=True))

    @cached_property
    def takes_input(self) -> bool:
        """Whether it takes an input after t, the state and the parameters."""
        return len(self.structs) - len(self.parameters) > 2

    def derive(self, evaluate: Callable[..., Traced]) -> Function:
        """Return another function of the same arguments, with its rate beside the input; `evaluate` takes those of the
        jaxpr.
        """
        structs = list(self.structs)
        if self.takes_input:
            structs[2] = jax.ShapeDtypeStruct((2, *structs[2].shape), structs[2].dtype)
        closed = jax.make_jaxpr(evaluate)(*structs)
        # Without what has no use: a corner does not take all of its mode, and is one in branches on its other sides.
        jaxpr, _ = drop_unused(closed.jaxpr, True)
        return Function(closed.replace(jaxpr=jaxpr), self.parameters)

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return self is other or (isinstance(other, Function) and self._key == other._key)


def _as_float64(value: Traced) -> Traced:
    """Return a value as a float64 array without weak type, which Python's numbers have, as the jaxpr requires."""
    is_double = getattr(value, "dtype", None) == np.float64 and not getattr(value, "weak_type", False)
    return value if is_double else jnp.asarray(value, jnp.float64)


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

    function: Callable[..., Traced]
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
    # JAX caches the trace of a jitted function by its identity: a global that it reads could change unseen.
    while type(function) is JITTED and hasattr(function, "__wrapped__"):  # JAX would not trace it again
        function = function.__wrapped__
    # The cache. Contents are compared by value, since problems are built again and again of functions that are made
    # anew each time, in a loop, a notebook's cell or a worker process: compared by identity, each would be traced (some
    # ten milliseconds) and none would find its compiled program (seconds). A function that reads what cannot be
    # compared is traced every time: retracing is the price of never using an outdated one.
    content = read_contents(function)
    asked = (call.arguments, call.shape, call.inputs, tuple(parameters.items()))
    key = None if content is None else (content, asked)
    if (found := _traces.get(key)) is not None:
        return found
    call = call._replace(function=function)
    # Inside, JAX reuses its own traces of jitted functions that are called, and these may read what has changed: a new
    # value of `_retracing` forbids it where the content is unknown.
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
        flat: list[Traced] = list(given[:count])
        if call.inputs:
            # The jaxpr takes the input as an array: a dict would be flattened in the order of its keys, and runs whose
            # inputs are named in different orders would not share a program.
            flat[-1] = {name: flat[-1][k] for k, name in enumerate(call.inputs)}
        named = dict(zip(parameters, given[count:], strict=True))
        return call_for_vector(call, (*flat[:position], named, *flat[position:]))

    shapes = [*(size for size in call.arguments if size is not None), *parameters.values()]
    closed = jax.make_jaxpr(evaluate)(*(jax.ShapeDtypeStruct(size, jnp.float64) for size in shapes))
    refuse_wrong_constants(closed, call.what)
    # t, x and u stay, also where they are not read: callers pass them by position. Parameters that are not read go, so
    # that the derivatives of a run cost what its own parameters cost.
    is_kept = [True] * count + [False] * len(parameters)
    jaxpr, is_read = drop_unused(closed.jaxpr, is_kept)
    for each in list_jaxprs(jaxpr):
        copy_literals(each)
    closed = type(closed)(forget_names(jaxpr), copy_constants(closed.consts))
    return Function(closed, tuple(compress(parameters, is_read[count:])))


# Calling a user's function while tracing


def _call_while_tracing(call: Call, arguments: tuple[Traced, ...]) -> Array:
    """Call a user's function while tracing; turn any exception into one sentence that names the function."""
    function, what, form = call.function, call.what, call.form
    # Before the call: a TypeError from inside the function looks the same as one from its call.
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


def call_for_vector(call: Call, arguments: tuple[Traced, ...]) -> Array:
    """Return the result of a user's function, checked (while tracing) to be a float64 array of the required shape."""
    array, shape, what, form = _call_while_tracing(call, arguments), call.shape, call.what, call.form
    if shape is not None and array.shape != shape:
        # A state of one number may be returned as a number, and a cost as an array of one.
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
