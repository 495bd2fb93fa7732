"""The functions of branches, evaluated by NumPy or by JAX, and whether two branches are the same function."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import jax
import numpy as np

from switchfit.arrays import FloatArray, Traced
from switchfit.engine.native.tracing.trace import trace_scalars
from switchfit.engine.native.tracing.unsupported import Unsupported
from switchfit.problem.functions import Function, use_float64
from switchfit.runtime.jax_internals import evaluate_jaxpr


@lru_cache(maxsize=1024)
def trace_for_numpy(function: Function) -> Callable[..., FloatArray]:
    """Return a function of a mode's arguments as NumPy evaluates it, from the graph of its scalars; by JAX if it has
    none.

    It takes times () or (L,), what moves with them, states (n,) or (L, n) and maybe the input (size,) or (L, size), for
    branches with its rate behind it, and the parameters.
    """
    call = lambda *given: evaluate_jaxpr(function.jaxpr, function.consts, *given)  # noqa: E731
    shapes = [struct.shape for struct in function.structs]
    with use_float64():
        try:
            template = trace_scalars(call, *shapes)
        except Unsupported:
            # Something that has no scalars, as a custom call or a loop of unknown length.
            compiled = jax.jit(call)
        else:
            return lambda t, moving, p: template.evaluate([t], *(a.T for a in moving), *map(np.ravel, p))[0]

    def evaluate(t: Traced, moving: Sequence[FloatArray], p: Sequence[FloatArray]) -> FloatArray:
        """Evaluate by JAX, point by point: it would compile a program for each number of points."""
        if np.ndim(t):
            return np.array([evaluate(at, inputs, p) for at, *inputs in zip(t, *moving, strict=True)])
        with use_float64():
            return np.asarray(compiled(*map(np.reshape, (t, *moving, *p), shapes))[0])

    return evaluate


@lru_cache(maxsize=1024)
def are_equal(one: Function, other: Function) -> bool:
    """Return whether two branches of a mode are one function: ``sign(d) * 0`` is 0 on both sides of d = 0."""
    shapes = [struct.shape for struct in one.structs]
    call = lambda *given: [each.evaluate(given) for each in (one, other)]  # noqa: E731
    with use_float64():
        try:
            # Outputs are equal where the graph has made them one node.
            return one == other or trace_scalars(call, *shapes).has_equal_outputs
        except Unsupported:
            return False
