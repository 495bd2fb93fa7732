"""Find the operation of a user's function whose value or derivative is not finite at a point.

``jnp.sqrt(jnp.maximum(x, 0.0))`` has a value at 0, but its slope there is infinite, and where the slope of the maximum
is 0 the product of both is NaN. The function is evaluated operation by operation: the first one whose operands are
finite, and whose value or whose first or second derivative is not, is the cause, if derivatives of the whole function
are not finite either. What grows without bound, as a product does, is none.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.problem.data import FloatArray
from switchfit.problem.functions import Function, use_float64
from switchfit.problem.jaxprs import find_line, find_public_name

GROWING = frozenset(
    {"add", "sub", "mul", "neg", "exp", "exp2", "expm1", "sinh", "cosh", "square", "dot_general", "reduce_sum"}
    | {"add_any", "reduce_prod", "cumsum", "cumprod"}
)
"""Operations that are defined everywhere, and overflow for large operands."""


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


class _Step(NamedTuple):
    """An operation, and whether its value, first and second derivative are finite at finite operands: (3,)."""

    operation: str
    line: str
    finite: jax.Array


def find_undefined(
    function: Function, arguments: Sequence[FloatArray], parameters: Mapping[str, Any], *, derivatives: bool = True
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
    check, steps = _compile(function, derivatives)
    with use_float64():
        named = [np.asarray(parameters[name], dtype=np.float64) for name in function.parameters]
        results = check([np.asarray(argument, dtype=np.float64) for argument in arguments], named)
    whole = np.asarray(results[0]).reshape(-1, 2)  # the value, and the derivatives
    finite = np.asarray(results[1]).reshape(len(whole), -1, 3)
    for point in np.flatnonzero(~whole.all(1)).tolist():
        wrong = np.argwhere(~finite[point])
        if wrong.size:
            k, order = wrong[0].tolist()
            operation, line = steps[k]
            return Undefined(point, operation, line, order, bool(whole[point, 0]))
    return None


@lru_cache(maxsize=64)
def _compile(function: Function, derivatives: bool) -> tuple[Callable[..., Any], list[tuple[str, str]]]:
    """Return a compiled check of a function at several points, and the operations that it checks, with their lines.

    The check returns whether the value of the function is finite, and its derivatives (N, 2), and those of each
    operation (N, K, 3).
    """
    checked: list[tuple[str, str]] = []

    def check(flat: list[Any], named: list[Any]) -> tuple[Any, Any]:
        given, steps = [*flat, *named], list[_Step]()
        depends = [derivatives and not (k == 0 and a.ndim == 0 and flat) for k, a in enumerate(given)]
        _walk(function.jaxpr, function.consts, given, depends, steps, "", "", jnp.array(True))
        checked[:] = [step[:2] for step in steps]
        finite = jnp.stack([step.finite for step in steps]) if steps else jnp.ones((0, 3), bool)
        return _is_finite(function, given, depends), finite

    points = len(function.jaxpr.invars) > len(function.parameters)
    return jax.jit(jax.vmap(check, in_axes=(0, None)) if points else check), checked


def _is_finite(function: Function, given: list[Any], depends: list[bool]) -> Any:
    """Return whether the value of a function is finite, and its first two derivatives in some arguments: (2,)."""

    def call(moving: list[Any]) -> Any:
        each = iter(moving)
        return function.evaluate([next(each) if moves else a for a, moves in zip(given, depends, strict=True)])

    moving = [a for a, moves in zip(given, depends, strict=True) if moves]
    derivatives = [jax.jacrev(call)(moving), jax.jacfwd(jax.jacrev(call))(moving)] if moving else []
    return jnp.stack([_are_finite([call(moving)]), _are_finite(jax.tree.leaves(derivatives))])


def _walk(
    jaxpr: Any,
    consts: Sequence[Any],
    given: Sequence[Any],
    depends: Sequence[bool],
    steps: list[_Step],
    caller: str,
    line: str,
    runs: Any,
) -> tuple[list[Any], list[bool]]:
    """Evaluate a jaxpr and add its operations to the steps; return its results, and which depend on what moves.

    Inside a function of JAX, `caller` and `line` are its name and that of the call. `runs` is whether this branch does.
    """
    values = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*consts, *given], strict=True))
    moving = dict(zip(jaxpr.invars, depends, strict=True))

    def value(atom: Any) -> Any:
        return atom.val if hasattr(atom, "val") else values[atom]

    def moves(atom: Any) -> bool:
        return not hasattr(atom, "val") and moving.get(atom, False)

    for equation in jaxpr.eqns:
        name, operands = equation.primitive.name, [value(atom) for atom in equation.invars]
        which = [moves(atom) for atom in equation.invars]
        results, results_move = _apply(jaxpr, equation, operands), [any(which)] * len(equation.outvars)
        if name in ("jit", "pjit"):
            inner = equation.params["jaxpr"]
            public = find_public_name(inner.jaxpr)
            here = (caller or public or "", line or (find_line(equation) if public else ""))
            results, results_move = _walk(inner.jaxpr, inner.consts, operands, which, steps, *here, runs)
        elif name == "cond":
            for k, branch in enumerate(equation.params["branches"]):
                taken = runs & (operands[0] == k)
                _walk(branch.jaxpr, branch.consts, operands[1:], which[1:], steps, caller, line, taken)
        elif name not in GROWING and not (name == "integer_pow" and equation.params["y"] > 0):
            finite = ~runs | ~_are_finite(operands) | _check_orders(jaxpr, equation, operands, which, results)
            steps.append(_Step(caller or name, line or find_line(equation), finite))
        values |= dict(zip(equation.outvars, results, strict=True))
        moving |= dict(zip(equation.outvars, results_move, strict=True))
    return [value(atom) for atom in jaxpr.outvars], [moves(atom) for atom in jaxpr.outvars]


def _apply(jaxpr: Any, equation: Any, operands: Sequence[Any]) -> list[Any]:
    """Return the results of an operation of a jaxpr, by its own rule for derivatives if it has one."""
    known = {atom: a for atom, a in zip(equation.invars, operands, strict=True) if not hasattr(atom, "val")}
    debug = jaxpr.debug_info.with_unknown_names()
    alone = jaxpr.replace(constvars=[], invars=list(known), outvars=equation.outvars, eqns=[equation], debug_info=debug)
    return list(jax.core.eval_jaxpr(alone, [], *known.values()))


def _check_orders(jaxpr: Any, equation: Any, operands: list[Any], which: list[bool], results: list[Any]) -> Any:
    """Return whether the value and the first two derivatives of an operation in some operands are finite: (3,)."""
    floats = [k for k, moves in enumerate(which) if moves and _is_float(operands[k])]

    def call(*moved: Any) -> list[Any]:
        made = _apply(jaxpr, equation, [moved[floats.index(k)] if k in floats else a for k, a in enumerate(operands)])
        return list(filter(_is_float, made))

    value = _are_finite(results)
    if not floats:
        return jnp.stack([value, jnp.array(True), jnp.array(True)])
    at = tuple(operands[k] for k in floats)
    ones = tuple(map(jnp.ones_like, at))

    def slope(*moved: Any) -> list[Any]:
        return jax.jvp(call, moved, ones)[1]

    return jnp.stack([value, _are_finite(slope(*at)), _are_finite(jax.jvp(slope, at, ones)[1])])


def _are_finite(values: Sequence[Any]) -> Any:
    """Return whether all floating-point numbers of some arrays are finite."""
    checked = [jnp.isfinite(value).all() for value in values if _is_float(value)]
    return jnp.stack(checked).all() if checked else jnp.array(True)


def _is_float(value: Any) -> bool:
    return bool(jnp.issubdtype(jnp.result_type(value), jnp.floating))
