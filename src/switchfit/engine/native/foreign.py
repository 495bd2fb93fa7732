"""The machine code of an experiment as an operation inside a JAX program, for fits that run in one program on a CPU."""

from __future__ import annotations

import ctypes
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from switchfit.discretization.arguments import Arguments
from switchfit.engine.native.frame import workspace
from switchfit.engine.native.kernels import Sizes, constants_of
from switchfit.engine.native.llvm import Program
from switchfit.engine.native.program import program_of
from switchfit.problem.structure import Structure


@cache  # what is registered must stay
def _registered(structure: Structure, sizes: Sizes) -> tuple[str, Program] | None:
    """Name of the operation for a structure; None where JAX has to do its work."""
    program = program_of(structure, sizes, 2)
    if isinstance(program, str):
        return None
    name = f"switchfit_{program.key[:32]}"
    new_capsule = ctypes.pythonapi.PyCapsule_New
    new_capsule.restype, new_capsule.argtypes = ctypes.py_object, [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    capsule = new_capsule(program.address("xla_handler"), b"xla._CUSTOM_CALL_TARGET", None)
    jax.ffi.register_ffi_target(name, capsule, platform="cpu")
    return name, program


def foreign_derivatives(structure: Structure, arguments: Arguments, tau: Any, p: Any) -> Any:
    """Cost, gradient (D,) and Hessian (D, D) of one experiment, inside a JAX program that runs on a CPU.

    As `switchfit.fit.evaluator.derivatives` with the side +1; None where JAX has to do it.
    """
    sizes = Sizes.of(structure, arguments)
    registered = _registered(structure, sizes)
    if registered is None:
        return None
    name, _ = registered
    n, D, width = sizes.n, sizes.D, sizes.width
    nodes = arguments.nodes
    cells = nodes.shape[0] - 1
    real_cells = jnp.sum(nodes[1:] > nodes[:-1])
    passed = jnp.sum(nodes[None] <= tau[:, None], axis=1)
    first_cell = jnp.append(jnp.zeros(1, int), jnp.clip(passed - 1, 0, real_cells - 1))
    constants = jnp.concatenate([*(jnp.ravel(a) for a in constants_of(arguments)), jnp.zeros(1)])
    units = np.zeros((D + 1, width))
    units[1:, :D] = np.eye(D)
    given = [nodes, arguments.signals, constants, jnp.concatenate([tau, p]), first_cell, units]
    for samples in arguments.samples:
        given += [samples.cell, samples.time, samples.value, samples.weight]
    lengths = workspace(sizes, cells, bool(arguments.samples))
    results = [jax.ShapeDtypeStruct((length,), np.float64) for length in lengths.values()]
    sums = jax.ffi.ffi_call(name, results)(*given)[0]
    cost = sums[n] + sums[-1]  # not a number where JAX has to look again, which the finisher of a batch lets it do
    return cost, sums[n + 1 : n + 1 + D], sums[n + 1 + width : -1].reshape(D, width)[:, :D]
