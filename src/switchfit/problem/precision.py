"""Find numbers of single precision inside the user's functions.

By default JAX computes in 32 bits, so that ``K = jnp.array(0.1)`` is 0.10000000149011612: a fit with it solves another
problem. Constants that a function reads, and numbers computed from them, have to pass
`switchfit.problem.validation.refuse_single_precision`; values that depend on t, x or p must not be cast at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np

from switchfit.problem.jaxprs import find_inner_jaxprs, write_line
from switchfit.problem.reads import find_named_values
from switchfit.problem.validation import is_low_precision, refuse_single_precision

MOVES = frozenset(
    {"slice", "squeeze", "reshape", "broadcast_in_dim", "transpose", "concatenate", "rev", "gather", "stack", "copy"}
    | {"dynamic_slice", "expand_dims", "select_n", "split", "unstack", "stop_gradient", "pad", "tile", "copy_p"}
)
"""Operations that only move entries."""


def refuse_single_precision_in(closed: Any, function: Any, what: str) -> None:
    """Raise ValueError if a traced function uses numbers that lost digits, or computes in less than double precision.

    Parameters
    ----------
    closed : jaxpr of the function
    function : callable, to find the names of its constants
    what : str, such as "mode 'slip'"
    """
    for name, value in find_named_values(function).items():
        if isinstance(value, (np.ndarray, np.generic, jax.Array)):
            refuse_single_precision(value, f"the constant {name} of {what}")
    if _has_short(closed.jaxpr, closed.consts):
        _Walk(what).through(closed.jaxpr, closed.consts, [None] * len(closed.jaxpr.invars))


def _has_short(jaxpr: Any, consts: Sequence[Any]) -> bool:
    if any(is_low_precision(v.aval.dtype) for v in (*jaxpr.constvars, *jaxpr.invars) if hasattr(v.aval, "dtype")):
        return True
    for equation in jaxpr.eqns:
        for atom in (*equation.invars, *equation.outvars):
            if is_low_precision(getattr(atom.aval, "dtype", np.float64)):
                return True
        if any(_has_short(*inner) for inner in find_inner_jaxprs(equation)):
            return True
    return False


class _Walk:
    """Propagates known numbers through a jaxpr and checks their precision."""

    def __init__(self, what: str) -> None:
        self.what = what

    def through(self, jaxpr: Any, consts: Sequence[Any], arguments: Sequence[Any]) -> list[Any]:
        """Return the values of the results, None where they depend on the arguments."""
        known: dict[Any, Any] = dict(zip(jaxpr.constvars, consts, strict=True))
        known |= {v: a for v, a in zip(jaxpr.invars, arguments, strict=True) if a is not None}
        for const in consts:
            self.check(const)

        def value(atom: Any) -> Any:
            return atom.val if hasattr(atom, "val") else known.get(atom)

        for equation in jaxpr.eqns:
            given = [value(a) for a in equation.invars]
            for atom, number in zip(equation.invars, given, strict=True):
                if hasattr(atom, "val"):
                    self.check(number)
            inner = find_inner_jaxprs(equation)
            if inner:
                results = self.calls(equation, inner, given)
            elif all(g is not None for g in given) and not equation.effects:
                with jax.ensure_compile_time_eval():
                    made = equation.primitive.bind(*given, **equation.params)
                results = list(made) if equation.primitive.multiple_results else [made]
            else:
                results = [None] * len(equation.outvars)
            for variable, result in zip(equation.outvars, results, strict=True):
                if result is not None:
                    known[variable] = result
                if (
                    is_low_precision(getattr(variable.aval, "dtype", np.float64))
                    and equation.primitive.name not in MOVES
                ):
                    if result is not None:
                        self.check(result, write_line(equation))
                    elif not inner:
                        self.refuse_cast(variable, equation)
        return [value(a) for a in jaxpr.outvars]

    def calls(self, equation: Any, inner: list[Any], given: list[Any]) -> list[Any]:
        """Walk through the functions that an operation calls: a plain call with its known arguments, loops without."""
        for jaxpr, consts in inner:
            plain = len(inner) == 1 and len(jaxpr.invars) == len(given) and equation.primitive.name == "jit"
            results = self.through(jaxpr, consts, given if plain else [None] * len(jaxpr.invars))
        return results if plain else [None] * len(equation.outvars)

    def check(self, number: Any, where: str = "") -> None:
        """Raise ValueError if a known number lost digits."""
        refuse_single_precision(number, f"a constant of {self.what}{where}")

    def refuse_cast(self, variable: Any, equation: Any) -> None:
        raise ValueError(
            f"{self.what} computes in {variable.aval.dtype}{write_line(equation)} with numbers that depend on t, x or "
            "p, and so loses half of their digits: its arguments are float64, do not cast them."
        )
