"""Parts of JAX that are private, or public but without a promise to stay: the only module that uses them.

They are of four kinds: jaxprs (evaluation, dead code, debug information), the user's line that an operation comes from,
tracers, and the state of the compilation cache. Jaxprs have no compatibility policy, and `jax._src` changes without
notice. Everything here is tested with JAX 0.9 and 0.10, the bounds in ``pyproject.toml``. For a newer JAX, run
`tests/house/test_jax_internals.py` and all of `tests/engine` with it, then raise the upper bound.

Two more things depend on the version of JAX: the layout of XLA's call frame in `engine.native.loops.xla_handler`, which
a test compares with the header that JAX installs, and the names and parameters of primitives, which are strings.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from types import CodeType
from typing import Any, TypeAlias, cast

import jax
import numpy as np
from jax._src import source_info_util
from jax._src.core import ClosedJaxpr, Jaxpr, JaxprEqn, Literal, Var  # jax.extend.core is the same, and takes 0.1 s
from jax.experimental.compilation_cache import compilation_cache
from jax.interpreters import partial_eval

__all__ = ["ClosedJaxpr", "Equation", "Jaxpr"]

Equation: TypeAlias = JaxprEqn
"""One operation of a jaxpr: a primitive with its parameters, its operands and its results."""

Atom: TypeAlias = Var | Literal
"""An operand or a result of an operation: a variable, or a number that stands in the jaxpr."""


# Jaxprs


def array_type(atom: Atom) -> jax.core.ShapedArray:
    """Return shape and type of a variable or a number of a jaxpr. All are arrays: none has a reference or a token."""
    return cast(jax.core.ShapedArray, atom.aval)


def evaluate_jaxpr(jaxpr: Jaxpr, consts: Sequence[Any], *given: Any) -> list[Any]:
    """Return the results of a jaxpr, operation by operation; its operations keep the user's lines."""
    return jax.core.eval_jaxpr(jaxpr, consts, *given)


def evaluate_equation(equation: Equation, operands: Sequence[Any]) -> list[Any]:
    """Return the results of one operation, by its own rule for derivatives if it has one."""
    # JAX 0.9 returns functions that go before the operands, and parameters; since 0.10 all are parameters.
    found = equation.primitive.get_bind_params(equation.params)
    functions, params = found if isinstance(found, tuple) else ((), found)
    made = equation.primitive.bind(*functions, *operands, **params)
    return list(made) if equation.primitive.multiple_results else [made]


def drop_unused(jaxpr: Jaxpr, keeps_input: bool | Sequence[bool]) -> tuple[Jaxpr, list[bool]]:
    """Return a jaxpr without the operations that no result needs, and which of its inputs are left.

    Parameters
    ----------
    keeps_input : whether an input stays even if no operation reads it, for all or for each
    """
    return partial_eval.dce_jaxpr(jaxpr, [True] * len(jaxpr.outvars), instantiate=keeps_input)


def forget_names(jaxpr: Jaxpr) -> Jaxpr:
    """Return a jaxpr without the names of its arguments and results, which no longer fit once some were dropped."""
    return jaxpr.replace(debug_info=jaxpr.debug_info.with_unknown_names())


def copy_constants(consts: Sequence[Any]) -> list[Any]:
    """Return the constants of a jaxpr, those in NumPy arrays as copies: JAX keeps references to the user's arrays."""
    return [np.array(const) if isinstance(const, np.ndarray) else _copy_wrapped(const) for const in consts]


def copy_literals(jaxpr: Jaxpr) -> None:
    """Copy the numbers in a jaxpr in place: JAX keeps references to the user's arrays without axes, which may change.

    Jaxprs inside it are not changed.
    """
    for atom in (*jaxpr.outvars, *(atom for equation in jaxpr.eqns for atom in equation.invars)):
        if isinstance(atom, Literal):
            atom.val = copy.deepcopy(atom.val) if isinstance(atom.val, np.ndarray) else _copy_wrapped(atom.val)


def _copy_wrapped(value: Any) -> Any:
    """Return a copy of a NumPy array in the object in which JAX 0.9 wraps it; anything else as it is."""
    return copy.deepcopy(value) if isinstance(getattr(value, "val", None), np.ndarray) else value


def find_traced_function(jaxpr: Jaxpr | ClosedJaxpr) -> tuple[str | None, str]:
    """Return file and name of the Python function of which a jaxpr was made; None and "" if they are unknown."""
    info = getattr(getattr(jaxpr, "jaxpr", jaxpr), "debug_info", None)
    return getattr(info, "func_filename", None), str(getattr(info, "func_name", ""))


def is_tracer(value: object) -> bool:
    """Return whether a value is a tracer: it stands for an array while JAX transforms a function."""
    return isinstance(value, jax.core.Tracer)


# The user's code


def find_user_line(equation: Equation) -> tuple[str, int] | None:
    """Return path and line of the innermost code outside JAX that made an operation; None if it is unknown."""
    frame = source_info_util.user_frame(equation.source_info.traceback)
    return None if frame is None else (frame.file_name, frame.start_line)


def keep_user_line(equation: Equation) -> AbstractContextManager[None]:
    """Return a context in which operations that are made have the user's line of this one."""
    return source_info_util.user_context(equation.source_info.traceback)


def list_calls(equation: Equation) -> list[CodeType]:
    """Return the code of the functions that were running when an operation was made, the innermost first."""
    traceback = equation.source_info.traceback
    return [] if traceback is None else [code for code, _ in zip(*traceback.raw_frames(), strict=True)]


def is_user_file(path: str) -> bool:
    """Return whether a path is one of the user's code, not of JAX or of Python."""
    return source_info_util.is_user_filename(path)


# The compilation cache


def reset_compilation_cache() -> None:
    """Make JAX decide again whether to use its compilation cache, and where it is: it decides only once."""
    compilation_cache.reset_cache()


def replace_compilation_cache(replacement: object) -> None:
    """Put an object with the methods ``get(key)`` and ``put(key, value)`` in the place of JAX's compilation cache.

    If JAX has changed the names, its own cache remains.
    """
    internals: Any = sys.modules[compilation_cache.reset_cache.__module__]
    with getattr(internals, "_cache_initialized_mutex", nullcontext()):
        # Under JAX's own lock, which guards the two together; another thread may be compiling.
        internals._cache_initialized, internals._cache = True, replacement
