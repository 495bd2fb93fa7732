"""Simulations by JAX, a block of rows at a time: one small program per model, for any mesh and number of samples.

If derivatives are requested, they are propagated from row to row with the state. The propagated derivative is that of
x at the end of a row, which moves with theta where it is a transition. The returned derivative is that at fixed time:
the propagated one minus dx/dt times the derivative of the end.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from numpy.typing import NDArray

from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import CHUNK, Mesh, Rows, build_rows
from switchfit.discretization.model import Model, Piece, read_parameters
from switchfit.discretization.nodes import list_costs_at_transitions
from switchfit.discretization.steps import step
from switchfit.engine.protocol import Simulation, Tangents, add_samples, cut_at_tf
from switchfit.problem.data import FloatArray
from switchfit.problem.functions import use_float64
from switchfit.problem.losses import robust
from switchfit.problem.structure import Structure
from switchfit.runtime.cache import use_compilation_cache

BLOCK = 64
"""Rows per call of the program. Its shapes do not depend on the mesh, so that it is compiled once per model."""


def simulate_by_jax(
    structure: Structure, whole: Arguments, mesh: Mesh, tau: FloatArray, p: FloatArray, tangents: bool
) -> Simulation:
    """Return all rows of one experiment, with their derivatives if `tangents`."""
    arguments, functions, N = whole.without_mesh(), structure.functions, structure.N
    layout = build_rows(mesh.nodes, tau, 1.0, np)
    rows, first_row = list_rows(layout, mesh)
    cell, start, end = (np.reshape(a, -1)[rows] for a in (layout.cell, layout.start, layout.end))
    moved_by = (np.reshape(a, -1)[rows, None] for a in (layout.starts_at, layout.ends_at))
    starts_d, ends_d = (1.0 * (i == np.arange(N + structure.M)) for i in moved_by)
    given = start, end, starts_d, ends_d, whole.nodes[cell], whole.signals[cell]
    costly = {i for i, _ in list_costs_at_transitions(Model(structure, arguments))}
    parts, cost = [], 0.0
    with use_float64(), use_compilation_cache():
        x, X = map(np.asarray, _compute_initial_state(arguments, p, structure=functions, N=N, tangents=tangents))
        for i, (first, last) in enumerate(pairwise([*first_row, len(rows)])):
            if i > 0 and structure.reset_maps[i - 1] is not None:
                through = partial(_apply_reset, structure=structure, i=i - 1, tangents=tangents)
                x, X = map(np.asarray, through(arguments, tau[i - 1], x, X, p))
            simulate = partial(_simulate_block, structure=functions, tangents=tangents)
            for k in range(first, last, BLOCK):
                # The last row is repeated to the length of a block.
                here = [a[np.minimum(np.arange(k, k + BLOCK), last - 1)] for a in given]
                found = simulate(arguments, structure.mode_of_segment[i], x, X, p, *here)
                costs, moved, *columns = (np.asarray(column)[: last - k] for column in found)
                x, X, cost = columns[1][-1], moved[-1], cost + float(costs.sum())
                parts.append(columns)
            if i in costly:
                cost += float(_compute_transition_cost(arguments, tau[i], x, p, structure=structure, i=i))
        cost += float(_compute_terminal_cost(arguments, x, p, structure=functions))
    before, after, y_before, y_after, *derivatives = (np.concatenate(column) for column in zip(*parts, strict=True))
    simulation = Simulation(
        cost=cost,
        nodes=mesh.times,
        first_cell=np.asarray(layout.first_cell),
        start=start,
        end=end,
        before=before,
        after=after,
        y_before=y_before,
        y_after=y_after,
        tangents=Tangents(*derivatives) if tangents else None,
    )
    late = {
        k: _compute_late_outputs(structure, whole, simulation, k, cell, p)
        for k, sensor in enumerate(structure.measurements)
        if sensor.delay is not None
    }
    found = add_samples(simulation, structure, whole, late)
    return cut_at_tf(replace(found, cost=cost + _cost_of_samples(structure, whole, found.seen, p)), structure)


def list_rows(layout: Rows, mesh: Mesh) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the flat indices of the rows without padding (R,), and where each segment begins in them (N + 1,)."""
    starts = np.asarray(layout.first_chunk) * CHUNK
    counts = np.asarray(layout.last_row) + 1 - starts
    counts[-1] = mesh.cells - int(layout.first_cell[-1])  # without the padding of the mesh
    rows = np.concatenate([np.arange(first, first + count) for first, count in zip(starts, counts, strict=True)])
    return rows, np.cumsum([0, *counts[:-1]])


def _cost_of_samples(structure: Structure, arguments: Arguments, seen: tuple[FloatArray, ...], p: FloatArray) -> float:
    """Return the costs of all samples from the outputs, in NumPy: JAX would compile a program for each sample count."""
    named, total = read_parameters(structure, arguments, p), 0.0
    for samples, sensor, y in zip(arguments.samples, structure.measurements, seen, strict=True):
        there = np.asarray(samples.weight) > 0
        u = samples.weight * np.where(there, y - samples.value, 0.0) ** 2
        if sensor.sigma:
            sigma = np.array([1.0 if name is None else float(named[name]) for name in sensor.sigma])
            u = u / sigma**2
            total += float(np.sum(there * np.log(sigma)))
        total += 0.5 * float(np.sum(robust(sensor.loss, sensor.loss_scale, u)))
    return total


@partial(jax.jit, static_argnames=("structure", "N", "tangents"))
def _compute_initial_state(
    arguments: Arguments, p: jax.Array, *, structure: Structure, N: int, tangents: bool
) -> tuple[jax.Array, jax.Array]:
    """Return x(t0) and its derivative in (tau, p): (n,), (n, D)."""
    model = Model(structure, arguments)
    if not tangents:
        return model.initial_state(p), jnp.zeros((structure.n, 0))
    derivative = jax.jacfwd(model.initial_state)(p).reshape(structure.n, -1)
    return model.initial_state(p), jnp.pad(derivative, ((0, 0), (N, 0)))


@partial(jax.jit, static_argnames=("structure", "i", "tangents"))
def _apply_reset(
    arguments: Arguments,
    t: jax.Array,
    x: jax.Array,
    X: jax.Array,
    p: jax.Array,
    *,
    structure: Structure,
    i: int,
    tangents: bool,
) -> tuple[jax.Array, jax.Array]:
    """Return the state after transition i (from 0) and its derivative along the moving transition: (n,), (n, D)."""
    reset = Model(structure, arguments).reset(i)
    if not tangents:
        return reset(t, x, p), X
    at_transition = (jnp.arange(X.shape[1]) == i).astype(float)
    after, linear = jax.linearize(reset, t, x, p)
    return after, jax.vmap(linear, in_axes=(0, 1, 1), out_axes=1)(at_transition, X, _of_parameters(X, p))


@partial(jax.jit, static_argnames=("structure", "tangents"))
def _simulate_block(
    arguments: Arguments,
    mode: jax.Array,
    x: jax.Array,
    X: jax.Array,
    p: jax.Array,
    *given: jax.Array,
    structure: Structure,
    tangents: bool,
) -> tuple[jax.Array, ...]:
    """Simulate a block of rows in one mode; x and X are the state before it and its derivative.

    Returns columns of the rows: the running cost, the propagated derivative at the end, then states before and after,
    outputs before and after, and, if requested, the derivatives of these at fixed times.
    """
    model = Model(structure, arguments)
    P = _of_parameters(X, p) if tangents else X

    def through(mode: int) -> Callable[..., Any]:
        def row(carried: tuple[jax.Array, jax.Array], given: tuple[jax.Array, ...]) -> tuple[Any, Any]:
            x, X = carried
            start, end, start_d, end_d, *piece = given
            f, ell = model.field(mode, Piece(*piece)), model.density(mode, Piece(*piece))

            def advance(start: jax.Array, end: jax.Array, x: jax.Array, p: jax.Array) -> tuple[jax.Array, jax.Array]:
                return step(model.tableaus[mode], f, ell if model.has_running_cost else None, start, end, x, p)

            if not tangents:
                after, cost = advance(start, end, x, p)
                return (after, X), (cost, X, x, after)
            after, linear, cost = jax.linearize(advance, start, end, x, p, has_aux=True)
            X_after = jax.vmap(linear, in_axes=(0, 0, 1, 1), out_axes=1)(start_d, end_d, X, P)
            before_d = X - jnp.outer(f(start, x, p), start_d)
            after_d = X_after - jnp.outer(f(end, after, p), end_d)
            return (after, X_after), (cost, X_after, x, after, before_d, after_d)

        return lambda x, X: lax.scan(row, (x, X), given)[1]

    modes = [through(k) for k in range(len(structure.modes))]
    found = modes[0](x, X) if len(modes) == 1 else lax.switch(mode, modes, x, X)
    costs, moved, before, after, *derivatives = found

    def see_along(t: jax.Array, x: jax.Array, X: jax.Array) -> jax.Array:
        linear = jax.linearize(partial(_see, model, t), x, p)[1]
        return jax.vmap(linear, in_axes=(1, 1), out_axes=1)(X, P)

    ends = (given[0], before), (given[1], after)
    outputs = [jax.vmap(partial(_see, model), in_axes=(0, 0, None))(*at, p) for at in ends]
    outputs_d = [jax.vmap(see_along)(*at, along) for at, along in zip(ends, derivatives, strict=tangents)]
    return costs, moved, before, after, *outputs, *derivatives, *outputs_d


def _of_parameters(X: jax.Array, p: jax.Array) -> jax.Array:
    """Return the derivative of p in (tau, p), ``[0 | I]``: (M, D)."""
    M = p.shape[0]
    return jnp.pad(jnp.eye(M), ((0, 0), (X.shape[1] - M, 0)))


@partial(jax.jit, static_argnames=("structure", "i"))
def _compute_transition_cost(
    arguments: Arguments, t: jax.Array, x: jax.Array, p: jax.Array, *, structure: Structure, i: int
) -> jax.Array:
    """Return the costs at transition i (from 0)."""
    total = jnp.zeros(())
    for at, cost in list_costs_at_transitions(Model(structure, arguments)):
        total = total + cost(t, x, p) if at == i else total
    return total


@partial(jax.jit, static_argnames=("structure",))
def _compute_terminal_cost(arguments: Arguments, x: jax.Array, p: jax.Array, *, structure: Structure) -> jax.Array:
    return Model(structure, arguments).terminal(x, p)


def _compute_late_outputs(
    structure: Structure, whole: Arguments, simulation: Simulation, k: int, cell: NDArray[np.intp], p: FloatArray
) -> FloatArray:
    """Return the outputs of all sensors at the samples of the k-th Measurements, which are late: (K, Q)."""
    sensor, samples = structure.measurements[k], whole.samples[k]
    times = np.asarray(samples.time) - float(read_parameters(structure, whole, p)[sensor.delay or ""])
    row = np.minimum(np.searchsorted(simulation.end, times), len(simulation.end) - 1)
    counts = [own.stop - own.start for own in simulation.segments]
    mode, at = np.repeat(structure.mode_of_segment, counts)[row], cell[row]
    piece = Piece(whole.nodes[at], whole.signals[at])
    return _map_blocks(
        _see_late, structure, whole, (times, mode, simulation.start[row], simulation.before[row], piece), p
    )


def compute_slopes(
    structure: Structure,
    arguments: Arguments,
    times: FloatArray,
    cells: NDArray[np.intp],
    states: FloatArray,
    p: FloatArray,
) -> FloatArray:
    """Return the vector fields of all modes at times (L,), with the signals of cells (L,), and states (L, n)."""
    piece = Piece(np.asarray(arguments.nodes)[cells], np.asarray(arguments.signals)[cells])  # type: ignore[arg-type]
    return _map_blocks(_compute_fields, structure, arguments, (times, states, piece), p)


def _map_blocks(
    program: Callable[..., Any], structure: Structure, arguments: Arguments, points: tuple[Any, ...], p: FloatArray
) -> FloatArray:
    """Return the results of a program at points, of arrays (L, ...), block by block: (L, ...)."""
    count, parts = len(points[0]), []
    with use_float64(), use_compilation_cache():
        for first in range(0, max(count, 1), BLOCK):
            block = jax.tree.map(lambda a, k=first: np.resize(a[k : k + BLOCK], (BLOCK, *a.shape[1:])), points)
            parts.append(np.asarray(program(arguments.without_mesh(), block, p, structure=structure.functions)))
    return np.concatenate(parts)[:count]


@partial(jax.jit, static_argnames=("structure",))
def _compute_fields(arguments: Arguments, points: tuple[Any, ...], p: jax.Array, *, structure: Structure) -> jax.Array:
    """Return the vector fields of all modes at the points of a block: (BLOCK, modes, n)."""
    model = Model(structure, arguments)

    def at_point(t: jax.Array, x: jax.Array, piece: Piece) -> jax.Array:
        return jnp.stack([model.field(mode, piece)(t, x, p) for mode in range(len(structure.modes))])

    return jax.vmap(at_point)(*points)


@partial(jax.jit, static_argnames=("structure",))
def _see_late(arguments: Arguments, points: tuple[Any, ...], p: jax.Array, *, structure: Structure) -> jax.Array:
    """Return all outputs at times inside rows, a step from the start of each: (BLOCK, Q)."""
    model = Model(structure, arguments)

    def one(time: jax.Array, mode: jax.Array, start: jax.Array, x: jax.Array, piece: Piece) -> jax.Array:
        steps = [
            lambda x, m=m: step(model.tableaus[m], model.field(m, piece), None, start, time, x, p)[0]
            for m in range(len(structure.modes))
        ]
        return _see(model, time, lax.switch(mode, steps, x), p)

    return jax.vmap(one)(*points)


def _see(model: Model, t: jax.Array, x: jax.Array, p: jax.Array) -> jax.Array:
    """Return the outputs of all sensors: (Q,)."""
    return jnp.concatenate([jnp.zeros(0), *(model.observe(h, t, x, p) for h, _ in model.structure.outputs)])
