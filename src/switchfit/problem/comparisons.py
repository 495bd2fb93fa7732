"""Find where the functions of a problem compare with a parameter, round it, or have a corner in it.

``jnp.where(t < p["t_on"], a, b)`` jumps as ``t_on`` passes t, and derivatives do not include that jump. `jnp.maximum`,
`jnp.clip` and `jnp.interp` compare too, but do not jump: they are not found, nor is what has a derivative rule of its
own. Only what the trace proves is found: that a value depends on a parameter, directly and not by the state.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from switchfit.arrays import Traced
from switchfit.problem.corners.branches import find_corners
from switchfit.problem.functions import Function
from switchfit.problem.jaxprs import Walk, find_line, find_public_name, strip_constants
from switchfit.problem.problem import Problem, keep_with_problem
from switchfit.runtime.jax_internals import ClosedJaxpr, Equation, Jaxpr, array_type

VERBS = {
    **dict.fromkeys(("lt", "le", "gt", "ge", "eq", "ne", "lt_to", "le_to"), "compares with"),
    "sign": "takes the sign of what depends on",
    **dict.fromkeys(("floor", "ceil", "round", "convert_element_type"), "rounds what depends on"),
}
"""Operations that jump, and what a function does by them."""

SMOOTH_FUNCTIONS = ("jnp.interp",)
"""Functions of JAX that compare without a jump of their value."""

Names = frozenset[str]
NO_PARAMETERS: Names = frozenset()

BENDS = frozenset({"max", "min", "clamp", "abs"})
"""Operations that are continuous, and have a corner."""

STATE = ""
"""Stands for the state among the names of parameters."""


@keep_with_problem
def find_comparisons(problem: Problem) -> dict[int, str]:
    """Return by which function and where an unknown is compared, such as "mode 'on' compares with t_on at model.py:12".

    By its index in theta, for all with which a function of the problem's sequences compares; transition times and
    initial states are never among them.

    Parameters
    ----------
    problem : Problem
    """
    return _find_places(problem)


def find_bends(problem: Problem) -> dict[int, str]:
    """Return what `find_comparisons` does, with the operations that bend alone, such as ``maximum``.

    Parameters
    ----------
    problem : Problem
    """
    return _find_places(problem, bends=True)


def _find_places(problem: Problem, bends: bool = False) -> dict[int, str]:
    found: dict[str, str] = {}
    for run, structure in zip(problem.experiments, problem.structures, strict=True):
        for role, function in structure.acting.items():
            # Where a mode compares with its state, rows end, and derivatives have all of it: see `corners`.
            for parameter, what in list_comparisons(function, with_state=not role.startswith("mode "), bends=bends):
                found.setdefault(run.parameter_map.get(parameter, parameter), f"{role} {what}")
    spans = problem.unknowns.parameters.items()
    return {i: found[name] for name, span in spans if name in found for i in range(span.start, span.stop)}


@keep_with_problem
def find_cost_corner(problem: Problem) -> str:
    """Return which running cost has a corner of the state, such as "RunningCost 1 has a corner at model.py:12"; empty
    if none has.

    Parameters
    ----------
    problem : Problem
    """
    for structure in problem.structures:
        for k, ell in enumerate(structure.running, start=1):
            if lines := find_corners(ell).lines:
                return f"RunningCost {k} has a corner{lines[0] and f' at {lines[0]}'}"
    return ""


@lru_cache(maxsize=1024)
def list_comparisons(function: Function, with_state: bool = True, bends: bool = False) -> tuple[tuple[str, str], ...]:
    """Return the parameters with which a function compares, in the order of its operations, and what it does, such as
    "compares with k at model.py:12".

    Parameters
    ----------
    function : Function
    with_state : bool
        Whether a comparison of the state, the second argument, with a parameter counts.
    bends : bool
        Whether operations that only bend count too.
    """
    others = [NO_PARAMETERS] * (len(function.jaxpr.invars) - len(function.parameters))
    if not with_state:
        others[1] = frozenset({STATE})
    walk = _Comparing(bends)
    walk.run(function.jaxpr, function.consts, [*others, *(frozenset({name}) for name in function.parameters)])
    return tuple(dict.fromkeys(walk.found))


class _Comparing(Walk[Names]):
    """Finds the comparisons of a function; what it follows are the parameters on which values depend."""

    def __init__(self, bends: bool) -> None:
        self._bends = bends
        self.found: list[tuple[str, str]] = []

    def constant(self, value: Traced) -> Names:
        return NO_PARAMETERS

    def apply(self, equation: Equation, given: list[Names], origin: Equation) -> list[Names]:
        names = NO_PARAMETERS.union(*given)
        is_bend = self._bends and equation.primitive.name in BENDS
        if (is_bend or _jumps(equation)) and STATE not in names:
            verb, line = VERBS.get(equation.primitive.name, "bends with"), find_line(origin)
            self.found += [(name, f"{verb} {name}{line and f' at {line}'}") for name in sorted(names)]
        # Without a walk inside, a result depends on all that its operands depend on: more than is true, and a
        # comparison may be named that is none. So calls are followed, whose results may depend on less.
        results = [names] * len(equation.outvars)
        for inner, own in _list_calls(equation, given):
            if find_public_name(inner) not in SMOOTH_FUNCTIONS:
                made = self.enter(equation, inner, own, origin)
                results = made if len(made) == len(results) else results
        return results


def _jumps(equation: Equation) -> bool:
    """Return whether an operation jumps: a comparison other than that of a number with itself, or rounding."""
    name = equation.primitive.name
    if name == "convert_element_type":
        kinds = array_type(equation.invars[0]).dtype.kind, np.dtype(equation.params["new_dtype"]).kind
        return kinds[0] == "f" and kinds[1] in "iub"
    return name in VERBS and (len(equation.invars) < 2 or equation.invars[0] is not equation.invars[1])


def _list_calls(equation: Equation, given: list[Names]) -> Iterator[tuple[Jaxpr | ClosedJaxpr, list[Names]]]:
    """Yield the jaxprs that an operation runs, with the parameters on which their arguments depend."""
    params = equation.params
    if equation.primitive.name == "while":
        # Operands of a loop: constants of the condition, constants of the body, then what goes round.
        first, second = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
        yield params["cond_jaxpr"], given[:first] + given[second:]
        yield params["body_jaxpr"], given[first:]
    elif equation.primitive.name == "cond":
        for branch in params["branches"]:
            yield branch, given[1:]
    elif "jaxpr" in params:  # calls and loops; custom derivatives have rules of their own
        inner = strip_constants(params["jaxpr"])
        if len(inner.invars) == len(given):
            yield params["jaxpr"], given
