"""Gather, scatter and slices of traced arrays, at indices that may depend on the state.

They are unrolled: selections choose the entry at run time. Indices out of range are treated as in JAX.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import product
from typing import Any, TypeAlias

import numpy as np
from jax.lax import GatherDimensionNumbers, GatherScatterMode, ScatterDimensionNumbers
from numpy.typing import ArrayLike

from switchfit.engine.native.scalars.graph import Graph, Objects, Scalar
from switchfit.engine.native.tracing.entries import (
    MOST_CHOICES,
    Entry,
    Integer,
    TracedArray,
    choose,
    clamp,
    equal,
    known_number,
    less,
    pick,
)
from switchfit.engine.native.tracing.integers import OF_INTEGERS
from switchfit.engine.native.tracing.unsupported import check_size
from switchfit.runtime.jax_internals import Equation, array_type

Index: TypeAlias = Entry
"""A place along an axis: an int, or an `Integer`."""

Combine = Callable[[Entry, Entry, Entry], Entry]
"""(condition, old entry, update) -> new entry."""


def take(graph: Graph, a: TracedArray, starts: Sequence[Index], sizes: Sequence[int]) -> TracedArray:
    """Return a window of an array: (sizes); each start is in range, an int or an `Integer`."""
    moving = [k for k, start in enumerate(starts) if isinstance(start, Integer)]
    # What the window may reach along each axis.
    ends = [(s.low, s.high) if isinstance(s, Integer) else (s, s) for s in starts]
    a = a[tuple(slice(low, high + size) for (low, high), size in zip(ends, sizes, strict=True))]
    # Known numbers along several moving axes: one table for all, else each axis multiplies the selections.
    if len(moving) > 1 and all(known_number(e) is not None for e in a.reshape(-1)):
        return _from_table(graph, a, [starts[k] for k in moving], moving, sizes)
    # Axis by axis, each entry of the window is picked among those that it may be for any value of the start.
    for axis in moving:
        rows = np.moveaxis(a, axis, 0)
        window = np.empty((sizes[axis], *rows.shape[1:]), dtype=object)
        for place in np.ndindex(*window.shape):
            candidates = rows[(slice(place[0], place[0] + len(rows) - sizes[axis] + 1), *place[1:])]
            window[place] = pick(graph, candidates.tolist(), starts[axis])
        a = np.moveaxis(window, 0, axis)
    return a


def _from_table(
    graph: Graph, a: TracedArray, starts: list[Integer], moving: list[int], sizes: Sequence[int]
) -> Objects:
    """Take a window of a known array that moves along several axes: each entry by one index into a table."""
    multiply, add, subtract = (partial(OF_INTEGERS[op], graph, {}, np.dtype(int)) for op in ("mul", "add", "sub"))
    spans = [start.high - start.low + 1 for start in starts]
    # The index of the table is that of row-major order over the ranges of the starts.
    index: Entry = 0
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


def put(
    graph: Graph, a: Objects, starts: Sequence[Index], window: TracedArray, combine: Combine, condition: Scalar = True
) -> None:
    """Change a window of an array of objects in place, at starts that are in range where the condition holds."""
    ranges = [range(s.low, s.high + 1) if isinstance(s, Integer) else (s,) for s in starts]
    count = int(np.prod([len(r) for r in ranges]))
    check_size(count, MOST_CHOICES, f"changes one of {count} numbers at an index that depends on the state")
    # Every place that the window may have is written, under the condition that it is there: elsewhere the old entry
    # stays. A place that bounds exclude emits nothing.
    for first in product(*ranges):
        here = condition
        for start, value in zip(starts, first, strict=True):
            here = graph.apply("and", here, equal(graph, start, value))
        if known_number(here) is False:
            continue
        for place in np.ndindex(*window.shape):
            at = tuple(f + k for f, k in zip(first, place, strict=True))
            a[at] = combine(here, a[at], window[place])


def dynamic_slice(graph: Graph, equation: Equation, a: TracedArray, *starts: TracedArray) -> TracedArray:
    """Trace `jax.lax.dynamic_slice`: a window that is out of range is moved inside."""
    sizes = equation.params["slice_sizes"]
    return take(graph, a, _move_inside(graph, starts, a.shape, sizes), sizes)


def dynamic_update_slice(
    graph: Graph, equation: Equation, a: TracedArray, update: TracedArray, *starts: TracedArray
) -> Objects:
    """Trace `jax.lax.dynamic_update_slice`."""
    result = a.astype(object)
    inside = _move_inside(graph, starts, a.shape, update.shape)
    put(graph, result, inside, update, lambda here, old, new: choose(graph, here, new, old))
    return result


def _move_inside(
    graph: Graph, starts: Sequence[TracedArray], shape: Sequence[int], sizes: Sequence[int]
) -> list[Index]:
    return [clamp(graph, s.item(), 0, n - size) for s, n, size in zip(starts, shape, sizes, strict=True)]


def _list_windows(
    graph: Graph,
    shape: Sequence[int],
    indices: TracedArray,
    sizes: Sequence[int],
    numbers: GatherDimensionNumbers | ScatterDimensionNumbers,
    inside: Sequence[int],
    many: int,
) -> Iterator[tuple[list[Index], Scalar, tuple[int | slice, ...]]]:
    """Yield the windows that a gather or a scatter moves.

    `inside` are the axes inside windows among the `many` axes of the array of all windows. Of each window: the first
    index along each axis of the operand, moved into range; whether the window was in range; its index in the array of
    all windows.
    """
    axes: Sequence[int]
    own: Sequence[int]
    if isinstance(numbers, GatherDimensionNumbers):
        axes, own = numbers.start_index_map, numbers.start_indices_batching_dims
    else:
        axes, own = numbers.scatter_dims_to_operand_dims, numbers.scatter_indices_batching_dims
    batched = dict(zip(numbers.operand_batching_dims, own, strict=True))
    outside = [k for k in range(many) if k not in inside]
    for place in np.ndindex(*indices.shape[:-1]):
        starts: list[Any] = [place[batched[axis]] if axis in batched else 0 for axis in range(len(shape))]
        for axis, start in zip(axes, indices[place], strict=True):
            starts[axis] = start
        # JAX clips an index that is out of range, or fills with a value and drops updates there; which of these is up
        # to the caller, who has both: the start moved inside, and whether it was inside before.
        fits: Scalar = True
        for axis, (start, n, size) in enumerate(zip(starts, shape, sizes, strict=True)):
            for outside_range in (less(graph, start, 0), less(graph, n - size, start)):
                fits = graph.apply("and", fits, graph.apply("not", outside_range))
            starts[axis] = clamp(graph, start, 0, n - size)
        among: list[Any] = [slice(None)] * many
        for axis, k in zip(outside, place, strict=True):
            among[axis] = k
        yield starts, fits, tuple(among)


def gather(graph: Graph, equation: Equation, a: TracedArray, indices: TracedArray) -> Objects:
    """Trace `jax.lax.gather`."""
    params, out = equation.params, array_type(equation.outvars[0])
    numbers, sizes = params["dimension_numbers"], params["slice_sizes"]
    dropped = (*numbers.collapsed_slice_dims, *numbers.operand_batching_dims)
    result = np.empty(out.shape, dtype=object)
    windows = _list_windows(graph, a.shape, indices, sizes, numbers, numbers.offset_dims, len(out.shape))
    for starts, fits, among in windows:
        # The window is taken at a place that is inside in any case: no memory outside is read.
        taken = np.squeeze(take(graph, a, starts, sizes), axis=dropped)
        if params["mode"] == GatherScatterMode.FILL_OR_DROP and known_number(fits) is not True:
            fill = _fill_value(params["fill_value"], out.dtype)
            filled = np.frompyfunc(partial(choose, graph, fits), 2, 1)(taken, fill)
            taken = np.asarray(filled, dtype=object)
        result[among] = taken if taken.ndim else taken.item()
    return result


def _fill_value(given: ArrayLike | None, dtype: np.dtype[Any]) -> float:
    """Return JAX's value for an index out of range: NaN, True, or the largest unsigned or smallest signed integer."""
    if given is not None:
        return np.asarray(given, dtype).item()
    if dtype.kind in "iu":
        return int(np.iinfo(dtype).max if dtype.kind == "u" else np.iinfo(dtype).min)
    return True if dtype.kind == "b" else float("nan")


def scatter(
    graph: Graph, equation: Equation, a: TracedArray, indices: TracedArray, updates: TracedArray, combine: Combine
) -> Objects:
    """Trace `jax.lax.scatter`, `jax.lax.scatter_add` and their variants."""
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
