"""Find where the functions of a problem compare with a parameter, or round it, in their traces.

``jnp.where(t < p["t_on"], a, b)`` jumps as ``t_on`` passes t, and derivatives do not include that jump. `jnp.maximum`,
`jnp.clip` and `jnp.interp` compare too, but do not jump: they are not found, nor is what has a derivative rule of its
own. Only what the trace proves is found: that a value depends on a parameter, directly and not by the state.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from switchfit.problem.functions import Function
from switchfit.problem.jaxprs import find_line, find_public_name
from switchfit.problem.problem import Problem, keep_with_problem

VERBS = {
    **dict.fromkeys(("lt", "le", "gt", "ge", "eq", "ne", "lt_to", "le_to"), "compares with"),
    "sign": "takes the sign of what depends on",
    **dict.fromkeys(("floor", "ceil", "round", "convert_element_type"), "rounds what depends on"),
}
"""Operations that jump, and what a function does by them."""

SMOOTH = ("jnp.interp",)
"""Functions of JAX that compare without a jump of their value."""

Names = frozenset[str]
NONE: Names = frozenset()

STATE = ""
"""Stands for the state among the names of parameters."""


class Comparison(NamedTuple):
    """A comparison with a parameter in a traced function.

    Attributes
    ----------
    parameter : str
    verb : str
        One of `VERBS`.
    line : str
        Place in the user's code, "file.py:12"; empty if it is unknown.
    """

    parameter: str
    verb: str
    line: str


def find_comparison(problem: Problem, i: int) -> str | None:
    """Return which function compares with an unknown and where, "mode 'on' compares with t_on at model.py:12".

    None for a transition time and an initial state, and if no function of the problem's sequences does.

    Parameters
    ----------
    problem : Problem
    i : int
        Index of the unknown in theta.
    """
    return find_comparisons(problem).get(i)


@keep_with_problem
def find_comparisons(problem: Problem) -> dict[int, str]:
    """Return what `find_comparison` says of each unknown of a problem with which a function compares."""
    found: dict[str, str] = {}
    for run, structure in zip(problem.experiments, problem.structures, strict=True):
        idle = {f"mode {name!r}" for k, name in enumerate(structure.mode_names) if k not in structure.mode_of_segment}
        for role, function in structure.roles.items():
            # Where a mode compares with its state, rows end, and derivatives have all of it: see `corners`.
            own = list_comparisons(function, with_state=not role.startswith("mode ")) if role not in idle else ()
            for parameter, verb, line in own:
                name = run.parameter_map.get(parameter, parameter)
                found.setdefault(name, f"{role} {verb} {parameter}{f' at {line}' if line else ''}")
    spans = problem.unknowns.parameters.items()
    return {i: found[name] for name, span in spans if name in found for i in range(span.start, span.stop)}


@lru_cache(maxsize=1024)
def list_comparisons(function: Function, with_state: bool = True) -> tuple[Comparison, ...]:
    """Return the comparisons of a function with its parameters, in the order of its operations.

    Parameters
    ----------
    function : Function
    with_state : bool
        Whether a comparison of the state, the second argument, with a parameter counts.
    """
    found: list[Comparison] = []
    others = [NONE] * (len(function.jaxpr.invars) - len(function.parameters))
    if not with_state:
        others[1] = frozenset({STATE})
    _walk(function.jaxpr, [*others, *(frozenset({name}) for name in function.parameters)], "", found)
    return tuple(dict.fromkeys(found))


def _walk(jaxpr: Any, arguments: Sequence[Names], line: str, found: list[Comparison]) -> list[Names]:
    """Add the comparisons of a jaxpr; return the parameters on which its results depend.

    `line` is that of the call, inside a function of JAX: see `find_public_name`.
    """
    known = dict(zip(jaxpr.invars, arguments, strict=True))

    def depends(atom: Any) -> Names:
        return NONE if hasattr(atom, "val") else known.get(atom, NONE)

    for equation in jaxpr.eqns:
        given = [depends(atom) for atom in equation.invars]
        if _jumps(equation):
            verb, where = VERBS[equation.primitive.name], line or find_line(equation)
            names = NONE.union(*given)
            found += [Comparison(name, verb, where) for name in sorted(names) if STATE not in names]
        results = [NONE.union(*given)] * len(equation.outvars)
        for inner, own in _list_calls(equation, given):
            name = find_public_name(inner)
            if name not in SMOOTH:
                made = _walk(inner, own, line or (find_line(equation) if name else ""), found)
                results = made if len(made) == len(results) else results
        known |= dict(zip(equation.outvars, results, strict=True))
    return [depends(atom) for atom in jaxpr.outvars]


def _jumps(equation: Any) -> bool:
    """Return whether an operation jumps: a comparison other than that of a number with itself, or rounding."""
    name = equation.primitive.name
    if name == "convert_element_type":
        kinds = equation.invars[0].aval.dtype.kind, np.dtype(equation.params["new_dtype"]).kind
        return kinds[0] == "f" and kinds[1] in "iub"
    return name in VERBS and (len(equation.invars) < 2 or equation.invars[0] is not equation.invars[1])


def _list_calls(equation: Any, given: list[Names]) -> Iterator[tuple[Any, list[Names]]]:
    """Yield the jaxprs that an operation runs, with the parameters on which their arguments depend."""
    params = equation.params
    if equation.primitive.name == "while":
        first, second = params["cond_nconsts"], params["cond_nconsts"] + params["body_nconsts"]
        yield params["cond_jaxpr"].jaxpr, given[:first] + given[second:]
        yield params["body_jaxpr"].jaxpr, given[first:]
    elif equation.primitive.name == "cond":
        for branch in params["branches"]:
            yield branch.jaxpr, given[1:]
    elif "jaxpr" in params:  # calls and loops; custom derivatives have rules of their own
        inner = getattr(params["jaxpr"], "jaxpr", params["jaxpr"])
        if len(inner.invars) == len(given):
            yield inner, given
