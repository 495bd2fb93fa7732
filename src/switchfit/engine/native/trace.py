"""Translate a JAX function to scalar operations: interpret its jaxpr, with object arrays of nodes for arrays.

The jaxpr contains the derivatives already. Operations that only move entries (reshape, slice, pad and so on) emit
nothing. Operations without a scalar form (loops of unknown length, random numbers, solvers) raise `Unsupported`.

An array whose entries are all known is a NumPy array of numbers, any other an object array of what `arrays` describes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import jax
import numpy as np
from jax.interpreters import partial_eval

from switchfit.engine.native import arrays
from switchfit.engine.native.arrays import Integer, Meaning, Unsupported, choose, known_number, less
from switchfit.engine.native.scalars import OPERATIONS, Graph, Node, Template, as_objects
from switchfit.problem.jaxprs import MOVES as SELECTIONS
from switchfit.problem.jaxprs import Walk, find_line, find_public_name, list_jaxprs

__all__ = ["Unsupported", "trace_scalars"]


MOST_NODES = 10_000
"""Largest number of operations of one function. Compiling takes 20 s at this size, and grows faster than it."""


def trace_scalars(
    function: Callable[..., Sequence[Any]], *shapes: tuple[int, ...], name: str = "the function"
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
        jaxpr, _ = partial_eval.dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars), instantiate=True)
        with np.errstate(all="ignore"):
            outputs = _Tracing(graph).run(jaxpr, closed.consts, inputs)
        if any(variable.aval.dtype != np.float64 for variable in closed.jaxpr.outvars):
            raise Unsupported("returns something else than float64")
    except Unsupported as error:
        raise Unsupported(f"{name} {error.what}", error.where) from error
    return Template(outputs, list(graph.presumed.values()))


def _make_jaxpr(function: Callable[..., Sequence[Any]], structs: Sequence[Any]) -> Any:
    try:
        return jax.make_jaxpr(function)(*structs)
    except Exception as error:  # raised by the function, or by JAX: for example, an operation without derivative
        line = (str(error).strip() or "no message").splitlines()[0]
        raise Unsupported(f"cannot be traced with its derivatives: {type(error).__name__}: {line}") from error


class _Tracing(Walk):
    """Follows arrays through a jaxpr; what is done to entries that are not known becomes nodes of a graph."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph

    def constant(self, value: Any) -> Any:
        return _as_array(value)

    def apply(self, equation: Any, given: list[Any], origin: Any) -> Sequence[Any]:
        try:
            if len(self._graph.nodes) > MOST_NODES:
                raise Unsupported(f"takes more than {MOST_NODES} operations")
            return [_as_array(value) for value in _apply(self._graph, equation, given)]
        except Unsupported as error:
            raise _add_location(error, equation) from None


def _run(graph: Graph, inner: Any, inputs: Sequence[Any]) -> list[Any]:
    """Return the results of a jaxpr that an operation calls, with its constants or without."""
    jaxpr, consts = getattr(inner, "jaxpr", inner), getattr(inner, "consts", ())
    return _Tracing(graph).run(jaxpr, consts, [_as_array(value) for value in inputs])


def _as_array(value: Any) -> Any:
    """Return a NumPy array; typed random keys of JAX, for which NumPy has no type, stay as they are."""
    extended = isinstance(value, jax.Array) and jax.dtypes.issubdtype(value.dtype, jax.dtypes.extended)
    return value if extended or isinstance(value, np.ndarray) else np.asarray(value)


def _add_location(error: Unsupported, equation: Any) -> Unsupported:
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


def _apply(graph: Graph, equation: Any, args: list[Any]) -> Sequence[Any]:
    name, params = equation.primitive.name, equation.params
    shapes = [variable.aval.shape for variable in equation.outvars]
    if shapes and all(0 in shape for shape in shapes):
        return [np.empty(shape) for shape in shapes]
    # An empty array counts as known, so that JAX evaluates reductions over it.
    args = [a if a.size else np.empty(a.shape, v.aval.dtype) for a, v in zip(args, equation.invars, strict=True)]
    known = all(a.dtype != object for a in args)
    # The order matters: calls are inlined; what is known is computed at once; only what is left becomes nodes.
    if name in CALLS:
        inner = params["jaxpr" if "jaxpr" in params else "call_jaxpr"]
        if not known and _is_search(equation):
            names = {each.primitive.name for jaxpr in list_jaxprs(inner.jaxpr) for each in jaxpr.eqns}
            places = arrays.search(graph, args[0], args[1], right="lt_to" in names)
            if places is not None:
                return [np.asarray(places, dtype=object)]
        return _run(graph, inner, args)
    if name in MOVES:
        result = MOVES[name](params, *args)
        return result if equation.primitive.multiple_results else [result]
    if known:
        return _evaluate_known(graph, equation, args)
    # What depends on the state: loops are unrolled, rules take whole arrays, and meanings one entry at a time.
    if name in LOOPS:
        return LOOPS[name](graph, equation, *args)
    for dtype in (variable.aval.dtype for variable in equation.invars):
        if dtype.kind not in "fbiu" or (dtype.kind == "f" and dtype != np.float64):
            raise Unsupported(f"has numbers of type {dtype} that depend on the state")
    if name in RULES:
        results = RULES[name](graph, equation, *args)
        return results if equation.primitive.multiple_results else [np.asarray(results, dtype=object)]
    meaning = _get_meaning(graph, name, params, equation.invars[-1].aval.dtype)
    return [np.asarray(np.frompyfunc(meaning, len(args), 1)(*args), dtype=object)]


def _evaluate_known(graph: Graph, equation: Any, args: list[Any]) -> list[Any]:
    """Evaluate an operation on known numbers: indexing here, frequent operations by NumPy and all others by XLA."""
    name, out = equation.primitive.name, [variable.aval for variable in equation.outvars]
    if name in INDEXED:  # rows of tangents: XLA would take 60 ms to compile each
        with suppress(Unsupported):
            return [np.asarray(INDEXED[name](graph, equation, *args)).astype(out[0].dtype)]
    # NumPy and JAX differ where doubles become integers, for numbers out of range.
    is_cut = name == "convert_element_type" and args[0].dtype.kind == "f" and out[0].dtype.kind in "iu"
    if name in NUMPY and not is_cut:
        return [np.asarray(NUMPY[name](equation.params, *args)).astype(out[0].dtype).reshape(out[0].shape)]
    with jax.ensure_compile_time_eval():
        results = equation.primitive.bind(*args, **equation.params)
    return [_as_array(a) for a in (results if equation.primitive.multiple_results else [results])]


def _get_meaning(graph: Graph, name: str, params: Any, dtype: np.dtype[Any]) -> Callable[..., Any]:
    """Return what an operation does to entries, of arrays of which the last has a type."""
    table = OF_ALL | {"f": OF_DOUBLES, "b": OF_TRUTH}.get(dtype.kind, arrays.OF_INTEGERS)
    if name in table:
        return partial(table[name], graph, params, dtype)
    if dtype.kind in "iu" and name not in OTHER_NAMES:
        raise Unsupported(f"does integer arithmetic ({name}) with what depends on the state")
    raise Unsupported(f"calls {OTHER_NAMES.get(name, f'jax.lax.{name}')}")


def _is_search(equation: Any) -> bool:
    """Return whether an operation is JAX's search in one sorted array, which `jnp.interp` calls too.

    Operands after the array and the numbers are tangents, on which an index does not depend.
    """
    if equation.params.get("name") != "_searchsorted_scan_impl":
        return False
    table, query = (variable.aval for variable in equation.invars[:2])
    found = [(variable.aval.shape, query.dtype) for variable in equation.outvars]
    return table.ndim == 1 and table.dtype == np.float64 and found == [(query.shape, table.dtype)]


OTHER_NAMES = {"while": "jax.lax.while_loop", "eigh": "jnp.linalg.eigh", "eig": "jnp.linalg.eig", "fft": "jnp.fft"}
"""Public names of operations for which it is not `jax.lax.NAME`."""


# Loops and branches


def _scan(graph: Graph, equation: Any, *args: Any) -> list[Any]:
    """Unroll a loop of known length."""
    params = equation.params
    fixed, carried, length = params["num_consts"], params["num_carry"], params["length"]
    consts, carry, columns = args[:fixed], list(args[fixed : fixed + carried]), args[fixed + carried :]
    made: list[list[Any]] = []
    for k in reversed(range(length)) if params["reverse"] else range(length):
        results = _run(graph, params["jaxpr"], [*consts, *carry, *(c[k] for c in columns)])
        carry = results[:carried]
        made.append(results[carried:])
    if not made:
        return [*carry, *(np.empty(variable.aval.shape) for variable in equation.outvars[carried:])]
    rows = made[::-1] if params["reverse"] else made
    return [*carry, *(np.stack(column) for column in zip(*rows, strict=True))]


def _cond(graph: Graph, equation: Any, *args: Any) -> list[Any]:
    """Trace all branches, and select among their results."""
    which, *operands = args
    choice, branches = which.item(), equation.params["branches"]
    known = known_number(choice)
    if known is not None:
        return _run(graph, branches[int(np.clip(known, 0, len(branches) - 1))], operands)
    results = [_run(graph, branch, operands) for branch in branches]
    select = np.frompyfunc(partial(_select, graph, None, None, choice), len(branches), 1)
    return [np.asarray(select(*cases), dtype=object) for cases in zip(*results, strict=True)]


def _linear_solve(graph: Graph, equation: Any, *args: Any) -> list[Any]:
    """Trace the solver of a linear system; JAX has differentiated it before."""
    lengths, jaxprs = equation.params["const_lengths"], equation.params["jaxprs"]
    # Operands: constants of matvec, vecmat, solve and transpose_solve, in this order, then the right-hand side.
    before = lengths.matvec + lengths.vecmat
    right = before + lengths.solve + (lengths.transpose_solve if jaxprs.transpose_solve is not None else 0)
    return _run(graph, jaxprs.solve, [*args[before : before + lengths.solve], *args[right:]])


LOOPS: dict[str, Callable[..., list[Any]]] = {"scan": _scan, "cond": _cond, "custom_linear_solve": _linear_solve}

CALLS = "jit", "closed_call", "remat2", "checkpoint", "custom_jvp_call", "custom_vjp_call"
"""Operations that run another jaxpr. Custom derivatives have been applied before."""


# Operations that move entries


def _broadcast(params: Any, a: Any, *_: Any) -> Any:
    others = [k for k in range(len(params["shape"])) if k not in params["broadcast_dimensions"]]
    return np.broadcast_to(np.expand_dims(a, others), params["shape"])


def _pad(params: Any, a: Any, value: Any) -> Any:
    """Insert entries between and around those of an array; a negative count at an end removes entries."""
    shape, inside, places = [], [], []
    for n, (low, high, between) in zip(a.shape, params["padding_config"], strict=True):
        shape.append(low + n + max(n - 1, 0) * between + high)
        place = low + np.arange(n) * (between + 1)
        inside.append((place >= 0) & (place < shape[-1]))
        places.append(place[inside[-1]])
    result = np.empty(shape, dtype=object if object in (a.dtype, value.dtype) else a.dtype)
    result[...] = value.item()
    result[np.ix_(*places)] = a[np.ix_(*inside)]
    return result


MOVES: dict[str, Callable[..., Any]] = {
    **{name: lambda params, a, *_, move=move: move(a, params) for name, move in SELECTIONS.items()},
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda params, *a: np.concatenate(a, axis=params["dimension"]),
    "pad": _pad,
    "rev": lambda params, a: np.flip(a, params["dimensions"]),
    "tile": lambda params, a: np.tile(a, params["reps"]),
    "split": lambda params, a: np.split(a, np.cumsum(params["sizes"])[:-1], axis=params["axis"]),
    "stack": lambda params, *a: np.stack(a, axis=params["axis"]),
    "unstack": lambda params, a: list(np.moveaxis(a, params["axis"], 0)),
    "copy": lambda params, a: a,
    "stop_gradient": lambda params, a: a,
    "optimization_barrier": lambda params, *a: a,
}
"""Operations that only move entries."""

NUMPY: dict[str, Callable[..., Any]] = {
    "iota": lambda params: _broadcast(
        params | {"broadcast_dimensions": [params["dimension"]]}, np.arange(params["shape"][params["dimension"]])
    ),
    "convert_element_type": lambda params, a: a,
    **{
        name: lambda params, *args, value=operation.value: value(*args)
        for operation in OPERATIONS.values()
        if operation.known_alike
        for name in (*operation.primitives, *operation.of_truth[:1])
    },
    "select_n": lambda params, which, *cases: np.choose(which.astype(int), cases),
}
"""Frequent operations on known numbers, evaluated by NumPy, since calling XLA for each would be slow."""


# Entries of any type


def _convert(graph: Graph, params: Any, dtype: np.dtype[Any], a: Any) -> Any:
    kind = np.dtype(params["new_dtype"])
    if kind.kind not in "biu" and kind != np.float64:
        raise Unsupported(f"converts what depends on the state to {kind}")
    if kind.kind == dtype.kind and kind.kind in "bf":
        return a
    if dtype.kind == "f":
        return graph.apply("ne", a, 0.0) if kind.kind == "b" else arrays.from_double(graph, kind, a)
    number = Integer.of(graph, a)
    if kind.kind in "iu":
        return arrays.within(graph, number, kind)
    return number.node if kind.kind == "f" else graph.apply("ne", number.node, 0.0)


def _raise_to_integer(graph: Graph, params: Any, dtype: np.dtype[Any], a: Any) -> Any:
    exponent, multiply = int(params["y"]), _get_meaning(graph, "mul", {}, dtype)
    # By squares: x^k takes about 2 log2 k products.
    result, square, left = 1, a, abs(exponent)
    while left:
        if left & 1:
            result = multiply(result, square)
        left >>= 1
        square = multiply(square, square) if left else square
    return graph.apply("div", 1.0, result) if exponent < 0 else result


def _select(graph: Graph, params: Any, dtype: Any, which: Any, *cases: Any) -> Any:
    """Select one of several cases by a truth value or an integer."""
    if not isinstance(which, Node | Integer):
        return cases[int(which)]
    if isinstance(which, Node):
        return choose(graph, which, cases[1], cases[0])
    result = cases[0]
    for k, case in enumerate(cases[1:], start=1):
        result = choose(graph, less(graph, which, k), result, case)
    return result


def _clamp(graph: Graph, params: Any, dtype: np.dtype[Any], low: Any, a: Any, high: Any) -> Any:
    smaller, larger = (_get_meaning(graph, name, {}, dtype) for name in ("min", "max"))
    return smaller(larger(a, low), high)


OF_ALL: dict[str, Meaning] = {
    "clamp": _clamp,
    "convert_element_type": _convert,
    "integer_pow": _raise_to_integer,
    "select_n": _select,
}
"""Operations on each entry of arrays of any type."""


# Doubles


def _apply_operation(op: str) -> Meaning:
    return lambda graph, params, dtype, *entries: graph.apply(op, *entries)


def _round(graph: Graph, params: Any, dtype: np.dtype[Any], a: Any) -> Any:
    """Round to the nearest integer; a half to the even one, or away from zero."""
    to_even = params["rounding_method"] == jax.lax.RoundingMethod.TO_NEAREST_EVEN
    return graph.apply("rint" if to_even else "round", a)


def _sign(graph: Graph, params: Any, dtype: np.dtype[Any], a: Any) -> Any:
    negative = graph.apply("select", graph.apply("lt", a, 0.0), -1.0, a)  # 0 and NaN are unchanged
    return graph.apply("select", graph.apply("lt", 0.0, a), 1.0, negative)


OF_DOUBLES: dict[str, Meaning] = {
    **{name: _apply_operation(op) for op, operation in OPERATIONS.items() for name in operation.primitives},
    "square": lambda graph, _, __, a: a * a,
    "rsqrt": lambda graph, _, __, a: 1.0 / graph.apply("sqrt", a),
    "logistic": lambda graph, _, __, a: 1.0 / (1.0 + graph.apply("exp", -a)),
    "sign": _sign,
    "round": _round,
    "lt_to": lambda graph, _, __, a, b: arrays.compare_in_order(graph, "lt", a, b),
    "le_to": lambda graph, _, __, a, b: arrays.compare_in_order(graph, "le", a, b),
    "is_finite": lambda graph, _, __, a: graph.apply("eq", a - a, 0.0),
}
"""Operations on each entry of arrays of doubles."""


# Truth values


OF_TRUTH: dict[str, Meaning] = arrays.OF_INTEGERS | {
    name: _apply_operation(op) for op, operation in OPERATIONS.items() for name in operation.of_truth
}
"""Operations on each entry of arrays of truth values, which are compared as integers are."""


# Whole arrays


def _dot(graph: Graph, equation: Any, a: Any, b: Any) -> Any:
    if any(variable.aval.dtype != np.float64 for variable in equation.invars):
        raise Unsupported("multiplies matrices of truth values or integers that depend on the state")
    (sum_a, sum_b), (batch_a, batch_b) = equation.params["dimension_numbers"]
    of_a, of_b = list(range(a.ndim)), list(range(a.ndim, a.ndim + b.ndim))
    # einsum's labels: axes that are summed, or shared as batch, get that of a.
    for one, other in zip((*sum_a, *batch_a), (*sum_b, *batch_b), strict=True):
        of_b[other] = one
    kept = [k for k in (*batch_a, *of_a, *of_b) if k not in sum_a]
    a, b = (np.asarray(each, dtype=object) for each in (a, b))
    return np.einsum(a, of_a, b, of_b, list(dict.fromkeys(kept)))


def _reduce(name: str) -> Callable[..., Any]:
    """Reduce over axes by an operation."""

    def over(graph: Graph, equation: Any, a: Any) -> Any:
        combine = np.frompyfunc(_get_meaning(graph, name, {}, equation.invars[0].aval.dtype), 2, 1)
        for axis in sorted(equation.params["axes"], reverse=True):
            a = combine.reduce(a, axis=axis, dtype=object)
        return a

    return over


def _accumulate(name: str) -> Callable[..., Any]:
    """Accumulate along an axis by an operation."""

    def along(graph: Graph, equation: Any, a: Any) -> Any:
        axis, turned = equation.params["axis"], equation.params["reverse"]
        combine = np.frompyfunc(_get_meaning(graph, name, {}, equation.invars[0].aval.dtype), 2, 1)
        ordered = np.flip(a, axis) if turned else a
        result = combine.accumulate(ordered, axis=axis, dtype=object)
        return np.flip(result, axis) if turned else result

    return along


def _find_first(name: str) -> Callable[..., Any]:
    """Find the index of the largest (smallest) entry along an axis, the first of several; NaN counts as extreme."""

    def along(graph: Graph, equation: Any, a: Any) -> Any:
        (axis,), dtype = equation.params["axes"], equation.invars[0].aval.dtype
        reaches = _get_meaning(graph, name, {}, dtype)  # false for NaN, which is beyond any number

        def first(row: Any) -> Any:
            best, found = row[0], 0
            for k, value in enumerate(row[1:], start=1):
                better = graph.apply("not", reaches(best, value))
                if dtype.kind == "f":
                    better = graph.apply("and", better, graph.apply("eq", best, best))  # the first NaN stays
                best, found = choose(graph, better, value, best), choose(graph, better, k, found)
            return found

        rows = np.moveaxis(a, axis, -1)
        return as_objects([first(row) for row in rows.reshape(-1, rows.shape[-1])]).reshape(rows.shape[:-1])

    return along


def _scatter(name: str | None) -> Callable[..., Any]:
    """Return a scatter that combines old entries with updates by an operation, or replaces them."""

    def scatter_entries(graph: Graph, equation: Any, a: Any, indices: Any, updates: Any) -> Any:
        dtype = equation.outvars[0].aval.dtype

        def combine(here: Any, old: Any, update: Any) -> Any:
            if name is None:
                return choose(graph, here, update, old)
            # Known place, known numbers: no node at all.
            if known_number(here) is True and not any(isinstance(a, Node | Integer) for a in (old, update)):
                return OPERATIONS[name].value(old, update)
            return choose(graph, here, _get_meaning(graph, name, {}, dtype)(old, update), old)

        return arrays.scatter(graph, equation, a, indices, updates, combine)

    return scatter_entries


SUMS = {"sum": "add", "prod": "mul", "max": "max", "min": "min"}

INDEXED: dict[str, Callable[..., Any]] = {
    "gather": arrays.gather,
    "dynamic_slice": arrays.dynamic_slice,
    "dynamic_update_slice": arrays.dynamic_update_slice,
    "scatter": _scatter(None),
    "scatter-add": _scatter("add"),
    "scatter-mul": _scatter("mul"),
    "scatter-max": _scatter("max"),
    "scatter-min": _scatter("min"),
}
"""Operations at indices."""

RULES: dict[str, Callable[..., Any]] = {
    "argmax": _find_first("ge"),
    "argmin": _find_first("le"),
    "lu": arrays.lu,
    "cholesky": arrays.cholesky,
    "triangular_solve": arrays.triangular_solve,
    "sort": arrays.sort,
    "dot_general": _dot,
    **{f"reduce_{name}": _reduce(op) for name, op in SUMS.items()},
    **{f"reduce_{name}": _reduce(name) for name in ("and", "or", "xor")},
    **{f"cum{name}": _accumulate(op) for name, op in SUMS.items()},
    **INDEXED,
}
"""Operations on whole arrays; each rule takes a graph, the equation and its operands."""
