"""What the traces of the user's functions tell: what they read and compare, and where they are not finite.

Find where the functions of a problem compare with a parameter, or round it, in their traces.

``jnp.where(t < p["t_on"], a, b)`` jumps as ``t_on`` passes t, and derivatives do not include that jump. `jnp.maximum`,
`jnp.clip` and `jnp.interp` compare too, but do not jump: they are not found, nor is what has a derivative rule of its
own. Only what the trace proves is found: that a value depends on a parameter, directly and not by the state.

Find the operation of a user's function whose value or derivative is not finite at a point.

``jnp.sqrt(jnp.maximum(x, 0.0))`` has a value at 0, but its slope there is infinite, and where the slope of the maximum
is 0 the product of both is NaN. The function is evaluated operation by operation: the first one whose operands are
finite, and whose value or whose first or second derivative is not, is the cause, if derivatives of the whole function
are not finite either. What grows without bound, as a product does, is none.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import chain
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.problem.corners import find_corners
from switchfit.problem.data import FloatArray
from switchfit.problem.functions import Function, use_float64
from switchfit.problem.jaxprs import Walk, evaluate, find_line, find_public_name
from switchfit.problem.problem import Problem, keep_with_problem
from switchfit.problem.structure import Structure, trace_structure


class Unread(NamedTuple):
    """Free parameters on which J cannot depend, by the names of their entries in theta.

    A parameter with a prior is not among them: J depends on it through the prior.

    Attributes
    ----------
    unread : tuple of str
        Those that no function of the model reads.
    absent : tuple of str
        Those that are read only by modes that occur in no mode_sequence, or at transitions that do not occur.
    """

    unread: tuple[str, ...] = ()
    absent: tuple[str, ...] = ()


@keep_with_problem
def find_unread(problem: Problem) -> Unread:
    """Return the free parameters that no function reads which acts in the sequences of a problem.

    If a mode that does not occur cannot be traced, as it needs a parameter that the problem lacks, it is unknown what
    it reads: parameters that nothing else reads are in neither list.

    Parameters
    ----------
    problem : Problem
    """
    unknowns, here = problem.unknowns, find_targets(problem, problem.structures, library=False)
    free, known = unknowns.parameters, unknowns.priors.precision > 0
    left = [name for name, span in free.items() if name not in here and not known[span].any()]
    if not left:
        return Unread()
    try:  # the modes, reset maps and guards that do not occur may have faults
        libraries = [trace_structure(problem._sources, run, len(run.mode_sequence)) for run in problem.experiments]
        elsewhere = find_targets(problem, libraries, library=True)
    except ValueError:
        return Unread()
    unread = tuple(entry for name in left if name not in elsewhere for entry in unknowns.names[free[name]])
    return Unread(unread, tuple(entry for name in left if name in elsewhere for entry in unknowns.names[free[name]]))


def name_whole_parameters(entries: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the parameters that entries of theta belong to, such as "k" of "k[0]" and "k[1]".

    Parameters
    ----------
    entries : iterable of str
    """
    return tuple(dict.fromkeys(name.partition("[")[0] for name in entries))


def find_targets(problem: Problem, structures: Iterable[Structure], *, library: bool) -> dict[str, set[int]]:
    """Return the entries of the problem's parameters that its experiments read: in their own sequences, or in any of a
    library.

    Parameters
    ----------
    problem : Problem
    structures : iterable of Structure, one for each experiment
    library : bool
    """
    found: dict[str, set[int]] = {}
    for run, structure in zip(problem.experiments, structures, strict=True):
        functions = structure.library.roles if library else structure.acting
        read = chain.from_iterable(function.read.items() for function in functions.values())
        named = ((name, (0,)) for sensor in structure.measurements for name in sensor.named)
        for name, entries in chain(read, named):
            found.setdefault(run.parameter_map.get(name, name), set()).update(entries)
    return found


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
    others = [NONE] * (len(function.jaxpr.invars) - len(function.parameters))
    if not with_state:
        others[1] = frozenset({STATE})
    walk = _Comparing(bends)
    walk.run(function.jaxpr, function.consts, [*others, *(frozenset({name}) for name in function.parameters)])
    return tuple(dict.fromkeys(walk.found))


class _Comparing(Walk):
    """Finds the comparisons of a function; what it follows are the parameters on which values depend."""

    def __init__(self, bends: bool) -> None:
        self._bends = bends
        self.found: list[tuple[str, str]] = []

    def constant(self, value: Any) -> Names:
        return NONE

    def apply(self, equation: Any, given: list[Names], origin: Any) -> list[Names]:
        names = NONE.union(*given)
        is_bend = self._bends and equation.primitive.name in BENDS
        if (is_bend or _jumps(equation)) and STATE not in names:
            verb, line = VERBS.get(equation.primitive.name, "bends with"), find_line(origin)
            self.found += [(name, f"{verb} {name}{line and f' at {line}'}") for name in sorted(names)]
        results = [names] * len(equation.outvars)
        for inner, own in _list_calls(equation, given):
            if find_public_name(inner) not in SMOOTH:
                made = self.enter(equation, inner, own, origin)
                results = made if len(made) == len(results) else results
        return results


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
        yield params["cond_jaxpr"], given[:first] + given[second:]
        yield params["body_jaxpr"], given[first:]
    elif equation.primitive.name == "cond":
        for branch in params["branches"]:
            yield branch, given[1:]
    elif "jaxpr" in params:  # calls and loops; custom derivatives have rules of their own
        inner = getattr(params["jaxpr"], "jaxpr", params["jaxpr"])
        if len(inner.invars) == len(given):
            yield params["jaxpr"], given


GROWING = frozenset(
    {"add", "sub", "mul", "neg", "exp", "exp2", "expm1", "sinh", "cosh", "square", "dot_general", "reduce_sum"}
    | {"add_any", "reduce_prod", "cumsum", "cumprod"}
)
"""Operations that are defined everywhere, and overflow for large operands."""


MOST_POINTS = 20
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
    if arguments:  # the last point once more and again: runs of similar length share a compiled check
        count = len(arguments[0])
        repeated = np.minimum(np.arange(1 << (count - 1).bit_length()), count - 1)
        arguments = [argument[repeated] for argument in arguments]
    with use_float64():
        given = [jnp.asarray(argument, dtype=jnp.float64) for argument in arguments]
        named = [jnp.asarray(parameters[name], dtype=jnp.float64) for name in function.parameters]
        is_timed = bool(given) and given[0].ndim == 1
        moves = [derivatives and not (is_timed and k == 0) for k in range(len(given) + len(named))]
        check = _compile(function, tuple(np.flatnonzero(moves).tolist()), len(given))
        finite = np.asarray(check(given, named)).reshape(-1, 2)  # the value, and the derivatives
        for point in np.flatnonzero(~finite.all(1))[:MOST_POINTS].tolist():
            walk = _Checking()
            values = [*(argument[point] for argument in given), *named]
            walk.run(function.jaxpr, function.consts, list(zip(values, moves, strict=True)))
            if walk.found is not None:
                return Undefined(point, *walk.found, valued=bool(finite[point, 0]))
    return None


@lru_cache(maxsize=64)
def _compile(function: Function, moving: tuple[int, ...], varying: int) -> Callable[..., Any]:
    """Return a compiled check whether the value of a function is finite, and its derivatives in some of its arguments,
    at each point: (N, 2).
    """

    def call(*every: Any) -> Any:
        return function.evaluate(every)

    slope = jax.jacrev(call, moving)

    def check(given: list[Any], named: list[Any]) -> Any:
        every = [*given, *named]
        derivatives = [slope(*every), jax.jacfwd(slope, moving)(*every)] if moving else []
        return jnp.stack([_are_finite([call(*every)]), _are_finite(jax.tree.leaves(derivatives))])

    return jax.jit(jax.vmap(check, in_axes=(0, None)) if varying else check)


class _Checking(Walk):
    """Evaluates a function at a point, and checks its operations; what it follows are values, and whether they move.

    Attributes
    ----------
    found : tuple (operation, line, order) or None
        The first operation that is not finite at finite operands.
    """

    def __init__(self) -> None:
        self.found: tuple[str, str, int] | None = None

    def constant(self, value: Any) -> tuple[Any, bool]:
        return value, False

    def apply(self, equation: Any, given: list[tuple[Any, bool]], origin: Any) -> list[tuple[Any, bool]]:
        name = equation.primitive.name
        operands, which = [value for value, _ in given], [moves for _, moves in given]
        if name in ("jit", "pjit"):
            return self.enter(equation, equation.params["jaxpr"], given, origin)
        if name == "cond":
            branches = equation.params["branches"]
            return self.enter(equation, branches[int(np.clip(operands[0], 0, len(branches) - 1))], given[1:], origin)
        results = evaluate(equation, operands)
        is_growing = name in GROWING or (name == "integer_pow" and equation.params["y"] > 0)
        if self.found is None and not is_growing and _are_finite(operands):
            order = _find_order(equation, operands, which, results)
            if order is not None:
                caller = None if origin is equation else find_public_name(origin.params.get("jaxpr"))
                self.found = caller or name, find_line(origin), order
        return [(result, any(which)) for result in results]


def _find_order(equation: Any, operands: list[Any], which: list[bool], results: list[Any]) -> int | None:
    """Return the order of the first derivative of an operation in some operands that is not finite, 0 for its value."""
    floats = [k for k, moves in enumerate(which) if moves and _is_float(operands[k])]

    def call(*moved: Any) -> list[Any]:
        made = evaluate(equation, [moved[floats.index(k)] if k in floats else a for k, a in enumerate(operands)])
        return list(filter(_is_float, made))

    at = tuple(operands[k] for k in floats)
    ones = tuple(map(jnp.ones_like, at))

    def slope(*moved: Any) -> list[Any]:
        return jax.jvp(call, moved, ones)[1]

    orders = (lambda: results, lambda: slope(*at), lambda: jax.jvp(slope, at, ones)[1])
    return next((order for order, find in enumerate(orders if floats else orders[:1]) if not _are_finite(find())), None)


def _are_finite(values: Sequence[Any]) -> Any:
    """Return whether all floating-point numbers of some arrays are finite."""
    checked = [jnp.isfinite(value).all() for value in values if _is_float(value)]
    return jnp.stack(checked).all() if checked else jnp.array(True)


def _is_float(value: Any) -> bool:
    return bool(jnp.issubdtype(jnp.result_type(value), jnp.floating))
