"""Walk through jaxprs: the operations of traced functions, and where in the user's code they come from."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import import_module
from itertools import chain
from typing import Generic, TypeVar, cast

import jax
import numpy as np

from switchfit.arrays import IntArray, Traced
from switchfit.runtime.jax_internals import (
    Atom,
    ClosedJaxpr,
    Equation,
    Jaxpr,
    array_type,
    evaluate_equation,
    find_traced_function,
    find_user_line,
)

V = TypeVar("V")

SELECTIONS: dict[str, Callable[[Traced, Mapping[str, Traced]], Traced]] = {
    "slice": lambda a, at: a[
        tuple(map(slice, at["start_indices"], at["limit_indices"], at["strides"] or a.ndim * [1]))
    ],
    "squeeze": lambda a, at: a.squeeze(at["dimensions"]),
    "reshape": lambda a, at: a.transpose(at["dimensions"] or range(a.ndim)).reshape(at["new_sizes"]),
    "transpose": lambda a, at: a.transpose(at["permutation"]),
}
"""Operations that only select or move entries, none of which depends on a value."""

PUBLIC = (
    *("jax.numpy", "jax.numpy.linalg", "jax.numpy.fft", "jax.scipy.special", "jax.scipy.linalg", "jax.nn"),
    *("jax.random", "jax.lax", "jax.lax.linalg"),
)
"""Modules of JAX in which the name of a function is looked for."""


def strip_constants(jaxpr: Jaxpr | ClosedJaxpr) -> Jaxpr:
    """Return a jaxpr without the constants that a closed one carries."""
    return cast("Jaxpr", getattr(jaxpr, "jaxpr", jaxpr))


def find_inner_jaxprs(equation: Equation) -> list[Jaxpr | ClosedJaxpr]:
    """Return the jaxprs that an operation calls, with their constants or without.

    Parameters
    ----------
    equation : operation of a jaxpr
    """
    values = equation.params.values()
    every = chain.from_iterable(value if isinstance(value, (tuple, list)) else (value,) for value in values)
    return [entry for entry in every if hasattr(entry, "eqns")]


def list_jaxprs(jaxpr: Jaxpr) -> Iterator[Jaxpr]:
    """Yield a jaxpr and those inside it.

    Parameters
    ----------
    jaxpr : jaxpr
    """
    yield jaxpr
    for equation in jaxpr.eqns:
        for inner in find_inner_jaxprs(equation):
            yield from list_jaxprs(strip_constants(inner))


def evaluate(equation: Equation, operands: Sequence[Traced]) -> list[Traced]:
    """Return the results of an operation, by its own rule for derivatives if it has one.

    Parameters
    ----------
    equation : operation of a jaxpr
    operands : sequence
    """
    return evaluate_equation(equation, operands)


class Walk(Generic[V]):
    """Follows values of any kind through a jaxpr, operation by operation: `apply` says what one makes of them."""

    def constant(self, value: Traced) -> V:
        """Return what stands for a constant: itself, if that is what is followed."""
        return cast("V", value)

    def apply(self, equation: Equation, given: list[V], origin: Equation) -> Sequence[V]:
        """Return the results of an operation; its place in the user's code is that of the operation `origin`."""
        raise NotImplementedError

    def run(
        self, jaxpr: Jaxpr, consts: Sequence[Traced], given: Sequence[V], origin: Equation | None = None
    ) -> list[V]:
        """Return the results of a jaxpr."""
        # Values by their variables, of this jaxpr alone: a jaxpr that is called has variables of its own (`enter`).
        known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*map(self.constant, consts), *given], strict=True))

        def value(atom: Atom) -> V:
            return self.constant(atom.val) if hasattr(atom, "val") else known[atom]

        for equation in jaxpr.eqns:
            results = self.apply(equation, [value(atom) for atom in equation.invars], origin or equation)
            known |= dict(zip(equation.outvars, results, strict=True))
        return [value(atom) for atom in jaxpr.outvars]

    def enter(self, equation: Equation, inner: Jaxpr | ClosedJaxpr, given: Sequence[V], origin: Equation) -> list[V]:
        """Return the results of a jaxpr that an operation calls.

        JAX traces its own functions once for all callers: what is inside them has the place of the call.
        """
        jaxpr, consts = strip_constants(inner), getattr(inner, "consts", ())
        # Once inside a function of JAX, all deeper ones belong to the call in the user's code.
        is_of_jax = origin is not equation or find_public_name(jaxpr) is not None
        return self.run(jaxpr, consts, given, origin if is_of_jax else None)


def find_read_entries(jaxpr: Jaxpr, variables: Sequence[Atom]) -> list[tuple[int, ...]]:
    """Return the positions in some arguments of the entries that may be read: those that a jaxpr does more with than
    to move them, and to leave them out of slices.

    Parameters
    ----------
    jaxpr : jaxpr
    variables : sequence of its arguments
    """
    # Which entries of which argument a variable holds; a variable that is no plain selection of one holds none.
    held: dict[Atom, tuple[int, IntArray]] = {}
    for k, v in enumerate(variables):
        held[v] = k, np.arange(array_type(v).size).reshape(array_type(v).shape)
    read: list[set[int]] = [set() for _ in variables]
    for name, given, made, settings in (
        *((each.primitive.name, each.invars, each.outvars, each.params) for each in jaxpr.eqns),
        ("return", jaxpr.outvars, [], {}),
    ):
        for k, entries in [held[atom] for atom in given if not hasattr(atom, "val") and atom in held]:
            if name in SELECTIONS:
                held[made[0]] = k, SELECTIONS[name](entries, settings)
            else:
                # Anything but a selection reads all that it gets, a call of a function too: more may be found than is
                # read, never less. What is found too much costs a derivative that is zero; too little would be a wrong
                # gradient.
                read[k].update(entries.ravel().tolist())
    return [tuple(sorted(positions)) for positions in read]


def find_line(equation: Equation) -> str:
    """Return file and line of the user's code from which an operation comes, "file.py:12"; empty if it is unknown.

    Parameters
    ----------
    equation : operation of a jaxpr
    """
    found = find_user_line(equation)
    return "" if found is None else f"{os.path.basename(found[0])}:{found[1]}"


def find_public_name(jaxpr: Jaxpr | ClosedJaxpr) -> str | None:
    """Return the public name of a function of JAX; None for any other function.

    JAX traces its functions once for all callers: the location of their inner operations may be that of another call,
    and messages have to take the location of the call itself.

    Parameters
    ----------
    jaxpr : that of the function
    """
    file, name = find_traced_function(jaxpr)
    name = name.lstrip("_")
    if file is None or not file.startswith(os.path.dirname(jax.__file__) + os.sep):
        return None
    # Users know `jnp.linalg.norm`, and not the private function that implements it and stands in the trace.
    for module in PUBLIC:
        if hasattr(import_module(module), name):
            return f"{module.replace('jax.numpy', 'jnp')}.{name}"
    return name or "a function of JAX"
