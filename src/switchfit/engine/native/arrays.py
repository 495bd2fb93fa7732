"""Entries of traced arrays, and operations on whole arrays: gather, scatter and slices, sorting, linear algebra.

An entry is a Python number, a node (a double, or a truth value in an array of booleans), or an `Integer`: one that
depends on the state, as a double. Each `Integer` has bounds. If they allow a result to overflow its type, or to be too
large for doubles to be exact, the program checks the result at run time (`Graph.require`), and falls back to JAX if it
is too large.

Operations on arrays are unrolled. Selections choose the entry at run time (`pick`). Indices out of range are treated as
in JAX. The algorithms of linear algebra are those of LAPACK, for the matrices in the last two axes of arrays: LU with
pivots chosen at run time, Cholesky, triangular systems.

Linear systems of implicit rows: elimination in straight-line code, or a routine for large and dense systems.
Straight-line code leaves zeros of the Jacobians out and takes the states in an order in which few arise (minimum
degree). It has no pivots: its diagonal is 1 minus a few terms, which are negative in a stable mode.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

import numpy as np
from jax.lax import GatherScatterMode
from numpy.typing import NDArray

from switchfit.discretization.rows import FloatArray, couple
from switchfit.engine.native.llvm import count_doubles
from switchfit.engine.native.scalars import Graph, Node, Objects, as_objects


class Unsupported(Exception):  # noqa: N818  # control flow, not an error: the caller falls back to JAX
    """A function that cannot be written as a straight line of scalars.

    Attributes
    ----------
    what : str
        What it does, as the rest of a sentence that begins with the function: "calls jnp.sort".
    where : str or None
        File and line of the user's code, if known.
    """

    def __init__(self, what: str, where: str | None = None) -> None:
        super().__init__(what, where)
        self.what, self.where = what, where

    def __str__(self) -> str:
        return self.what if self.where is None else f"{self.what} ({self.where})"


MOST_CHOICES = 64
"""Largest number of state-dependent entries from which an index selects: each takes a comparison and a selection."""

MOST_SELECTIONS = 4
"""Largest number of known entries from which an index selects by comparisons; more become a table in memory."""

MOST_ROWS_OF_TABLE = 100_000
"""Largest number of entries of a table in memory. It is part of the module's text: 2 MB at this size."""


@dataclass(frozen=True, slots=True)
class Integer:
    """An integer that depends on the state.

    Attributes
    ----------
    node : Node
        Its value, as a double; it is finite, and never -0.0.
    low, high : int
        Inclusive bounds of its value, far below 2**53, so that arithmetic with doubles is exact.
    """

    node: Node
    low: int
    high: int

    @classmethod
    def of(cls, graph: Graph, value: Any) -> Integer:
        """Convert a known integer or a truth value to an `Integer`; return an `Integer` as it is."""
        if isinstance(value, Integer):
            return value
        if isinstance(value, Node):
            return cls(graph.apply("select", value, 1.0, 0.0), 0, 1)
        return cls(graph.constant(float(value)), int(value), int(value))


def _check_size(count: int, most: int, what: str) -> None:
    """Refuse what would take too many operations, or too much memory."""
    if count > most:
        raise Unsupported(f"{what} (limit: {most})")


def _is_known_integer(value: Any) -> bool:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def choose(graph: Graph, condition: Any, yes: Any, no: Any) -> Any:
    """Select one of two entries of the same type; the condition may be known or traced."""
    known = known_number(condition)
    if known is not None:
        return yes if known else no
    if isinstance(yes, Integer) or isinstance(no, Integer) or (_is_known_integer(yes) and _is_known_integer(no)):
        one, other = Integer.of(graph, yes), Integer.of(graph, no)
        node = graph.apply("select", condition, one.node, other.node)
        return Integer(node, min(one.low, other.low), max(one.high, other.high))
    return graph.apply("select", condition, yes, no)


def less(graph: Graph, a: Any, b: Any) -> Any:
    """Return whether a < b for integers: a bool if their bounds decide it."""
    one, other = Integer.of(graph, a), Integer.of(graph, b)
    if one.high < other.low:
        return True
    if one.low >= other.high:
        return False
    return graph.apply("lt", one.node, other.node)


def equal(graph: Graph, a: Any, b: Any) -> Any:
    """Return whether a == b for integers: a bool if their bounds decide it."""
    one, other = Integer.of(graph, a), Integer.of(graph, b)
    if one.high < other.low or other.high < one.low:
        return False
    if one.node is other.node or one.low == one.high == other.low == other.high:
        return True
    return graph.apply("eq", one.node, other.node)


def clamp(graph: Graph, index: Any, low: int, high: int) -> Any:
    """Clamp an integer to a range; return an int if the result is known."""
    if not isinstance(index, Integer):
        return min(max(int(index), low), high)
    found = _choose_extreme(graph, min, high, _choose_extreme(graph, max, low, index))
    return found.low if found.low == found.high else found


def pick(graph: Graph, entries: Sequence[Any], index: Integer) -> Any:
    """Select an entry by an index; the first entry belongs to `index.low`, the last one to `index.high`.

    Equal neighbors are merged, so that one number in a row of zeros takes two selections. More than a few known numbers
    become a table in memory, whose lookup takes the same time for any size.
    """
    starts = [k for k in range(len(entries)) if k == 0 or not _is_same(entries[k - 1], entries[k])]
    if len(starts) == 1:
        return entries[0]
    if len(starts) > MOST_SELECTIONS and all(known_number(e) is not None for e in entries):
        return _look_up(graph, list(map(known_number, entries)), index)
    count = len(starts)
    _check_size(count, MOST_CHOICES, f"takes one of {count} numbers by an index that depends on the state")

    def select_run(runs: list[int]) -> Any:
        if len(runs) == 1:
            return entries[runs[0]]
        middle = len(runs) // 2
        before = less(graph, index, index.low + runs[middle])
        return choose(graph, before, select_run(runs[:middle]), select_run(runs[middle:]))

    return select_run(starts)


def known_number(entry: Any) -> Any:
    """Return the value of an entry; None if it depends on the state."""
    if isinstance(entry, Node):
        return entry.number
    return None if isinstance(entry, Integer) else entry


def _is_same(one: Any, other: Any) -> bool:
    if isinstance(one, Integer) and isinstance(other, Integer):
        return one.node is other.node
    a, b = known_number(one), known_number(other)
    if a is None or b is None:
        return one is other
    return bool((a == b and np.signbit(a) == np.signbit(b)) or (a != a and b != b))


def _look_up(graph: Graph, entries: Sequence[Any], index: Integer) -> Any:
    _check_size(len(entries), MOST_ROWS_OF_TABLE, f"looks up numbers in a table of {len(entries)} entries")
    node = graph.lookup(np.array(entries, dtype=float), index.node - float(index.low))
    if all(isinstance(e, bool | np.bool_) for e in entries):
        return graph.apply("ne", node, 0.0)
    if all(_is_known_integer(e) for e in entries):
        return Integer(node, int(min(entries)), int(max(entries)))
    return node


Meaning = Callable[..., Any]
"""What a JAX operation does to entries: takes a graph, the parameters of the operation, the type of the last operand,
then an entry of each operand.
"""

LARGEST = 2**51
"""Bound below which sums, products and quotients of doubles are exact for integers."""


def _bounds(dtype: np.dtype[Any]) -> tuple[int, int]:
    info = np.iinfo(dtype)
    return max(info.min, -LARGEST), min(info.max, LARGEST)


def within(graph: Graph, found: Integer, dtype: np.dtype[Any]) -> Any:
    """Return an integer as one of a type, clamped to its range: it may be an index of memory."""
    least, most = _bounds(dtype)
    if found.high < least or found.low > most:
        raise Unsupported(f"does arithmetic with integers beyond {most}")
    inside = clamp(graph, found, least, most)
    if found.low < least or found.high > most:
        graph.require(graph.apply("eq", found.node, Integer.of(graph, inside).node))
    return inside


def _exactly(op: str, value: Callable[..., int]) -> Meaning:
    """Return an operation on doubles; its result is between the extremes at the bounds of the operands and at zero."""

    def apply(graph: Graph, params: Any, dtype: np.dtype[Any], *given: Any) -> Any:
        args = [Integer.of(graph, a) for a in given]
        corners = [value(*c) for c in product(*((a.low, a.high, min(max(0, a.low), a.high)) for a in args))]
        low, high = min(corners), max(corners)
        node = _drop_sign_of_zero(graph, graph.apply(op, *(a.node for a in args)), low, high, op)
        return within(graph, Integer(node, low, high), dtype)

    return apply


def _drop_sign_of_zero(graph: Graph, node: Node, low: int, high: int, op: str) -> Node:
    if op not in ("mul", "neg", "trunc") or low > 0 or high < 0 or node.op == "const":
        return node if node.number != 0.0 else graph.constant(0.0)
    return graph.apply("select", graph.apply("eq", node, 0.0), 0.0, node)


def _divide(graph: Graph, params: Any, dtype: np.dtype[Any], one: Any, other: Any) -> Any:
    """Divide, rounded towards zero; division by zero yields -1."""
    a, b = Integer.of(graph, one), Integer.of(graph, other)
    largest = max(abs(a.low), abs(a.high), 1)
    low = 0 if a.low >= 0 and b.low >= 0 else -largest
    node = _drop_sign_of_zero(graph, graph.apply("trunc", a.node / b.node), -largest, largest, "trunc")
    return choose(graph, equal(graph, b, 0), -1, within(graph, Integer(node, low, largest), dtype))


def _find_remainder(graph: Graph, params: Any, dtype: np.dtype[Any], one: Any, other: Any) -> Any:
    """Return the remainder with the sign of the dividend; for a division by zero, it is the dividend itself."""
    a, b = Integer.of(graph, one), Integer.of(graph, other)
    nonzero = Integer.of(graph, choose(graph, equal(graph, b, 0), 1, b))
    largest = max(abs(b.low), abs(b.high)) - 1
    node = a.node - nonzero.node * graph.apply("trunc", a.node / nonzero.node)
    low, high = (0 if a.low >= 0 else -max(largest, 0)), (0 if a.high <= 0 else max(largest, 0))
    return choose(graph, equal(graph, b, 0), a, Integer(node, low, high))


def _choose_extreme(graph: Graph, extreme: Callable[..., int], a: Any, b: Any) -> Integer:
    """Return the smaller (larger) of two integers, as Python's `min` (`max`) does for bounds."""
    one, other = Integer.of(graph, a), Integer.of(graph, b)
    is_first = less(graph, one, other) if extreme is min else less(graph, other, one)
    node = choose(graph, is_first, one, other).node
    return Integer(node, extreme(one.low, other.low), extreme(one.high, other.high))


def from_double(graph: Graph, kind: np.dtype[Any], a: Any) -> Any:
    """Return a double as an integer of a type: rounded towards zero, NaN to 0, clipped to the bounds."""
    (least, most), rounded = _bounds(kind), graph.apply("trunc", a)
    number = graph.apply("select", graph.apply("lt", 0.0, graph.apply("abs", rounded)), rounded, 0.0)
    if kind.itemsize == 8:
        graph.require(graph.apply("le", graph.apply("abs", number), float(most)))
    return clamp(graph, Integer(number, least - 1, most + 1), least, most)


OF_INTEGERS: dict[str, Meaning] = {
    "add": _exactly("add", operator.add),
    "sub": _exactly("sub", operator.sub),
    "mul": _exactly("mul", operator.mul),
    "neg": _exactly("neg", operator.neg),
    "abs": _exactly("abs", abs),
    "div": _divide,
    "rem": _find_remainder,
    "sign": lambda graph, _, __, a: choose(graph, less(graph, a, 0), -1, choose(graph, less(graph, 0, a), 1, 0)),
    "max": lambda graph, _, __, a, b: _choose_extreme(graph, max, a, b),
    "min": lambda graph, _, __, a, b: _choose_extreme(graph, min, a, b),
    "lt": lambda graph, _, __, a, b: less(graph, a, b),
    "gt": lambda graph, _, __, a, b: less(graph, b, a),
    "le": lambda graph, _, __, a, b: graph.apply("not", less(graph, b, a)),
    "ge": lambda graph, _, __, a, b: graph.apply("not", less(graph, a, b)),
    "eq": lambda graph, _, __, a, b: equal(graph, a, b),
    "ne": lambda graph, _, __, a, b: graph.apply("not", equal(graph, a, b)),
}
"""Operations on each entry of arrays of integers; comparisons too."""


# Windows at indices


Combine = Callable[[Any, Any, Any], Any]
"""(condition, old entry, update) -> new entry."""


def take(graph: Graph, a: Any, starts: Sequence[Any], sizes: Sequence[int]) -> Any:
    """Return a window of an array: (sizes); each start is in range, an int or an `Integer`."""
    moving = [k for k, start in enumerate(starts) if isinstance(start, Integer)]
    # What the window may reach along each axis.
    ends = [(s.low, s.high) if isinstance(s, Integer) else (s, s) for s in starts]
    a = a[tuple(slice(low, high + size) for (low, high), size in zip(ends, sizes, strict=True))]
    if len(moving) > 1 and all(known_number(e) is not None for e in a.reshape(-1)):
        return _from_table(graph, a, [starts[k] for k in moving], moving, sizes)
    for axis in moving:
        rows = np.moveaxis(a, axis, 0)
        window = np.empty((sizes[axis], *rows.shape[1:]), dtype=object)
        for place in np.ndindex(*window.shape):
            candidates = rows[(slice(place[0], place[0] + len(rows) - sizes[axis] + 1), *place[1:])]
            window[place] = pick(graph, candidates.tolist(), starts[axis])
        a = np.moveaxis(window, 0, axis)
    return a


def _from_table(graph: Graph, a: Any, starts: list[Integer], moving: list[int], sizes: Sequence[int]) -> Objects:
    """Take a window of a known array that moves along several axes: each entry by one index into a table."""
    multiply, add, subtract = (partial(OF_INTEGERS[op], graph, {}, np.dtype(int)) for op in ("mul", "add", "sub"))
    spans = [start.high - start.low + 1 for start in starts]
    index: Any = 0
    for start, span in zip(starts, spans, strict=True):
        index = add(multiply(index, span), subtract(start, start.low))
    index = Integer(index.node, 0, int(np.prod(spans)) - 1)
    window = np.empty(sizes, dtype=object)
    for place in np.ndindex(*sizes):
        reached = tuple(
            slice(place[k], place[k] + spans[moving.index(k)]) if k in moving else place[k] for k in range(a.ndim)
        )
        window[place] = pick(graph, a[reached].reshape(-1).tolist(), index)
    return window


def put(graph: Graph, a: Objects, starts: Sequence[Any], window: Any, combine: Combine, condition: Any = True) -> None:
    """Change a window of an array of objects in place, at starts that are in range where the condition holds."""
    ranges = [range(s.low, s.high + 1) if isinstance(s, Integer) else (s,) for s in starts]
    count = int(np.prod([len(r) for r in ranges]))
    _check_size(count, MOST_CHOICES, f"changes one of {count} numbers at an index that depends on the state")
    for first in product(*ranges):
        here = condition
        for start, value in zip(starts, first, strict=True):
            here = graph.apply("and", here, equal(graph, start, value))
        if known_number(here) is False:
            continue
        for place in np.ndindex(*window.shape):
            at = tuple(f + k for f, k in zip(first, place, strict=True))
            a[at] = combine(here, a[at], window[place])


def dynamic_slice(graph: Graph, equation: Any, a: Any, *starts: Any) -> Any:
    """Trace `jax.lax.dynamic_slice`: a window that is out of range is moved inside."""
    sizes = equation.params["slice_sizes"]
    return take(graph, a, _move_inside(graph, starts, a.shape, sizes), sizes)


def dynamic_update_slice(graph: Graph, equation: Any, a: Any, update: Any, *starts: Any) -> Any:
    """Trace `jax.lax.dynamic_update_slice`."""
    result = a.astype(object)
    inside = _move_inside(graph, starts, a.shape, update.shape)
    put(graph, result, inside, update, lambda here, old, new: choose(graph, here, new, old))
    return result


def _move_inside(graph: Graph, starts: Sequence[Any], shape: Sequence[int], sizes: Sequence[int]) -> list[Any]:
    return [clamp(graph, s.item(), 0, n - size) for s, n, size in zip(starts, shape, sizes, strict=True)]


def _list_windows(
    graph: Graph, shape: Sequence[int], indices: Any, sizes: Sequence[int], numbers: Any, inside: Any, many: int
) -> Iterator[tuple[list[Any], Any, tuple[Any, ...]]]:
    """Yield the windows that a gather or a scatter moves.

    `inside` are the axes inside windows among the `many` axes of the array of all windows. Of each window: the first
    index along each axis of the operand, moved into range; whether the window was in range; its index in the array of
    all windows.
    """
    gathers = hasattr(numbers, "start_index_map")
    axes = numbers.start_index_map if gathers else numbers.scatter_dims_to_operand_dims
    own = numbers.start_indices_batching_dims if gathers else numbers.scatter_indices_batching_dims
    batched = dict(zip(numbers.operand_batching_dims, own, strict=True))
    outside = [k for k in range(many) if k not in inside]
    for place in np.ndindex(*indices.shape[:-1]):
        starts: list[Any] = [place[batched[axis]] if axis in batched else 0 for axis in range(len(shape))]
        for axis, start in zip(axes, indices[place], strict=True):
            starts[axis] = start
        fits: Any = True
        for axis, (start, n, size) in enumerate(zip(starts, shape, sizes, strict=True)):
            for outside_range in (less(graph, start, 0), less(graph, n - size, start)):
                fits = graph.apply("and", fits, graph.apply("not", outside_range))
            starts[axis] = clamp(graph, start, 0, n - size)
        among: list[Any] = [slice(None)] * many
        for axis, k in zip(outside, place, strict=True):
            among[axis] = k
        yield starts, fits, tuple(among)


def gather(graph: Graph, equation: Any, a: Any, indices: Any) -> Any:
    """Trace `jax.lax.gather`."""
    params, out = equation.params, equation.outvars[0].aval
    numbers, sizes = params["dimension_numbers"], params["slice_sizes"]
    dropped = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    result = np.empty(out.shape, dtype=object)
    windows = _list_windows(graph, a.shape, indices, sizes, numbers, numbers.offset_dims, len(out.shape))
    for starts, fits, among in windows:
        taken = np.squeeze(take(graph, a, starts, sizes), axis=dropped)
        if params["mode"] == GatherScatterMode.FILL_OR_DROP and known_number(fits) is not True:
            fill = _fill_value(params["fill_value"], out.dtype)
            filled = np.frompyfunc(partial(choose, graph, fits), 2, 1)(taken, fill)
            taken = np.asarray(filled, dtype=object)
        result[among] = taken if taken.ndim else taken.item()
    return result


def _fill_value(given: Any, dtype: np.dtype[Any]) -> Any:
    """Return JAX's value for an index out of range: NaN, True, or the largest unsigned or smallest signed integer."""
    if given is not None:
        return np.asarray(given, dtype).item()
    if dtype.kind in "iu":
        return int(np.iinfo(dtype).max if dtype.kind == "u" else np.iinfo(dtype).min)
    return True if dtype.kind == "b" else float("nan")


def scatter(graph: Graph, equation: Any, a: Any, indices: Any, updates: Any, combine: Combine) -> Any:
    """Trace `jax.lax.scatter`, `scatter_add` and their variants."""
    params = equation.params
    numbers = params["dimension_numbers"]
    inside, dropped = numbers.update_window_dims, (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
    lengths = iter([updates.shape[k] for k in inside])
    sizes = [1 if k in dropped else next(lengths) for k in range(a.ndim)]
    result = a.astype(object)
    for starts, fits, among in _list_windows(graph, a.shape, indices, sizes, numbers, inside, updates.ndim):
        update = np.asarray(updates[among], dtype=object).reshape(sizes)
        put(graph, result, starts, update, combine, True if params["mode"] == GatherScatterMode.CLIP else fits)
    return result


MOST_SORTED = 16
"""Largest number of entries to sort. n entries take n (n - 1) / 2 comparisons, each followed by selections."""

Entries = tuple[Any, ...]
"""Entries that move together: one of each array that is sorted."""


def sort(graph: Graph, equation: Any, *arrays: Any) -> list[Any]:
    """Trace `jax.lax.sort`: stable, NaN last, by the first array."""
    axis, shape = equation.params["dimension"], arrays[0].shape
    if equation.params["num_keys"] > 1:
        raise Unsupported("sorts by several keys what depends on the state")
    is_double = equation.invars[0].aval.dtype.kind == "f"
    rows = [np.moveaxis(a, axis, -1).reshape(-1, shape[axis]) for a in arrays]
    found = [np.empty(row.shape, dtype=object) for row in rows]
    for k in range(len(rows[0])):
        entries = _sort_entries(graph, list(zip(*(row[k].tolist() for row in rows), strict=True)), is_double)
        for to, column in zip(found, zip(*entries, strict=True), strict=True):
            to[k] = as_objects(column)
    moved = tuple(n for k, n in enumerate(shape) if k != axis)
    return [np.moveaxis(each.reshape(*moved, shape[axis]), -1, axis) for each in found]


def _sort_entries(graph: Graph, entries: list[Entries], is_double: bool) -> list[Entries]:
    """Sort entries by exchanging neighbors."""
    n = len(entries)
    _check_size(n, MOST_SORTED, f"sorts {n} numbers that depend on the state")
    for front in range(n - 1):
        for k in reversed(range(front, n - 1)):
            one, other = entries[k], entries[k + 1]
            a, b = one[0], other[0]
            # of doubles, a > b, or a is NaN and b is not
            swap = (
                less(graph, b, a)
                if not is_double
                else graph.apply("and", graph.apply("not", graph.apply("le", a, b)), graph.apply("eq", b, b))
            )
            entries[k] = tuple(choose(graph, swap, b, a) for a, b in zip(one, other, strict=True))
            entries[k + 1] = tuple(choose(graph, swap, a, b) for a, b in zip(one, other, strict=True))
    return entries


# Searching sorted arrays


def compare_in_order(graph: Graph, op: str, a: Any, b: Any) -> Any:
    """Return whether a < b ("lt") or a <= b ("le") in the order in which NaN comes after all numbers."""
    undefined = graph.apply("ne", b, b)
    if op == "lt":
        undefined = graph.apply("and", undefined, graph.apply("eq", a, a))
    return graph.apply("or", graph.apply(op, a, b), undefined)


def search(graph: Graph, table: Any, query: Any, right: bool) -> Any:
    """Trace `jnp.searchsorted`: the insertion index of each number in a sorted table of known ones, (K,).

    It is a bisection in memory, in a fixed number of log2 K steps. None for any other table.
    """
    numbers = np.array([known_number(e) for e in table.tolist()], dtype=float)  # NaN for what is not known
    if np.isnan(numbers).any() or (np.diff(numbers) < 0.0).any():
        return None
    K = len(numbers)
    _check_size(K, MOST_ROWS_OF_TABLE, f"searches a table of {K} entries")
    turns = K.bit_length()
    padded = np.concatenate([numbers, np.full(2**turns - 1 - K, np.inf)])

    def place(x: Any) -> Any:
        found: Any = graph.constant(0.0)
        for step in (2**k for k in reversed(range(turns))):
            entry = graph.lookup(padded, found + float(step - 1))
            beyond = graph.apply("not", graph.apply("lt" if right else "le", x, entry))  # NaN comes after all numbers
            found = graph.apply("select", beyond, found + float(step), found)
        return clamp(graph, Integer(found, 0, 2**turns - 1), 0, K)

    return as_objects([place(x) for x in np.ravel(query).tolist()]).reshape(np.shape(query))


MOST_ROWS_TO_PIVOT = 5
"""Largest number of rows in an LU factorization, whose pivots take selections."""

MOST_ROWS = 6
"""Largest number of rows in a Cholesky factorization, or in a triangular system that depends on the state."""

MOST_KNOWN_ROWS = 30
"""Largest number of rows in a triangular system whose matrix is known."""


def _map_matrices(graph: Graph, function: Callable[..., tuple[Any, ...]], *arrays: Any) -> list[Any]:
    """Map a function of matrices of nodes over arrays of matrices."""
    batch, to_node = arrays[0].shape[:-2], lambda value: value if isinstance(value, Node) else graph.constant(value)
    given = [np.asarray(np.frompyfunc(to_node, 1, 1)(a), dtype=object) for a in arrays]
    parts = [function(*(a[place] for a in given)) for place in np.ndindex(*batch)]
    return [np.stack(column).reshape(*batch, *np.shape(column[0])) for column in zip(*parts, strict=True)]


def _check_rows(rows: int, most: int) -> None:
    _check_size(rows, most, f"works with a matrix of {rows} rows")


def lu(graph: Graph, equation: Any, a: Any) -> list[Any]:
    """Trace `jax.lax.linalg.lu`: L and U in one matrix, the pivots, the permutation."""
    _check_rows(max(a.shape[-2:]), MOST_ROWS_TO_PIVOT)
    return _map_matrices(graph, partial(_lu, graph), a)


def _lu(graph: Graph, a: Objects) -> tuple[Any, ...]:
    order: Any = np.array(range(len(a)), dtype=object)
    pivots: list[Any] = []
    for k in range(min(a.shape)):
        pivots.append(_find_largest(graph, a[:, k], k))
        a = _exchange_rows(graph, a, k, pivots[k])
        order = _exchange_rows(graph, order[:, None], k, pivots[k])[:, 0]
        # Like LAPACK, leave a column of zeros unchanged.
        inverse = 1.0 / choose(graph, graph.apply("eq", a[k, k], 0.0), 1.0, a[k, k])
        a[k + 1 :, k] = a[k + 1 :, k] * inverse
        a[k + 1 :, k + 1 :] = a[k + 1 :, k + 1 :] - np.outer(a[k + 1 :, k], a[k, k + 1 :])
    return a, as_objects(pivots), order


def _find_largest(graph: Graph, column: Objects, k: int) -> Any:
    """Return the index of the largest entry from k on, the first of several; entries known to be zero are skipped."""
    size, found = graph.apply("abs", column[k]), k
    for i in range(k + 1, len(column)):
        other = graph.apply("abs", column[i])
        if known_number(other) == 0.0:
            continue
        larger = graph.apply("lt", size, other)
        size, found = graph.apply("select", larger, other, size), choose(graph, larger, i, found)
    return found


def _exchange_rows(graph: Graph, a: Any, k: int, other: Any) -> Any:
    """Exchange row k with another one from k on, whose index is known or an `Integer`."""
    result = a.copy()
    if isinstance(other, int):
        result[[k, other]] = a[[other, k]]
        return result
    for i in range(k + 1, len(a)):
        result[i] = [choose(graph, equal(graph, other, i), up, down) for up, down in zip(a[k], a[i], strict=True)]
    result[k] = [pick(graph, column.tolist(), other) for column in a[other.low : other.high + 1].T]
    return result


def cholesky(graph: Graph, equation: Any, a: Any) -> Any:
    """Trace `jax.lax.linalg.cholesky` for a symmetric matrix; L is NaN if the matrix is not positive definite."""
    _check_rows(a.shape[-1], MOST_ROWS)
    return _map_matrices(graph, lambda matrix: (_cholesky(graph, matrix),), a)[0]


def _cholesky(graph: Graph, a: Objects) -> Objects:
    n = len(a)
    L, positive = np.full((n, n), 0.0, dtype=object), graph.constant(True)
    for k in range(n):
        positive = graph.apply("and", positive, graph.apply("lt", 0.0, a[0, 0]))
        L[k, k] = graph.apply("sqrt", a[0, 0])
        L[k + 1 :, k] = a[1:, 0] * (1.0 / L[k, k])
        a = a[1:, 1:] - np.outer(L[k + 1 :, k], L[k + 1 :, k])
    for i in range(n):
        L[i, : i + 1] = [choose(graph, positive, entry, float("nan")) for entry in L[i, : i + 1]]
    return L


def triangular_solve(graph: Graph, equation: Any, a: Any, b: Any) -> Any:
    """Trace `jax.lax.linalg.triangular_solve`."""
    _check_rows(a.shape[-1], MOST_ROWS if a.dtype == object else MOST_KNOWN_ROWS)
    params = equation.params
    turned = params["transpose_a"] == params["left_side"]  # x A = b is A' x' = b'
    is_lower, unit = params["lower"] != turned, params["unit_diagonal"]

    def solve(a: Objects, b: Objects) -> tuple[Any, ...]:
        a, b = a.T if turned else a, b if params["left_side"] else b.T
        x = _substitute(a, b, unit) if is_lower else _substitute(a[::-1, ::-1], b[::-1], unit)[::-1]
        return (x if params["left_side"] else x.T,)

    return _map_matrices(graph, solve, a, b)[0]


def _substitute(a: Objects, b: Objects, unit_diagonal: bool) -> Objects:
    """Solve a lower triangular system for several right-hand sides (n, m)."""
    x = b.copy()
    for i in range(len(b)):
        if i:
            x[i] = x[i] - (0.0 + a[i, :i] @ x[:i])  # a sum is never -0.0
        if not unit_diagonal:
            x[i] = x[i] * (1.0 / a[i, i])
    return x


# The coupled equations of implicit rows

MOST_PRODUCTS = 150
"""Products for each equation from which elimination is left to a routine: those of 7 states that all depend on each
other, which compile in 1.5 s then, not 5 s, and take 1.5 times as long to evaluate. A chain of states takes 36."""

KEPT = "kept"
"""Name of the pointer to what the forward step of a row keeps for the backward one."""


def eliminate(a: FloatArray, h: Node, f_x: Sequence[Objects], place: int | None = None) -> Elimination | Routine:
    """Factorize the matrix of the coupled equations: see `switchfit.discretization.rows`.

    With a place behind `KEPT`, another function can `load` the factors from there, once their `stores` are written.
    """
    filled = np.any([[[known_number(value) != 0.0 for value in row] for row in J] for J in f_x], axis=0)
    order, products = order_states(filled)
    n, s = len(order), len(a)
    if _takes_routine(products, n, s):
        entries = [value for J in f_x for value in J.reshape(-1)]
        return Routine(h.graph.call("factors", n, tuple(map(tuple, a.tolist())), place, h, *entries))
    # By states, with the stages of each next to one another: fill-in then follows the pattern of D_1 f.
    order = [n * j + state for state in order for j in range(s)]
    return Elimination(_factorize(np.block(couple(a, h, f_x))[np.ix_(order, order)]), order, place or 0)


def count_factors(n: int, s: int) -> int:
    """Return how many doubles the factors for n states and s stages take at most."""
    of_dense = sum(k**2 for k in range(1, n + 1))
    return count_doubles(n * s) if _takes_routine(of_dense, n, s) else (n * s) ** 2


def _takes_routine(products: int, n: int, s: int) -> bool:
    return products * s**2 > MOST_PRODUCTS * n


def order_states(filled: NDArray[np.bool_]) -> tuple[list[int], int]:
    """Return an order of elimination for a matrix with these entries and a diagonal, and the products that it takes.

    The next state is one with the fewest products.
    """
    filled, left, order, products = filled | np.eye(len(filled), dtype=bool), list(range(len(filled))), [], 0
    while left:
        inner = filled[np.ix_(left, left)]
        each = inner.sum(axis=0) * inner.sum(axis=1)
        products += int(each.min())
        state = left.pop(int(each.argmin()))
        order.append(state)
        # Eliminating a state joins all that depend on it with all that it depends on.
        filled |= np.outer(filled[:, state], filled[state])
    return order, products


def _factorize(a: Objects) -> Objects:
    """Replace a matrix (m, m) by its factors L and U, with 1 / U on the diagonal."""
    for k in range(len(a)):
        a[k, k] = 1.0 / a[k, k]
        after = [j for j in range(k + 1, len(a)) if a[k, j].number != 0.0]
        for i in range(k + 1, len(a)):
            if a[i, k].number == 0.0:
                continue
            # L is stored below the diagonal, which is 1 there, and U above it; structural zeros are skipped.
            a[i, k] = a[i, k] * a[k, k]
            for j in after:
                a[i, j] = a[i, j] - a[i, k] * a[k, j]
    return a


class Elimination:
    """The factors of a matrix (m, m), its rows and columns in this order, as nodes."""

    def __init__(self, factors: Objects, order: list[int], place: int) -> None:
        self._factors, self._order, self._place = factors, order, place

    @property
    def stores(self) -> list[tuple[str, int, Node]]:
        """Stores of all factors but known numbers."""
        unknown = [node for node in self._factors.reshape(-1).tolist() if node.number is None]
        return [(KEPT, k, node) for k, node in enumerate(unknown, self._place)]

    def load(self, graph: Graph) -> Elimination:
        """Load the factors in another graph."""
        loads = (graph.load(KEPT, k, certain=False) for _, k, _ in self.stores)
        nodes = self._factors.reshape(-1).tolist()
        factors = [next(loads) if node.number is None else graph.constant(node.number) for node in nodes]
        return Elimination(as_objects(factors).reshape(self._factors.shape), self._order, self._place)

    def solve(self, right: Sequence[Objects], *, transposed: bool = False) -> list[Any]:
        """Return the solution for a right-hand side of s vectors (n,) of scalars or vectors."""
        x = np.concatenate(list(right))[self._order]
        order, a = range(len(x)), self._factors.T if transposed else self._factors
        # P A P' = L U: forward with L, backward with U; transposed, U' L': the diagonal of U goes with the forward
        # part.
        for i in order:
            x[i] = _subtract(x[i], a[i, :i], x[:i]) * (a[i, i] if transposed else 1.0)
        for i in reversed(order):
            x[i] = _subtract(x[i], a[i, i + 1 :], x[i + 1 :]) * (1.0 if transposed else a[i, i])
        return np.split(x[np.argsort(self._order)], len(right))


def _subtract(value: Any, factors: Objects, others: Objects) -> Any:
    for factor, other in zip(factors, others, strict=True):
        if factor.number != 0.0:
            value = value - factor * other
    return value


class Routine:
    """The factors of a matrix in memory, by the functions of `switchfit.engine.native.llvm`."""

    stores = ()

    def __init__(self, factors: Node) -> None:
        self._factors = factors

    def load(self, graph: Graph) -> Routine:
        """Load the factors in another graph."""
        return Routine(graph.call("factors", *self._factors.args[:3]))

    def solve(self, right: Sequence[Objects], *, transposed: bool = False) -> list[Any]:
        """Return the solution for a right-hand side of s vectors (n,) of scalars or vectors."""
        values = np.concatenate(list(right))
        vector = any(isinstance(value, Node) and value.vector for value in values)
        graph: Graph = self._factors.graph
        solution = graph.call("solution", self._factors, transposed, *values, vector=vector)
        x = [graph.call("entry", solution, k, vector=vector) for k in range(len(values))]
        return np.split(as_objects(x), len(right))
