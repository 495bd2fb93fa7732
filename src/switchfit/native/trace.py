"""From a JAX function to scalars: its jaxpr, read one operation after another, with arrays of nodes for arrays.

JAX has differentiated by then; what happens here is bookkeeping. Whatever moves entries about (reshape, slice, pad and
so on) leaves no trace. What has no meaning here (loops, random numbers, solvers) raises `Unsupported`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial, reduce
from typing import Any

import jax
import numpy as np

from switchfit.native.scalars import CONDITIONS, FOLDED, Graph, Node, Objects, Template, as_objects


class Unsupported(Exception):  # noqa: N818  # says what is not there, is no error: something else then does the work
    """A function that cannot be written as a straight line of scalars."""


MOST_NODES = 50_000
"""Operations of one function beyond which compiling them one by one takes too long."""


def traced(function: Callable[..., Sequence[Any]], *shapes: tuple[int, ...]) -> Template:
    """A function of float64 arrays of the given shapes, which returns a flat list of arrays.

    Raises
    ------
    Unsupported
        If it does something that has no scalar form.
    """
    structs = [jax.ShapeDtypeStruct(shape, np.float64) for shape in shapes]
    closed = jax.make_jaxpr(function)(*structs)
    graph = Graph()
    inputs = [graph.loads(str(k), int(np.prod(shape))).reshape(shape) for k, shape in enumerate(shapes)]
    with np.errstate(all="ignore"):
        outputs = _run(graph, closed.jaxpr, closed.consts, inputs)
    return Template(outputs)


def _run(graph: Graph, jaxpr: Any, consts: Sequence[Any], inputs: Sequence[Any]) -> list[Any]:
    known: dict[Any, Any] = {}
    for variables, values in ((jaxpr.constvars, consts), (jaxpr.invars, inputs)):
        for variable, value in zip(variables, values, strict=True):
            known[variable] = value if isinstance(value, np.ndarray) else np.asarray(value)

    def of(atom: Any) -> Any:
        return np.asarray(atom.val) if hasattr(atom, "val") else known[atom]

    for equation in jaxpr.eqns:
        if len(graph.nodes) > MOST_NODES:
            raise Unsupported(f"more than {MOST_NODES} operations")
        results = _apply(graph, equation, [of(a) for a in equation.invars])
        for variable, value in zip(equation.outvars, results, strict=True):
            known[variable] = np.asarray(value)
    return [of(a) for a in jaxpr.outvars]


def _apply(graph: Graph, equation: Any, args: list[Any]) -> Sequence[Any]:
    name, params = equation.primitive.name, equation.params
    if name in CALLS:
        inner = params[CALLS[name]]
        if hasattr(inner, "consts"):
            return _run(graph, inner.jaxpr, inner.consts, args)
        return _run(graph, inner, (), args)
    if name == "scan":
        return _scan(graph, params, args)
    if name == "cond":
        return _cond(graph, params, args)
    if name in MOVES:
        result = MOVES[name](params, *args)
        return result if name in ("split", "unstack") else [result]
    if name in INDEXED and args[1].dtype != object:
        return [np.asarray(INDEXED[name](equation, *args), dtype=object)]
    if all(a.dtype != object for a in args):
        if name in NUMPY:
            shape, dtype = equation.outvars[0].aval.shape, equation.outvars[0].aval.dtype
            return [np.asarray(NUMPY[name](params, *args)).astype(dtype).reshape(shape)]
        with jax.ensure_compile_time_eval():
            results = equation.primitive.bind(*args, **params)
        return [np.asarray(a) for a in (results if equation.primitive.multiple_results else [results])]
    if name in MEANINGS:
        meaning = MEANINGS[name](graph, params)
        return [np.asarray(np.frompyfunc(meaning, len(args), 1)(*args), dtype=object)]
    if name in ARRAYS:
        return [np.asarray(ARRAYS[name](graph, params, *args), dtype=object)]
    raise Unsupported(f"jax.lax.{name}")


def _scan(graph: Graph, params: Any, args: list[Any]) -> list[Any]:
    """A loop of known length, one turn after another."""
    fixed, carried, length = params["num_consts"], params["num_carry"], params["length"]
    consts, carry, columns = args[:fixed], args[fixed : fixed + carried], args[fixed + carried :]
    made: list[list[Any]] = []
    for k in reversed(range(length)) if params["reverse"] else range(length):
        results = _run(
            graph, params["jaxpr"].jaxpr, params["jaxpr"].consts, [*consts, *carry, *(c[k] for c in columns)]
        )
        carry = results[:carried]
        made.append(results[carried:])
        if len(graph.nodes) > MOST_NODES:
            raise Unsupported(f"more than {MOST_NODES} operations")
    rows = made[::-1] if params["reverse"] else made
    return [*carry, *(np.stack(column) for column in zip(*rows, strict=True))]


def _cond(graph: Graph, params: Any, args: list[Any]) -> list[Any]:
    """All branches, and a choice among their results."""
    which, *operands = args
    branches = [_run(graph, branch.jaxpr, branch.consts, operands) for branch in params["branches"]]
    choice = which.item()
    if not isinstance(choice, Choice):
        return branches[int(np.clip(choice, 0, len(branches) - 1))]
    select = np.frompyfunc(partial(graph.apply, "select", choice.condition), 2, 1)
    return [np.asarray(select(yes, no), dtype=object) for no, yes in zip(*branches, strict=True)]


class Choice:
    """A condition as a number that picks a branch: it can do nothing else."""

    def __init__(self, condition: Node) -> None:
        self.condition = condition

    def __float__(self) -> float:
        raise Unsupported("arithmetic with integers that depend on the state")

    __int__ = __bool__ = __index__ = __float__


CALLS = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "closed_call": "call_jaxpr",
    "core_call": "call_jaxpr",
    "remat": "jaxpr",
    "checkpoint": "jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "custom_vjp_call": "call_jaxpr",
    "custom_vjp_call_jaxpr": "fun_jaxpr",
}
"""Operations that run another jaxpr, by where they keep it. Custom derivatives have been used before."""


def _broadcast(params: Any, a: Any, *_: Any) -> Any:
    shape = [1] * len(params["shape"])
    for axis, length in zip(params["broadcast_dimensions"], a.shape, strict=True):
        shape[axis] = length
    return np.broadcast_to(a.reshape(shape), params["shape"])


def _slice(params: Any, a: Any) -> Any:
    steps = params["strides"] or [1] * a.ndim
    return a[tuple(slice(*s) for s in zip(params["start_indices"], params["limit_indices"], steps, strict=True))]


def _pad(params: Any, a: Any, value: Any) -> Any:
    config = params["padding_config"]
    if any(low < 0 or high < 0 for low, high, _ in config):
        raise Unsupported("negative padding")
    shape = [low + high + n + max(n - 1, 0) * inner for n, (low, high, inner) in zip(a.shape, config, strict=True)]
    result = np.empty(shape, dtype=object)
    result[...] = value.item() if value.dtype != object else value.reshape(-1)[0]
    result[
        tuple(
            slice(low, low + n + max(n - 1, 0) * inner, inner + 1)
            for n, (low, _, inner) in zip(a.shape, config, strict=True)
        )
    ] = a
    return result if object in (a.dtype, value.dtype) else result.astype(a.dtype)


def _dynamic_slice(params: Any, a: Any, *starts: Any) -> Any:
    if any(s.dtype == object for s in starts):
        raise Unsupported("an index that depends on the state")
    sizes = params["slice_sizes"]
    first = [int(np.clip(s, 0, n - size)) for s, n, size in zip(starts, a.shape, sizes, strict=True)]
    return a[tuple(slice(f, f + size) for f, size in zip(first, sizes, strict=True))]


def _dynamic_update_slice(params: Any, a: Any, update: Any, *starts: Any) -> Any:
    if any(s.dtype == object for s in starts):
        raise Unsupported("an index that depends on the state")
    first = [int(np.clip(s, 0, n - size)) for s, n, size in zip(starts, a.shape, update.shape, strict=True)]
    result = a.astype(object)
    result[tuple(slice(f, f + size) for f, size in zip(first, update.shape, strict=True))] = update
    return result


def _split(params: Any, a: Any) -> Any:
    return np.split(a, np.cumsum(params["sizes"])[:-1], axis=params["axis"])


MOVES: dict[str, Callable[..., Any]] = {
    "broadcast_in_dim": _broadcast,
    "reshape": lambda params, a, *_: a.reshape(params["new_sizes"]),
    "squeeze": lambda params, a: np.squeeze(a, axis=tuple(params["dimensions"])),
    "expand_dims": lambda params, a: np.expand_dims(a, tuple(params["dimensions"])),
    "transpose": lambda params, a: np.transpose(a, params["permutation"]),
    "slice": _slice,
    "dynamic_slice": _dynamic_slice,
    "dynamic_update_slice": _dynamic_update_slice,
    "concatenate": lambda params, *a: np.concatenate(a, axis=params["dimension"]),
    "pad": _pad,
    "rev": lambda params, a: np.flip(a, params["dimensions"]),
    "tile": lambda params, a: np.tile(a, params["reps"]),
    "split": _split,
    "stack": lambda params, *a: np.stack(a, axis=params["axis"]),
    "unstack": lambda params, a: list(np.moveaxis(a, params["axis"], 0)),
    "copy": lambda params, a: a,
    "stop_gradient": lambda params, a: a,
    "optimization_barrier": lambda params, *a: a[0],
}
"""Operations that only move entries about."""

NUMPY: dict[str, Callable[..., Any]] = {
    "iota": lambda params: (
        np.arange(params["shape"][params["dimension"]]).reshape(
            [-1 if k == params["dimension"] else 1 for k in range(len(params["shape"]))]
        )
        + np.zeros(params["shape"], int)
    ),
    "convert_element_type": lambda params, a: a,
    "add": lambda params, a, b: a + b,
    "sub": lambda params, a, b: a - b,
    "mul": lambda params, a, b: a * b,
    "eq": lambda params, a, b: a == b,
    "ne": lambda params, a, b: a != b,
    "lt": lambda params, a, b: a < b,
    "le": lambda params, a, b: a <= b,
    "ge": lambda params, a, b: a >= b,
    "gt": lambda params, a, b: a > b,
    "and": lambda params, a, b: a & b,
    "or": lambda params, a, b: a | b,
    "select_n": lambda params, which, *cases: np.choose(which.astype(int), cases),
}
"""Operations on known numbers that models have often, without a start of XLA for each."""


def _simply(op: str) -> Callable[[Graph, Any], Callable[..., Any]]:
    return lambda graph, params: partial(graph.apply, op)


def _swapped(op: str) -> Callable[[Graph, Any], Callable[..., Any]]:
    return lambda graph, params: lambda a, b: graph.apply(op, b, a)


def _convert(graph: Graph, params: Any) -> Callable[[Any], Any]:
    kind = np.dtype(params["new_dtype"])

    def convert(a: Any) -> Any:
        if kind == np.int32 and isinstance(a, Node) and _is_condition(a):
            return Choice(a)
        if kind != np.float64:
            raise Unsupported(f"numbers of type {kind}")
        return graph.apply("select", a, 1.0, 0.0) if isinstance(a, Node) and _is_condition(a) else a

    return convert


def _is_condition(a: Any) -> bool:
    if isinstance(a, Node):
        return a.op in CONDITIONS or isinstance(a.number, bool)
    return isinstance(a, bool | np.bool_)


def _equal(op: str) -> Callable[[Graph, Any], Callable[..., Any]]:
    """Of numbers, or of truth values."""

    def meaning(graph: Graph, params: Any) -> Callable[..., Any]:
        def compare(a: Any, b: Any) -> Any:
            if not (_is_condition(a) and _is_condition(b)):
                return graph.apply(op, a, b)
            either, both = graph.apply("or", a, b), graph.apply("and", a, b)
            differ = graph.apply("and", either, graph.apply("not", both))
            return differ if op == "ne" else graph.apply("not", differ)

        return compare

    return meaning


def _integer_power(graph: Graph, params: Any) -> Callable[[Any], Any]:
    exponent = int(params["y"])

    def power(a: Any) -> Any:
        result, square, left = graph.constant(1.0), a, abs(exponent)
        while left:
            if left & 1:
                result = result * square
            left >>= 1
            square = square * square if left else square
        return 1.0 / result if exponent < 0 else result

    return power


def _select(graph: Graph, params: Any) -> Callable[..., Any]:
    def select(which: Any, *cases: Any) -> Any:
        if len(cases) != 2:
            raise Unsupported("select_n of more than two cases")
        return graph.apply("select", which, cases[1], cases[0])

    return select


def _round(graph: Graph, params: Any) -> Callable[[Any], Any]:
    """To the nearest integer; of two the even one, or the one farther from zero."""
    if params["rounding_method"] == jax.lax.RoundingMethod.TO_NEAREST_EVEN:
        return partial(graph.apply, "rint")
    sign = _sign(graph, params)
    return lambda a: sign(a) * graph.apply("floor", graph.apply("abs", a) + 0.5)


def _sign(graph: Graph, params: Any) -> Callable[[Any], Any]:
    def sign(a: Any) -> Any:
        negative = graph.apply("select", graph.apply("lt", a, 0.0), -1.0, a)  # 0 and nan stay what they are
        return graph.apply("select", graph.apply("lt", 0.0, a), 1.0, negative)

    return sign


MEANINGS: dict[str, Callable[[Graph, Any], Callable[..., Any]]] = {
    **{op: _simply(op) for op in FOLDED if op not in ("select", "not", "lt", "le", "abs")},
    "abs": _simply("abs"),
    "add_any": _simply("add"),
    "eq": _equal("eq"),
    "ne": _equal("ne"),
    "lt": _simply("lt"),
    "le": _simply("le"),
    "gt": _swapped("lt"),
    "ge": _swapped("le"),
    "not": _simply("not"),
    "convert_element_type": _convert,
    "copy_p": lambda graph, params: lambda a: a,
    "integer_pow": _integer_power,
    "square": lambda graph, params: lambda a: a * a,
    "rsqrt": lambda graph, params: lambda a: 1.0 / graph.apply("sqrt", a),
    "logistic": lambda graph, params: lambda a: 1.0 / (1.0 + graph.apply("exp", -a)),
    "select_n": _select,
    "sign": _sign,
    "round": _round,
    "clamp": lambda graph, params: lambda low, a, high: graph.apply("min", graph.apply("max", a, low), high),
    "is_finite": lambda graph, params: lambda a: graph.apply("eq", a - a, 0.0),
}
"""Operations on each entry."""


def _dot(graph: Graph, params: Any, a: Any, b: Any) -> Any:
    (sum_a, sum_b), (batch_a, batch_b) = params["dimension_numbers"]
    a = np.moveaxis(a, batch_a, range(len(batch_a)))
    b = np.moveaxis(b, batch_b, range(len(batch_b)))
    # Where the summed axes lie once the batch is in front.
    rest_a = [k for k in range(a.ndim) if k not in batch_a]
    rest_b = [k for k in range(b.ndim) if k not in batch_b]
    axes = [[rest_a.index(k) for k in sum_a], [rest_b.index(k) for k in sum_b]]
    if not batch_a:
        return _contract(graph, a, b, axes)
    shape = a.shape[: len(batch_a)]
    flat_a, flat_b = a.reshape(-1, *a.shape[len(shape) :]), b.reshape(-1, *b.shape[len(shape) :])
    parts = [_contract(graph, x, y, axes) for x, y in zip(flat_a, flat_b, strict=True)]
    return np.stack(parts).reshape(*shape, *parts[0].shape)


def _contract(graph: Graph, a: Any, b: Any, axes: Any) -> Objects:
    result = np.tensordot(a.astype(object), b.astype(object), axes=axes)
    return np.asarray(result, dtype=object)


def _reduced(op: Callable[[Graph], Callable[[Any, Any], Any]]) -> Callable[..., Any]:
    def over(graph: Graph, params: Any, a: Any) -> Any:
        axes = params["axes"]
        last = np.moveaxis(a, axes, range(a.ndim - len(axes), a.ndim))
        kept = last.shape[: a.ndim - len(axes)]
        sums = [reduce(op(graph), row) for row in last.reshape(int(np.prod(kept)), -1)]
        return as_objects(sums).reshape(kept)

    return over


ARRAYS: dict[str, Callable[..., Any]] = {
    "dot_general": _dot,
    "reduce_sum": _reduced(lambda graph: partial(graph.apply, "add")),
    "reduce_prod": _reduced(lambda graph: partial(graph.apply, "mul")),
    "reduce_max": _reduced(lambda graph: partial(graph.apply, "max")),
    "reduce_min": _reduced(lambda graph: partial(graph.apply, "min")),
    "reduce_and": _reduced(lambda graph: partial(graph.apply, "and")),
    "reduce_or": _reduced(lambda graph: partial(graph.apply, "or")),
    "cumsum": lambda graph, params, a: (
        np.flip(np.cumsum(np.flip(a, params["axis"]), params["axis"]), params["axis"])
        if params["reverse"]
        else np.cumsum(a, params["axis"])
    ),
}
"""Operations on whole arrays."""


def _windows(equation: Any, shape: tuple[int, ...], indices: Any, many: Any) -> Any:
    """Pairs of places: a window of an array of a shape, and where it stands among `many` windows.

    As `jax.lax.gather` and `jax.lax.scatter` have it, for known indices.
    """
    numbers, params = equation.params["dimension_numbers"], equation.params
    if equation.primitive.name == "gather":
        inside, dropped, starts = numbers.offset_dims, numbers.collapsed_slice_dims, numbers.start_index_map
        batched = numbers.operand_batching_dims
        sizes = params["slice_sizes"]
    else:
        inside, dropped = numbers.update_window_dims, numbers.inserted_window_dims
        starts, batched = numbers.scatter_dims_to_operand_dims, numbers.operand_batching_dims
        lengths = iter([many[k] for k in inside])
        sizes = [1 if k in (*dropped, *batched) else next(lengths) for k in range(len(shape))]
    if batched:
        raise Unsupported("indices in batches")
    outside = [k for k in range(len(many)) if k not in inside]
    for place in np.ndindex(*indices.shape[:-1]):
        first = [0] * len(shape)
        for axis, start in zip(starts, indices[place], strict=True):
            first[axis] = int(start)
        if any(f < 0 or f + size > n for f, size, n in zip(first, sizes, shape, strict=True)):
            raise Unsupported("an index out of range")
        window = tuple(f if k in dropped else slice(f, f + sizes[k]) for k, f in enumerate(first))
        among: list[Any] = [slice(None)] * len(many)
        for axis, k in zip(outside, place, strict=True):
            among[axis] = k
        yield window, tuple(among)


def _gather(equation: Any, a: Any, indices: Any) -> Any:
    result = np.empty(equation.outvars[0].aval.shape, dtype=object)
    for window, among in _windows(equation, a.shape, indices, result.shape):
        result[among] = a[window]
    return result


def _scatter(equation: Any, a: Any, indices: Any, updates: Any) -> Any:
    result = a.astype(object)
    for window, among in _windows(equation, a.shape, indices, updates.shape):
        added = equation.primitive.name == "scatter-add"
        result[window] = result[window] + updates[among] if added else updates[among]
    return result


INDEXED: dict[str, Callable[..., Any]] = {"gather": _gather, "scatter-add": _scatter, "scatter": _scatter}
"""Operations at known indices."""
