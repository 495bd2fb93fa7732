"""Text of a jaxpr with the values of its constants, by which traced functions are compared and hashed.

Custom derivative rules have no text: they are compared by the text of the first and second derivatives.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import jax
import numpy as np

from switchfit.arrays import Traced
from switchfit.problem.jaxprs import strip_constants
from switchfit.runtime.jax_internals import Atom, ClosedJaxpr, Jaxpr, evaluate_jaxpr

UNCOMPARED_PARAMETERS = (
    "jvp_jaxpr_fun",
    "jvp_jaxpr_thunk",
    "fwd_jaxpr_thunk",
    "bwd",
    "out_trees",
    "name",
    "debug_info",
)
"""Parameters of operations that are not compared: names, and derivative rules, which show in the derivatives."""


def describe_jaxpr(closed: ClosedJaxpr) -> _Text:
    """Return a jaxpr as text, with the values of its constants, and the objects in it that have no text."""
    text = _Text(closed)
    if text.has_rules:
        try:
            # Two functions with equal values and other rules for their derivatives are different functions for a fit.
            text.lines += _Text(_differentiate_twice(closed)).lines
        except TypeError:  # functions with reverse-mode rules only have no forward derivative
            text.opaque.append(object())
    return text


def _differentiate_twice(closed: ClosedJaxpr) -> ClosedJaxpr:
    """Return the jaxpr of the first and second derivatives along all arguments, in which custom rules are applied."""

    def value(*arguments: Traced) -> Traced:
        return evaluate_jaxpr(closed.jaxpr, closed.consts, *arguments)[0]

    def slope(*arguments: Traced) -> Traced:
        return jax.jvp(value, arguments, arguments)[1]

    return jax.make_jaxpr(lambda *a: (slope(*a), jax.jvp(slope, a, a)[1]))(*closed.in_avals)


class _Text:
    """Lines that describe a jaxpr, variables numbered in their order."""

    def __init__(self, closed: ClosedJaxpr) -> None:
        self.lines: list[str] = []
        self.opaque: list[object] = []
        self.has_rules = False
        self.add(closed.jaxpr, closed.consts)

    def add(self, jaxpr: Jaxpr, consts: Sequence[Traced]) -> None:
        """Describe a jaxpr."""
        # Numbers of variables in the order in which they are met, as JAX's own names of them count on in a process: the
        # text, and the digest made of it, are the same in every process.
        number: dict[Atom, int] = {}

        def atom(a: Atom) -> str:
            return self._array(a.val) if hasattr(a, "val") else f"%{number.setdefault(a, len(number))}"

        for variables in (jaxpr.constvars, jaxpr.invars):
            self.lines.append(" ".join(f"{atom(v)}:{v.aval.str_short()}" for v in variables))
        self.lines += [self._array(const) for const in consts]
        for equation in jaxpr.eqns:
            given = " ".join(map(atom, equation.invars))
            made = " ".join(f"{atom(v)}:{v.aval.str_short()}" for v in equation.outvars)
            self.lines.append(f"{made} = {equation.primitive.name} {given}")
            self.has_rules = self.has_rules or equation.primitive.name.startswith("custom_")
            # Sorted: the order of a dict's entries is that of JAX's source, which another version may have changed.
            for name, value in sorted(equation.params.items()):
                if name not in UNCOMPARED_PARAMETERS:
                    self._parameter(name, value)
        self.lines.append("-> " + " ".join(map(atom, jaxpr.outvars)))

    def _parameter(self, name: str, value: Traced) -> None:
        if hasattr(value, "eqns"):
            self.lines.append(f"{name}:")
            self.add(strip_constants(value), getattr(value, "consts", ()))
        elif isinstance(value, (tuple, list)) and any(hasattr(v, "eqns") for v in value):
            for entry in value:
                self._parameter(name, entry)
        elif isinstance(value, (np.ndarray, jax.Array)):
            self.lines.append(f"{name}={self._array(value)}")
        else:
            text = repr(value)
            # An address in the text would be another in each process, and may be that of another object later on.
            if " at 0x" in text or (callable(value) and not isinstance(value, type)):
                text = f"object {len(self.opaque)}"
                self.opaque.append(value)
            self.lines.append(f"{name}={text}")

    def _array(self, value: Traced) -> str:
        array = np.asarray(value)
        # A digest and not the numbers: a function may hold a table of a million. The dtype and the shape belong to it,
        # as bytes alone do not tell one array from another of the same bytes.
        digest = hashlib.blake2b(np.ascontiguousarray(array).tobytes(), digest_size=16).hexdigest()
        return f"{array.dtype}{list(array.shape)}{digest}"
