"""Arrays that the programs of an experiment on a mesh take as arguments."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np
from numpy.typing import NDArray

from switchfit.discretization.mesh import Mesh
from switchfit.problem.data import FloatArray, Measurements, ReferenceSignal
from switchfit.problem.experiment import Experiment, initial_state_of
from switchfit.problem.problem import Problem
from switchfit.problem.signals import PiecewisePolynomial
from switchfit.problem.structure import read_initial_values, select_kind

Array = jax.Array


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
    measurements = select_kind(experiment.data, Measurements)
    samples = tuple(
        padded._replace(cell=_pad_with_last(mesh.cell_ending_at(item.seen_times), len(padded.time), 0))  # type: ignore[arg-type]
        for item, padded in zip(measurements, common.samples, strict=True)
    )
    signals = _split_signals_by_cell(experiment, mesh)
    return common._replace(nodes=mesh.nodes, signals=signals, samples=samples)  # type: ignore[arg-type]  # made jax arrays


def build_common_arguments(problem: Problem, e: int) -> Arguments:
    """Return the arguments of experiment e that suit any mesh, without nodes, signals and the cells of samples."""
    structure, experiment = problem.structures[e], problem.experiments[e]
    initial = initial_state_of(problem.system, experiment)
    mapped = experiment.parameter_map
    fixed = tuple(
        problem.parameters[mapped.get(name, name)].value for name, _, read in structure.parameters if not read
    )
    measurements = select_kind(experiment.data, Measurements)
    lengths = problem.sample_lengths[e]
    samples = tuple(_pad_samples(*each, experiment.t0) for each in zip(measurements, lengths, strict=True))
    weights = tuple(_drop_off_diagonal_zeros(item.weights) for item in select_kind(experiment.data, ReferenceSignal))
    x0 = np.zeros(structure.n) if callable(initial) else read_initial_values(initial)
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
    rows = ((0, length - len(item.times)), (0, 0))
    return Samples(
        np.zeros(0, dtype=np.intp),  # type: ignore[arg-type]  # made jax arrays
        _pad_with_last(item.seen_times, length, t0),  # type: ignore[arg-type]
        np.pad(np.nan_to_num(item.values), rows),  # type: ignore[arg-type]
        np.pad(item.weights, rows),  # type: ignore[arg-type]
    )


def _pad_with_last(array: NDArray[Any], length: int, first: float) -> NDArray[Any]:
    """Return an array padded to a length with its last entry, or `first`; `np.pad` takes ten times longer."""
    padded = np.full(length, array[-1] if len(array) else first, array.dtype)
    padded[: len(array)] = array
    return padded


def _split_signals_by_cell(experiment: Experiment, mesh: Mesh) -> FloatArray:
    """Return every signal as a cubic in each cell, in powers of the time since the cell's first node: (G, 4, S)."""
    signals = [split_by_cell(signal, mesh) for signal in experiment.signals]
    none = np.zeros((len(mesh.nodes) - 1, 4, 0))
    return signals[0] if len(signals) == 1 else np.concatenate([none, *signals], axis=2)


def split_by_cell(signal: PiecewisePolynomial, mesh: Mesh) -> FloatArray:
    """Return one signal as a cubic in each cell of a mesh that has its knots as nodes: (G, 4, q)."""
    starts, ends = mesh.nodes[:-1], mesh.nodes[1:]
    k = signal.interval(0.5 * (starts + ends))
    s = starts - signal.knots[k]
    shifted = signal.coefficients.T.take(k, axis=2)  # cells last: loops over them are the fast ones
    c0, c1, c2, c3 = shifted.swapaxes(0, 1)
    bend = 3 * s * c3
    c0 += s * (c1 + s * (c2 + s * c3))  # each before the coefficients that it is shifted by
    c1 += s * (2 * c2 + bend)
    c2 += bend
    return np.ascontiguousarray(shifted.T)
