"""Parts of traced functions, and where in the user's code their operations come from."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import Any

import jax
import numpy as np
from jax._src import source_info_util

MOVES: dict[str, Callable[[Any, Any], Any]] = {
    "slice": lambda a, at: a[
        tuple(map(slice, at["start_indices"], at["limit_indices"], at["strides"] or a.ndim * [1]))
    ],
    "squeeze": lambda a, at: a.squeeze(at["dimensions"]),
    "reshape": lambda a, at: a.transpose(at["dimensions"] or range(a.ndim)).reshape(at["new_sizes"]),
    "transpose": lambda a, at: a.transpose(at["permutation"]),
}
"""Operations that only select or move entries, none of which depends on a value."""


def find_inner_jaxprs(equation: Any) -> list[tuple[Any, Sequence[Any]]]:
    """Return the jaxprs that an operation calls, each with its constants.

    Parameters
    ----------
    equation : operation of a jaxpr
    """
    found = []
    for value in equation.params.values():
        for entry in value if isinstance(value, (tuple, list)) else (value,):
            if hasattr(entry, "eqns"):
                found.append((getattr(entry, "jaxpr", entry), getattr(entry, "consts", ())))
    return found


def list_jaxprs(jaxpr: Any) -> Iterator[Any]:
    """Yield a jaxpr and those inside it.

    Parameters
    ----------
    jaxpr : jaxpr
    """
    yield jaxpr
    for equation in jaxpr.eqns:
        for inner, _ in find_inner_jaxprs(equation):
            yield from list_jaxprs(inner)


def find_read_entries(jaxpr: Any, variable: Any) -> tuple[int, ...]:
    """Return the positions in an argument of the entries that may be read: those that a jaxpr does more with than to
    move them, and to leave them out of slices.

    Parameters
    ----------
    jaxpr : jaxpr
    variable : one of its arguments
    """
    held = {variable: np.arange(variable.aval.size).reshape(variable.aval.shape)}
    read = set[int]()
    for name, given, made, settings in (
        *((each.primitive.name, each.invars, each.outvars, each.params) for each in jaxpr.eqns),
        ("return", jaxpr.outvars, [], {}),
    ):
        for entries in [held[atom] for atom in given if not hasattr(atom, "val") and atom in held]:
            if name in MOVES:
                held[made[0]] = MOVES[name](entries, settings)
            else:
                read.update(entries.ravel().tolist())
    return tuple(sorted(read))


def find_line(equation: Any) -> str:
    """Return file and line of the user's code from which an operation comes, "file.py:12"; empty if it is unknown.

    Parameters
    ----------
    equation : operation of a jaxpr
    """
    try:  # private API of JAX: if it changes, messages have no location
        frame = source_info_util.user_frame(equation.source_info.traceback)
        return "" if frame is None else f"{os.path.basename(frame.file_name)}:{frame.start_line}"
    except (AttributeError, TypeError):
        return ""


def write_line(equation: Any) -> str:
    """Return the location of an operation as the end of a sentence, " (file.py:12)"; empty if it is unknown.

    Parameters
    ----------
    equation : operation of a jaxpr
    """
    where = find_line(equation)
    return f" ({where})" if where else ""


def find_public_name(jaxpr: Any) -> str | None:
    """Return the public name of a function of JAX; None for any other function.

    JAX traces its functions once for all callers: the location of their inner operations may be that of another call,
    and messages have to take the location of the call itself.

    Parameters
    ----------
    jaxpr : that of the function
    """
    info = getattr(jaxpr, "debug_info", None)
    file, name = getattr(info, "func_filename", None), str(getattr(info, "func_name", "")).lstrip("_")
    if file is None or not file.startswith(os.path.dirname(jax.__file__) + os.sep):
        return None
    for place, module in _list_modules():
        if hasattr(module, name):
            return f"{place}.{name}"
    return name or "a function of JAX"


@cache
def _list_modules() -> list[tuple[str, Any]]:
    import jax.scipy.linalg
    import jax.scipy.special

    numpy, scipy = jax.numpy, jax.scipy
    return [
        ("jnp", numpy),
        ("jnp.linalg", numpy.linalg),
        ("jnp.fft", numpy.fft),
        ("jax.scipy.special", scipy.special),
        ("jax.scipy.linalg", scipy.linalg),
        ("jax.nn", jax.nn),
        ("jax.random", jax.random),
        ("jax.lax", jax.lax),
        ("jax.lax.linalg", jax.lax.linalg),
    ]
