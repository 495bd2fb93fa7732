"""Parts of traced functions, and where in the user's code their operations come from.

Numbers that are known in a traced function: those that lost digits, and indices that are out of range.

By default JAX computes in 32 bits, so that ``K = jnp.array(0.1)`` is 0.10000000149011612: a fit with it solves another
problem. Constants that a function reads have to pass `switchfit.problem.validation.refuse_single_precision`, and
nothing may be computed in 32 bits.

JAX raises no error for indices out of range: ``x[2]`` of two states is the last state, and ``x.at[2].set(0.0)`` changes
nothing. The fit is then that of another model.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib import import_module
from itertools import chain, count, pairwise
from types import MappingProxyType
from typing import Any

import jax
import numpy as np
from jax._src import source_info_util

from switchfit.problem.validation import is_low_precision, refuse_single_precision

MOVES: dict[str, Callable[[Any, Any], Any]] = {
    "slice": lambda a, at: a[
        tuple(map(slice, at["start_indices"], at["limit_indices"], at["strides"] or a.ndim * [1]))
    ],
    "squeeze": lambda a, at: a.squeeze(at["dimensions"]),
    "reshape": lambda a, at: a.transpose(at["dimensions"] or range(a.ndim)).reshape(at["new_sizes"]),
    "transpose": lambda a, at: a.transpose(at["permutation"]),
}
"""Operations that only select or move entries, none of which depends on a value."""


def find_inner_jaxprs(equation: Any) -> list[Any]:
    """Return the jaxprs that an operation calls, with their constants or without.

    Parameters
    ----------
    equation : operation of a jaxpr
    """
    values = equation.params.values()
    every = chain.from_iterable(value if isinstance(value, (tuple, list)) else (value,) for value in values)
    return [entry for entry in every if hasattr(entry, "eqns")]


def list_jaxprs(jaxpr: Any) -> Iterator[Any]:
    """Yield a jaxpr and those inside it.

    Parameters
    ----------
    jaxpr : jaxpr
    """
    yield jaxpr
    for equation in jaxpr.eqns:
        for inner in find_inner_jaxprs(equation):
            yield from list_jaxprs(getattr(inner, "jaxpr", inner))


def evaluate(equation: Any, operands: Sequence[Any]) -> list[Any]:
    """Return the results of an operation, by its own rule for derivatives if it has one.

    Parameters
    ----------
    equation : operation of a jaxpr
    operands : sequence
    """
    made = equation.primitive.bind(*operands, **equation.primitive.get_bind_params(equation.params))
    return list(made) if equation.primitive.multiple_results else [made]


class Walk:
    """Follows values of any kind through a jaxpr, operation by operation: `apply` says what one makes of them."""

    def constant(self, value: Any) -> Any:
        """Return what stands for a constant."""
        return value

    def apply(self, equation: Any, given: list[Any], origin: Any) -> Sequence[Any]:
        """Return the results of an operation; its place in the user's code is that of the operation `origin`."""
        raise NotImplementedError

    def run(self, jaxpr: Any, consts: Sequence[Any], given: Sequence[Any], origin: Any = None) -> list[Any]:
        """Return the results of a jaxpr."""
        known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*map(self.constant, consts), *given], strict=True))

        def value(atom: Any) -> Any:
            return self.constant(atom.val) if hasattr(atom, "val") else known[atom]

        for equation in jaxpr.eqns:
            results = self.apply(equation, [value(atom) for atom in equation.invars], origin or equation)
            known |= dict(zip(equation.outvars, results, strict=True))
        return [value(atom) for atom in jaxpr.outvars]

    def enter(self, equation: Any, inner: Any, given: Sequence[Any], origin: Any) -> list[Any]:
        """Return the results of a jaxpr that an operation calls.

        JAX traces its own functions once for all callers: what is inside them has the place of the call.
        """
        jaxpr, consts = getattr(inner, "jaxpr", inner), getattr(inner, "consts", ())
        is_of_jax = origin is not equation or find_public_name(jaxpr) is not None
        return self.run(jaxpr, consts, given, origin if is_of_jax else None)


def find_read_entries(jaxpr: Any, variables: Sequence[Any]) -> list[tuple[int, ...]]:
    """Return the positions in some arguments of the entries that may be read: those that a jaxpr does more with than
    to move them, and to leave them out of slices.

    Parameters
    ----------
    jaxpr : jaxpr
    variables : sequence of its arguments
    """
    held = {v: (k, np.arange(v.aval.size).reshape(v.aval.shape)) for k, v in enumerate(variables)}
    read: list[set[int]] = [set() for _ in variables]
    for name, given, made, settings in (
        *((each.primitive.name, each.invars, each.outvars, each.params) for each in jaxpr.eqns),
        ("return", jaxpr.outvars, [], {}),
    ):
        for k, entries in [held[atom] for atom in given if not hasattr(atom, "val") and atom in held]:
            if name in MOVES:
                held[made[0]] = k, MOVES[name](entries, settings)
            else:
                read[k].update(entries.ravel().tolist())
    return [tuple(sorted(positions)) for positions in read]


def find_line(equation: Any) -> str:
    """Return file and line of the user's code from which an operation comes, "file.py:12"; empty if it is unknown.

    Parameters
    ----------
    equation : operation of a jaxpr
    """
    frame = source_info_util.user_frame(equation.source_info.traceback)
    return "" if frame is None else f"{os.path.basename(frame.file_name)}:{frame.start_line}"


def find_public_name(jaxpr: Any) -> str | None:
    """Return the public name of a function of JAX; None for any other function.

    JAX traces its functions once for all callers: the location of their inner operations may be that of another call,
    and messages have to take the location of the call itself.

    Parameters
    ----------
    jaxpr : that of the function
    """
    info = getattr(getattr(jaxpr, "jaxpr", jaxpr), "debug_info", None)
    file, name = getattr(info, "func_filename", None), str(getattr(info, "func_name", "")).lstrip("_")
    if file is None or not file.startswith(os.path.dirname(jax.__file__) + os.sep):
        return None
    for module in PUBLIC:
        if hasattr(import_module(module), name):
            return f"{module.replace('jax.numpy', 'jnp')}.{name}"
    return name or "a function of JAX"


PUBLIC = (
    *("jax.numpy", "jax.numpy.linalg", "jax.numpy.fft", "jax.scipy.special", "jax.scipy.linalg", "jax.nn"),
    *("jax.random", "jax.lax", "jax.lax.linalg"),
)
"""Modules of JAX in which the name of a function is looked for."""

KEEPING = frozenset(
    {"slice", "squeeze", "reshape", "broadcast_in_dim", "transpose", "concatenate", "rev", "gather", "stack", "copy"}
    | {"dynamic_slice", "expand_dims", "select_n", "split", "unstack", "stop_gradient", "pad", "tile", "copy_p"}
    | {"neg", "abs", "max", "min"}
)
"""Operations that only move entries, or are exact in any precision."""

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
            np.expand_dims(a, tuple(set(range(len(shape))) - set(broadcast_dimensions))), shape
        ),
        "concatenate": lambda *parts, dimension: np.concatenate(parts, axis=dimension),
        "reshape": lambda a, new_sizes, **_: np.reshape(a, new_sizes),
    }
)
"""Operations by which JAX makes what it reads of a constant index; in NumPy, which compiles nothing."""


def refuse_wrong_constants(closed: Any, what: str) -> None:
    """Raise ValueError if a traced function uses numbers that lost digits, computes in less than double precision, or
    reads or writes an array at a constant index that it does not have.

    ``mode="clip"`` and, of reads, ``mode="fill"`` say what is meant by such an index, and are accepted.

    Parameters
    ----------
    closed : jaxpr of the function
    what : str, such as "mode 'slip'"
    """
    _Constants(what).run(closed.jaxpr, closed.consts, [None] * len(closed.jaxpr.invars))


class _Constants(Walk):
    """Follows known numbers, and None for unknown ones, and checks them."""

    def __init__(self, what: str) -> None:
        self._what = what

    def apply(self, equation: Any, given: list[Any], origin: Any) -> Sequence[Any]:
        for number in given:
            refuse_single_precision(number, f"a constant of {self._what}{_locate(origin)}")
        inner = find_inner_jaxprs(equation)
        results: Sequence[Any] = [None] * len(equation.outvars)
        for jaxpr in inner:
            if equation.primitive.name == "jit":  # a plain call; loops and branches without known arguments
                results = self.enter(equation, jaxpr, given, origin)
            else:
                self.enter(equation, jaxpr, [None] * len(getattr(jaxpr, "jaxpr", jaxpr).invars), origin)
        if not inner:
            self._check_precision(equation, origin)
            if all(operand is not None for operand in given):
                results = self._evaluate(equation, given)
        self._check_indices(equation, given, origin)
        return results

    def _evaluate(self, equation: Any, given: list[Any]) -> Sequence[Any]:
        """Return the results of an operation of known numbers that may make an index."""
        fold, kind = FOLDED.get(equation.primitive.name), getattr(equation.outvars[0].aval.dtype, "kind", "O")
        if fold is None or kind not in "iub":
            return [None] * len(equation.outvars)
        return [fold(*given, **equation.params)]

    def _check_precision(self, equation: Any, origin: Any) -> None:
        """Raise ValueError if an operation computes in less than double precision."""
        kinds = (getattr(variable.aval, "dtype", np.float64) for variable in equation.outvars)
        short = list(filter(is_low_precision, kinds))
        if short and equation.primitive.name not in KEEPING:
            raise ValueError(
                f"{self._what} computes in {short[0]}{_locate(origin)}, and so loses half of all digits: its arguments "
                "are float64, do not cast them, and write constants as numbers or NumPy arrays."
            )

    def _check_indices(self, equation: Any, given: list[Any], origin: Any) -> None:
        """Raise ValueError for a known index of an operation that is out of range."""
        verb = "reads index" if equation.primitive.name in ("dynamic_slice", "gather") else "writes to index"
        for start, axis, size in _list_indices(equation, given):
            shape = equation.invars[0].aval.shape
            n, starts = shape[axis], np.ravel(start)
            wrong = starts[(starts < 0) | (starts > n - size)]
            if wrong.size:
                index = int(wrong[0]) - (n if wrong[0] < 0 else 0)  # JAX has added n to a negative index
                along = f"axis {axis} of an array of shape {shape}" if len(shape) > 1 else f"an array of size {n}"
                raise ValueError(
                    f"{self._what} {verb} {index} of {along}{_locate(origin)}: its indices are 0 to {n - 1}."
                )


def _locate(equation: Any) -> str:
    """Return the location of an operation as the end of a sentence, " (file.py:12)"; empty if it is unknown."""
    where = find_line(equation)
    return f" ({where})" if where else ""


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
    calls = pairwise(code for code, _ in zip(*equation.source_info.traceback.raw_frames(), strict=True))
    is_of_user = source_info_util.is_user_filename
    found = next((inner for inner, outer in calls if is_of_user(outer.co_filename)), None)
    return found is not None and found.co_qualname.startswith(WRITER) and found.co_name != "get"
