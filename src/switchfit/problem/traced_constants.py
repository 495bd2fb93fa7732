"""Checks of the constants in a traced function: numbers that lost digits, and indices that are out of range.

By default JAX computes in 32 bits, so that ``K = jnp.array(0.1)`` is 0.10000000149011612: a fit with it solves another
problem. Constants that a function reads have to pass `refuse_single_precision`, and nothing may be computed in 32 bits.

JAX raises no error for indices out of range: ``x[2]`` of two states is the last state, and ``x.at[2].set(0.0)`` changes
nothing. The fit is then that of another model.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import count, pairwise
from types import MappingProxyType

import jax
import numpy as np

from switchfit.arrays import Traced
from switchfit.problem.jaxprs import Walk, find_inner_jaxprs, find_line, strip_constants
from switchfit.problem.validation.precision import is_low_precision, refuse_single_precision
from switchfit.runtime.jax_internals import ClosedJaxpr, Equation, array_type, is_user_file, list_calls

Known = Traced
"""A number or an array that does not depend on the arguments; None for one that does."""

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

FOLDED: Mapping[str, Callable[..., Traced]] = MappingProxyType(
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


def refuse_wrong_constants(closed: ClosedJaxpr, what: str) -> None:
    """Raise ValueError if a traced function uses numbers that lost digits, computes in less than double precision, or
    reads or writes an array at a constant index that it does not have.

    ``mode="clip"`` and, of reads, ``mode="fill"`` say what is meant by such an index, and are accepted.

    Parameters
    ----------
    closed : jaxpr of the function
    what : str, such as "mode 'slip'"
    """
    _Constants(what).run(closed.jaxpr, closed.consts, [None] * len(closed.jaxpr.invars))


class _Constants(Walk[Known]):
    """Follows known numbers, and None for unknown ones, and checks them."""

    def __init__(self, what: str) -> None:
        self._what = what

    def apply(self, equation: Equation, given: list[Known], origin: Equation) -> Sequence[Known]:
        for number in given:
            refuse_single_precision(number, f"a constant of {self._what}{_locate(origin)}")
        inner = find_inner_jaxprs(equation)
        results: Sequence[Known] = [None] * len(equation.outvars)
        for jaxpr in inner:
            # Known numbers are followed into plain calls alone: an index in a loop is another in each pass.
            if equation.primitive.name == "jit":  # a plain call; loops and branches without known arguments
                results = self.enter(equation, jaxpr, given, origin)
            else:
                self.enter(equation, jaxpr, [None] * len(strip_constants(jaxpr).invars), origin)
        if not inner:
            self._check_precision(equation, origin)
            if all(operand is not None for operand in given):
                results = self._evaluate(equation, given)
        self._check_indices(equation, given, origin)
        return results

    def _evaluate(self, equation: Equation, given: list[Known]) -> Sequence[Known]:
        """Return the results of an operation of known numbers that may make an index."""
        fold, kind = FOLDED.get(equation.primitive.name), getattr(array_type(equation.outvars[0]).dtype, "kind", "O")
        # Indices are integers: nothing else needs to be known, and arrays of the user may be large.
        if fold is None or kind not in "iub":
            return [None] * len(equation.outvars)
        return [fold(*given, **equation.params)]

    def _check_precision(self, equation: Equation, origin: Equation) -> None:
        """Raise ValueError if an operation computes in less than double precision."""
        kinds = (getattr(variable.aval, "dtype", np.float64) for variable in equation.outvars)
        short = list(filter(is_low_precision, kinds))
        if short and equation.primitive.name not in KEEPING:
            raise ValueError(
                f"{self._what} computes in {short[0]}{_locate(origin)}, and so loses half of all digits: its arguments "
                "are float64, do not cast them, and write constants as numbers or NumPy arrays."
            )

    def _check_indices(self, equation: Equation, given: list[Known], origin: Equation) -> None:
        """Raise ValueError for a known index of an operation that is out of range."""
        verb = "reads index" if equation.primitive.name in ("dynamic_slice", "gather") else "writes to index"
        for start, axis, size in _list_indices(equation, given):
            shape = array_type(equation.invars[0]).shape
            n, starts = shape[axis], np.ravel(start)
            # A slice that reaches beyond the end is moved back by JAX without a word, an index beyond it is clipped.
            wrong = starts[(starts < 0) | (starts > n - size)]
            if wrong.size:
                index = int(wrong[0]) - (n if wrong[0] < 0 else 0)  # JAX has added n to a negative index
                along = f"axis {axis} of an array of shape {shape}" if len(shape) > 1 else f"an array of size {n}"
                raise ValueError(
                    f"{self._what} {verb} {index} of {along}{_locate(origin)}: its indices are 0 to {n - 1}."
                )


def _locate(equation: Equation) -> str:
    """Return the location of an operation as the end of a sentence, " (file.py:12)"; empty if it is unknown."""
    where = find_line(equation)
    return f" ({where})" if where else ""


def _list_indices(equation: Equation, given: list[Known]) -> Iterator[tuple[Known, int, int]]:
    """Yield the known indices of an operation, the axis of each, and the number of entries from it on."""
    name, params = equation.primitive.name, equation.params
    found: Iterable[tuple[Known, int, int]] = ()
    if name == "dynamic_slice":
        # The start of a slice on each axis: what ``x[i]`` with a constant i becomes.
        found = zip(given[1:], count(), params["slice_sizes"], strict=False)
    elif name == "dynamic_update_slice":
        found = zip(given[2:], count(), array_type(equation.invars[1]).shape, strict=False)
    # Several indices at once, ``x[np.array([0, 2])]``. Only where the mode promises that they are in range: with
    # ``mode="fill"`` or "clip" the user has said what is to happen.
    elif name == "gather" and params["mode"] is PROMISED and given[1] is not None:
        axes = params["dimension_numbers"].start_index_map
        found = ((np.asarray(given[1])[..., k], axis, params["slice_sizes"][axis]) for k, axis in enumerate(axes))
    elif name.startswith("scatter") and params["mode"] is DROPPED and given[1] is not None and _is_update(equation):
        axes = params["dimension_numbers"].scatter_dims_to_operand_dims
        found = ((np.asarray(given[1])[..., k], axis, 1) for k, axis in enumerate(axes))
    yield from (each for each in found if each[0] is not None)


def _is_update(equation: Equation) -> bool:
    """Return whether a scatter is an update of the user, ``x.at[index].set(value)``, and not one by JAX, as derivatives
    of ``x.at[index].get(mode="fill")`` are.
    """
    # The function of JAX that the user's code called: the innermost frame whose caller is the user's.
    calls = pairwise(list_calls(equation))
    found = next((inner for inner, outer in calls if is_user_file(outer.co_filename)), None)
    return found is not None and found.co_qualname.startswith(WRITER) and found.co_name != "get"
