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
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.problem.data import FloatArray
from switchfit.problem.functions import Function, use_float64
from switchfit.problem.jaxprs import find_line, find_public_name
from switchfit.problem.problem import Problem, keep_with_problem
from switchfit.problem.structure import Structure, trace_structure


class Readers(NamedTuple):
    """Which of the model's parameters the functions of an experiment read.

    Attributes
    ----------
    always : set of str
        By functions that act whatever the sequence.
    modes : dict of mode to set of str
    """

    always: frozenset[str]
    modes: Mapping[str, frozenset[str]]

    def find(self, sequence: Iterable[str], structure: Structure | None) -> set[str]:
        """Return what a sequence reads, with the functions at its transitions if its structure is given."""
        found = set(self.always).union(*(self.modes[mode] for mode in sequence))
        if structure is not None:
            at = (*structure.reset_maps, *structure.guards, *structure.transition_costs)
            found = found.union(*(function.parameters for function in at if function is not None))
        return found


def list_readers(structure: Structure) -> Readers:
    """Return which parameters each mode of a structure reads, and which the functions read that always act."""
    observes = [observe for observe, _ in structure.outputs]
    jumps = [structure.reset_maps[i] for i in structure.jumps]
    at_all_times = [*structure.running, *observes, *jumps]
    functions = [structure.initial_state, *at_all_times, *structure.terminal, *structure.terminal_constraints]
    always = {name for function in functions if function is not None for name in function.parameters}
    always = always.union(*(sensor.named for sensor in structure.measurements))
    pairs = zip(structure.mode_names, structure.modes, strict=True)
    return Readers(frozenset(always), {name: frozenset(mode.parameters) for name, mode in pairs})


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
    unknowns, texts = problem.unknowns, problem.unknowns.priors.texts()
    here = find_targets(problem, problem.structures, library=False)
    free = {name: range(span.start, span.stop) for name, span in unknowns.parameters.items()}
    left = [name for name, span in free.items() if name not in here and not any(texts[i] for i in span)]
    if not left:
        return Unread()
    try:
        elsewhere = find_targets(problem, _trace_libraries(problem), library=True)
    except ValueError:
        return Unread()
    unread = tuple(unknowns.names[i] for name in left if name not in elsewhere for i in free[name])
    return Unread(unread, tuple(unknowns.names[i] for name in left if name in elsewhere for i in free[name]))


def name_whole_parameters(entries: Iterable[str]) -> tuple[str, ...]:
    """Return the names of the parameters that entries of theta belong to, such as "k" of "k[0]" and "k[1]".

    Parameters
    ----------
    entries : iterable of str
    """
    return tuple(dict.fromkeys(name.partition("[")[0] for name in entries))


def find_targets(problem: Problem, structures: Iterable[Structure], *, library: bool) -> set[str]:
    """Return the problem's parameters that its experiments read: in their own sequences, or in any of a library.

    Parameters
    ----------
    problem : Problem
    structures : iterable of Structure, one for each experiment
    library : bool
    """
    found: set[str] = set()
    for run, structure in zip(problem.experiments, structures, strict=True):
        readers = list_readers(structure)
        modes = readers.modes if library else {structure.mode_names[k] for k in structure.mode_of_segment}
        names = readers.find(modes, structure.library if library else structure)
        found.update(run.parameter_map.get(name, name) for name in names)
    return found


def _trace_libraries(problem: Problem) -> list[Structure]:
    """Return the structures with all modes of the system, traced if the problem's own have those of a sequence alone.

    Raises
    ------
    ValueError
        If a mode, a reset map or a guard that does not occur cannot be traced.
    """
    if problem.max_transitions is not None:
        return list(problem.structures)
    each = zip(problem.experiments, problem.structures, strict=True)
    return [trace_structure(problem.system, run, problem._functions, problem.solver, own.N) for run, own in each]


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
    _follow(function.jaxpr, [*others, *(frozenset({name}) for name in function.parameters)], "", found)
    return tuple(dict.fromkeys(found))


def _follow(jaxpr: Any, arguments: Sequence[Names], line: str, found: list[Comparison]) -> list[Names]:
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
                made = _follow(inner, own, line or (find_line(equation) if name else ""), found)
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
