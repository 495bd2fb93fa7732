"""Machine code of an experiment as a foreign function in a JAX program, for fits that run in one program on a CPU."""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Mapping
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import count_passed
from switchfit.engine.native.experiment import find_directions, places_in_library
from switchfit.engine.native.llvm import Program
from switchfit.engine.native.program import program_of
from switchfit.engine.native.templates import Order, Sizes, constants_of
from switchfit.engine.native.workspace import GIVEN, constraint_rows, memory, sums
from switchfit.problem.structure import Structure

_registered: dict[str, Program] = {}
"""Programs whose addresses XLA keeps, by the names of their operations: they must stay alive."""
_one_at_a_time = threading.Lock()


@cache
def _register(library: Structure, sizes: Sizes) -> str:
    """Register the operation of a library with XLA; return its name.

    XLA takes a name once. Models with the same machine code, which may differ in the names of their parameters, share
    the operation of the first.
    """
    program = program_of(library, sizes, Order.HESSIAN)
    if isinstance(program, str):
        raise ValueError(f"the experiment has no machine code: {program}")
    name = f"switchfit_{program.key[:32]}"
    with _one_at_a_time:
        if name not in _registered:
            jax.ffi.register_ffi_target(
                name, jax.ffi.pycapsule(program.function("xla_handler", ctypes.c_void_p)), platform="cpu"
            )
            _registered[name] = program
    return name


def can_be_foreign(structure: Structure) -> bool:
    """Return whether a JAX program can call the machine code of an experiment: it must have no late samples."""
    return all(sensor.delay is None for sensor in structure.measurements)


def foreign_derivatives(
    structure: Structure, arguments: Arguments, tau: Any, p: Any, side: Any, places: Mapping[str, Any] | None = None
) -> Any:
    """Return cost, gradient (D,) and Hessian (D, D) of one experiment inside a JAX program that runs on a CPU.

    The experiment must satisfy `can_be_foreign` and have machine code. `side` is +1 or -1: the right or left
    derivative in a transition time that lies on a node.

    With `places`, the result of `places_in_library`, only the library of the structure is used. A JAX program that
    takes the places as arguments then serves all sequences of a library with the same number of transitions, and
    ``structure.library`` may be passed in place of the structure, as the key of that program.
    """
    sizes, library = Sizes.of(structure, arguments), structure.library
    name = _register(library, sizes)
    N, D, width = sizes.N, sizes.D, sizes.width
    idle = N - tau.shape[0]  # number of segments that the sequence does not need: they begin and end at tf
    places = places_in_library(structure) if places is None else places
    nodes = arguments.nodes
    cells = nodes.shape[0] - 1
    real_cells = jnp.sum(nodes[1:] > nodes[:-1])
    count_own = tau.shape[0]
    jumps = places.get("jumps", np.zeros(count_own, dtype=np.int64))[:count_own]
    side = jnp.where(jumps > 0, 1.0, side)  # as in `Structure.fix_sides`
    passed = count_passed(nodes, tau, side)
    begins = jnp.clip(passed - 1, 0, real_cells - 1)
    units, own, there = find_directions(sizes, jumps, jnp)
    count = max(constraint_rows(library, sizes)["count"], 1)
    given: dict[str, Any] = {
        "nodes": nodes,
        "signals": arguments.signals,
        "c": jnp.concatenate([*(jnp.ravel(a) for a in constants_of(arguments)), jnp.zeros(1)]),
        "p": jnp.append(p, 0.0),
        "bounds": jnp.concatenate([nodes[:1], tau, jnp.repeat(nodes[-1:], idle + 1)]),
        "first_cell": jnp.concatenate([jnp.zeros(1, int), begins, jnp.full(idle + 1, cells - 1)]),
        "multipliers": np.zeros(count),
        "units": units,
    }
    given |= places
    buffers = [given[key] for key in GIVEN]
    for samples in arguments.samples:
        buffers += [*samples, np.zeros(1, dtype=np.int64)]
    lengths = sums(library, sizes)
    of_memory = sum(length.at(cells + N) for length in memory(library, sizes, Order.HESSIAN).values())
    results = [jax.ShapeDtypeStruct((length,), np.float64) for length in (sum(lengths.values()), of_memory)]
    totals = jax.ffi.ffi_call(name, results, vmap_method="expand_dims")(*buffers)[0]
    ends = dict(zip(lengths, np.cumsum(list(lengths.values())).tolist(), strict=True))
    J, g, H = (totals[ends[key] - lengths[key] : ends[key]] for key in ("J", "g", "H"))
    cost = J[0] + totals[-1]  # NaN if a finiteness check failed: the finisher of a batch then falls back to JAX
    gradient, hessian = g[own], H.reshape(D, width)[own[:, None], own]
    return cost, jnp.where(there, gradient, 0.0), jnp.where(there[:, None] & there[None], hessian, 0.0)
