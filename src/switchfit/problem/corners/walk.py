"""Walk through a traced function with given sides of its corners, and list the functions g of the corners."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from itertools import count, islice
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from numpy.typing import NDArray

from switchfit.arrays import BoolArray, Traced
from switchfit.problem.jaxprs import SELECTIONS, Walk, evaluate, find_line, list_jaxprs, strip_constants
from switchfit.problem.traced_constants import FOLDED
from switchfit.runtime.jax_internals import ClosedJaxpr, Equation, Jaxpr, array_type, keep_user_line

Names = NDArray[np.int64]
"""Numbers that stand for expressions: two values have one number if they are one expression of t, x and p."""

ROUNDED = {"floor": (0.0, 0.0), "ceil": (0.0, 1.0), "round": (0.5, 0.0)}
"""Operations that are ``floor(x + shift) + more`` between their jumps: shift and more."""

CORNER_PRIMITIVES = ("sign", "abs", "max", "min", "clamp", "lt", "le", "gt", "ge", *ROUNDED)
"""Primitives of JAX that have a corner."""

BY_ENTRY = frozenset(
    {"neg", "abs", "sign", "sqrt", "rsqrt", "cbrt", "square", "integer_pow", "pow", "exp", "exp2", "expm1", "log"}
    | {"log1p", "logistic", "sin", "cos", "tan", "asin", "acos", "atan", "atan2", "sinh", "cosh", "tanh", "asinh"}
    | {"acosh", "atanh", "add", "sub", "mul", "div", "max", "min", "clamp", "lt", "le", "gt", "ge", "eq", "ne"}
    | {"and", "or", "not", "select_n", "convert_element_type", "copy", *ROUNDED}
)
"""Operations that make each entry of the same entry of their operands."""

MOST_ENTRIES = 64
"""Most entries of an array that are followed one by one."""

MOST_KNOTS = 16
"""Most knots of a table that are corners. A longer one is nearly smooth, and its knots are passed all the time."""

NO_NAME: Names = np.zeros((), dtype=np.int64)


class _Entries(NamedTuple):
    """An array of objects, each of which is an array of shape ()."""

    array: NDArray[np.object_]


class _Value(NamedTuple):
    """A value in a mode with given sides.

    Attributes
    ----------
    value : array or _Entries
    moves : bool
        Whether it depends on the state.
    names : array of int
        Of each entry; two are equal if they are one expression of t, x and p, whatever the sides are.
    """

    value: Traced  # or _Entries
    moves: bool
    names: Names


class CornerWalk(Walk[_Value]):
    """Evaluates a jaxpr with given sides of its corners, and lists their functions g; without sides, all are +1.

    Entries of a vector may be on different sides of a corner: each is followed by itself, so that nothing that is not
    chosen has a derivative, as ``sqrt(0)`` is of ``sqrt(maximum(x, 0))`` where x < 0.

    Attributes
    ----------
    values : list of pairs (a, b), one per corner: its function is g = a - b
    pairs : list of the names of a and b
    lines : list of str, file and line of the user's code
    """

    def __init__(self, sides: Sequence[int] | None) -> None:
        self._sides = sides
        self.values: list[tuple[Traced, Traced]] = []
        self.pairs: list[tuple[int, int]] = []
        self.lines: list[str] = []
        self._known: dict[Hashable, int] = {}

    def argument(self, k: int, value: Traced) -> _Value:
        """Return the k-th argument of a mode."""
        return _Value(value, k == 1, self._list_names(np.shape(value), (("argument", k, i) for i in count())))

    def constant(self, value: Traced) -> _Value:
        """Return a constant as an array of NumPy, unless it is a random key."""
        if isinstance(value, jax.Array) and jax.dtypes.issubdtype(value.dtype, jax.dtypes.extended):
            return _Value(value, False, self._list_names(value.shape, (("key", id(value), i) for i in count())))
        array = np.asarray(value)
        entries = (("constant", str(array.dtype), entry) for entry in array.ravel().tolist())
        return _Value(array, False, self._list_names(array.shape, entries))

    # Names are found once, by the walk that looks for the corners. Walks that evaluate know the sides of each of them,
    # and need no names.
    def _list_names(self, shape: tuple[int, ...], keys: Iterable[Hashable]) -> Names:
        """Return an array of numbers, the same for the same key; only where the corners are looked for."""
        if self._sides is not None:
            return NO_NAME
        size = int(np.prod(shape))
        found = [self._known.setdefault(key, len(self._known)) for key in islice(keys, size)]
        return np.array(found, dtype=np.int64).reshape(shape)

    def _name(self, equation: Equation, given: list[_Value]) -> list[Names]:
        """Return the names of the results of an operation."""
        name, params, names = equation.primitive.name, equation.params, [each.names for each in given]
        if self._sides is not None:
            return [NO_NAME] * len(equation.outvars)
        # An entry keeps its name as it is moved: `x[0]` of a slice is `x[0]`. Else relu(x)[0] and maximum(x[0], 0)
        # would be two corners at one place, met at one time.
        if name in SELECTIONS:
            return [SELECTIONS[name](names[0], params)]
        if name in ("broadcast_in_dim", "concatenate"):
            return [FOLDED[name](*names, **params)]
        what = name, str(params)
        if name in BY_ENTRY:
            every = np.broadcast_arrays(*names)
            operands = zip(*(each.ravel().tolist() for each in every), strict=True)
            return [self._list_names(every[0].shape, ((what, own) for own in operands))]
        # A result that mixes entries, as a sum does: its name is that of the operation and of all entries it takes.
        whole = tuple((each.shape, *each.ravel().tolist()) for each in names)
        outs = enumerate(array_type(out).shape for out in equation.outvars)
        return [self._list_names(shape, ((what, whole, i, k) for k in count())) for i, shape in outs]

    def apply(self, equation: Equation, given: list[_Value], origin: Equation) -> list[_Value]:
        """Return the results of an operation on the given sides, and note the corners that it makes."""
        name, params, names = equation.primitive.name, equation.params, self._name(equation, given)
        depends = [each.moves for each in given]
        # A vector: its entries may lie on different sides, as the four wheels of a vehicle do of the slip at which they
        # let go. Longer ones, as of a discretized rod, would make too many sides to be followed: they stay whole.
        is_array = 1 < max((np.size(_get_array(each.value)) for each in given), default=1) <= MOST_ENTRIES
        if is_array and any(depends) and name in BY_ENTRY:
            return [_Value(self._apply_by_entry(equation, given, origin), True, names[0])]
        # What follows takes vectors that have been split: it moves the entries, or puts them together again.
        is_split = any(isinstance(each.value, _Entries) for each in given)
        if is_split and name in SELECTIONS:
            found = SELECTIONS[name](given[0].value.array, params)
            return [_Value(_Entries(found) if found.shape else found.item(), True, names[0])]
        # A NumPy array is known once the sides are: whatever these are, there is no corner.
        moves = [each.moves and not isinstance(each.value, np.ndarray) for each in given]
        moving = [each._replace(moves=own) for each, own in zip(given, moves, strict=True)]
        joined = [each._replace(value=join_entries(each.value)) for each in moving]
        values = [each.value for each in joined]
        # First what the sides decide: an operation with a corner, a table, a choice.
        made = self._evaluate(equation, joined, origin)
        if made is None and name == "cond" and isinstance(values[0], np.ndarray):
            chosen = int(np.clip(values[0], 0, len(params["branches"]) - 1))
            # The corners are those of all branches, whichever is taken.
            results = {
                k: self.run(branch.jaxpr, branch.consts, moving[1:])
                for k, branch in enumerate(params["branches"])
                if k == chosen or has_corners(branch)
            }
            return [each._replace(names=own) for each, own in zip(results[chosen], names, strict=True)]
        # Then calls. A loop, `scan` or `while`, is evaluated as it is: corners inside it are not found.
        is_call = made is None and name not in ("scan", "while")
        inner = params.get("jaxpr", params.get("call_jaxpr")) if is_call else None
        # Functions inside are walked through where they have corners or are decided by one; else they are bound as they
        # are.
        if inner is not None and (is_split or moves != depends or (any(moves) and has_corners(inner))):
            return self.enter(equation, inner, moving, origin)
        made = _bind(equation, values, origin) if made is None else made
        made = [np.asarray(value) if isinstance(value, np.generic) else value for value in made]
        return [_Value(value, any(depends), own) for value, own in zip(made, names, strict=True)]

    def _apply_by_entry(self, equation: Equation, given: list[_Value], origin: Equation) -> _Entries:
        """Return the result of an operation of arrays, entry by entry."""
        shape = array_type(equation.outvars[0]).shape
        split = [(np.broadcast_to(_split(own.value), shape), np.broadcast_to(own.names, shape)) for own in given]
        found = np.empty(shape, dtype=object)
        for place in np.ndindex(shape):
            entries = [
                _Value(values[place], own.moves, names[place])
                for (values, names), own in zip(split, given, strict=True)
            ]
            found[place] = self.apply(equation, entries, origin)[0].value
        return _Entries(found)

    def _evaluate(self, equation: Equation, given: list[_Value], origin: Equation) -> list[Traced] | None:
        """Return the results of an operation that the sides decide; None for any other."""
        name, values, moves = equation.primitive.name, [each.value for each in given], [each.moves for each in given]
        if name in CORNER_PRIMITIVES and any(moves) and array_type(equation.invars[-1]).dtype == np.float64:
            return [self._pass_corner(name, given, origin)]
        is_search = equation.params.get("name") == "searchsorted" and moves[-1] and not moves[0]
        # A table that is looked up by the state is smooth between its knots: each knot is a corner.
        if is_search and np.ndim(values[0]) == 1 and len(values[0]) <= MOST_KNOTS:
            names = np.broadcast_to(given[0].names, np.shape(values[0]))
            knots = [_Value(values[0][k, ...], False, names[k, ...]) for k in range(len(names))]
            below = [self._meet(given[1], knot, origin) for knot in knots]
            return [np.sum(below, axis=0).astype(array_type(equation.outvars[0]).dtype)]
        if values and all(isinstance(value, np.ndarray) for value in values):  # also the sides of corners
            with jax.ensure_compile_time_eval():
                return [np.asarray(value) for value in _bind(equation, values, origin)]
        # The condition follows from the sides: one of the cases, entry by entry.
        if name == "select_n" and isinstance(values[0], np.ndarray):
            return [_choose(values[0], *values[1:])]
        return None

    def _pass_corner(self, name: str, given: list[_Value], origin: Equation) -> Traced:
        """Return the result of an operation on the sides given."""
        shape = np.broadcast_shapes(*(np.shape(each.value) for each in given))
        given = [each._replace(value=_broadcast(each.value, shape)) for each in given]
        if name in ROUNDED:
            # A gear or an encoder, ``floor(x)``: it jumps at every integer, and sides are two. The parity of the
            # integer below is such a side: on either, the trajectory is between two jumps, and the branch is a
            # constant.
            shift, more = ROUNDED[name]
            operands, v = given[0].names.ravel().tolist(), given[0].value + shift
            names = self._list_names(shape, (("sine", shift, own) for own in operands))
            # The integer below v is even where sin(pi v) > 0. A side goes on by 1/2 beyond its ends as it is between.
            is_even = self._meet(_Value(jnp.sin(np.pi * v), True, names), self.constant(np.zeros(())), origin)
            odd, even = 2.0 * jnp.floor((v - 0.5) / 2.0) + 1.0, 2.0 * jnp.floor((v + 0.5) / 2.0)
            return _choose(is_even, odd, even) + more
        if name == "clamp":  # of the lowest value, the state, and the highest
            # A limit, ``clip(x, -1, 1)``: one corner at each end.
            low, x, high = given
            above, below = self._meet(x, low, origin), self._meet(x, high, origin)
            return _choose(above, low.value, _choose(below, x.value, high.value))
        one, other = given if len(given) > 1 else (given[0], self.constant(np.zeros(())))
        is_above, a, b = self._meet(one, other, origin), one.value, other.value
        # A relay or dry friction: ``sign`` is never 0 here, since a trajectory that stays at the corner slides, with
        # side 0.
        if name == "sign":
            return np.where(is_above, 1.0, -1.0)
        if name == "abs":
            return _choose(is_above, -a, a)
        if name in ("max", "min"):
            return _choose(is_above, *((b, a) if name == "max" else (a, b)))
        return is_above if name in ("gt", "ge") else ~is_above

    def _meet(self, one: _Value, other: _Value, origin: Equation) -> BoolArray:
        """Note the corners a - b = 0, and return whether each is met on its positive side."""
        a, first = one.value, len(self.values)
        b, size = _broadcast(other.value, a.shape), int(np.prod(a.shape))
        names = [np.broadcast_to(each.names, a.shape).ravel().tolist() for each in (one, other)]
        self.values += [(a.reshape(-1)[k], b.reshape(-1)[k]) for k in range(size)]
        self.pairs += zip(*names, strict=True)
        self.lines += [find_line(origin)] * size
        # Corners are numbered in the order in which the walk meets them, which is the same for all sides: the k-th of
        # `sides` belongs to the k-th of `values`. So the walk must pass all branches of a `cond`.
        sides = [1] * size if self._sides is None else self._sides[first : first + size]
        return (np.array(sides) > 0).reshape(a.shape)


def _get_array(value: Traced) -> Traced:
    return value.array if isinstance(value, _Entries) else value


def _split(value: Traced) -> NDArray[np.object_]:
    """Return the entries of an array, or those that it has been split into."""
    if isinstance(value, _Entries):
        return value.array
    found = np.empty(np.shape(value), dtype=object)
    for place in np.ndindex(found.shape):
        found[place] = np.asarray(value[place]) if isinstance(value, np.ndarray) else value[place]
    return found


def join_entries(value: Traced) -> Traced:
    """Return entries as one array, which is one of NumPy if all are known; any other value as it is."""
    if not isinstance(value, _Entries):
        return value
    entries = value.array.ravel().tolist()
    known = all(isinstance(entry, np.ndarray) for entry in entries)
    return (np if known else jnp).stack(entries).reshape(value.array.shape)


def _choose(which: NDArray[np.generic], no: Traced, yes: Traced, *more: Traced) -> Traced:
    """Return ``select_n`` of a condition that is known; without the other case where all entries take the same."""
    cases = [_broadcast(case, which.shape or np.shape(no)) for case in (no, yes, *more)]  # one condition, many entries
    # One case alone, so that nothing of the other has a derivative: JAX would multiply an infinite slope there by 0.
    if np.all(which == which.flat[0]):
        found = cases[int(which.flat[0])]
        return found if all(isinstance(case, np.ndarray) for case in cases) else jnp.asarray(found)
    return lax.select_n(which, *map(jnp.asarray, cases))


def _broadcast(value: Traced, shape: tuple[int, ...]) -> Traced:
    """Return an array of a shape, which is one of NumPy if it is known."""
    return (np if isinstance(value, np.ndarray) else jnp).broadcast_to(value, shape)


def _bind(equation: Equation, values: Sequence[Traced], origin: Equation) -> list[Traced]:
    """Evaluate an operation as JAX does, with the line of the user's code from which it comes."""
    with keep_user_line(origin):
        return evaluate(equation, values)


def has_corners(jaxpr: Jaxpr | ClosedJaxpr) -> bool:
    """Return whether a corner may be in a jaxpr, or in one inside it."""
    every = list_jaxprs(strip_constants(jaxpr))
    return any(equation.primitive.name in CORNER_PRIMITIVES for each in every for equation in each.eqns)
