"""Machine code as a foreign function in a JAX program, for fits that run in one program on a CPU."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_batching import sequential_vmap

from switchfit.arrays import Traced
from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import build_rows
from switchfit.engine.native.layout import layout_of
from switchfit.engine.native.library_places import find_directions
from switchfit.engine.native.llvm.compilation import Program
from switchfit.engine.native.program import program_of
from switchfit.engine.native.sizes import Order, Sizes, constants_of
from switchfit.problem.structure import Structure

Array = jax.Array

_registered: dict[str, Program] = {}
"""Programs whose addresses XLA keeps, by the names of their operations: they must stay alive."""

_one_at_a_time = threading.Lock()


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
            handler = jax.ffi.pycapsule(program.function("xla_handler", 1))
            jax.ffi.register_ffi_target(name, handler, platform="cpu")
            _registered[name] = program
    return name


def foreign_derivatives(
    structure: Structure, arguments: Arguments, tau: Array, p: Array, side: Array, places: Mapping[str, Traced]
) -> tuple[Array, Array, Array]:
    """Return cost, gradient (D,) and Hessian (D, D) of one experiment inside a JAX program that runs on a CPU.

    The experiment must have machine code, and no late samples. `side` is +1 or -1: the right or left derivative in a
    transition time that lies on a node.

    `places` are the result of `places_in_library`: only the library of the structure is used. A JAX program that takes
    the places as arguments serves all sequences of a library with the same number of transitions, and
    ``structure.library`` may be passed in place of the structure, as the key of that program.
    """
    sizes, library = Sizes.of(structure, arguments), structure.library
    name = _register(library, sizes)
    N, D, width = sizes.N, sizes.D, sizes.width
    nodes, count_own = jnp.asarray(arguments.nodes), tau.shape[0]
    cells, idle = nodes.shape[0] - 1, N - count_own  # idle: segments that the sequence does not need, from tf to tf
    jumps = places.get("jumps", np.zeros(count_own, dtype=np.int64))[:count_own]
    side = jnp.where(jumps > 0, 1.0, side)  # as in `Structure.fix_sides`
    first_cell = build_rows(nodes, tau, side).first_cell
    units, own, there = find_directions(sizes, jumps, jnp)
    layout = layout_of(library, sizes, Order.HESSIAN)
    given: dict[str, Any] = {
        "nodes": nodes,
        "signals": arguments.signals,
        "c": jnp.concatenate([*(jnp.ravel(a) for a in constants_of(arguments)), jnp.zeros(1)]),
        "p": jnp.append(p, 0.0),
        "bounds": jnp.concatenate([nodes[:1], tau, jnp.repeat(nodes[-1:], idle + 1)]),
        "first_cell": jnp.concatenate([first_cell, jnp.full(idle + 1, cells - 1)]),
        "multipliers": np.zeros(max(layout.constraint_rows["count"], 1)),
        "units": units,
    }
    given |= places
    for k, samples in enumerate(arguments.samples):
        given |= {f"{name} {k}": values for name, values in samples._asdict().items()}
        given |= {f"segment {k}": np.zeros(1, dtype=np.int64), f"seen {k}": np.zeros(1)}  # none is late
    buffers = [given[name] for name in layout.arguments]
    of_memory = sum(fixed + each * (cells + N) for fixed, each in layout.memory.values())
    results = [jax.ShapeDtypeStruct((length,), np.float64) for length in (sum(layout.sums.values()), of_memory)]
    # A batch is a loop: all of its entries use one scratch space, which stays in the CPU caches.
    totals = sequential_vmap(lambda *given: jax.ffi.ffi_call(name, results)(*given)[0])(*buffers)
    _, J, g, H, *_ = jnp.split(totals, np.cumsum([*layout.sums.values()])[:-1].tolist())
    cost = J[0] + totals[-1]  # NaN if a finiteness check failed: the finisher of a batch then falls back to JAX
    gradient, hessian = g[own], H.reshape(D, width)[own[:, None], own]
    return cost, jnp.where(there, gradient, 0.0), jnp.where(there[:, None] & there[None], hessian, 0.0)
