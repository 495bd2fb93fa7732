"""Corners that follow from t, the input and fixed parameters alone, such as those of ``clip(u, -2, 2)``.

They are compiled as functions of time. The times at which they are met are known before anything runs, and are nodes of
every mesh: `switchfit.problem.corners.times` finds them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.arrays import Traced
from switchfit.problem.corners.walk import CORNER_PRIMITIVES, MOST_KNOTS, ROUNDED, has_corners
from switchfit.problem.functions import Function, use_float64
from switchfit.problem.jaxprs import Walk, evaluate
from switchfit.runtime.jax_internals import Equation, array_type

Array = jax.Array

NO_CALLS = frozenset({"scan", "while", "reduce", "reduce_window"})
"""Operations that do not run a jaxpr once, for their own operands."""


class _Timed(Walk[Array | None]):
    """Evaluates what follows from t, the input and fixed parameters; None stands for all else.

    Attributes
    ----------
    gaps : two lists of arrays, the functions g of corners at which values bend, and at which they may jump
    """

    def __init__(self) -> None:
        self.gaps: tuple[list[Array], list[Array]] = [], []

    def apply(self, equation: Equation, given: list[Traced], origin: Equation) -> Sequence[Traced]:
        name, params = equation.primitive.name, equation.params
        # Of the branches of a `cond` all are looked at: which of them runs may depend on the state, which is unknown
        # here.
        is_search, inner = params.get("name") == "searchsorted", params.get("jaxpr", params.get("call_jaxpr"))
        if name == "cond":
            for branch in params["branches"]:
                self.enter(equation, branch, given[1:], origin)
        elif inner is not None and name not in NO_CALLS and not is_search:
            return self.enter(equation, inner, given, origin)
        # An operand that follows from the state makes the result unknown; so does a callback, which may read anything.
        if any(value is None for value in given) or name.endswith("callback"):
            return [None] * len(equation.outvars)
        if is_search and np.shape(given[0]) <= (MOST_KNOTS,):
            self.gaps[0].append(given[1][..., None] - given[0])
        elif name in CORNER_PRIMITIVES and array_type(equation.invars[-1]).dtype == np.float64:
            a, *others = given[1:2] + given[::2] if name == "clamp" else given
            gaps = [a - b for b in others or [0.0]]
            # ``floor(t)`` jumps where sin(pi t) = 0: one function for all integers.
            gaps = [jnp.sin(np.pi * (a + ROUNDED[name][0]))] if name in ROUNDED else gaps
            # A field is continuous at a bend, as of ``clip(u, -2, 2)``, and not at a jump, as of ``t > 3``: who makes
            # the nodes has to tell the two apart.
            self.gaps[name not in ("max", "min", "clamp", "abs")].extend(gaps)
        return evaluate(equation, given)


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

    if not has_corners(function.jaxpr):
        return None
    structs = dict(zip(function.parameters[::-1], function.structs[::-1], strict=False))
    with use_float64():
        # Shapes alone, without compiling: most functions with a comparison have it with the state, and need nothing
        # here.
        found = jax.eval_shape(evaluate, function.structs[0], function.structs[2:3], [structs[name] for name in known])
    return jax.jit(jax.vmap(evaluate, in_axes=(0, 0, None))) if any(each.size for each in found) else None
