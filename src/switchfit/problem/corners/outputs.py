"""Outputs with corners, written as a choice among their branches so that all derivatives are finite.

JAX differentiates both cases of a choice: where the slope of the one that is left out is infinite, as that of
``sqrt(maximum(x, 0))`` is for x < 0, the derivative is NaN.
"""

from __future__ import annotations

from switchfit.problem.corners.branches import find_corners
from switchfit.problem.functions import Function, use_float64
from switchfit.problem.jaxprs import list_jaxprs

STEEP_PRIMITIVES = frozenset({"sqrt", "rsqrt", "cbrt", "log", "log1p", "pow", "acos", "asin", "acosh", "atanh"})
"""Operations whose slope may be infinite where they begin to be defined."""

MOST_CHOSEN = 3
"""Most corners of a function that is written as a choice among its branches."""


def choose_sides(function: Function) -> Function:
    """Return an output h(t, x, p) that has derivatives on both sides of its corners.

    Those of ``sqrt(maximum(x, 0))`` are NaN for x < 0, where an infinite slope is multiplied by 0.
    """
    # Without an operation of infinite slope the derivative of the case left out is finite, and 0 times it is 0: the
    # function is right as it is, and shorter.
    names = {equation.primitive.name for each in list_jaxprs(function.jaxpr) for equation in each.eqns}
    corners = find_corners(function) if names & STEEP_PRIMITIVES else None
    # 2**count branches are evaluated for every sample; with many corners the function is left as it is, and
    # `finiteness` names the operation if a derivative is NaN.
    if corners is None or not 0 < corners.count <= MOST_CHOSEN:
        return function
    with use_float64():
        return function.derive(corners.choose)
