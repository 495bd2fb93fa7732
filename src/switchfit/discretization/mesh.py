"""The mesh of an experiment: fixed nodes, and the rows into which the transition times cut the cells between them.

The *nodes* of an experiment are t0, tf, all sample times, the knots of inputs and reference signals, the times of
corners that follow from t and the input alone, and a refinement grid. They are fixed while the optimizer runs. The
transition times cut the *cells* between them into *rows*: one row is one Runge-Kutta step, in one mode, inside one
cell. Samples, knots and transitions are thus always ends of rows, and only the two rows at a transition move with it.

Rows are numbered by ``cell + segment``, where a segment is the time a mode is active: no shape depends on the
transition times.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from switchfit.arrays import ArrayModule, FloatArray, IntArray, Traced
from switchfit.discretization.stiffness import Stiffness
from switchfit.problem.experiment import Experiment
from switchfit.problem.padding import choose_common_lengths, pad_length

SHARP = 1e-3
"""Part of the longest cell of a mesh below which its shortest one says that the model is sharp: 1e-6 to 1e-4 where
friction is regularised at 1e-3 m/s and less, 2e-3 and more for smooth models."""

MANY_STEPS = 32
"""Steps inside a cell from which it matters whether stability limits them."""

PARTS_OF_CELL = 4
"""Into which the steps of a cell are divided, to see where they are shortest."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Fixed nodes of one experiment.

    Attributes
    ----------
    nodes : (G + 1,) array
        Increasing, from t0 to tf; padded at the end with tf to a length from `pad_length`, so that
        experiments of similar size share one compiled program.
    cells : int
        Number of cells without the padding.
    stiffness : tuple of Stiffness
        The modes that take implicit steps on this mesh because ``solver="auto"`` has chosen them, and why.
    has_rest : bool
        Whether a free tf lies before its last node: a cell has steps up to it then, and rest behind.
    """

    nodes: FloatArray
    cells: int
    stiffness: tuple[Stiffness, ...] = ()
    has_rest: bool = False

    @classmethod
    def from_times(cls, times: FloatArray, stiffness: tuple[Stiffness, ...] = ()) -> Mesh:
        """Return the mesh whose nodes are `times`, in any order and with repetitions."""
        nodes = np.unique(times)
        cells = len(nodes) - 1
        # Padded cells have the length 0 and lie behind tf: rows in them change nothing, but are computed. `build_rows`
        # keeps transitions out of them.
        padding = np.full(pad_length(cells) - cells, nodes[-1])
        return cls(np.concatenate([nodes, padding]), cells, stiffness)

    @classmethod
    def of(cls, experiment: Experiment, *more: FloatArray) -> Mesh:
        """Return the mesh of the times that must be nodes: t0, tf, and samples and knots of signals inside the horizon.

        If tf is free, its upper bound is the last node. `more` times are nodes too.
        """
        ends = np.array([experiment.t0, experiment.end])
        samples = (item.seen_times for item in experiment.measurements)
        times = np.concatenate([ends, *samples, *(signal.knots for signal in experiment.signals), *more])
        # Knots may lie outside of the horizon, for signals are defined beyond it.
        mesh = cls.from_times(times[(times >= ends[0]) & (times <= ends[1])])
        return replace(mesh, has_rest=experiment.has_free_tf)

    @property
    def times(self) -> FloatArray:
        """The nodes without the padding."""
        return self.nodes[: self.cells + 1]

    @cached_property
    def is_sharp(self) -> bool:
        """Whether some of its cells are so short that the model may have layers or jumps."""
        lengths = np.diff(self.times)
        return bool(lengths.min() < SHARP * lengths.max())

    @property
    def has_layers(self) -> bool:
        """Whether implicit steps pass layers that are far shorter than other cells, and move with theta."""
        return bool(self.stiffness) and self.is_sharp

    def pad_to(self, cells: int) -> Mesh:
        """Return the mesh padded to the given number of cells."""
        return replace(self, nodes=np.append(self.times, np.full(cells - self.cells, self.times[-1])))

    def insert(self, times: FloatArray) -> Mesh:
        """Return the mesh with more nodes."""
        return Mesh.from_times(np.concatenate([self.times, times]), self.stiffness)

    def divide(self, parts: int = 2) -> Mesh:
        """Return the mesh with every cell cut into equal parts."""
        nodes = self.times
        inside = nodes[:-1, None] + np.diff(nodes)[:, None] * np.arange(parts) / parts
        # Parts of a cell that is as short as rounding may coincide: such nodes are one.
        return Mesh.from_times(np.append(inside, nodes[-1]), self.stiffness)

    def refine(
        self,
        solutions: Sequence[FloatArray],
        stiffness: tuple[Stiffness, ...],
        has_limits: Callable[[], bool],
        finer: float = 1.0,
    ) -> Mesh:
        """Return the mesh with the nodes that the steps of some solutions need, or `finer` times as many.

        `has_limits` says whether stability limits explicit ones.
        """
        nodes, (times, counts) = self.times, _count_steps(solutions)
        # Steps of the solver in each cell: a cell between two samples has at least one row, however smooth the
        # trajectory.
        needed = np.diff(np.interp(nodes, times, counts))
        if self.has_rest or (needed.max() > MANY_STEPS and has_limits()):
            needed *= _compare_densities(nodes, times, counts)
        # A twentieth of a step beyond a whole number does not cost a cell more.
        pieces = np.maximum(np.ceil(finer * needed - 0.05).astype(int), 1)
        return Mesh.from_times(np.concatenate([nodes, _grade_nodes(nodes, times, counts, pieces)]), stiffness)

    def halve_rows(self, transition_times: FloatArray) -> Mesh:
        """Return the mesh with every row cut in two: every cell, or its parts where transitions (N,) cut it.

        Halving cells would not do: after a transition in the second half of a cell, the row would keep its length.
        """
        cuts = np.unique(np.concatenate([self.times, transition_times]))
        return self.insert(0.5 * (cuts[:-1] + cuts[1:]))


def _count_steps(solutions: Sequence[FloatArray]) -> tuple[FloatArray, FloatArray]:
    """Return times (K,) and the number of solver steps up to each, (K,), linear in between, from the step times of
    several solutions: at each time, the smallest step of any of them counts.
    """
    times = np.unique(np.concatenate(solutions))
    # Between two neighbouring times of all solutions each has one step: 1 / step is the density, whose integral is
    # counts.
    middles = times[:-1] + 0.5 * np.diff(times)
    lengths = [np.diff(steps)[np.searchsorted(steps, middles) - 1] for steps in solutions]
    return times, np.concatenate([[0.0], np.cumsum(np.diff(times) / np.min(lengths, axis=0))])


def _compare_densities(nodes: FloatArray, times: FloatArray, counts: FloatArray) -> FloatArray:
    """Return how many times as dense as the nodes of `_grade_nodes` the steps of a solver are in each cell, where it is
    not all rest: explicit steps are unstable if they are longer.
    """
    low, high, lengths = np.interp(nodes[:-1], times, counts), np.interp(nodes[1:], times, counts), np.diff(nodes)
    # The second shortest quarter of the s steps in a cell of length T takes s h / 4: the first steps of a solve may
    # make one shorter. There the density of s nodes is s (1 / (s h) + 1 / T) / 2, and that of the steps 1 / h.
    quarters = np.interp(np.linspace(low, high, PARTS_OF_CELL + 1, axis=1), counts, times)
    return np.asarray(2.0 / (1.0 + PARTS_OF_CELL * np.sort(np.diff(quarters), axis=1)[:, 1] / lengths))


def _grade_nodes(nodes: FloatArray, step_times: FloatArray, steps: FloatArray, pieces: IntArray) -> FloatArray:
    """Return the nodes that cut each cell between nodes (G + 1,) into its pieces (G,): half of them follow the density
    of the solver's steps, of which there are `steps` (K,) up to `step_times` (K,), half are even.

    The steps are short in the layers of a stiff mode, which evenly spaced nodes would miss; but layers move with the
    transition times, and the mesh does not.
    """
    inside = (step_times > nodes[0]) & (step_times < nodes[-1])
    times = np.unique(np.concatenate([nodes, step_times[inside]]))
    cell = np.minimum(np.searchsorted(nodes, times, "right") - 1, len(pieces) - 1)
    # Of all cells at once: k + w in cell k, where w grows from 0 to 1 in it.
    counts = np.interp(nodes, step_times, steps)
    of_steps, of_time = (np.diff(grown)[cell] for grown in (counts, nodes))
    of_steps = np.where(of_steps > 0.0, of_steps, 1.0)  # no solution reaches this cell, which stays whole
    position = (
        cell
        + 0.5 * (np.interp(times, step_times, steps) - counts[cell]) / of_steps
        + 0.5 * (times - nodes[cell]) / of_time
    )
    cut = np.repeat(np.arange(len(pieces)), pieces - 1)
    turn = np.arange(len(cut)) - np.repeat(np.cumsum(pieces - 1) - (pieces - 1), pieces - 1) + 1
    return np.interp(cut + turn / pieces[cut], position, times)


def pad_meshes(meshes: Sequence[Mesh], groups: Iterable[Sequence[int]]) -> list[Mesh]:
    """Return the meshes of all experiments, in each group of equal structure padded to lengths that they share."""
    padded = list(meshes)
    for group in groups if len(padded) > 1 else ():
        lengths = choose_common_lengths([padded[e].cells for e in group])
        for e, length in zip(group, lengths, strict=True):
            padded[e] = padded[e] if len(group) == 1 else padded[e].pad_to(length)
    return padded


class MeshRows(NamedTuple):
    """The rows of a mesh at given transition times: R = cells + N of them, in the order of time, in JAX or NumPy.

    Attributes
    ----------
    segment, cell : (R,) int, index in the mode sequence, and in the mesh
    opens : (R,) bool, whether the row opens a segment other than the first (a transition precedes it)
    start, end : (R,) times
    first_row, first_cell : (N + 1,) int, the row and the cell in which each segment begins
    """

    segment: Traced
    cell: Traced
    opens: Traced
    start: Traced
    end: Traced
    first_row: Traced
    first_cell: Traced


def build_rows(nodes: Traced, tau: Traced, side: Traced, xp: ArrayModule = jnp) -> MeshRows:
    """Cut the cells between `nodes` (G + 1,) at `tau` (N,).

    Where tau_i equals a node, `side` = +1 lets segment i begin in the cell after it, so that derivatives are those
    for tau_i increasing, and -1 in the cell before it. `side` is one number, or has one for each of tau (N,). Arrays
    are those of `xp`, JAX or NumPy.
    """
    cells, N = nodes.shape[0] - 1, tau.shape[0]
    several = getattr(side, "ndim", 0) > 0
    right = (side[:, None] if several else side) > 0
    # How many nodes each of tau is past.
    passed = xp.where(right, nodes[None] <= tau[:, None], nodes[None] < tau[:, None]).sum(1)
    # See `Structure.fix_sides`: times at nodes that are known jumps have a side of their own.
    if several and N:  # of two equal times with different sides, the later one must not begin in an earlier cell
        passed = xp.maximum.accumulate(passed)
    real_cells = (nodes[1:] > nodes[:-1]).sum()  # without padding: tau = tf stays before the samples and costs at tf
    first_cell = xp.concatenate([xp.zeros(1, passed.dtype), xp.clip(passed - 1, 0, real_cells - 1)])
    # Row = cell + segment: each transition cuts one cell in two, so that segment i begins at row first_cell_i + i. R =
    # cells + N whatever tau is, and rows between transitions in one cell are as short as these are close, or empty.
    first_row = first_cell + xp.arange(N + 1)
    row = xp.arange(cells + N)
    segment = (row[:, None] >= first_row[None, 1:]).sum(1)
    cell = row - segment
    opens = (row == first_row[segment]) & (segment > 0)
    # A row ends at tau where the next one opens a segment, else at the node.
    # The node at the end of a row counts only where no transition ends it before: a row that is cut twice begins and
    # ends at transition times.
    closes = xp.concatenate([opens[1:], xp.zeros(1, bool)])
    begins, finishes = xp.concatenate([nodes[:1], tau]), xp.concatenate([tau, nodes[-1:]])
    start = xp.where(opens, begins[segment], nodes[cell])
    end = xp.where(closes, finishes[segment], nodes[cell + 1])
    return MeshRows(segment, cell, opens, start, end, first_row, first_cell)


def find_row_ending_cell(first_cell: Traced, cell: Traced, xp: ArrayModule = jnp) -> Traced:
    """Return the last row inside each of the given cells (K,), -1 for cell -1; segments begin in cells (N + 1,)."""
    return xp.where(cell < 0, -1, cell + (cell[:, None] >= first_cell[None, 1:]).sum(1))
