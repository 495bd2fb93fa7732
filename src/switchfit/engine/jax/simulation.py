"""Simulations by JAX, a block of rows at a time: one small program per model, for any mesh and number of samples.

If derivatives are requested, they are propagated from row to row with the state. The propagated derivative is that of
x at the end of a row, which moves with theta where it is a transition. The returned derivative is that at fixed time:
the propagated one minus dx/dt times the derivative of the end.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from numpy.typing import NDArray

from switchfit.discretization.arguments import Arguments
from switchfit.discretization.mesh import CHUNK, Mesh, build_rows
from switchfit.discretization.model import Model, Piece
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
    arguments = whole.without_mesh()
    layout = build_rows(mesh.nodes, tau, 1.0, np)
    cell, start, end = (np.reshape(a, -1) for a in (layout.cell, layout.start, layout.end))
    index = np.arange(structure.N + structure.M)
    starts_d, ends_d = (1.0 * (np.reshape(a, -1)[:, None] == index) for a in (layout.starts_at, layout.ends_at))
    costly = {i for i, _ in list_costs_at_transitions(Model(structure, arguments))}
    kept, parts, cost = [], [], 0.0
    with use_float64(), use_compilation_cache():
        start_of = partial(_compute_initial_state, structure=structure.functions, N=structure.N, tangents=tangents)
        x, X = map(np.asarray, start_of(arguments, p))
        for i, mode in enumerate(structure.mode_of_segment):
            if i > 0 and structure.reset_maps[i - 1] is not None:
                through = partial(_apply_reset, structure=structure, i=i - 1, tangents=tangents)
                x, X = map(np.asarray, through(arguments, tau[i - 1], x, X, p))
            first = int(layout.first_chunk[i]) * CHUNK
            count = int(layout.last_row[i]) + 1 - first
            if i == structure.N:  # without the padding of the mesh
                count = mesh.cells - int(layout.first_cell[i])
            here = slice(first, first + count)
            pieces = Piece(whole.nodes[cell[here]], whole.signals[cell[here]])
            given = start[here], end[here], starts_d[here], ends_d[here], pieces
            x, X, added, columns = _simulate_segment(structure, arguments, mode, x, X, p, given, tangents)
            kept.append(np.arange(here.start, here.stop))
            parts.append(columns)
            cost += added
            if i in costly:
                cost += float(_compute_transition_cost(arguments, tau[i], x, p, structure=structure, i=i))
        cost += float(_compute_terminal_cost(arguments, x, p, structure=structure.functions))
    own = np.concatenate(kept)
    before, after, y_before, y_after, *derivatives = (np.concatenate(column) for column in zip(*parts, strict=True))
    simulation = Simulation(
        cost=cost,
        nodes=mesh.times,
        first_cell=np.asarray(layout.first_cell),
        start=start[own],
        end=end[own],
        before=before,
        after=after,
        y_before=y_before,
        y_after=y_after,
        tangents=Tangents(*derivatives) if tangents else None,
    )
    late = {
        k: _compute_late_outputs(structure, whole, simulation, k, cell[own], p)
        for k, sensor in enumerate(structure.measurements)
        if sensor.delay is not None
    }
    found = add_samples(simulation, structure, whole, late)
    return cut_at_tf(replace(found, cost=cost + _cost_of_samples(structure, whole, found.seen, p)), structure)


def _cost_of_samples(structure: Structure, arguments: Arguments, seen: tuple[FloatArray, ...], p: FloatArray) -> float:
    """Return the costs of all samples from the outputs, in NumPy: JAX would compile a program for each sample count."""
    named, total = _name_parameters(structure, arguments, p), 0.0
    for samples, sensor, y in zip(arguments.samples, structure.measurements, seen, strict=True):
        there = np.asarray(samples.weight) > 0
        u = samples.weight * np.where(there, y - samples.value, 0.0) ** 2
        if sensor.sigma:
            sigma = np.array([1.0 if name is None else float(named[name]) for name in sensor.sigma])
            u = u / sigma**2
            total += float(np.sum(there * np.log(sigma)))
        total += 0.5 * float(np.sum(robust(sensor.loss, sensor.loss_scale, u)))
    return total


def _name_parameters(structure: Structure, arguments: Arguments, p: FloatArray) -> dict[str, Any]:
    """Return the parameters by the model's names."""
    return dict(Model(structure, arguments).parameters(p))  # type: ignore[arg-type]  # NumPy arrays


def _simulate_segment(
    structure: Structure,
    arguments: Arguments,
    mode: int,
    x: FloatArray,
    X: FloatArray,
    p: FloatArray,
    given: tuple[FloatArray, FloatArray, FloatArray, FloatArray, Piece],
    tangents: bool,
) -> tuple[FloatArray, FloatArray, float, list[FloatArray]]:
    """Return all rows of a segment, block by block; the last block is padded with rows of length zero at fixed times.

    Returns the state after it and its derivative, the running cost, and columns: states before and after, outputs
    before and after; then their derivatives, if requested.
    """
    end, count = given[1], len(given[0])
    missing = -count % BLOCK
    still = (np.repeat(end[-1:], missing),) * 2 + (np.zeros((missing, given[2].shape[1])),) * 2
    times = [np.concatenate([a, b]) for a, b in zip(given[:4], still, strict=True)]
    pieces = jax.tree.map(lambda a: np.concatenate([a, np.repeat(a[-1:], missing, axis=0)]), given[4])
    block = partial(_simulate_block, structure=structure.functions, tangents=tangents)
    parts, cost = [], 0.0
    for k in range(0, count + missing, BLOCK):
        span = slice(k, k + BLOCK)
        here = (*(a[span] for a in times), jax.tree.map(lambda a, span=span: a[span], pieces))
        carried, added, columns = block(arguments, mode, x, X, p, here)
        x, X = map(np.asarray, carried)
        cost += float(added)
        parts.append([np.asarray(column) for column in columns])
    return x, X, cost, [np.concatenate(column)[:count] for column in zip(*parts, strict=True)]


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
    given: tuple[jax.Array, jax.Array, jax.Array, jax.Array, Piece],
    *,
    structure: Structure,
    tangents: bool,
) -> tuple[tuple[jax.Array, jax.Array], jax.Array, tuple[jax.Array, ...]]:
    """Return x and X after a block of rows in one mode, its running cost, and columns as in `_simulate_segment`."""
    model = Model(structure, arguments)
    P = _of_parameters(X, p) if tangents else X

    def through(mode: int) -> Callable[..., Any]:
        tableau = model.tableaus[mode]

        def row(carried: tuple[jax.Array, jax.Array], given: tuple[Any, ...]) -> tuple[Any, Any]:
            x, X = carried
            start, end, start_d, end_d, piece = given
            f, ell = model.field(mode, piece), model.density(mode, piece) if model.has_running_cost else None
            after, cost = step(tableau, f, ell, start, end, x, p)
            if not tangents:
                return (after, X), (cost, x, after)

            def advance(start: jax.Array, end: jax.Array, x: jax.Array, p: jax.Array) -> jax.Array:
                return step(tableau, f, None, start, end, x, p)[0]

            _, linear = jax.linearize(advance, start, end, x, p)
            X_after = jax.vmap(linear, in_axes=(0, 0, 1, 1), out_axes=1)(start_d, end_d, X, P)
            before_d = X - jnp.outer(f(start, x, p), start_d)
            after_d = X_after - jnp.outer(f(end, after, p), end_d)
            return (after, X_after), (cost, x, after, before_d, after_d)

        return lambda x, X: lax.scan(row, (x, X), given)

    modes = [through(k) for k in range(len(structure.modes))]
    carried, found = modes[0](x, X) if len(modes) == 1 else lax.switch(mode, modes, x, X)
    costs, before, after, *derivatives = found

    def seen(t: jax.Array, x: jax.Array, p: jax.Array) -> jax.Array:
        return jnp.concatenate([jnp.zeros(0), *(model.observe(h, t, x, p) for h, _ in structure.outputs)])

    def along(t: jax.Array, x: jax.Array, X: jax.Array) -> jax.Array:
        linear = jax.linearize(partial(seen, t), x, p)[1]
        return jax.vmap(linear, in_axes=(1, 1), out_axes=1)(X, P)

    over_rows = jax.vmap(seen, in_axes=(0, 0, None))
    columns = [before, after, over_rows(given[0], before, p), over_rows(given[1], after, p)]
    if tangents:
        columns += derivatives
        columns += [jax.vmap(along)(t, x, X) for t, x, X in zip(given[:2], (before, after), derivatives, strict=True)]
    return carried, costs.sum(), tuple(columns)


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
    times = np.asarray(samples.time) - float(_name_parameters(structure, whole, p)[sensor.delay or ""])
    row = np.minimum(np.searchsorted(simulation.end, times), len(simulation.end) - 1)
    counts = [own.stop - own.start for own in simulation.segments]
    mode, at = np.repeat(structure.mode_of_segment, counts)[row], cell[row]
    of_rows = times, mode, simulation.start[row], simulation.before[row], whole.nodes[at], whole.signals[at]
    padded = [np.concatenate([a, np.repeat(a[-1:], -len(times) % BLOCK, axis=0)]) for a in of_rows]
    parts = []
    with use_float64(), use_compilation_cache():
        for first in range(0, len(padded[0]), BLOCK):
            block = [a[first : first + BLOCK] for a in padded]
            parts.append(
                np.asarray(_simulate_late_block(whole.without_mesh(), *block, p, structure=structure.functions))
            )
    return np.concatenate(parts)[: len(times)]


@partial(jax.jit, static_argnames=("structure",))
def _simulate_late_block(
    arguments: Arguments,
    times: jax.Array,
    mode: jax.Array,
    start: jax.Array,
    x: jax.Array,
    origin: jax.Array,
    coefficients: jax.Array,
    p: jax.Array,
    *,
    structure: Structure,
) -> jax.Array:
    """Return all outputs at times inside rows, a step from the start of each: (BLOCK, Q)."""
    model = Model(structure, arguments)

    def one(time: jax.Array, mode: jax.Array, start: jax.Array, x: jax.Array, piece: Piece) -> jax.Array:
        steps = [
            lambda x, m=m: step(model.tableaus[m], model.field(m, piece), None, start, time, x, p)[0]
            for m in range(len(structure.modes))
        ]
        there = lax.switch(mode, steps, x)
        return jnp.concatenate([jnp.zeros(0), *(model.observe(h, time, there, p) for h, _ in structure.outputs)])

    return jax.vmap(one)(times, mode, start, x, Piece(origin, coefficients))
