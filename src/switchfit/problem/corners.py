"""Corners of a mode: surfaces g(t, x, p) = 0 on which ``sign``, ``abs``, ``where``, ``maximum``... of a state change.

They are found in the traced function. With the *side* of each corner given (+1 where g > 0, -1 where g < 0), the mode
is a smooth function: its *branch*. On a surface that attracts from both sides the trajectory slides along it. With side
0 the branch is the convex combination that stays on the surface (Filippov, 1988): with f_0 the field where all sliding
corners have the side -1, and f_k the same with the side +1 at corner k,

    ``f = f_0 + sum_k s_k (f_k - f_0)``,  ``dg_k/dt = D_t g_k + D_x g_k . f + D_u g_k . du/dt = 0``,

for all sliding corners k, which is left where s_k leaves [0, 1]. So a branch takes the input u with its rate, (2, ...).

A field may be undefined beyond a corner, as ``sqrt(maximum(x, 0))`` is on the side +1 where x < 0, with an infinite
slope at the corner. Such a corner is *steep*: nearer to it than a small *margin*, and beyond it, the field of a side is
that at the margin.

Corners that follow from t, the input and fixed parameters alone are met at times that are known before anything runs:
see `compile_timed_corners`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from itertools import count, islice, product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax._src import source_info_util
from numpy.typing import NDArray

from switchfit.problem.functions import Function, use_float64
from switchfit.problem.jaxprs import FOLDED, MOVES, Walk, evaluate, find_line, list_jaxprs

Array = Any
Sides = tuple[int, ...]
"""Side of each corner of a mode: +1, -1, or 0 where the trajectory slides."""

Margins = tuple[tuple[tuple[int, int], float], ...]
"""Corners that are steep with the side on which they are, and the |g| of their margins."""

ROUNDED = {"floor": (0.0, 0.0), "ceil": (0.0, 1.0), "round": (0.5, 0.0)}
"""Operations that are ``floor(x + shift) + more`` between their jumps: shift and more."""

CORNERS = ("sign", "abs", "max", "min", "clamp", "lt", "le", "gt", "ge", *ROUNDED)
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

BEYOND = 1e-8
"""Smallest |g| at which a field is evaluated beyond a corner."""


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

    value: Any
    moves: bool
    names: NDArray[Any]


NO_NAME = np.zeros((), dtype=np.int64)


class _Walk(Walk):
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
        self.values: list[Array] = []
        self.pairs: list[tuple[int, int]] = []
        self.lines: list[str] = []
        self._known: dict[Any, int] = {}

    def argument(self, k: int, value: Any) -> _Value:
        """Return the k-th argument of a mode."""
        return _Value(value, k == 1, self._list_names(np.shape(value), (("argument", k, i) for i in count())))

    def constant(self, value: Any) -> _Value:
        """Return a constant as an array of NumPy, unless it is a random key."""
        if isinstance(value, jax.Array) and jax.dtypes.issubdtype(value.dtype, jax.dtypes.extended):
            return _Value(value, False, self._list_names(value.shape, (("key", id(value), i) for i in count())))
        array = np.asarray(value)
        entries = (("constant", str(array.dtype), entry) for entry in array.ravel().tolist())
        return _Value(array, False, self._list_names(array.shape, entries))

    def _list_names(self, shape: tuple[int, ...], keys: Iterable[Any]) -> NDArray[Any]:
        """Return an array of numbers, the same for the same key; only where the corners are looked for."""
        if self._sides is not None:
            return NO_NAME
        size = int(np.prod(shape))
        found = [self._known.setdefault(key, len(self._known)) for key in islice(keys, size)]
        return np.array(found, dtype=np.int64).reshape(shape)

    def _name(self, equation: Any, given: list[_Value]) -> list[NDArray[Any]]:
        """Return the names of the results of an operation."""
        name, params, names = equation.primitive.name, equation.params, [each.names for each in given]
        if self._sides is not None:
            return [NO_NAME] * len(equation.outvars)
        if name in MOVES:
            return [MOVES[name](names[0], params)]
        if name in ("broadcast_in_dim", "concatenate"):
            return [FOLDED[name](*names, **params)]
        what = name, str(params)
        if name in BY_ENTRY:
            every = np.broadcast_arrays(*names)
            operands = zip(*(each.ravel().tolist() for each in every), strict=True)
            return [self._list_names(every[0].shape, ((what, own) for own in operands))]
        whole = tuple((each.shape, *each.ravel().tolist()) for each in names)
        outs = enumerate(out.aval.shape for out in equation.outvars)
        return [self._list_names(shape, ((what, whole, i, k) for k in count())) for i, shape in outs]

    def apply(self, equation: Any, given: list[_Value], origin: Any) -> list[_Value]:
        name, params, names = equation.primitive.name, equation.params, self._name(equation, given)
        depends = [each.moves for each in given]
        is_array = 1 < max((np.size(_get_array(each.value)) for each in given), default=1) <= MOST_ENTRIES
        if is_array and any(depends) and name in BY_ENTRY:
            return [_Value(self._apply_by_entry(equation, given, origin), True, names[0])]
        is_split = any(isinstance(each.value, _Entries) for each in given)
        if is_split and name in MOVES:
            found = MOVES[name](given[0].value.array, params)
            return [_Value(_Entries(found) if found.shape else found.item(), True, names[0])]
        # A NumPy array is known once the sides are: whatever these are, there is no corner.
        moves = [each.moves and not isinstance(each.value, np.ndarray) for each in given]
        moving = [each._replace(moves=own) for each, own in zip(given, moves, strict=True)]
        joined = [each._replace(value=_join(each.value)) for each in moving]
        values = [each.value for each in joined]
        made = self._evaluate(equation, joined, origin)
        if made is None and name == "cond" and isinstance(values[0], np.ndarray):
            chosen = int(np.clip(values[0], 0, len(params["branches"]) - 1))
            # The corners are those of all branches, whichever is taken.
            results = {
                k: self.run(branch.jaxpr, branch.consts, moving[1:])
                for k, branch in enumerate(params["branches"])
                if k == chosen or _has_corners(branch)
            }
            return [each._replace(names=own) for each, own in zip(results[chosen], names, strict=True)]
        is_call = made is None and name not in ("scan", "while")
        inner = params.get("jaxpr", params.get("call_jaxpr")) if is_call else None
        # Functions inside are walked through where they have corners or are decided by one; else they are bound as they
        # are.
        if inner is not None and (is_split or moves != depends or (any(moves) and _has_corners(inner))):
            return self.enter(equation, inner, moving, origin)
        made = _bind(equation, values, origin) if made is None else made
        made = [np.asarray(value) if isinstance(value, np.generic) else value for value in made]
        return [_Value(value, any(depends), own) for value, own in zip(made, names, strict=True)]

    def _apply_by_entry(self, equation: Any, given: list[_Value], origin: Any) -> _Entries:
        """Return the result of an operation of arrays, entry by entry."""
        shape = equation.outvars[0].aval.shape
        split = [[np.broadcast_to(each, shape) for each in (_split(own.value), own.names)] for own in given]
        found = np.empty(shape, dtype=object)
        for place in np.ndindex(shape):
            entries = [
                _Value(values[place], own.moves, names[place])
                for (values, names), own in zip(split, given, strict=True)
            ]
            found[place] = self.apply(equation, entries, origin)[0].value
        return _Entries(found)

    def _evaluate(self, equation: Any, given: list[_Value], origin: Any) -> list[Any] | None:
        """Return the results of an operation that the sides decide; None for any other."""
        name, values, moves = equation.primitive.name, [each.value for each in given], [each.moves for each in given]
        if name in CORNERS and any(moves) and equation.invars[-1].aval.dtype == np.float64:
            return [self._pass_corner(name, given, origin)]
        is_search = equation.params.get("name") == "searchsorted" and moves[-1] and not moves[0]
        # A table that is looked up by the state is smooth between its knots: each knot is a corner.
        if is_search and np.ndim(values[0]) == 1 and len(values[0]) <= MOST_KNOTS:
            names = np.broadcast_to(given[0].names, np.shape(values[0]))
            knots = [_Value(values[0][k, ...], False, names[k, ...]) for k in range(len(names))]
            below = [self._meet(given[1], knot, origin) for knot in knots]
            return [np.sum(below, axis=0).astype(equation.outvars[0].aval.dtype)]
        if values and all(isinstance(value, np.ndarray) for value in values):  # also the sides of corners
            with jax.ensure_compile_time_eval():
                return [np.asarray(value) for value in _bind(equation, values, origin)]
        # The condition follows from the sides: one of the cases, entry by entry.
        if name == "select_n" and isinstance(values[0], np.ndarray):
            return [_choose(values[0], *values[1:])]
        return None

    def _pass_corner(self, name: str, given: list[_Value], origin: Any) -> Any:
        """Return the result of an operation on the sides given."""
        shape = np.broadcast_shapes(*(np.shape(each.value) for each in given))
        given = [each._replace(value=_broadcast(each.value, shape)) for each in given]
        if name in ROUNDED:
            shift, more = ROUNDED[name]
            operands, v = given[0].names.ravel().tolist(), given[0].value + shift
            names = self._list_names(shape, (("sine", shift, own) for own in operands))
            # The integer below v is even where sin(pi v) > 0. A side goes on by 1/2 beyond its ends as it is between.
            is_even = self._meet(_Value(jnp.sin(np.pi * v), True, names), self.constant(np.zeros(())), origin)
            odd, even = 2.0 * jnp.floor((v - 0.5) / 2.0) + 1.0, 2.0 * jnp.floor((v + 0.5) / 2.0)
            return _choose(is_even, odd, even) + more
        if name == "clamp":  # of the lowest value, the state, and the highest
            low, x, high = given
            above, below = self._meet(x, low, origin), self._meet(x, high, origin)
            return _choose(above, low.value, _choose(below, x.value, high.value))
        one, other = given if len(given) > 1 else (given[0], self.constant(np.zeros(())))
        is_above, a, b = self._meet(one, other, origin), one.value, other.value
        if name == "sign":
            return np.where(is_above, 1.0, -1.0)
        if name == "abs":
            return _choose(is_above, -a, a)
        if name in ("max", "min"):
            return _choose(is_above, *((b, a) if name == "max" else (a, b)))
        return is_above if name in ("gt", "ge") else ~is_above

    def _meet(self, one: _Value, other: _Value, origin: Any) -> Any:
        """Note the corners a - b = 0, and return whether each is met on its positive side."""
        a, first = one.value, len(self.values)
        b, size = _broadcast(other.value, a.shape), int(np.prod(a.shape))
        names = [np.broadcast_to(each.names, a.shape).ravel().tolist() for each in (one, other)]
        self.values += [(a.reshape(-1)[k], b.reshape(-1)[k]) for k in range(size)]
        self.pairs += zip(*names, strict=True)
        self.lines += [find_line(origin)] * size
        sides = [1] * size if self._sides is None else self._sides[first : first + size]
        return (np.array(sides) > 0).reshape(a.shape)


def _get_array(value: Any) -> Any:
    return value.array if isinstance(value, _Entries) else value


def _split(value: Any) -> NDArray[np.object_]:
    """Return the entries of an array, or those that it has been split into."""
    if isinstance(value, _Entries):
        return value.array
    found = np.empty(np.shape(value), dtype=object)
    for place in np.ndindex(found.shape):
        found[place] = np.asarray(value[place]) if isinstance(value, np.ndarray) else value[place]
    return found


def _join(value: Any) -> Any:
    """Return entries as one array, which is one of NumPy if all are known; any other value as it is."""
    if not isinstance(value, _Entries):
        return value
    entries = value.array.ravel().tolist()
    known = all(isinstance(entry, np.ndarray) for entry in entries)
    return (np if known else jnp).stack(entries).reshape(value.array.shape)


def _choose(which: Any, no: Any, yes: Any, *more: Any) -> Any:
    """Return ``select_n`` of a condition that is known; without the other case where all entries take the same."""
    cases = [_broadcast(case, which.shape or np.shape(no)) for case in (no, yes, *more)]  # one condition, many entries
    if np.all(which == which.flat[0]):
        found = cases[int(which.flat[0])]
        return found if all(isinstance(case, np.ndarray) for case in cases) else jnp.asarray(found)
    return lax.select_n(which, *map(jnp.asarray, cases))


def _broadcast(value: Any, shape: tuple[int, ...]) -> Any:
    """Return an array of a shape, which is one of NumPy if it is known."""
    return (np if isinstance(value, np.ndarray) else jnp).broadcast_to(value, shape)


def _bind(equation: Any, values: Sequence[Any], origin: Any) -> list[Any]:
    """Evaluate an operation as JAX does, with the line of the user's code from which it comes."""
    with source_info_util.user_context(origin.source_info.traceback):
        return evaluate(equation, values)


def _has_corners(jaxpr: Any) -> bool:
    """Return whether a corner may be in a jaxpr, or in one inside it."""
    every = list_jaxprs(getattr(jaxpr, "jaxpr", jaxpr))
    return any(equation.primitive.name in CORNERS for each in every for equation in each.eqns)


class Corners:
    """The corners of a mode, and its branches.

    Attributes
    ----------
    function : Function
        The mode.
    margins : Margins
    count : int
    lines : list of str
        File and line of the user's code that makes each of them.
    """

    def __init__(self, function: Function, margins: Margins = ()) -> None:
        self.function, self.margins = function, margins
        walks = [_Walk(())]
        if _has_corners(function.jaxpr):
            with use_float64():
                jax.eval_shape(lambda *given: walks.append(self._run(None, given)[0]), *function.structs)
        lines, pairs = walks[-1].lines, walks[-1].pairs
        # Corners are the same where they compare the same two numbers, in either order.
        known: dict[tuple[int, ...], int] = {}
        self._group = [known.setdefault(tuple(sorted(pair)), len(known)) for pair in pairs]
        firsts = [self._group.index(k) for k in range(len(known))]
        self._orientation = [1 if pair == pairs[firsts[k]] else -1 for pair, k in zip(pairs, self._group, strict=True)]
        self.count = len(known)
        self.lines = [lines[k] for k in firsts]
        self._firsts = firsts
        self._derived: dict[Any, Function] = {}

    def branch(self, sides: Sides) -> Function:
        """Return the mode with these sides."""
        if not self.count:
            return self.function
        return self._derive("branch", sides, lambda *given: self._field(sides, given)[0])

    def surfaces(self, sides: Sides) -> Function:
        """Return the functions g of all corners, (count,), with these sides."""
        sides = _settle(sides)
        return self._derive("surfaces", sides, lambda *given: jnp.stack(self._evaluate(sides, given)[1]))

    def rates(self, sides: Sides) -> Function:
        """Return dg/dt of all corners along a branch, (count,)."""
        return self._derive("rates", sides, lambda *given: self._rates(sides, self._field(sides, given)[0], given))

    def rates_at(self, sides: Sides, corner: int) -> Function:
        """Return what `rates` does at a steep corner, on its margin, at the point that is the nearest to the given."""
        margin = max(margin for (k, _), margin in self.margins if k == corner)

        def evaluate(t: Array, x: Array, *others: Array) -> Array:
            given = [t, self._move(sides, corner, sides[corner] * margin, [t, x, *others]), *others]
            return self._rates(sides, self._field(sides, given)[0], given)

        return self._derive(("rates_at", corner), sides, evaluate)

    def onto(self, sides: Sides, corner: int) -> Function:
        """Return the point of a corner that is the nearest to the given one, to first order: (n,)."""
        return self._derive(("onto", corner), sides, lambda *given: self._move(sides, corner, 0.0, given))

    def beyond(self, sides: Sides, corner: int) -> Function:
        """Return the field of a branch, (n,), at a point beyond one of its corners that is near to the given one."""

        def evaluate(t: Array, x: Array, *others: Array) -> Array:
            given = [t, x, *others]
            g = self.surfaces(sides).evaluate(given)[corner]
            there = self._move(sides, corner, -sides[corner] * (abs(g) + BEYOND), given)
            return self._field(sides, [t, there, *others])[0]

        return self._derive(("beyond", corner), sides, evaluate)

    def list_ends(self, sides: Sides) -> list[tuple[int, int]]:
        """Return the corner at each end of a branch, and its side behind the end.

        The function of an end, of (t, x, p), is positive inside and zero at the end.
        """
        return [(k, behind) for k, side in enumerate(sides) for behind in ((-side,) if side else (-1, 1))]

    def ends(self, sides: Sides) -> Function:
        """Return the functions of all ends of a branch, (ends,)."""
        return self._derive("ends", sides, lambda *given: jnp.stack(self._ends(sides, given)))

    def end(self, sides: Sides, which: int) -> Function:
        """Return the function of one of the ends of a branch, ()."""
        return self._derive(("end", which), sides, lambda *given: self._ends(sides, given)[which])

    def _derive(self, what: Any, sides: Sides, evaluate: Any) -> Function:
        key = what, sides
        if key not in self._derived:
            with use_float64():
                self._derived[key] = self.function.derive(evaluate)
        return self._derived[key]

    def _run(self, sides: Sequence[int] | None, given: Sequence[Any]) -> tuple[_Walk, Any]:
        walk, function = _Walk(sides), self.function
        with use_float64():
            arguments = [walk.argument(k, value) for k, value in enumerate(given)]  # the state comes after t
            results = walk.run(function.jaxpr, function.consts, arguments)
        return walk, jnp.asarray(_join(results[0].value))

    def _evaluate(self, sides: Sides, given: Sequence[Any]) -> tuple[Array, list[Array]]:
        """Return f (n,), and g of each corner."""
        # Members of a group compare the same two numbers, maybe in the other order: `o` is -1 then.
        members = [o * sides[g] for g, o in zip(self._group, self._orientation, strict=True)]
        t, x, *others = given
        own = [others[0][0], *others[1:]] if self.function.takes_input else others  # of u and du/dt, the mode takes u
        walk, f = self._run(members, [t, x, *own])
        return f, [a - b for a, b in (walk.values[k] for k in self._firsts)]

    def _field(self, sides: Sides, given: Sequence[Any]) -> tuple[Array, list[Array]]:
        """Return the field of a branch (n,), and s of its sliding corners."""
        sliding, (f, *others) = self._slide(sides, given)
        if not sliding:
            return f, []
        # dg_i/dt is linear in f, so that dg/dt = 0 along f_0 + sum_k s_k (f_k - f_0) is A s = -rate_0 with
        # A_ij = rate_j,i - rate_0,i.
        rate = [self._rates(_settle(sides), field, given)[jnp.array(sliding)] for field in (f, *others)]
        A = [[rate[1 + j][i] - rate[0][i] for j in range(len(sliding))] for i in range(len(sliding))]
        s = _solve(A, [-rate[0][i] for i in range(len(sliding))])
        return f + sum(each * (other - f) for each, other in zip(s, others, strict=True)), s

    def _slide(self, sides: Sides, given: Sequence[Any]) -> tuple[list[int], list[Array]]:
        """Return the sliding corners; f_0 with side -1 at all of them, and f_k with side +1 at one of them alone."""
        sliding, base = [k for k, side in enumerate(sides) if side == 0], _settle(sides)
        every = base, *((*base[:k], 1, *base[k + 1 :]) for k in sliding)
        return sliding, [self._guard(each).evaluate(given) for each in every]

    def returns(self, sides: Sides) -> Function:
        """Return what is left of a small displacement from a branch that slides once the trajectory is back: (n, n).

        Of x it is ``x - sum_k c_k (f_k - f_0)``, with c such that D_x g of the sliding corners along it is zero.
        """

        def evaluate(t: Array, x: Array, *others: Array) -> Array:
            sliding, (f, *fields) = self._slide(sides, [t, x, *others])
            g_x = jax.jacfwd(lambda x: self.surfaces(sides).evaluate([t, x, *others]))(x)
            A = [[g_x[i] @ (field - f) for field in fields] for i in sliding]
            c = _solve(A, [g_x[i] for i in sliding])
            return jnp.eye(len(x)) - sum(jnp.outer(field - f, each) for field, each in zip(fields, c, strict=True))

        return self._derive("returns", sides, evaluate)

    def _guard(self, sides: Sides) -> Function:
        """Return the mode with these sides, at steep corners no nearer than their margins: traced once for all uses."""

        def evaluate(t: Array, x: Array, *others: Array) -> Array:
            for (k, side), margin in self.margins:
                if sides[k] == side:
                    is_near = side * self.surfaces(sides).evaluate([t, x, *others])[k] < margin
                    x = jnp.where(is_near, self._move(sides, k, side * margin, [t, x, *others]), x)
            return self._evaluate(sides, [t, x, *others])[0]

        return self._derive("guard", sides, evaluate)

    def _move(self, sides: Sides, corner: int, target: Any, given: Sequence[Any]) -> Array:
        """Return the state nearest to x at which g of a corner is the target, to first order in g: (n,)."""
        t, x, *others = given
        g, gradient = jax.value_and_grad(lambda x: self.surfaces(sides).evaluate([t, x, *others])[corner])(x)
        square = jnp.sum(gradient**2)
        return x - (g - target) * gradient / jnp.where(square > 0, square, 1.0)

    def _rates(self, sides: Sides, f: Array, given: Sequence[Any]) -> Array:
        """Return D_t g + D_x g . f + D_u g . du/dt of all corners: (count,)."""
        t, x, *others = given
        moving, rates = [t, x], [jnp.ones_like(t), f]
        if self.function.takes_input:
            u, *others = others
            moving, rates = [*moving, u], [*rates, jnp.stack([u[1], jnp.zeros_like(u[1])])]
        # The derivative of g along (1, f, du/dt): one forward pass.
        surfaces = lambda *moving: self.surfaces(sides).evaluate([*moving, *others])  # noqa: E731
        return jax.jvp(surfaces, moving, rates)[1]

    def _ends(self, sides: Sides, given: Sequence[Any]) -> list[Array]:
        g = self.surfaces(sides).evaluate(given)
        s = iter(self._field(sides, given)[1])
        # Of a corner with a side: side g, positive inside. Of a sliding one: s and 1 - s, the limits of the convex
        # combination.
        ends = [[side * g[k]] if side else [each := next(s), 1.0 - each] for k, side in enumerate(sides)]
        return [value for each in ends for value in each]

    def choose(self, t: Array, x: Array, *others: Array) -> Array:
        """Return the function on the sides on which x is: others are evaluated where they are defined, and left out."""
        g, chosen = self._evaluate((1,) * self.count, [t, x, *others])[1], jnp.zeros(self.function.shape)
        for sides in product((1, -1), repeat=self.count):
            is_here, there = jnp.array(True), x
            for k, side in enumerate(sides):
                is_inside, target = side * g[k] > 0, side * (abs(g[k]) + TOUCHED)
                there = jnp.where(is_inside, there, self._move(sides, k, target, [t, there, *others]))
                is_here &= (g[k] > 0) == (side > 0)
            chosen = jnp.where(is_here, self._evaluate(sides, [t, there, *others])[0], chosen)
        return chosen


class _Timed(Walk):
    """Evaluates what follows from t, the input and fixed parameters; None stands for all else.

    Attributes
    ----------
    gaps : two lists of arrays, the functions g of corners at which values bend, and at which they may jump
    """

    def __init__(self) -> None:
        self.gaps: tuple[list[Array], list[Array]] = [], []

    def apply(self, equation: Any, given: list[Any], origin: Any) -> Sequence[Any]:
        name, params = equation.primitive.name, equation.params
        is_search, inner = params.get("name") == "searchsorted", params.get("jaxpr", params.get("call_jaxpr"))
        if name == "cond":
            for branch in params["branches"]:
                self.enter(equation, branch, given[1:], origin)
        elif inner is not None and name not in NO_CALLS and not is_search:
            return self.enter(equation, inner, given, origin)
        if any(value is None for value in given) or name.endswith("callback"):
            return [None] * len(equation.outvars)
        if is_search and np.shape(given[0]) <= (MOST_KNOTS,):
            self.gaps[0].append(given[1][..., None] - given[0])
        elif name in CORNERS and equation.invars[-1].aval.dtype == np.float64:
            a, *others = given[1:2] + given[::2] if name == "clamp" else given
            gaps = [a - b for b in others or [0.0]]
            gaps = [jnp.sin(np.pi * (a + ROUNDED[name][0]))] if name in ROUNDED else gaps
            self.gaps[name not in ("max", "min", "clamp", "abs")].extend(gaps)
        return evaluate(equation, given)


NO_CALLS = frozenset({"scan", "while", "reduce", "reduce_window"})
"""Operations that do not run a jaxpr once, for their own operands."""


@lru_cache(maxsize=256)
def compile_timed_corners(function: Function, known: tuple[str, ...]) -> Callable[..., list[Array]] | None:
    """Return a compiled function of times (L,), an input (L, ...) in a list and the values of some parameters that are
    read: g of the corners that follow from them alone, (L, k) of bends and (L, l) of jumps. None without such corners.
    """

    def evaluate(t: Array, u: Sequence[Array], values: Sequence[Array]) -> list[Array]:
        walk, named = _Timed(), dict(zip(known, values, strict=True))
        parameters = [named.get(name) for name in function.parameters]
        walk.run(function.jaxpr, function.consts, [t, None, *u[: function.takes_input], *parameters])
        return [jnp.concatenate([jnp.zeros(0), *map(jnp.ravel, gaps)]) for gaps in walk.gaps]

    if not _has_corners(function.jaxpr):
        return None
    structs = dict(zip(function.parameters[::-1], function.structs[::-1], strict=False))
    with use_float64():
        found = jax.eval_shape(evaluate, function.structs[0], function.structs[2:3], [structs[name] for name in known])
    return jax.jit(jax.vmap(evaluate, in_axes=(0, 0, None))) if any(each.size for each in found) else None


STEEP = frozenset({"sqrt", "rsqrt", "cbrt", "log", "log1p", "pow", "acos", "asin", "acosh", "atanh"})
"""Operations whose slope may be infinite where they begin to be defined."""

MOST_CHOSEN = 3
"""Most corners of a function that is written as a choice among its branches."""

TOUCHED = 1e-12
"""|g| at which an output is evaluated at a corner."""


def choose_sides(function: Function) -> Function:
    """Return an output h(t, x, p) that has derivatives on both sides of its corners.

    Those of ``sqrt(maximum(x, 0))`` are NaN for x < 0, where an infinite slope is multiplied by 0.
    """
    names = {equation.primitive.name for each in list_jaxprs(function.jaxpr) for equation in each.eqns}
    corners = find_corners(function) if names & STEEP else None
    if corners is None or not 0 < corners.count <= MOST_CHOSEN:
        return function
    with use_float64():
        return function.derive(corners.choose)


def _settle(sides: Sides) -> Sides:
    """Return sides with -1 for those that slide."""
    return tuple(side or -1 for side in sides)


def _solve(A: list[list[Any]], b: list[Any]) -> list[Any]:
    """Solve linear equations by elimination, without pivoting: A_kk < 0 where corner k attracts from both sides."""
    (pivot, *right), *rest = A
    parts = [row[0] / pivot for row in rest]
    inner = [[a - part * c for a, c in zip(row[1:], right, strict=True)] for row, part in zip(rest, parts, strict=True)]
    others = _solve(inner, [each - part * b[0] for each, part in zip(b[1:], parts, strict=True)]) if rest else []
    return [(b[0] - sum(c * s for c, s in zip(right, others, strict=True))) / pivot, *others]


@lru_cache(maxsize=256)
def find_corners(function: Function, margins: Margins = ()) -> Corners:
    """Return the corners of a mode, some of them steep, found once."""
    return Corners(function, margins)
