"""Arguments: the arrays that the programs of an experiment take, apart from what is estimated.

Some suit any mesh: fixed parameters, the initial state, weights, and the samples, padded so that logs of similar length
share a program. The others belong to one mesh: its nodes, the cells of the samples, and the signals as cubics in each
cell.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jax import Array
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.discretization.mesh import Mesh
from switchfit.problem.experiment import Experiment, initial_state_of
from switchfit.problem.measurements import Measurements
from switchfit.problem.problem import Problem
from switchfit.problem.signals import PiecewisePolynomial


class Samples(NamedTuple):
    """Discrete samples: cell that ends at each (K,), time (K,), value (K, q), weight (K, q), 0 where missing."""

    cell: Array
    time: Array
    value: Array
    weight: Array


class Arguments(NamedTuple):
    """Numbers of a run that are not estimated.

    Attributes
    ----------
    nodes : (G + 1,)
    signals : (G, 4, S)
        Polynomial of each signal channel in each cell, in powers of time since the cell's first node: the
        references in the order of the data, then the input.
    fixed : values of the fixed parameters, in order
    initial_state : (n,), zeros where it is a function of the parameters; unknown entries are ignored
    samples : one `Samples` for each `Measurements`
    weights : W of each `ReferenceSignal`, its diagonal (q,) where it is diagonal, else (q, q)
    sequence : (N + 1,) int or None
        Index of the mode of each segment, for programs that read it at run time; None where the structure has it.
    """

    nodes: Array
    signals: Array
    fixed: tuple[Array, ...]
    initial_state: Array
    samples: tuple[Samples, ...]
    weights: tuple[Array, ...]
    sequence: Array | None = None

    def without_mesh(self) -> Arguments:
        """Return the arguments that the functions of the model need: their shapes do not depend on the number of
        nodes or samples.
        """
        return self._replace(nodes=np.zeros(2), signals=np.zeros((1, *self.signals.shape[1:])), samples=())  # type: ignore[arg-type]


def build_arguments(problem: Problem, e: int, mesh: Mesh) -> Arguments:
    """Return the NumPy arrays of experiment e on a mesh that has all its sample times and knots as nodes."""
    return put_on_mesh(build_common_arguments(problem, e), problem.experiments[e], mesh)


def put_on_mesh(common: Arguments, experiment: Experiment, mesh: Mesh) -> Arguments:
    """Return the arguments of an experiment on a mesh, from those that suit any mesh."""
    # Of each sample the index of the cell that ends at it; -1 for t0.
    # A sample belongs to the end of a cell: it sees the state before a jump at its time. A transition at its time is
    # before or behind it by the side on which J is asked for (`build_rows`), whose one-sided derivatives differ.
    cells = (np.searchsorted(mesh.times, item.seen_times) - 1 for item in experiment.measurements)
    samples = tuple(
        padded._replace(cell=_pad_with_last(cell, len(padded.time), 0))  # type: ignore[arg-type]  # made jax arrays
        for cell, padded in zip(cells, common.samples, strict=True)
    )
    # Every signal as a cubic in each cell, in powers of the time since the cell's first node: (G, 4, S).
    split = [split_by_cell(signal, mesh) for signal in experiment.signals]
    signals = split[0] if len(split) == 1 else np.concatenate([np.zeros((len(mesh.nodes) - 1, 4, 0)), *split], axis=2)
    return common._replace(nodes=mesh.nodes, signals=signals, samples=samples)  # type: ignore[arg-type]  # made jax arrays


def build_common_arguments(problem: Problem, e: int) -> Arguments:
    """Return the arguments of experiment e that suit any mesh, without nodes, signals and the cells of samples."""
    structure, experiment = problem.structures[e], problem.experiments[e]
    initial = initial_state_of(problem.system, experiment)
    unread = (experiment.parameter_map.get(name, name) for name, _, read in structure.parameters if not read)
    fixed = tuple(problem.parameters[name].value for name in unread)
    lengths = problem.sample_lengths[e]
    samples = tuple(_pad_samples(*each, experiment.t0) for each in zip(experiment.measurements, lengths, strict=True))
    weights = tuple(_drop_off_diagonal_zeros(item.weights) for item in experiment.references)
    x0 = np.zeros(structure.n) if callable(initial) else np.array([getattr(x, "value", x) for x in initial], float)
    empty = np.zeros(0)
    return Arguments(empty, empty, fixed, x0, samples, weights)  # type: ignore[arg-type]


def _drop_off_diagonal_zeros(W: FloatArray) -> FloatArray:
    """Return the diagonal of a diagonal matrix, which takes q products instead of q squared at every stage of every
    step; any other matrix unchanged.
    """
    diagonal = np.diag(W)
    return diagonal if np.array_equal(W, np.diag(diagonal)) else W


def _pad_samples(item: Measurements, length: int, t0: float) -> Samples:
    """Return samples of one Measurements, padded with missing ones to a length, without their cells."""
    # Padding repeats the last time with the weight 0, so that it is in the last cell, and its terms in J are exactly 0.
    rows = ((0, length - len(item.times)), (0, 0))
    times, values = _pad_with_last(item.seen_times, length, t0), np.pad(np.nan_to_num(item.values), rows)
    return Samples(np.zeros(0, int), times, values, np.pad(item.weights, rows))  # type: ignore[arg-type]  # made jax arrays


def _pad_with_last(array: NDArray[Any], length: int, first: float) -> NDArray[Any]:
    """Return an array padded to a length with its last entry, or `first`; `np.pad` takes ten times longer."""
    padded = np.full(length, array[-1] if len(array) else first, array.dtype)
    padded[: len(array)] = array
    return padded


def split_by_cell(signal: PiecewisePolynomial, mesh: Mesh) -> FloatArray:
    """Return one signal as a cubic in each cell of a mesh that has its knots as nodes: (G, 4, q)."""
    starts, ends = mesh.nodes[:-1], mesh.nodes[1:]
    # The middle of a cell is in one piece of the signal for certain: at its ends, which are knots, a held input jumps.
    k = signal.interval(0.5 * (starts + ends))
    s = starts - signal.knots[k]
    shifted = signal.coefficients.T.take(k, axis=2)  # cells last: loops over them are the fast ones
    c0, c1, c2, c3 = shifted.swapaxes(0, 1)
    bend = 3 * s * c3
    c0 += s * (c1 + s * (c2 + s * c3))  # each before the coefficients that it is shifted by
    c1 += s * (2 * c2 + bend)
    c2 += bend
    return np.ascontiguousarray(shifted.T)


def count_samples(samples: Samples) -> int:
    """Return the number of samples up to the last with a nonzero weight, at least 1; the rest is padding."""
    there = np.flatnonzero(np.asarray(samples.weight).any(1))
    return int(there[-1]) + 1 if len(there) else 1
