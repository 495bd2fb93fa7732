"""Find indices that are out of range inside the user's functions.

JAX raises no error for them: ``x[2]`` of two states is the last state, and ``x.at[2].set(0.0)`` changes nothing. The
fit is then that of another model.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import count, pairwise
from types import MappingProxyType
from typing import Any

import jax
import numpy as np
from jax._src import source_info_util

from switchfit.problem.jaxprs import follow_constants, write_line

PROMISED = jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS
"""Mode of ``x[index]``; the other modes say what an index out of range means."""

DROPPED = jax.lax.GatherScatterMode.FILL_OR_DROP
"""Mode of ``x.at[index].set(value)``; JAX does not record whether ``mode="drop"`` was written there."""

WRITER = "_IndexUpdateRef."
"""Class of JAX that ``x.at[index]`` is an object of, at the beginning of the names of its methods."""

FOLDED: Mapping[str, Callable[..., Any]] = MappingProxyType(
    {
        "lt": lambda a, b, **_: np.less(a, b),
        "add": lambda a, b, **_: np.add(a, b),
        "select_n": lambda which, no, yes: np.where(which, yes, no),
        "convert_element_type": lambda a, new_dtype, **_: np.asarray(a).astype(new_dtype),
        "broadcast_in_dim": lambda a, shape, broadcast_dimensions, **_: np.broadcast_to(
            np.reshape(a, _spread(np.shape(a), shape, broadcast_dimensions)), shape
        ),
        "concatenate": lambda *parts, dimension: np.concatenate(parts, axis=dimension),
        "reshape": lambda a, new_sizes, **_: np.reshape(a, new_sizes),
    }
)
"""Operations by which JAX makes what it reads of a constant index; in NumPy, which compiles nothing."""


def _spread(sizes: Sequence[int], shape: Sequence[int], places: Sequence[int]) -> list[int]:
    """Return the sizes of an array with axes of size 1 where it is repeated."""
    spread = [1] * len(shape)
    for place, size in zip(places, sizes, strict=True):
        spread[place] = size
    return spread


def refuse_indices_out_of_range(closed: Any, what: str) -> None:
    """Raise ValueError if a traced function reads or writes an array at a constant index that it does not have.

    ``mode="clip"`` and, of reads, ``mode="fill"`` say what is meant, and are accepted.

    Parameters
    ----------
    closed : jaxpr of the function
    what : str, such as "mode 'slip'"
    """
    unknown = [None] * len(closed.jaxpr.invars)
    follow_constants(closed.jaxpr, closed.consts, unknown, _fold, partial(_check, what))


def _fold(equation: Any, given: list[Any]) -> Sequence[Any] | None:
    """Return the result of an operation from which an index may be computed."""
    fold = FOLDED.get(equation.primitive.name)
    if fold is None or getattr(equation.outvars[0].aval.dtype, "kind", "O") not in "iub":
        return None
    return [fold(*given, **equation.params)]


def _check(what: str, equation: Any, given: list[Any], results: Sequence[Any]) -> None:
    """Raise ValueError for a known index of an operation that is out of range."""
    verb = "reads index" if equation.primitive.name in ("dynamic_slice", "gather") else "writes to index"
    for start, axis, size in _list_indices(equation, given):
        shape = equation.invars[0].aval.shape
        n, starts = shape[axis], np.ravel(start)
        wrong = starts[(starts < 0) | (starts > n - size)]
        if wrong.size:
            index = int(wrong[0]) - (n if wrong[0] < 0 else 0)  # JAX has added n to a negative index
            along = f"axis {axis} of an array of shape {shape}" if len(shape) > 1 else f"an array of size {n}"
            where = write_line(equation)
            raise ValueError(f"{what} {verb} {index} of {along}{where}: its indices are 0 to {n - 1}.")


def _list_indices(equation: Any, given: list[Any]) -> Iterator[tuple[Any, int, int]]:
    """Yield the known indices of an operation, the axis of each, and the number of entries from it on."""
    name, params = equation.primitive.name, equation.params
    found: Iterable[tuple[Any, int, int]] = ()
    if name == "dynamic_slice":
        found = zip(given[1:], count(), params["slice_sizes"], strict=False)
    elif name == "dynamic_update_slice":
        found = zip(given[2:], count(), equation.invars[1].aval.shape, strict=False)
    elif name == "gather" and params["mode"] is PROMISED and given[1] is not None:
        axes = params["dimension_numbers"].start_index_map
        found = ((np.asarray(given[1])[..., k], axis, params["slice_sizes"][axis]) for k, axis in enumerate(axes))
    elif name.startswith("scatter") and params["mode"] is DROPPED and given[1] is not None and _is_update(equation):
        axes = params["dimension_numbers"].scatter_dims_to_operand_dims
        found = ((np.asarray(given[1])[..., k], axis, 1) for k, axis in enumerate(axes))
    yield from (each for each in found if each[0] is not None)


def _is_update(equation: Any) -> bool:
    """Return whether a scatter is an update of the user, ``x.at[index].set(value)``, and not one by JAX, as derivatives
    of ``x.at[index].get(mode="fill")`` are.
    """
    frames = zip(*equation.source_info.traceback.raw_frames(), strict=True)
    found = next((inner for inner, outer in pairwise(code for code, _ in frames) if _is_of_user(outer)), None)
    return found is not None and found.co_qualname.startswith(WRITER) and found.co_name != "get"


def _is_of_user(code: Any) -> bool:
    return bool(source_info_util.is_user_filename(code.co_filename))
