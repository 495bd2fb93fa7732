"""Find the operation of a user's function whose value or derivative is not finite at a point.

``jnp.sqrt(jnp.maximum(x, 0.0))`` has a value at 0, but its slope there is infinite, and where the slope of the maximum
is 0 the product of both is NaN. The function is evaluated operation by operation: the first one whose operands are
finite, and whose value or whose first or second derivative is not, is the cause, if derivatives of the whole function
are not finite either. An operation that grows without bound, as a product does, is never the cause.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.arrays import FloatArray, Traced
from switchfit.problem.functions import Function, use_float64
from switchfit.problem.jaxprs import Walk, evaluate, find_line, find_public_name
from switchfit.runtime.jax_internals import Equation

Followed = tuple[Traced, bool]
"""A value at a point, and whether it moves with what derivatives are taken in."""

GROWING = frozenset(
    {"add", "sub", "mul", "neg", "exp", "exp2", "expm1", "sinh", "cosh", "square", "dot_general", "reduce_sum"}
    | {"add_any", "reduce_prod", "cumsum", "cumprod"}
)
"""Operations that are defined everywhere, and overflow for large operands."""

MOST_CHECKED_POINTS = 20
"""Largest number of points at which the operations of a function are checked one by one."""


class Undefined(NamedTuple):
    """An operation that is not defined at a point, or has no finite derivative there.

    Attributes
    ----------
    point : int
        Index of the first such point, from 0.
    operation : str
        Name in JAX, such as "sqrt", or the public name of the function of JAX that calls it.
    line : str
        Place in the user's code, "file.py:12"; empty if it is unknown.
    order : int
        0 if its value is not finite, else the order of the derivative that is not.
    valued : bool
        Whether the value of the whole function is finite there.
    """

    point: int
    operation: str
    line: str
    order: int
    valued: bool


def find_undefined(
    function: Function,
    arguments: Sequence[FloatArray],
    parameters: Mapping[str, Traced],
    *,
    derivatives: bool = True,
) -> Undefined | None:
    """Return the first operation of a function that is not finite, at the first of some points; None if there is none.

    Parameters
    ----------
    function : Function
    arguments : sequence of (N, ...) arrays
        Values of its arguments other than the parameters at N points.
    parameters : mapping of str to array
        The same at all points.
    derivatives : bool
        Whether derivatives in the state, the input and the parameters have to be finite too.
    """
    if arguments:  # the last point once more and again: runs of similar length share a compiled check
        count = len(arguments[0])
        repeated = np.minimum(np.arange(1 << (count - 1).bit_length()), count - 1)
        arguments = [argument[repeated] for argument in arguments]
    with use_float64():
        given = [jnp.asarray(argument, dtype=jnp.float64) for argument in arguments]
        named = [jnp.asarray(parameters[name], dtype=jnp.float64) for name in function.parameters]
        # t is a number at each point, (N,): derivatives in it are no part of a fit.
        is_timed = bool(given) and given[0].ndim == 1
        moves = [derivatives and not (is_timed and k == 0) for k in range(len(given) + len(named))]
        check = _compile(function, tuple(np.flatnonzero(moves).tolist()), len(given))
        # First the function as a whole, compiled, at all points: nearly always finite, and then nothing more is to be
        # done.
        finite = np.asarray(check(given, named)).reshape(-1, 2)  # the value, and the derivatives
        for point in np.flatnonzero(~finite.all(1))[:MOST_CHECKED_POINTS].tolist():
            # Then operation by operation, in Python, at the few points where it is not.
            walk = _Checking()
            values = [*(argument[point] for argument in given), *named]
            walk.run(function.jaxpr, function.consts, list(zip(values, moves, strict=True)))
            if walk.found is not None:
                return Undefined(point, *walk.found, valued=bool(finite[point, 0]))
    return None


@lru_cache(maxsize=64)
def _compile(function: Function, moving: tuple[int, ...], varying: int) -> Callable[..., jax.Array]:
    """Return a compiled check whether the value of a function is finite, and its derivatives in some of its arguments,
    at each point: (N, 2).
    """

    def call(*every: Traced) -> Traced:
        return function.evaluate(every)

    slope = jax.jacrev(call, moving)

    def check(given: list[Traced], named: list[Traced]) -> Traced:
        every = [*given, *named]
        derivatives = [slope(*every), jax.jacfwd(slope, moving)(*every)] if moving else []
        return jnp.stack([_are_finite([call(*every)]), _are_finite(jax.tree.leaves(derivatives))])

    return jax.jit(jax.vmap(check, in_axes=(0, None)) if varying else check)


class _Checking(Walk[Followed]):
    """Evaluates a function at a point, and checks its operations; what it follows are values, and whether they move.

    Attributes
    ----------
    found : tuple (operation, line, order) or None
        The first operation that is not finite at finite operands.
    """

    def __init__(self) -> None:
        self.found: tuple[str, str, int] | None = None

    def constant(self, value: Traced) -> Followed:
        return value, False

    def apply(self, equation: Equation, given: list[Followed], origin: Equation) -> list[Followed]:
        name = equation.primitive.name
        operands, which = [value for value, _ in given], [moves for _, moves in given]
        if name in ("jit", "pjit"):
            return self.enter(equation, equation.params["jaxpr"], given, origin)
        # Only the branch that runs at this point: the other one may be undefined here by intention.
        if name == "cond":
            branches = equation.params["branches"]
            return self.enter(equation, branches[int(np.clip(operands[0], 0, len(branches) - 1))], given[1:], origin)
        results = evaluate(equation, operands)
        # ``exp(1000)`` is infinite, and so is ``1e200 * 1e200``: consequences of a state that ran away, not of the
        # function.
        is_growing = name in GROWING or (name == "integer_pow" and equation.params["y"] > 0)
        # The first one with finite operands is the cause; all behind it inherit its NaN.
        if self.found is None and not is_growing and _are_finite(operands):
            order = _find_order(equation, operands, which, results)
            if order is not None:
                called = None if origin is equation else origin.params.get("jaxpr")
                caller = None if called is None else find_public_name(called)
                self.found = caller or name, find_line(origin), order
        return [(result, any(which)) for result in results]


def _find_order(equation: Equation, operands: list[Traced], which: list[bool], results: list[Traced]) -> int | None:
    """Return the order of the first derivative of an operation in some operands that is not finite, 0 for its value."""
    # Along all operands that move at once: one pass for each order, and what is infinite along one axis is so along a
    # sum of all but by cancellation.
    floats = [k for k, moves in enumerate(which) if moves and _is_float(operands[k])]

    def call(*moved: Traced) -> list[Traced]:
        made = evaluate(equation, [moved[floats.index(k)] if k in floats else a for k, a in enumerate(operands)])
        return list(filter(_is_float, made))

    at = tuple(operands[k] for k in floats)
    ones = tuple(map(jnp.ones_like, at))

    def slope(*moved: Traced) -> list[Traced]:
        return jax.jvp(call, moved, ones)[1]

    # Lazily: a value that is not finite needs no derivative to be looked at.
    orders = (lambda: results, lambda: slope(*at), lambda: jax.jvp(slope, at, ones)[1])
    return next((order for order, find in enumerate(orders if floats else orders[:1]) if not _are_finite(find())), None)


def _are_finite(values: Sequence[Traced]) -> Traced:
    """Return whether all floating-point numbers of some arrays are finite."""
    checked = [jnp.isfinite(value).all() for value in values if _is_float(value)]
    return jnp.stack(checked).all() if checked else jnp.array(True)


def _is_float(value: Traced) -> bool:
    return bool(jnp.issubdtype(jnp.result_type(value), jnp.floating))
