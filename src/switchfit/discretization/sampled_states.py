"""The states that samples see, as JAX functions: those at nodes, and those of late samples inside a row.

A sample with a delay saw the state at ``t - delay(p)``, which a step of its own reaches from the start of the row
around that time.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jax import Array, lax

from switchfit.discretization.arguments import Samples
from switchfit.discretization.model import Model
from switchfit.discretization.propagation import Path, switch_mode
from switchfit.discretization.signals import Piece
from switchfit.discretization.steps import step


def see_samples(model: Model, path: Path, k: int, p: Array) -> tuple[Samples, Array]:
    """Return the samples of the k-th Measurements, with the times of the states that late ones saw, and these states:
    (K, n).
    """
    samples = model.arguments.samples[k]
    if model.structure.measurements[k].delay is None:
        return samples, path.at_samples(samples.cell)
    _, segment, piece, start, before = find_late_rows(model, path, k, p)
    late = jax.vmap(partial(step_to_late_sample, model, k), in_axes=(0, 0, 0, 0, 0, None))
    return late(samples, segment, piece, start, before, p)


def find_late_rows(model: Model, path: Path, k: int, p: Array) -> tuple[Array, Array, Piece, Array, Array]:
    """Return the rows with ``start < t - delay <= end`` for the late samples of the k-th Measurements.

    Returns
    -------
    row, segment : (K,) int
    piece : Piece, of K rows
    start, x : (K,), (K, n), start of the row and the state there
    """
    layout, samples = path.layout, model.arguments.samples[k]
    # The row is found by search, which has no derivative; the time inside it is differentiated in
    # `step_to_late_sample`.
    times = lax.stop_gradient(jax.vmap(lambda s: model.correct_delay(k, s, p).time)(samples))
    ends = lax.stop_gradient(layout.end)
    # A time outside of the horizon, at a trial delay, is reached from the first or from the last row.
    row = jnp.minimum(jnp.searchsorted(ends, times), ends.shape[0] - 1)
    piece = jax.tree.map(lambda a: a[row], path.pieces)
    return row, layout.segment[row], piece, layout.start[row], path.before[row]


def step_to_late_sample(
    model: Model, k: int, sample: Samples, segment: Array, piece: Piece, start: Array, x: Array, p: Array
) -> tuple[Samples, Array]:
    """Return one late sample with the time of the state that it saw, and that state, one step from `start`: (n,)."""
    there = model.correct_delay(k, sample, p)

    def through(mode: int) -> Callable[..., Array]:
        return lambda time, start, x: step(model.tableaus[mode], model.field(mode, piece), start, time, x, p)[0]

    return there, switch_mode(model, segment, through, there.time, start, x)
