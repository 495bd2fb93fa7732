"""Trace a JAX function to scalar operations: interpret its jaxpr, with object arrays of nodes for arrays.

The jaxpr contains the derivatives already. Loops are unrolled, and branches become selections. Operations without a
scalar form (loops of unknown length, random numbers, solvers) raise `Unsupported`.

An array whose entries are all known is a NumPy array of numbers, any other an object array of `entries`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import jax
import numpy as np

from switchfit.arrays import Traced
from switchfit.engine.native.scalars.graph import Graph
from switchfit.engine.native.scalars.template import Template
from switchfit.engine.native.tracing import sorting
from switchfit.engine.native.tracing.entries import TracedArray, known_number
from switchfit.engine.native.tracing.known_numbers import as_numpy, evaluate_known
from switchfit.engine.native.tracing.meanings import get_meaning, select_case
from switchfit.engine.native.tracing.moves import MOVING_OPERATIONS
from switchfit.engine.native.tracing.rules import ARRAY_RULES
from switchfit.engine.native.tracing.unsupported import Unsupported
from switchfit.problem.jaxprs import Walk, find_line, find_public_name, list_jaxprs, strip_constants
from switchfit.runtime.jax_internals import ClosedJaxpr, Equation, Jaxpr, array_type, drop_unused

__all__ = ["Unsupported", "trace_scalars"]

MOST_NODES = 10_000
"""Largest number of operations of one function. Compiling takes 20 s at this size, and grows faster than it."""

CALLS = "jit", "closed_call", "remat2", "checkpoint", "custom_jvp_call", "custom_vjp_call"
"""Operations that run another jaxpr. Custom derivatives have been applied before."""


def trace_scalars(
    function: Callable[..., Sequence[Traced]], *shapes: tuple[int, ...], name: str = "the function"
) -> Template:
    """Trace a function of float64 arrays of the given shapes, which returns a flat list of arrays.

    Raises
    ------
    Unsupported
        If it does something that has no scalar form; the message begins with its `name`.
    """
    structs = [jax.ShapeDtypeStruct(shape, np.float64) for shape in shapes]
    graph = Graph()
    inputs = [graph.loads(str(k), int(np.prod(shape))).reshape(shape) for k, shape in enumerate(shapes)]
    try:
        closed = _make_jaxpr(function, structs)
        # Without what has no use: there, no operation has to be finite.
        jaxpr, _ = drop_unused(closed.jaxpr, True)
        with np.errstate(all="ignore"):
            outputs = _Tracing(graph).run(jaxpr, closed.consts, inputs)
        # A function that returns float32 or integers is evaluated by JAX, with its own rounding.
        if any(array_type(variable).dtype != np.float64 for variable in closed.jaxpr.outvars):
            raise Unsupported("returns something else than float64")
    except Unsupported as error:
        raise Unsupported(f"{name} {error.what}", error.where) from error
    return Template(outputs, list(graph.presumed.values()))


def _make_jaxpr(function: Callable[..., Sequence[Traced]], structs: Sequence[jax.ShapeDtypeStruct]) -> ClosedJaxpr:
    try:
        return jax.make_jaxpr(function)(*structs)
    except Exception as error:  # raised by the function, or by JAX: for example, an operation without derivative
        line = (str(error).strip() or "no message").splitlines()[0]
        raise Unsupported(f"cannot be traced with its derivatives: {type(error).__name__}: {line}") from error


class _Tracing(Walk):
    """Follows arrays through a jaxpr; what is done to entries that are not known becomes nodes of a graph."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph

    def constant(self, value: Traced) -> TracedArray:
        return as_numpy(value)

    def apply(self, equation: Equation, given: list[TracedArray], origin: Equation) -> Sequence[TracedArray]:
        try:
            # Here, not at the end: a loop of a million turns would fill the memory before.
            if len(self._graph.nodes) > MOST_NODES:
                raise Unsupported(f"takes more than {MOST_NODES} operations")
            return [as_numpy(value) for value in _apply(self._graph, equation, given)]
        except Unsupported as error:
            raise _add_location(error, equation) from None


def _run(graph: Graph, inner: Jaxpr | ClosedJaxpr, inputs: Sequence[TracedArray]) -> list[TracedArray]:
    """Return the results of a jaxpr that an operation calls, with its constants or without."""
    jaxpr, consts = strip_constants(inner), getattr(inner, "consts", ())
    return _Tracing(graph).run(jaxpr, consts, [as_numpy(value) for value in inputs])


def _add_location(error: Unsupported, equation: Equation) -> Unsupported:
    """Add the line of the user's code, and the name of the JAX function that it calls.

    JAX traces functions such as `jnp.sort` once for all callers: the source location of their inner operations may be
    that of another call. The location of the call itself is therefore used.
    """
    inner = equation.params.get("jaxpr") if equation.primitive.name == "jit" else None
    name = None if inner is None else find_public_name(inner.jaxpr)
    if name is not None:
        calls, _, why = error.what.partition(", which ")
        why = why if calls.startswith("calls ") else error.what
        more = f", which {why}" if why else ""
        return Unsupported(f"calls {name}{more}", find_line(equation) or None)
    return Unsupported(error.what, error.where or find_line(equation) or None)


def _apply(graph: Graph, equation: Equation, args: list[TracedArray]) -> Sequence[TracedArray]:
    name, params = equation.primitive.name, equation.params
    shapes = [array_type(variable).shape for variable in equation.outvars]
    if shapes and all(0 in shape for shape in shapes):
        return [np.empty(shape) for shape in shapes]
    # An empty array counts as known, so that JAX evaluates reductions over it.
    args = [a if a.size else np.empty(a.shape, array_type(v).dtype) for a, v in zip(args, equation.invars, strict=True)]
    known = all(a.dtype != object for a in args)
    # The order matters: calls are inlined; what is known is computed at once; only what is left becomes nodes.
    if name in CALLS:
        inner = params["jaxpr" if "jaxpr" in params else "call_jaxpr"]
        if not known and _is_search(equation):
            names = {each.primitive.name for jaxpr in list_jaxprs(inner.jaxpr) for each in jaxpr.eqns}
            places = sorting.search(graph, args[0], args[1], right="lt_to" in names)
            if places is not None:
                return [np.asarray(places, dtype=object)]
        return _run(graph, inner, args)
    if name in MOVING_OPERATIONS:
        result = MOVING_OPERATIONS[name](params, *args)
        return result if equation.primitive.multiple_results else [result]
    if known:
        return evaluate_known(graph, equation, args)
    # What depends on the state: loops are unrolled, rules take whole arrays, and meanings one entry at a time.
    if name in LOOPS:
        return LOOPS[name](graph, equation, *args)
    for dtype in (array_type(variable).dtype for variable in equation.invars):
        if dtype.kind not in "fbiu" or (dtype.kind == "f" and dtype != np.float64):
            raise Unsupported(f"has numbers of type {dtype} that depend on the state")
    if name in ARRAY_RULES:
        results = ARRAY_RULES[name](graph, equation, *args)
        return results if equation.primitive.multiple_results else [np.asarray(results, dtype=object)]
    meaning = get_meaning(graph, name, params, array_type(equation.invars[-1]).dtype)
    return [np.asarray(np.frompyfunc(meaning, len(args), 1)(*args), dtype=object)]


def _is_search(equation: Equation) -> bool:
    """Return whether an operation is JAX's search in one sorted array, which `jnp.interp` calls too.

    Operands after the array and the numbers are tangents, on which an index does not depend.
    """
    if equation.params.get("name") != "_searchsorted_scan_impl":
        return False
    table, query = (array_type(variable) for variable in equation.invars[:2])
    found = [(array_type(variable).shape, query.dtype) for variable in equation.outvars]
    return table.ndim == 1 and table.dtype == np.float64 and found == [(query.shape, table.dtype)]


# Loops and branches


def _scan(graph: Graph, equation: Equation, *args: TracedArray) -> list[TracedArray]:
    """Unroll a loop of known length."""
    params = equation.params
    fixed, carried, length = params["num_consts"], params["num_carry"], params["length"]
    consts, carry, columns = args[:fixed], list(args[fixed : fixed + carried]), args[fixed + carried :]
    made: list[list[TracedArray]] = []
    for k in reversed(range(length)) if params["reverse"] else range(length):
        results = _run(graph, params["jaxpr"], [*consts, *carry, *(c[k] for c in columns)])
        carry = results[:carried]
        made.append(results[carried:])
    if not made:
        return [*carry, *(np.empty(array_type(variable).shape) for variable in equation.outvars[carried:])]
    rows = made[::-1] if params["reverse"] else made
    return [*carry, *(np.stack(column) for column in zip(*rows, strict=True))]


def _cond(graph: Graph, equation: Equation, *args: TracedArray) -> list[TracedArray]:
    """Trace all branches, and select among their results."""
    which, *operands = args
    choice, branches = which.item(), equation.params["branches"]
    known = known_number(choice)
    if known is not None:
        return _run(graph, branches[int(np.clip(known, 0, len(branches) - 1))], operands)
    results = [_run(graph, branch, operands) for branch in branches]
    select = np.frompyfunc(partial(select_case, graph, None, None, choice), len(branches), 1)
    return [np.asarray(select(*cases), dtype=object) for cases in zip(*results, strict=True)]


def _linear_solve(graph: Graph, equation: Equation, *args: TracedArray) -> list[TracedArray]:
    """Trace the solver of a linear system; JAX has differentiated it before."""
    lengths, jaxprs = equation.params["const_lengths"], equation.params["jaxprs"]
    # Operands: constants of matvec, vecmat, solve and transpose_solve, in this order, then the right-hand side.
    before = lengths.matvec + lengths.vecmat
    right = before + lengths.solve + (lengths.transpose_solve if jaxprs.transpose_solve is not None else 0)
    return _run(graph, jaxprs.solve, [*args[before : before + lengths.solve], *args[right:]])


LOOPS: dict[str, Callable[..., list[TracedArray]]] = {
    "scan": _scan,
    "cond": _cond,
    "custom_linear_solve": _linear_solve,
}
