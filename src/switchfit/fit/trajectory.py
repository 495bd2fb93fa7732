"""Trajectories for people: the forward pass at any theta, as NumPy arrays."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from numpy.typing import ArrayLike, NDArray

from switchfit.discretization.arguments import Arguments, arguments_of
from switchfit.discretization.mesh import CHUNK, Mesh, rows
from switchfit.discretization.model import Model, Piece
from switchfit.discretization.steps import step
from switchfit.engine.adaptive import after_reset, initial_state, refined_mesh
from switchfit.engine.native.experiment import NativeExperiment, native_experiment
from switchfit.engine.native.templates import Order
from switchfit.problem.data import FloatArray, Measurements, ReferenceSignal
from switchfit.problem.functions import float64
from switchfit.problem.losses import robust
from switchfit.problem.problem import Problem
from switchfit.problem.structure import Structure
from switchfit.problem.validation import as_index, as_instance
from switchfit.runtime.cache import compilation_cache


@dataclass(frozen=True, eq=False)
class Trajectory:
    """States over time.

    Attributes
    ----------
    times : (K,) array
        All nodes, in `time_unit`; each transition time stands twice, with the state before and after it.
    states : (K, n) array
    modes : (K,) array of str
        The mode that is active.
    segments : (N + 2,) int array
        Entries ``segments[i]:segments[i + 1]`` belong to the i-th entry of the mode sequence.
    state_names, state_units : tuple of str
    time_unit : str
        That of the experiment.
    """

    times: FloatArray
    states: FloatArray
    modes: NDArray[np.str_]
    segments: NDArray[np.intp]
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    time_unit: str = "s"

    @property
    def mode_spans(self) -> list[tuple[str, float, float]]:
        """Each mode in turn with the times at which it begins and ends."""
        return [
            (str(self.modes[a]), float(self.times[a]), float(self.times[b - 1]))
            for a, b in zip(self.segments[:-1], self.segments[1:], strict=True)
        ]


@dataclass(frozen=True, eq=False)
class Comparison:
    """Measured against fitted, for one of the data of one experiment.

    Attributes
    ----------
    kind : "measurements" or "reference"
    names : tuple of str, one a channel
    times, measured, fitted : (K,), (K, q), (K, q)
        At the sample times; for a reference signal at the nodes of the mesh. NaN where a sample is missing.
    sigma : (K, q) or None where unknown
    curve_times, curve : (L,), (L, q)
        The fitted output at all nodes, for plots.
    downweighted : (K, q) of bool, or None
        Where a robust loss counts a residual as an outlier, one larger than its `loss_scale`; None without such a loss.
    """

    kind: str
    names: tuple[str, ...]
    times: FloatArray
    measured: FloatArray
    fitted: FloatArray
    sigma: FloatArray | None
    curve_times: FloatArray
    curve: FloatArray
    downweighted: NDArray[np.bool_] | None = None

    @property
    def residuals(self) -> FloatArray:
        """Measured less fitted: (K, q)."""
        return self.measured - self.fitted

    @property
    def rmse(self) -> FloatArray:
        """Root mean square of the residuals of each channel: (q,); NaN where there is no sample."""
        known = np.isfinite(self.measured)
        squares = np.where(known, self.residuals, 0.0) ** 2
        return np.sqrt(squares.sum(0) / np.where(known.any(0), known.sum(0), np.nan))


def simulate(problem: Problem, theta: ArrayLike | None = None, *, experiment: int = 0) -> Trajectory:
    """Integrate the model to the problem's tolerances.

    Parameters
    ----------
    problem : Problem
    theta : (d,) array_like, optional
        In the order of ``problem.theta_names``; the initial guess if left out.
    experiment : int, optional
        Which experiment, from 0.

    Returns
    -------
    Trajectory

    Raises
    ------
    ValueError
        For a theta of the wrong shape or order, an experiment that does not exist, or a trajectory that
        cannot be integrated.
    TypeError
        If an argument is of the wrong type.
    """
    as_instance(problem, "problem", Problem, "an sf.Problem")
    experiment = as_index(experiment, "experiment", len(problem.experiments))
    checked = problem.checked_theta(theta)
    mesh = refined_mesh(problem, experiment, checked)
    run = _simulated(problem, experiment, checked, mesh, arguments_of(problem, experiment, mesh))
    return _trajectory(problem, experiment, run)


def runs_of(
    problem: Problem, theta: FloatArray, meshes: Sequence[Mesh], arguments: Sequence[Arguments] | None = None
) -> list[Run]:
    """All experiments at theta on given meshes, with the problem's `arguments` there if they are known already."""
    found = [arguments_of(problem, e, mesh) for e, mesh in enumerate(meshes)] if arguments is None else arguments
    return [_simulated(problem, e, theta, mesh, found[e]) for e, mesh in enumerate(meshes)]


def cost_of(problem: Problem, theta: FloatArray, runs: Sequence[Run]) -> float:
    """Total cost, priors included."""
    priors = problem.unknowns.priors
    return sum((run.cost for run in runs), float(priors.evaluate(theta)[0]) if priors.any else 0.0)


def compared(
    problem: Problem, theta: FloatArray, runs: Sequence[Run]
) -> tuple[tuple[Trajectory, ...], tuple[tuple[Comparison, ...], ...]]:
    """Trajectories and measured against fitted of all experiments."""
    trajectories = tuple(_trajectory(problem, e, run) for e, run in enumerate(runs))
    pairs = enumerate(zip(runs, trajectories, strict=True))
    return trajectories, tuple(_comparisons(problem, e, theta, run, trajectory) for e, (run, trajectory) in pairs)


BLOCK = 64
"""Rows that one call of the program takes: with shapes that do not depend on the mesh it is compiled once a model."""


class Segment(NamedTuple):
    """One mode's turn: its rows, in order.

    Attributes
    ----------
    start, end : (R,) times
    before, after : (R, n), states at the start and at the end of each row
    y_before, y_after : (R, q), what the reference signals and the Measurements see there, in this order
    """

    start: FloatArray
    end: FloatArray
    before: FloatArray
    after: FloatArray
    y_before: FloatArray
    y_after: FloatArray


@dataclass(frozen=True, eq=False)
class Run:
    """One simulation: its cost, its segments, the cells of the mesh in which these begin (N + 1,), and the mesh.

    `seen` is what each of the Measurements sees at its samples, (K, q) arrays.
    """

    cost: float
    segments: list[Segment]
    first_cell: NDArray[np.intp]
    mesh: Mesh
    seen: tuple[FloatArray, ...] = ()

    def at_cells(self, cells: NDArray[np.intp], channels: slice) -> FloatArray:
        """Outputs at the ends of cells (K,), before a jump; at t0 for cell -1: (K, q)."""
        segment = (cells[:, None] >= self.first_cell[None, 1:]).sum(1)
        values = np.empty((len(cells), self.segments[0].y_after[:, channels].shape[1]))
        for i, part in enumerate(self.segments):
            here = (segment == i) & (cells >= 0)
            values[here] = part.y_after[cells[here] - self.first_cell[i], channels]
        values[cells < 0] = self.segments[0].y_before[0, channels]
        return values


def _simulated(problem: Problem, e: int, theta: FloatArray, mesh: Mesh, whole: Arguments) -> Run:
    """Integrate experiment e over the rows of a mesh, mode by mode."""
    structure = problem.structures[e]
    tau, p = problem.vectors(theta, e)
    native = native_experiment(structure, whole, mesh.times, order=Order.COST)
    found = None if native is None else _natively(structure, native, mesh.times, tau, p)
    if found is not None:
        cost, segments, first_cell = found
    else:
        with float64(), compilation_cache():
            cost, segments, first_cell = _by_blocks(structure, whole, tau, p)
    run = Run(cost, segments, first_cell, mesh)
    first = sum(q for _, q in structure.references)
    named = problem.named(theta, e)
    all_seen, of_samples = [], 0.0
    for k, (samples, sensor) in enumerate(zip(whole.samples, structure.measurements, strict=True)):
        if sensor.delay is None:
            seen = run.at_cells(np.asarray(samples.cell), slice(first, first + sensor.channels))
        else:
            seen = _late_outputs(structure, whole, run, k, named, p)
        all_seen.append(seen)
        there = np.asarray(samples.weight) > 0
        u = samples.weight * np.where(there, seen - samples.value, 0.0) ** 2
        if sensor.sigma:
            sigma = np.array([1.0 if name is None else float(named[name]) for name in sensor.sigma])
            u = u / sigma**2
            of_samples += float(np.sum(there * np.log(sigma)))
        of_samples += 0.5 * float(np.sum(robust(sensor.loss, sensor.loss_scale, u)))
        first += sensor.channels
    return replace(run, cost=cost if found is not None else cost + of_samples, seen=tuple(all_seen))


def _natively(
    structure: Structure, native: NativeExperiment, nodes: FloatArray, tau: FloatArray, p: FloatArray
) -> tuple[float, list[Segment], NDArray[np.intp]] | None:
    """J, all segments and the cells in which they begin, by machine code; None where it presumed wrongly."""
    found = native.simulated(tau, p)
    if found is None:
        return None
    seen = native.outputs(found.times, found.states, p)
    behind = native.outputs(tau, found.reset_states, p) if structure.resets else seen
    if seen is None or behind is None:
        return None
    y, reset_y = seen[0], behind[0]
    bounds = np.concatenate([nodes[:1], tau, nodes[-1:]])
    lasts = [*found.first_cell[1:].tolist(), len(nodes) - 2]
    segments = []
    for i, (first, last) in enumerate(zip(found.first_cell.tolist(), lasts, strict=True)):
        times = np.concatenate([bounds[i : i + 1], nodes[first + 1 : last + 1], bounds[i + 1 : i + 2]])
        states, outputs = (a[first + i : last + i + 2] for a in (found.states, y))
        before, y_before = states[:-1], outputs[:-1]
        if i - 1 in structure.resets:
            before = np.concatenate([found.reset_states[i - 1 : i], before[1:]])
            y_before = np.concatenate([reset_y[i - 1 : i], y_before[1:]])
        segments.append(Segment(times[:-1], times[1:], before, states[1:], y_before, outputs[1:]))
    return found.cost, segments, found.first_cell.astype(np.intp)


def _by_blocks(
    structure: Structure, whole: Arguments, tau: FloatArray, p: FloatArray
) -> tuple[float, list[Segment], NDArray[np.intp]]:
    """Running and terminal costs, all segments and the cells in which they begin, by JAX, some rows at a time."""
    arguments = whole.without_mesh()
    layout = rows(whole.nodes, tau, 1.0, np)
    cell, start, end = (np.reshape(a, -1) for a in (layout.cell, layout.start, layout.end))
    segments, cost = [], 0.0
    x = np.asarray(initial_state(arguments, p, structure=structure.functions))
    for i, mode in enumerate(structure.mode_of_segment):
        if i > 0 and structure.reset_maps[i - 1] is not None:
            x = np.asarray(after_reset(arguments, tau[i - 1], x, p, structure=structure, i=i - 1))
        span = slice(layout.first_chunk[i] * CHUNK, layout.last_row[i] + 1)
        pieces = Piece(whole.nodes[cell[span]], whole.signals[cell[span]])
        part, added = _segment(structure, arguments, mode, x, p, start[span], end[span], pieces)
        x = part.after[-1]
        segments.append(part)
        cost += added
    cost += float(_terminal(arguments, x, p, structure=structure.functions))
    return cost, segments, np.asarray(layout.first_cell)


def _late_outputs(
    structure: Structure,
    whole: Arguments,
    run: Run,
    k: int,
    named: Mapping[str, FloatArray],
    p: FloatArray,
) -> FloatArray:
    """What the k-th Measurements sees at its samples, which are late by a parameter: (K, q)."""
    sensor, samples = structure.measurements[k], whole.samples[k]
    times = np.asarray(samples.time) - float(named[sensor.delay or ""])
    start, end, before = (
        np.concatenate([getattr(part, a) for part in run.segments]) for a in ("start", "end", "before")
    )
    row = np.minimum(np.searchsorted(end, times), len(end) - 1)
    mode = np.repeat(structure.mode_of_segment, [len(part.start) for part in run.segments])[row]
    flat = np.concatenate(
        [np.arange(len(part.start)) + c for part, c in zip(run.segments, run.first_cell, strict=True)]
    )
    cell = flat[row]
    rows = (times, mode, start[row], before[row], whole.nodes[cell], whole.signals[cell])
    count = len(times)
    padded = [np.concatenate([a, np.repeat(a[-1:], -count % BLOCK, axis=0)]) for a in rows]
    parts = []
    with float64(), compilation_cache():
        for first in range(0, len(padded[0]), BLOCK):
            block = [a[first : first + BLOCK] for a in padded]
            found = _late_block(whole.without_mesh(), *block, p, structure=structure.functions, k=k)
            parts.append(np.asarray(found))
    return np.concatenate(parts)[:count]


@partial(jax.jit, static_argnames=("structure", "k"))
def _late_block(
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
    k: int,
) -> jax.Array:
    """Outputs of the k-th Measurements at times inside rows, a step from the start of each: (BLOCK, q)."""
    model = Model(structure, arguments)
    sensor = structure.measurements[k]

    def one(time: jax.Array, mode: jax.Array, start: jax.Array, x: jax.Array, piece: Piece) -> jax.Array:
        steps = [
            lambda x, m=m: step(model.tableau, model.field(m, piece), None, start, time, x, p)[0]
            for m in range(len(structure.modes))
        ]
        return model.observed(sensor.observe, time, lax.switch(mode, steps, x), p)

    return jax.vmap(one)(times, mode, start, x, Piece(origin, coefficients))


def _segment(
    structure: Structure,
    arguments: Arguments,
    mode: int,
    x: FloatArray,
    p: FloatArray,
    start: FloatArray,
    end: FloatArray,
    pieces: Piece,
) -> tuple[Segment, float]:
    """All rows of a segment from the state x, block by block, and the running cost; the last block is padded."""
    count = len(start)
    missing = -count % BLOCK
    start_, end_ = np.append(start, np.repeat(end[-1:], missing)), np.append(end, np.repeat(end[-1:], missing))
    padded = jax.tree.map(lambda a: np.concatenate([a, np.repeat(a[-1:], missing, axis=0)]), pieces)
    parts, cost = [], 0.0
    for k in range(0, len(start_), BLOCK):
        span = slice(k, k + BLOCK)
        here = jax.tree.map(lambda a, span=span: a[span], padded)
        result = _block(arguments, mode, x, p, start_[span], end_[span], here, structure=structure.functions)
        added, *columns = (np.asarray(a) for a in result)
        x = columns[1][-1]
        cost += float(added)
        parts.append(columns)
    before, after, y_before, y_after = (np.concatenate(column)[:count] for column in zip(*parts, strict=True))
    return Segment(start, end, before, after, y_before, y_after), cost


@partial(jax.jit, static_argnames=("structure",))
def _block(
    arguments: Arguments,
    mode: jax.Array,
    x: jax.Array,
    p: jax.Array,
    start: jax.Array,
    end: jax.Array,
    pieces: Piece,
    *,
    structure: Structure,
) -> tuple[jax.Array, ...]:
    """Running cost of a block of rows in one mode; states and outputs at the start and at the end of each row."""
    model = Model(structure, arguments)
    tableau = model.tableau

    def through(mode: int) -> Callable[..., tuple[jax.Array, ...]]:
        def row(x: jax.Array, given: tuple[jax.Array, jax.Array, Piece]) -> tuple[jax.Array, tuple[jax.Array, ...]]:
            start, end, piece = given
            ell = model.density(piece) if model.has_running_cost else None
            after, cost = step(tableau, model.field(mode, piece), ell, start, end, x, p)
            return after, (cost, x, after)

        return lambda x: lax.scan(row, x, (start, end, pieces))[1]

    modes = [through(k) for k in range(len(structure.modes))]
    costs, before, after = modes[0](x) if len(modes) == 1 else lax.switch(mode, modes, x)

    def outputs(t: jax.Array, x: jax.Array) -> jax.Array:
        seen = [model.observed(observe, t, x, p) for observe, _ in structure.outputs]
        return jnp.concatenate([jnp.zeros(0), *seen])

    over_rows = jax.vmap(outputs)
    return costs.sum(), before, after, over_rows(start, before), over_rows(end, after)


@partial(jax.jit, static_argnames=("structure",))
def _terminal(arguments: Arguments, x: jax.Array, p: jax.Array, *, structure: Structure) -> jax.Array:
    return Model(structure, arguments).terminal(x, p)


def _trajectory(problem: Problem, e: int, run: Run) -> Trajectory:
    """The start of every segment and the ends of all its rows that are not empty."""
    structure, system = problem.structures[e], problem.system
    times = [_shown(part, part.start, part.end) for part in run.segments]
    states = [_shown(part, part.before, part.after) for part in run.segments]
    modes = [
        np.full(len(part), structure.mode_names[mode])
        for part, mode in zip(times, structure.mode_of_segment, strict=True)
    ]
    names = system.state_names or tuple(f"x{k + 1}" for k in range(structure.n))
    units = system.state_units or ("",) * structure.n
    segments = np.cumsum([0, *(len(part) for part in times)])
    return Trajectory(
        np.concatenate(times),
        np.concatenate(states),
        np.concatenate(modes),
        segments,
        names,
        units,
        problem.experiments[e].time_unit,
    )


def _shown(part: Segment, before: FloatArray, after: FloatArray) -> FloatArray:
    """Of values at the starts and ends of a segment's rows those that a trajectory shows."""
    return np.concatenate([before[:1], after[part.end > part.start]])


def _comparisons(
    problem: Problem, e: int, theta: FloatArray, run: Run, trajectory: Trajectory
) -> tuple[Comparison, ...]:
    """Measured against fitted for each reference signal and each Measurements."""
    data, times = problem.experiments[e].data, trajectory.times
    curves = np.concatenate([_shown(part, part.y_before, part.y_after) for part in run.segments])
    comparisons = []
    items = [d for d in data if isinstance(d, ReferenceSignal)] + [d for d in data if isinstance(d, Measurements)]
    first = measured = 0
    for item in items:
        q = item.signal.channels if isinstance(item, ReferenceSignal) else item.values.shape[1]
        channels = slice(first, first + q)
        first += q
        curve = curves[:, channels]
        default = trajectory.state_names if item.observe is None else tuple(f"y{k + 1}" for k in range(q))
        label = item.names or default
        if isinstance(item, ReferenceSignal):
            here = Comparison("reference", label, times, item.signal(times), curve, None, times, curve)
        else:
            named = problem.named(theta, e)
            fitted = run.seen[measured][: len(item.times)]
            measured += 1
            delay = float(named[item.delay]) if isinstance(item.delay, str) else item.delay
            sigma = item.noise(named)
            beyond = None
            if item.loss != "linear" and sigma is not None:
                beyond = np.abs(np.nan_to_num(item.values - fitted)) > item.loss_scale * sigma
            shown = times + delay  # as the sensor says it
            here = Comparison("measurements", label, item.times, item.values, fitted, sigma, shown, curve, beyond)
        comparisons.append(here)
    return tuple(comparisons)
