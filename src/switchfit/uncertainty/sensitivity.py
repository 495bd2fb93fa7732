"""How states and outputs depend on theta along a trajectory: exact first derivatives of the discretised system.

Machine code has x and its derivative X in theta at the ends of all rows. Where there is none, JAX carries them from row
to row, in blocks of rows, mode by mode: one small program a model, whatever the mesh and the number of samples.

The derivative of x at a *fixed* time t jumps where a transition time passes t. With X^i the jump of the vector field,
equation (8), it is 0 in tau_i just before the transition and -X^i just after. At a transition both are given, one with
the state before it and one with the state after it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from numpy.typing import NDArray

from switchfit.discretization.arguments import Arguments, arguments_of
from switchfit.discretization.mesh import CHUNK, Mesh, rows
from switchfit.discretization.model import Model, Piece
from switchfit.discretization.steps import step
from switchfit.engine.adaptive import initial_state
from switchfit.engine.native.experiment import native_experiment
from switchfit.engine.native.templates import Order
from switchfit.fit.trajectory import BLOCK
from switchfit.problem.data import FloatArray, Measurements
from switchfit.problem.functions import float64
from switchfit.problem.problem import Problem
from switchfit.problem.structure import Structure
from switchfit.runtime.cache import compilation_cache


class Points(NamedTuple):
    """Values and their derivatives at L times.

    Attributes
    ----------
    times : (L,)
    states, states_d : (L, n), (L, n, d)
    outputs, outputs_d : (L, Q), (L, Q, d)
        Of the reference signals, then of the Measurements, in their order.
    """

    times: FloatArray
    states: FloatArray
    states_d: FloatArray
    outputs: FloatArray
    outputs_d: FloatArray


class Segment(NamedTuple):
    """One mode's turn: its rows from `start` to `end` (R,), with what is at either end of each."""

    start: FloatArray
    end: FloatArray
    before: Points
    after: Points


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """States and outputs of one experiment and their derivatives in theta.

    Attributes
    ----------
    segments : list of Segment
    first_cell : (N + 1,) int
        The cells of the mesh in which the segments begin.
    mesh : Mesh
    """

    segments: list[Segment]
    first_cell: NDArray[np.intp]
    mesh: Mesh

    @property
    def nodes(self) -> Points:
        """At all nodes in order, as `Trajectory` has them: each transition stands twice, before and after it."""
        shown = [_joined([_at(s.before, slice(1)), _at(s.after, s.end > s.start)]) for s in self.segments]
        return _joined(shown)

    def at(self, times: FloatArray) -> Points:
        """At nodes (K,) of the mesh; at a transition what is just before it, as a sample there is."""
        cells = self.mesh.cell_ending_at(times)
        segment = (cells[:, None] >= self.first_cell[None, 1:]).sum(1)
        first_row = np.cumsum([1, *(len(part.start) for part in self.segments)])  # after that of t0
        ends = _joined([_at(self.segments[0].before, slice(1)), *(part.after for part in self.segments)])
        row = np.where(cells < 0, 0, first_row[segment] + cells - self.first_cell[segment])
        return _at(ends, row)._replace(times=np.asarray(times, dtype=np.float64))


def _at(points: Points, which: slice | NDArray[Any]) -> Points:
    return Points(*(column[which] for column in points))


def _joined(parts: Sequence[Points]) -> Points:
    return Points(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def sensitivity(problem: Problem, e: int, theta: FloatArray, mesh: Mesh) -> Sensitivity:
    """States and outputs of experiment e at theta, and their derivatives in theta, on the nodes of a mesh.

    Parameters
    ----------
    problem : Problem
    e : int
        Which experiment, from 0.
    theta : (d,)
    mesh : Mesh
        With all sample times and knots as nodes.
    """
    structure = problem.structures[e]
    tau, p = problem.vectors(theta, e)
    whole = arguments_of(problem, e, mesh)
    found = _natively(structure, whole, mesh, tau, p)
    segments, first_cell = _by_blocks(structure, whole, mesh, tau, p) if found is None else found
    placed = [_placed(part, problem.places[e], len(theta)) for part in segments]
    return Sensitivity(placed, first_cell, mesh)


def _natively(
    structure: Structure, whole: Arguments, mesh: Mesh, tau: FloatArray, p: FloatArray
) -> tuple[list[Segment], NDArray[np.intp]] | None:
    """All segments by machine code, and the cells in which they begin; None where there is none that can be used.

    Its derivatives are those at the ends of rows, which move where they are transitions. At the time at which such an
    end is they are less dx/dt.
    """
    native = native_experiment(structure, whole, mesh.times, order=Order.HESSIAN)
    fields = native_experiment(structure, whole, mesh.times, order=Order.COST)
    if native is None or fields is None:
        return None
    found = native.simulated(tau, p)
    if found is None:
        return None
    N, cells = structure.N, len(mesh.times) - 1
    lasts = [*found.first_cell[1:].tolist(), cells - 1]
    segments = []
    for i, (first, last) in enumerate(zip(found.first_cell.tolist(), lasts, strict=True)):
        here = slice(first + i, last + i + 2)
        times, states, tangents = (a[here].copy() for a in (found.times, found.states, found.tangents))
        if i - 1 in structure.resets:
            states[0], tangents[0] = found.reset_states[i - 1], found.reset_tangents[i - 1]
        mode = structure.mode_of_segment[i]
        for k, transition in ((0, i - 1), (-1, i)):
            if 0 <= transition < N:
                slope = fields.slope(mode, times[k], np.append(states[k], 0.0), p, first if k == 0 else last)[:-1]
                tangents[k, :, transition] -= slope
        seen = native.outputs(times, states, p, tangents)
        if seen is None:
            return None
        points = Points(times, states, tangents, *seen)
        before = Points(*(column[:-1] for column in points))
        segments.append(Segment(times[:-1], times[1:], before, Points(*(column[1:] for column in points))))
    return segments, found.first_cell.astype(np.intp)


def _by_blocks(
    structure: Structure, whole: Arguments, mesh: Mesh, tau: FloatArray, p: FloatArray
) -> tuple[list[Segment], NDArray[np.intp]]:
    """The same by JAX, some rows at a time."""
    arguments = whole.without_mesh()
    layout = rows(mesh.nodes, tau, 1.0, np)
    cell, start, end = (np.reshape(a, -1) for a in (layout.cell, layout.start, layout.end))
    index = np.arange(structure.N)
    starts_d, ends_d = (1.0 * (np.reshape(a, -1)[:, None] == index) for a in (layout.starts_at, layout.ends_at))
    segments: list[Segment] = []
    with float64(), compilation_cache():
        x = np.asarray(initial_state(arguments, p, structure=structure.functions))
        X = np.asarray(_initial_tangents(arguments, p, structure=structure.functions, N=structure.N))
        for i, mode in enumerate(structure.mode_of_segment):
            if i > 0 and structure.reset_maps[i - 1] is not None:
                x, X = map(np.asarray, _through_reset(arguments, tau[i - 1], x, X, p, structure=structure, i=i - 1))
            span = slice(layout.first_chunk[i] * CHUNK, layout.last_row[i] + 1)
            pieces = Piece(whole.nodes[cell[span]], whole.signals[cell[span]])
            given = (start[span], end[span], starts_d[span], ends_d[span], pieces)
            x, X, part = _segment(structure, arguments, mode, x, X, p, given)
            segments.append(part)
    return segments, np.asarray(layout.first_cell)


def _placed(part: Segment, places: NDArray[np.intp], d: int) -> Segment:
    """Derivatives in theta (d) from those in the experiment's own transition times and parameters (D)."""
    own = places >= 0

    def spread(derivative: FloatArray) -> FloatArray:
        full = np.zeros((*derivative.shape[:-1], d))
        # Two names of the model may mean one parameter: both count.
        np.add.at(np.moveaxis(full, -1, 0), places[own], np.moveaxis(derivative, -1, 0)[own])
        return full

    def of(points: Points) -> Points:
        return points._replace(states_d=spread(points.states_d), outputs_d=spread(points.outputs_d))

    return part._replace(before=of(part.before), after=of(part.after))


def _segment(
    structure: Structure,
    arguments: Arguments,
    mode: int,
    x: FloatArray,
    X: FloatArray,
    p: FloatArray,
    given: tuple[FloatArray, FloatArray, FloatArray, FloatArray, Piece],
) -> tuple[FloatArray, FloatArray, Segment]:
    """All rows of a segment, block by block; the last block is padded with rows of length zero at fixed times."""
    start, end = given[:2]
    count = len(start)
    missing = -count % BLOCK
    still = (np.repeat(end[-1:], missing),) * 2 + (np.zeros((missing, given[2].shape[1])),) * 2
    times = [np.concatenate([a, b]) for a, b in zip(given[:4], still, strict=True)]
    pieces = jax.tree.map(lambda a: np.concatenate([a, np.repeat(a[-1:], missing, axis=0)]), given[4])
    parts = []
    for k in range(0, count + missing, BLOCK):
        span = slice(k, k + BLOCK)
        here = (*(a[span] for a in times), jax.tree.map(lambda a, span=span: a[span], pieces))
        carried, columns = _block_along(arguments, mode, x, X, p, here, structure=structure.functions)
        x, X = map(np.asarray, carried)
        parts.append([np.asarray(column) for column in columns])
    columns = [np.concatenate(column)[:count] for column in zip(*parts, strict=True)]
    return x, X, Segment(start, end, Points(start, *columns[:4]), Points(end, *columns[4:]))


@partial(jax.jit, static_argnames=("structure", "N"))
def _initial_tangents(arguments: Arguments, p: jax.Array, *, structure: Structure, N: int) -> jax.Array:
    """Derivative of x(t0) in (tau, p): (n, D)."""
    model = Model(structure, arguments)
    return jnp.pad(jax.jacfwd(model.initial_state)(p).reshape(structure.n, -1), ((0, 0), (N, 0)))


@partial(jax.jit, static_argnames=("structure", "i"))
def _through_reset(
    arguments: Arguments,
    t: jax.Array,
    x: jax.Array,
    X: jax.Array,
    p: jax.Array,
    *,
    structure: Structure,
    i: int,
) -> tuple[jax.Array, jax.Array]:
    """State after transition i (from 0) and its derivative in theta along the moving transition: (n,), (n, D)."""
    reset = Model(structure, arguments).reset(i)
    at_transition = 1.0 * (jnp.arange(X.shape[1]) == i)
    after, linear = jax.linearize(reset, t, x, p)
    return after, jax.vmap(linear, in_axes=(0, 1, 1), out_axes=1)(at_transition, X, _of_parameters(X, p))


@partial(jax.jit, static_argnames=("structure",))
def _block_along(
    arguments: Arguments,
    mode: jax.Array,
    x: jax.Array,
    X: jax.Array,
    p: jax.Array,
    given: tuple[jax.Array, jax.Array, jax.Array, jax.Array, Piece],
    *,
    structure: Structure,
) -> tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, ...]]:
    """A block of rows in one mode: x and X after it, and (x, X, y, Y) at the start and the end of each row.

    What is carried is the derivative of x at the end of a row, which moves with theta where it is a transition; what is
    returned is that at the time at which the end is: less dx/dt times the end's own derivative.
    """
    model, P = Model(structure, arguments), _of_parameters(X, p)
    M = structure.M

    def through(mode: int) -> Callable[..., tuple[tuple[jax.Array, jax.Array], tuple[jax.Array, ...]]]:
        def row(carried: tuple[jax.Array, jax.Array], given: tuple[Any, ...]) -> tuple[Any, Any]:
            x, X = carried
            start, end, start_d, end_d, piece = given
            start_d, end_d = jnp.pad(start_d, (0, M)), jnp.pad(end_d, (0, M))
            f = model.field(mode, piece)

            def advance(start: jax.Array, end: jax.Array, x: jax.Array, p: jax.Array) -> jax.Array:
                return step(model.tableau, f, None, start, end, x, p)[0]

            after, linear = jax.linearize(advance, start, end, x, p)
            X_after = jax.vmap(linear, in_axes=(0, 0, 1, 1), out_axes=1)(start_d, end_d, X, P)
            before_d = X - f(start, x, p)[:, None] * start_d
            after_d = X_after - f(end, after, p)[:, None] * end_d
            return (after, X_after), (x, before_d, after, after_d)

        return lambda x, X: lax.scan(row, (x, X), given)

    modes = [through(k) for k in range(len(structure.modes))]
    carried, (before, before_d, after, after_d) = modes[0](x, X) if len(modes) == 1 else lax.switch(mode, modes, x, X)

    def outputs(t: jax.Array, x: jax.Array, X: jax.Array) -> tuple[jax.Array, jax.Array]:
        def seen(x: jax.Array, p: jax.Array) -> jax.Array:
            return jnp.concatenate([jnp.zeros(0), *(model.observed(h, t, x, p) for h, _ in structure.outputs)])

        y, linear = jax.linearize(seen, x, p)
        return y, jax.vmap(linear, in_axes=(1, 1), out_axes=1)(X, P)

    over_rows = jax.vmap(outputs)
    at_start, at_end = over_rows(given[0], before, before_d), over_rows(given[1], after, after_d)
    return carried, (before, before_d, *at_start, after, after_d, *at_end)


def _of_parameters(X: jax.Array, p: jax.Array) -> jax.Array:
    """Derivative of p in (tau, p), ``[0 | I]``: (M, D)."""
    M = p.shape[0]
    return jnp.pad(jnp.eye(M), ((0, 0), (X.shape[1] - M, 0)))


class SampleDerivatives(NamedTuple):
    """The samples that are not missing, S of them over all experiments.

    Attributes
    ----------
    experiment : (S,) int
    item, channel : (S,) int
        Which of the experiment's Measurements, and which of its channels.
    time, residual, weight : (S,)
        Sample time in the experiment's time unit, fitted less measured, ``1 / sigma**2`` (1 where sigma is unknown).
    derivative : (S, d)
        Of the fitted value in theta.
    """

    experiment: NDArray[np.intp]
    item: NDArray[np.intp]
    channel: NDArray[np.intp]
    time: FloatArray
    residual: FloatArray
    weight: FloatArray
    derivative: FloatArray


def sample_derivatives(problem: Problem, sensitivities: Sequence[Sensitivity]) -> SampleDerivatives:
    """Residuals of all samples and the derivatives of what is fitted to them.

    Parameters
    ----------
    problem : Problem
    sensitivities : sequence of Sensitivity, one an experiment
    """
    d = len(problem.theta_names)
    columns: list[tuple[NDArray[Any], ...]] = []
    for e, (experiment, found) in enumerate(zip(problem.experiments, sensitivities, strict=True)):
        first = sum(q for _, q in problem.structures[e].references)
        items = [item for item in experiment.data if isinstance(item, Measurements)]
        for k, item in enumerate(items):
            q = item.values.shape[1]
            points = found.at(item.times)
            there = ~np.isnan(item.values)
            where = np.argwhere(there)
            fitted, slope = points.outputs[:, first : first + q], points.outputs_d[:, first : first + q]
            columns.append(
                (
                    np.full(len(where), e),
                    np.full(len(where), k),
                    where[:, 1],
                    item.times[where[:, 0]],
                    (fitted - np.nan_to_num(item.values))[there],
                    item.weights[there],
                    slope[there],
                )
            )
            first += q
    if not columns:
        none = np.zeros(0, dtype=np.intp)
        return SampleDerivatives(none, none, none, np.zeros(0), np.zeros(0), np.zeros(0), np.zeros((0, d)))
    return SampleDerivatives(*(np.concatenate(column) for column in zip(*columns, strict=True)))


def gauss_newton_of(samples: SampleDerivatives) -> FloatArray:
    """The Gauss-Newton matrix ``sum_k w_k (D h_k)' D h_k`` of all samples: (d, d)."""
    return samples.derivative.T @ (samples.weight[:, None] * samples.derivative)
