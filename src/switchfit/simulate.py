"""Trajectories for people: the forward pass at any theta, as NumPy arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike, NDArray

from switchfit.cache import compilation_cache
from switchfit.data import FloatArray, Measurements, ReferenceSignal
from switchfit.mesh import Mesh
from switchfit.model import Arguments, Model, Structure, float64
from switchfit.problem import Problem
from switchfit.propagate import Path, by_row, path_cost, propagate
from switchfit.refine import refined_mesh


@dataclass(frozen=True, eq=False)
class Trajectory:
    """States over time.

    Attributes
    ----------
    times : (K,) array (s)
        All nodes; each transition time stands twice, with the state before and after it.
    states : (K, n) array
    modes : (K,) array of str
        The mode that is active.
    segments : (N + 2,) int array
        Entries ``segments[i]:segments[i + 1]`` belong to the i-th entry of the mode sequence.
    state_names, state_units : tuple of str
    """

    times: FloatArray
    states: FloatArray
    modes: NDArray[np.str_]
    segments: NDArray[np.intp]
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]

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
    """

    kind: str
    names: tuple[str, ...]
    times: FloatArray
    measured: FloatArray
    fitted: FloatArray
    sigma: FloatArray | None
    curve_times: FloatArray
    curve: FloatArray

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
    """
    if not 0 <= experiment < len(problem.experiments):
        raise ValueError(f"experiment must lie in 0..{len(problem.experiments) - 1}; got {experiment}.")
    checked = problem.checked_theta(theta)
    _, path, _ = _simulated(problem, experiment, checked, refined_mesh(problem, experiment, checked))
    return _trajectory(problem, experiment, path)


def compare(
    problem: Problem, theta: FloatArray, meshes: Sequence[Mesh]
) -> tuple[float, tuple[Trajectory, ...], tuple[tuple[Comparison, ...], ...]]:
    """Total cost, trajectories and measured against fitted of all experiments at theta, on given meshes."""
    total, trajectories, comparisons = 0.0, [], []
    for e, mesh in enumerate(meshes):
        cost, path, outputs = _simulated(problem, e, theta, mesh)
        total += cost
        trajectories.append(_trajectory(problem, e, path))
        comparisons.append(_comparisons(problem, e, path, outputs))
    return total, tuple(trajectories), tuple(comparisons)


def _simulated(problem: Problem, e: int, theta: FloatArray, mesh: Mesh) -> tuple[float, Path, list[Outputs]]:
    """Cost, path and outputs of experiment e on a given mesh, as NumPy arrays."""
    times, parameters = problem.split(theta)
    p = flat_parameters(problem, parameters)
    with float64(), compilation_cache():
        results = _simulation(problem.arguments(e, mesh), times[e], p, structure=problem.structures[e])
    cost, path, outputs = jax.tree.map(np.asarray, results)
    return float(cost), path, outputs


def flat_parameters(problem: Problem, parameters: dict[str, FloatArray]) -> FloatArray:
    """The free parameters as the vector p (M,) that the compiled programs take."""
    free = [np.ravel(parameters[name]) for name, q in problem.parameters.items() if not q.fixed]
    return np.concatenate([np.zeros(0), *free])


class Outputs(NamedTuple):
    """What one of the data sees: at the start and at the end of each row (Q, C, q), and at the samples (K, q)."""

    before: jax.Array
    after: jax.Array
    at_samples: jax.Array


@partial(jax.jit, static_argnames=("structure",))
def _simulation(
    arguments: Arguments, tau: jax.Array, p: jax.Array, *, structure: Structure
) -> tuple[jax.Array, Path, list[Outputs]]:
    model = Model(structure, arguments)
    path = propagate(model, tau, p, jnp.ones(()))
    layout = path.layout
    outputs: list[Outputs] = []
    for observe, channels in (*structure.references, *structure.measurements):

        def y(t: jax.Array, x: jax.Array, observe: Any = observe, channels: int = channels) -> jax.Array:
            return model.observed(observe, t, x, p, channels)

        k = len(outputs) - len(structure.references)
        samples = arguments.samples[k] if k >= 0 else None
        none = jnp.zeros((0, channels))
        at = none if samples is None else jax.vmap(y)(samples.time, path.at_samples(samples.cell))
        over_rows = jax.vmap(jax.vmap(y))
        outputs.append(Outputs(over_rows(layout.start, path.before), over_rows(layout.end, path.after), at))
    return path_cost(model, path, p), path, outputs


def _pick(structure: Structure, path: Path, before: Any, after: Any) -> list[FloatArray]:
    """Of values at the starts and ends of rows (Q, C, ...) those that a trajectory shows, a list by segment."""
    layout = path.layout
    real = (layout.end > layout.start).reshape(-1)
    before, after = by_row(before), by_row(after)
    parts = []
    for i in range(structure.N + 1):
        first, last = layout.first_chunk[i] * layout.start.shape[1], layout.last_row[i] + 1
        parts.append(np.concatenate([before[first : first + 1], after[first:last][real[first:last]]]))
    return parts


def _trajectory(problem: Problem, e: int, path: Path) -> Trajectory:
    """The start of every segment and the ends of all its rows that are not padding."""
    structure, system = problem.structures[e], problem.system
    states = _pick(structure, path, path.before, path.after)
    times = _pick(structure, path, path.layout.start, path.layout.end)
    modes = [
        np.full(len(part), structure.mode_names[mode])
        for part, mode in zip(times, structure.mode_of_segment, strict=True)
    ]
    names = system.state_names or tuple(f"x{k + 1}" for k in range(structure.n))
    units = system.state_units or ("",) * structure.n
    segments = np.cumsum([0, *(len(part) for part in times)])
    return Trajectory(np.concatenate(times), np.concatenate(states), np.concatenate(modes), segments, names, units)


def _comparisons(problem: Problem, e: int, path: Path, outputs: list[Outputs]) -> tuple[Comparison, ...]:
    """Measured against fitted for each reference signal and each Measurements."""
    structure, data = problem.structures[e], problem.experiments[e].data
    times = np.concatenate(_pick(structure, path, path.layout.start, path.layout.end))
    names = _trajectory(problem, e, path).state_names
    comparisons = []
    items = [d for d in data if isinstance(d, ReferenceSignal)] + [d for d in data if isinstance(d, Measurements)]
    for item, output in zip(items, outputs, strict=True):
        curve = np.concatenate(_pick(structure, path, output.before, output.after))
        default = names if item.observe is None else tuple(f"y{k + 1}" for k in range(curve.shape[1]))
        label = item.names or default
        if isinstance(item, ReferenceSignal):
            here = Comparison("reference", label, times, item.signal(times), curve, None, times, curve)
        else:
            fitted = np.asarray(output.at_samples)[: len(item.times)]
            sigma = None if item.sigma is None else np.broadcast_to(item.sigma, item.values.shape).copy()
            here = Comparison("measurements", label, item.times, item.values, fitted, sigma, times, curve)
        comparisons.append(here)
    return tuple(comparisons)
