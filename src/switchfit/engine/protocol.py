"""What the engines take and return for one experiment on one mesh. Code outside `engine` does not depend on which.

An experiment of a problem, prepared once: what all its meshes, adaptive solves and engines share.
"""

from __future__ import annotations

import threading
from collections.abc import Container, Mapping
from dataclasses import dataclass, field, replace
from enum import IntEnum
from functools import cached_property
from typing import Any, Generic, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from switchfit.discretization.corner_times import find_corner_times
from switchfit.discretization.mesh import (
    Arguments,
    Mesh,
    Stiffness,
    build_common_arguments,
    find_row_ending_cell,
    put_on_mesh,
)
from switchfit.engine.branches import Branches, Path, find_branches, has_corners
from switchfit.problem.data import FloatArray
from switchfit.problem.experiment import Experiment
from switchfit.problem.problem import Problem, keep_with_problem
from switchfit.problem.structure import Structure
from switchfit.runtime.presentation import format_line

Matrix = Literal["exact", "gauss-newton", "none"]
"""What to return as the Hessian: the exact one, the Gauss-Newton matrix, or NaN."""


@dataclass(frozen=True)
class Engine:
    """Name of what evaluated a cost and its derivatives, and the reason.

    Attributes
    ----------
    name : str
        "native" for machine code, or "jax".
    reason : str or None
        Why JAX evaluates: the part of the problem that has no machine code. A reason that begins with "internal: " is
        a defect of switchfit, not of the model. None for machine code.
    implicit_modes : tuple of str
        The modes that take implicit steps, in any of the experiments.
    """

    name: str
    reason: str | None = None
    implicit_modes: tuple[str, ...] = ()

    def __str__(self) -> str:
        if self.reason is not None:
            return f"Evaluated by JAX: {self.reason}."
        modes = " and ".join(map(repr, self.implicit_modes))
        return f"Evaluated in machine code{f', with implicit steps in {modes}' if modes else ''}."


H_co = TypeVar("H_co", covariant=True)


@dataclass(frozen=True, eq=False)
class Evaluation(Generic[H_co]):
    """Cost, constraints and their derivatives at one theta, of an experiment or of a whole problem.

    Attributes
    ----------
    cost : J
    gradient : (d,), J's derivative in theta
    hessian : (d, d)
        Of J; where constraints were evaluated with multipliers, of ``J + multipliers . constraints``. Inside the
        optimizer, of many runs an arrow-shaped matrix.
    constraints, jacobian : (m,), (m, d)
        Guards and terminal constraints, in the order of ``problem.constraint_names``, and their derivatives in theta.
        Empty if the problem has none.
    row_errors : tuple of float
        Of each experiment the largest error of a row, relative to the largest value of its state on the first
        trajectory on this mesh; NaN if its engine has none, empty where none was asked for. The estimate compares the
        method of order 5 with one of order 3: on the same stages, or, in implicit rows, with the slope before the row,
        as Hairer and Wanner do. Where a row is fine, it is far larger than the error.
    stiffness : tuple of Stiffness
        From `evaluate`: each mode of each experiment in which ``solver="auto"`` chose implicit steps, and why; empty if
        there is none.

    See Also
    --------
    evaluate, GuardedEvaluation

    Examples
    --------
    >>> import switchfit as sf
    >>> from switchfit.models import heater_problem
    >>> problem = heater_problem()

    >>> evaluation = sf.evaluate(problem)
    >>> evaluation.gradient.shape, evaluation.hessian.shape
    ((2,), (2, 2))
    """

    cost: float
    gradient: FloatArray
    hessian: H_co
    constraints: FloatArray = field(default_factory=lambda: np.zeros(0))
    jacobian: FloatArray = field(default_factory=lambda: np.zeros((0, 0)))
    row_errors: tuple[float, ...] = ()
    stiffness: tuple[Stiffness, ...] = ()

    def __repr__(self) -> str:
        return format_line(self, f"J = {self.cost:.9g}", f"{len(self.gradient)} unknowns")


DenseEvaluation = Evaluation[FloatArray]
"""With the Hessian as an array."""


@dataclass(frozen=True, eq=False)
class Simulation:
    """One experiment row by row, R = cells + N rows in the order of time; up to tf where it is free.

    Attributes
    ----------
    cost : float
        J.
    nodes : (G + 1,)
        Nodes of the mesh.
    first_cell : (N + 1,) int
        The cell in which each segment begins; (N,) where tf is free.
    start, end : (R,)
        Times of each row.
    before, after : (R, n)
        States at the start and at the end of each row.
    y_before, y_after : (R, q)
        Outputs of the reference signals and the Measurements there, in this order.
    seen : tuple of (K, q), one per Measurements
        Its outputs at its samples, late ones included.
    tangents : Tangents or None
        If requested, the derivatives of `before`, `after`, `y_before` and `y_after` in the experiment's unknowns at
        fixed times, along an additional last axis of length D.
    """

    cost: float
    nodes: FloatArray
    first_cell: NDArray[np.intp]
    start: FloatArray
    end: FloatArray
    before: FloatArray
    after: FloatArray
    y_before: FloatArray
    y_after: FloatArray
    seen: tuple[FloatArray, ...] = ()
    tangents: Tangents | None = None

    @property
    def first_row(self) -> NDArray[np.intp]:
        """The row in which each segment begins."""
        return self.first_cell + np.arange(len(self.first_cell))

    @property
    def segments(self) -> list[slice]:
        """Slice of rows of each segment."""
        first = self.first_row.tolist()
        return [slice(a, b) for a, b in zip(first, [*first[1:], len(self.start)], strict=True)]

    def row_ending(self, cells: NDArray[np.intp]) -> NDArray[np.intp]:
        """Return the last row that ends in each of the cells (K,), before any jump at its end; -1 for cell -1."""
        return np.asarray(find_row_ending_cell(self.first_cell, cells, np))


class Tangents(NamedTuple):
    """Derivatives of a `Simulation`: (R, n, D), (R, n, D), (R, q, D), (R, q, D)."""

    before: FloatArray
    after: FloatArray
    y_before: FloatArray
    y_after: FloatArray


class Costates(NamedTuple):
    """Derivatives of the cost to go in the states at the starts of all rows, R = cells + N, up to tf where it is free.

    Samples, jumps and reset maps at the start of a row lie before it: the costate has nothing of them.

    Attributes
    ----------
    times : (R,)
    cells, modes : (R,) int
        Cell of the mesh that holds each row, and the index of its mode in the library.
    states, costates : (R, n)
    """

    times: FloatArray
    cells: NDArray[np.intp]
    modes: NDArray[np.intp]
    states: FloatArray
    costates: FloatArray

    @classmethod
    def of_rows(cls, structure: Structure, first_row: NDArray[np.intp], *rows: FloatArray) -> Costates:
        """Return the costates of rows, given the times (R,), states and costates at their starts (R, n), without those
        after a free tf; `first_row` is that of each segment.
        """
        times, *states = rows
        segment = np.searchsorted(first_row, np.arange(len(times)), "right") - 1
        cells, modes = np.arange(len(times)) - segment, np.array(structure.mode_of_segment)[segment]
        last = int(first_row[-1]) if structure.has_free_tf else len(times)
        return cls(*(values[:last] for values in (times, cells, modes, *states)))


def finish_simulation(
    simulation: Simulation, structure: Structure, arguments: Arguments, late: Mapping[int, FloatArray]
) -> Simulation:
    """Return the simulation with the outputs of each of the Measurements at its samples, and without the rows after a
    free tf.

    Parameters
    ----------
    simulation : Simulation
    structure : Structure
    arguments : Arguments
    late : mapping
        Outputs of all sensors, (L, q), at the samples of each late Measurements, by its index.
    """
    seen, first = [], sum(q for _, q in structure.references)
    for k, (samples, sensor) in enumerate(zip(arguments.samples, structure.measurements, strict=True)):
        if sensor.delay is None:
            row = simulation.row_ending(np.asarray(samples.cell))
            y = np.where((row < 0)[:, None], simulation.y_before[:1], simulation.y_after[row])
        else:
            y = np.concatenate([late[k], np.repeat(late[k][-1:], len(samples.time) - len(late[k]), axis=0)])
        seen.append(y[:, first : first + sensor.channels])
        first += sensor.channels
    simulation = replace(simulation, seen=tuple(seen))
    if not structure.has_free_tf:
        return simulation
    rows = slice(0, simulation.segments[-1].start)
    by_row = ("start", "end", "before", "after", "y_before", "y_after")
    cut: dict[str, Any] = {name: getattr(simulation, name)[rows] for name in by_row}
    if simulation.tangents is not None:
        cut["tangents"] = Tangents(*(values[rows] for values in simulation.tangents))
    return replace(simulation, first_cell=simulation.first_cell[:-1], **cut)


class Hypotheses(NamedTuple):
    """Hypotheses on the mode sequence of one experiment, at one time; D = births at most + M unknowns.

    Their costs are linearised: ``J + g'd + d'H d / 2`` for a change d of the birth times and of p from the point of
    linearisation.

    Attributes
    ----------
    scores : (B,), the lowest cost for any d; NaN where a hypothesis has failed
    costs : (B,), J of the samples so far
    gradients, matrices : (B, D), (B, D, D): g and the Gauss-Newton matrix H
    moved : (B, D), how far the point of linearisation is from the births on the grid and from the first p
    states, tangents : (B, n), (B, n, D)
    records : Any
        What the engine needs to go on.
    """

    scores: FloatArray
    costs: FloatArray
    gradients: FloatArray
    matrices: FloatArray
    moved: FloatArray
    states: FloatArray
    tangents: FloatArray
    records: Any = None

    def take(self, chosen: NDArray[np.int64]) -> Hypotheses:
        """Return some of them, with which no engine can go on."""
        return Hypotheses(*(values[chosen] for values in self[:-1]))


Column = IntEnum("Column", "PARENT BEFORE AFTER SLOT RESET_MAP TRANSITION_COST GUARD", start=0)
"""Columns of the table that makes children of hypotheses: (C, 7) of int64.

PARENT : position of the parent
BEFORE, AFTER : mode of the parent and of the child
SLOT : which transition happens at the first node, from 0, a birth; -1 if none does
RESET_MAP, TRANSITION_COST, GUARD : place of its functions in the library, -1 for none
"""


class Tolerances(NamedTuple):
    """Tolerances of the propagation of hypotheses.

    Attributes
    ----------
    relative : error of a step, relative to the state
    smallest : size of a state at which the relative and the absolute error are equal
    guard : information of a guard on the time of its transition, in units of J
    """

    relative: float
    smallest: float
    guard: float


class Limits(NamedTuple):
    """Bounds of `Hypotheses.moved`, (D,) each, and how far it may move at once, (D,)."""

    low: FloatArray
    high: FloatArray
    most: FloatArray


def take_implicit_steps(structure: Structure, modes: Container[str]) -> Structure:
    """Return a structure in which these modes take implicit steps too; itself if they do already."""
    named = zip(structure.mode_names, structure.implicit, strict=True)
    implicit = tuple(is_set or name in modes for name, is_set in named)
    return structure if implicit == structure.implicit else replace(structure, implicit=implicit)


class Run:
    """One experiment of a problem, from 0.

    Attributes
    ----------
    structure : Structure
        With the steps that the problem's solver takes in each mode.
    branches : Branches or None
        Of its modes; None if they have no corners, or if its trajectory passes too many: its rows do not end there.
    path : Path or None
        Of the last trajectory through corners, on any mesh.
    solvers : threading.local
        Machine code of adaptive solves, kept by each thread for the next ones.
    """

    def __init__(self, problem: Problem, e: int) -> None:
        self.problem, self.e = problem, e
        self.experiment: Experiment = problem.experiments[e]
        self.structure: Structure = problem.structures[e]
        self.branches: Branches | None = find_branches(self.structure.library) if has_corners(self.structure) else None
        self.path: Path | None = None
        self.solvers = threading.local()  # a solver has one p at a time

    @cached_property
    def coarse(self) -> Mesh:
        """The nodes that every mesh of the experiment has."""
        return Mesh.of(self.experiment, self.corner_times)

    @cached_property
    def corner_times(self) -> FloatArray:
        """Known times of corners, whatever theta is."""
        return find_corner_times(self.structure, self.experiment, self._common.fixed)

    def vectors(self, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what its programs take at theta (d,): its times (N,) and its p (M,)."""
        return self.problem.vectors(theta, self.e)

    def build_arguments(self, mesh: Mesh) -> Arguments:
        """Return the arrays that its programs take on a mesh; those on the coarse one are kept."""
        if mesh is self.coarse:
            return self._coarse_arguments
        return put_on_mesh(self._common, self.experiment, mesh)

    @cached_property
    def _coarse_arguments(self) -> Arguments:
        return put_on_mesh(self._common, self.experiment, self.coarse)

    @cached_property
    def _common(self) -> Arguments:
        return build_common_arguments(self.problem, self.e)

    def get_structure(self, mesh: Mesh) -> Structure:
        """Return its structure with the method of the steps of each mode on a mesh."""
        return take_implicit_steps(self.structure, [each.mode for each in mesh.stiffness])


@keep_with_problem
def runs_of(problem: Problem) -> tuple[Run, ...]:
    """Return the experiments of a problem, prepared once and kept with it."""
    return tuple(Run(problem, e) for e in range(len(problem.experiments)))
