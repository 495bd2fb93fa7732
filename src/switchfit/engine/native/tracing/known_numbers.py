"""Operations on traced arrays whose entries are all known: evaluated at once, by NumPy where it agrees with JAX."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import Traced
from switchfit.engine.native.scalars.graph import Graph
from switchfit.engine.native.scalars.operations import OPERATIONS
from switchfit.engine.native.tracing.entries import TracedArray
from switchfit.engine.native.tracing.moves import broadcast_in_dim
from switchfit.engine.native.tracing.rules import INDEXED
from switchfit.engine.native.tracing.unsupported import Unsupported
from switchfit.runtime.jax_internals import Equation, array_type

BY_NUMPY: dict[str, Callable[..., Any]] = {
    "iota": lambda params: broadcast_in_dim(
        params | {"broadcast_dimensions": [params["dimension"]]}, np.arange(params["shape"][params["dimension"]])
    ),
    "convert_element_type": lambda params, a: a,
    **{
        name: lambda params, *args, value=operation.value: value(*args)
        for operation in OPERATIONS.values()
        if operation.known_alike
        for name in (*operation.primitives, *operation.of_truth[:1])
    },
    "select_n": lambda params, which, *cases: np.choose(which.astype(int), cases),
}
"""Frequent operations on known numbers, evaluated by NumPy, since calling XLA for each would be slow."""


def as_numpy(value: Traced) -> TracedArray:
    """Return a NumPy array; typed random keys of JAX, for which NumPy has no type, stay as they are."""
    extended = isinstance(value, jax.Array) and jax.dtypes.issubdtype(value.dtype, jax.dtypes.extended)
    return value if extended or isinstance(value, np.ndarray) else np.asarray(value)


def evaluate_known(graph: Graph, equation: Equation, args: list[NDArray[Any]]) -> list[TracedArray]:
    """Evaluate an operation on known numbers: indexing here, frequent operations by NumPy and all others by XLA."""
    name, out = equation.primitive.name, [array_type(variable) for variable in equation.outvars]
    if name in INDEXED:  # rows of tangents: XLA would take 60 ms to compile each
        with suppress(Unsupported):
            return [np.asarray(INDEXED[name](graph, equation, *args)).astype(out[0].dtype)]
    # NumPy and JAX differ where doubles become integers, for numbers out of range.
    is_cut = name == "convert_element_type" and args[0].dtype.kind == "f" and out[0].dtype.kind in "iu"
    if name in BY_NUMPY and not is_cut:
        return [np.asarray(BY_NUMPY[name](equation.params, *args)).astype(out[0].dtype).reshape(out[0].shape)]
    with jax.ensure_compile_time_eval():
        results = equation.primitive.bind(*args, **equation.params)
    return [as_numpy(a) for a in (results if equation.primitive.multiple_results else [results])]
