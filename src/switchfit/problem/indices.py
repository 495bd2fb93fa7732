"""Find indices that are out of range inside the user's functions.

JAX raises no error for them: ``x[2]`` of two states is the last state, and ``x.at[2].set(0.0)`` changes nothing. The
fit is then that of another model.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from itertools import pairwise
from types import MappingProxyType
from typing import Any

import jax
import numpy as np
from jax._src import source_info_util

from switchfit.problem.jaxprs import find_inner_jaxprs, write_line

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
    _check(closed.jaxpr, closed.consts, [None] * len(closed.jaxpr.invars), what)


def _check(jaxpr: Any, consts: Sequence[Any], arguments: Sequence[Any], what: str) -> None:
    """Check the operations of a jaxpr, of whose arguments those that are not None are known."""
    known: dict[Any, Any] = {v: c for v, c in zip(jaxpr.constvars, consts, strict=True) if _is_index(v)}
    known |= {v: a for v, a in zip(jaxpr.invars, arguments, strict=True) if a is not None}

    def value(atom: Any) -> Any:
        return atom.val if hasattr(atom, "val") else known.get(atom)

    for equation in jaxpr.eqns:
        name, given = equation.primitive.name, [value(atom) for atom in equation.invars]
        inner = find_inner_jaxprs(equation)
        for own, own_consts in inner:
            plain = len(inner) == 1 and len(own.invars) == len(given) and name == "jit"
            _check(own, own_consts, given if plain else [None] * len(own.invars), what)
        if name == "dynamic_slice":
            sizes = equation.params["slice_sizes"]
            for axis, (start, size) in enumerate(zip(given[1:], sizes, strict=True)):
                _check_index(start, equation, axis, size, f"{what} reads index")
        elif name == "gather" and equation.params["mode"] is PROMISED and given[1] is not None:
            sizes = equation.params["slice_sizes"]
            for k, axis in enumerate(equation.params["dimension_numbers"].start_index_map):
                _check_index(np.asarray(given[1])[..., k], equation, axis, sizes[axis], f"{what} reads index")
        elif name == "dynamic_update_slice":
            for axis, (start, size) in enumerate(zip(given[2:], equation.invars[1].aval.shape, strict=True)):
                _check_index(start, equation, axis, size, f"{what} writes to index")
        elif name.startswith("scatter") and equation.params["mode"] is DROPPED and given[1] is not None:
            if _is_update(equation):
                for k, axis in enumerate(equation.params["dimension_numbers"].scatter_dims_to_operand_dims):
                    _check_index(np.asarray(given[1])[..., k], equation, axis, 1, f"{what} writes to index")
        elif name in FOLDED and _is_index(equation.outvars[0]) and all(g is not None for g in given):
            known[equation.outvars[0]] = FOLDED[name](*given, **equation.params)


def _is_index(variable: Any) -> bool:
    """Return whether a variable may be an index, or what one is computed from."""
    dtype = getattr(variable.aval, "dtype", None)
    return dtype is not None and (np.issubdtype(dtype, np.integer) or dtype == np.bool_)


def _is_update(equation: Any) -> bool:
    """Return whether a scatter is an update of the user, ``x.at[index].set(value)``, and not one by JAX, as derivatives
    of ``x.at[index].get(mode="fill")`` are.
    """
    frames = zip(*equation.source_info.traceback.raw_frames(), strict=True)
    found = next((inner for inner, outer in pairwise(code for code, _ in frames) if _is_of_user(outer)), None)
    return found is not None and found.co_qualname.startswith(WRITER) and found.co_name != "get"


def _is_of_user(code: Any) -> bool:
    return bool(source_info_util.is_user_filename(code.co_filename))


def _check_index(start: Any, equation: Any, axis: int, size: int, what: str) -> None:
    """Raise ValueError for a known index that is out of range along an axis."""
    if start is None:
        return
    shape = equation.invars[0].aval.shape
    n, starts = shape[axis], np.ravel(start)
    wrong = starts[(starts < 0) | (starts > n - size)]
    if wrong.size:
        index = int(wrong[0]) - (n if wrong[0] < 0 else 0)  # JAX has added n to a negative index
        along = f"axis {axis} of an array of shape {shape}" if len(shape) > 1 else f"an array of size {n}"
        raise ValueError(f"{what} {index} of {along}{write_line(equation)}: its indices are 0 to {n - 1}.")
