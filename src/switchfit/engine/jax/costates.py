"""Costates at the starts of rows, and the vector fields of all modes at any points, by JAX."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import CHUNK, Mesh, build_rows
from switchfit.discretization.model import Model, Piece
from switchfit.engine.jax.backward_sweep import backward_sweep
from switchfit.engine.jax.forward_sweep import forward_sweep
from switchfit.engine.jax.simulation import BLOCK
from switchfit.engine.protocol import Costates
from switchfit.problem.data import FloatArray
from switchfit.problem.functions import use_float64
from switchfit.problem.structure import Structure
from switchfit.runtime.cache import use_compilation_cache


def sweep_costates(
    structure: Structure, arguments: Arguments, mesh: Mesh, tau: FloatArray, p: FloatArray, multipliers: FloatArray
) -> Costates:
    """Return the costates of ``J + multipliers . c`` at the starts of all rows; rows of padding are left out."""
    layout = build_rows(mesh.nodes, tau, structure.fix_sides(1.0, np), np)
    with use_float64(), use_compilation_cache():
        found = _sweep_costates(arguments, tau, p, multipliers, structure=structure)
    states, costates = (np.asarray(values).reshape(-1, structure.n) for values in found)
    starts = np.asarray(layout.first_chunk) * CHUNK
    counts = np.asarray(layout.last_row) + 1 - starts
    counts[-1] = mesh.cells - int(layout.first_cell[-1])  # without the padding of the mesh
    rows = np.concatenate([np.arange(first, first + count) for first, count in zip(starts, counts, strict=True)])
    first_row = np.cumsum([0, *counts[:-1]])
    return Costates.of_rows(structure, first_row, np.reshape(layout.start, -1)[rows], states[rows], costates[rows])


@partial(jax.jit, static_argnames=("structure",))
def _sweep_costates(
    arguments: Arguments, tau: jax.Array, p: jax.Array, multipliers: jax.Array, *, structure: Structure
) -> tuple[jax.Array, jax.Array]:
    """Return states and costates at the starts of all rows, those of the padding included: (Q, C, n) each."""
    model = Model(structure, arguments)
    first = forward_sweep(model, tau, p, jnp.ones(()))
    return first.path.before, backward_sweep(model, first, p, multipliers).costates.before


def compute_slopes(
    structure: Structure,
    arguments: Arguments,
    times: FloatArray,
    cells: NDArray[np.intp],
    states: FloatArray,
    p: FloatArray,
) -> FloatArray:
    """Return the vector fields of all modes at times (L,), with the signals of cells (L,), and states (L, n).

    They are computed block by block, so that the program does not depend on the number of points.
    """
    count = len(times)
    points = times, np.asarray(arguments.nodes)[cells], np.asarray(arguments.signals)[cells], states
    parts = [np.zeros((0, len(structure.modes), structure.n))]
    with use_float64(), use_compilation_cache():
        for first in range(0, count, BLOCK):
            block = [np.resize(a[first : first + BLOCK], (BLOCK, *a.shape[1:])) for a in points]
            parts.append(np.asarray(_compute_block(arguments.without_mesh(), *block, p, structure=structure.functions)))
    return np.concatenate(parts)[:count]


@partial(jax.jit, static_argnames=("structure",))
def _compute_block(
    arguments: Arguments,
    times: jax.Array,
    origins: jax.Array,
    coefficients: jax.Array,
    states: jax.Array,
    p: jax.Array,
    *,
    structure: Structure,
) -> jax.Array:
    """Return the vector fields of all modes at the points of a block: (BLOCK, modes, n)."""
    model = Model(structure, arguments)

    def at_point(t: jax.Array, x: jax.Array, piece: Piece) -> jax.Array:
        return jnp.stack([model.field(mode, piece)(t, x, p) for mode in range(len(structure.modes))])

    return jax.vmap(at_point)(times, states, Piece(origins, coefficients))
