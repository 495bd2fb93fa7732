"""Find numbers of single precision inside the user's functions.

By default JAX computes in 32 bits, so that ``K = jnp.array(0.1)`` is 0.10000000149011612: a fit with it solves another
problem. Constants that a function reads, and numbers computed from them, have to pass
`switchfit.problem.validation.refuse_single_precision`; values that depend on t, x or p must not be cast at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import numpy as np

from switchfit.problem.jaxprs import find_inner_jaxprs, follow_constants, list_jaxprs, write_line
from switchfit.problem.validation import is_low_precision, refuse_single_precision

MOVES = frozenset(
    {"slice", "squeeze", "reshape", "broadcast_in_dim", "transpose", "concatenate", "rev", "gather", "stack", "copy"}
    | {"dynamic_slice", "expand_dims", "select_n", "split", "unstack", "stop_gradient", "pad", "tile", "copy_p"}
)
"""Operations that only move entries."""


def refuse_single_precision_in(closed: Any, what: str) -> None:
    """Raise ValueError if a traced function uses numbers that lost digits, or computes in less than double precision.

    Parameters
    ----------
    closed : jaxpr of the function
    what : str, such as "mode 'slip'"
    """
    every = (equation for jaxpr in list_jaxprs(closed.jaxpr) for equation in jaxpr.eqns)
    if any(_is_short(atom) for equation in every for atom in (*equation.invars, *equation.outvars)):
        unknown = [None] * len(closed.jaxpr.invars)
        follow_constants(closed.jaxpr, closed.consts, unknown, _evaluate, partial(_check, what))


def _is_short(atom: Any) -> bool:
    return is_low_precision(getattr(atom.aval, "dtype", np.float64))


def _evaluate(equation: Any, given: list[Any]) -> Sequence[Any] | None:
    """Return the results of an operation of known numbers."""
    if equation.effects:
        return None
    with jax.ensure_compile_time_eval():
        made = equation.primitive.bind(*given, **equation.params)
    return made if equation.primitive.multiple_results else [made]


def _check(what: str, equation: Any, given: list[Any], results: Sequence[Any]) -> None:
    """Raise ValueError if a known number of an operation lost digits, or an unknown one is cast."""
    for number in given:
        refuse_single_precision(number, f"a constant of {what}{write_line(equation)}")
    if equation.primitive.name in MOVES:
        return
    for variable, result in zip(equation.outvars, results, strict=True):
        if result is not None:
            refuse_single_precision(result, f"a constant of {what}{write_line(equation)}")
        elif _is_short(variable) and not find_inner_jaxprs(equation):
            raise ValueError(
                f"{what} computes in {variable.aval.dtype}{write_line(equation)} with numbers that depend on t, x or "
                "p, and so loses half of their digits: its arguments are float64, do not cast them."
            )
