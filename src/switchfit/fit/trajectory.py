"""Trajectories for people: states over time at any theta, as NumPy arrays."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.engine.simulation import Simulation
from switchfit.problem.experiment import drop_jumps
from switchfit.problem.origin import Origin
from switchfit.problem.problem import Problem
from switchfit.problem.validation.messages import unit_suffix
from switchfit.runtime.frames import Tabular
from switchfit.runtime.presentation import format_line, join_first


@dataclass(frozen=True, eq=False)
class Trajectory(Tabular):
    """States over time.

    Attributes
    ----------
    times : (K,) array
        All nodes, in `time_unit`; each transition time and the time of each jump occur twice, with the state before and
        after.
    states : (K, n) array
    modes : (K,) array of str
        The mode that is active.
    segments : (N + 2,) int array
        Entries ``segments[i]:segments[i + 1]`` belong to the i-th entry of the mode sequence; at times that were asked
        for there may be none.
    state_names, state_units : tuple of str
    time_unit : str
        Unit of the experiment's times.
    origin : Origin or None
        The date at which times are 0; None where they are no dates.

    See Also
    --------
    simulate, Comparison

    Examples
    --------
    >>> problem = heater_problem()

    >>> path = sf.simulate(problem)
    >>> path.mode_spans
    [('on', 0.0, 2.0), ('off', 2.0, 6.0)]
    >>> path.states[-1].round(2)
    array([1.71])
    """

    times: FloatArray
    states: FloatArray
    modes: NDArray[np.str_]
    segments: NDArray[np.intp]
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    time_unit: str = "s"
    origin: Origin | None = None

    @property
    def dates(self) -> list[datetime] | None:
        """The times as dates in the experiment's time zone; None where they are no dates."""
        return None if self.origin is None else self.origin.to_dates(self.times, self.time_unit)

    def __repr__(self) -> str:
        modes = join_first((str(self.modes[k]) for k in self.segments[:-1] if k < len(self.modes)), 8)
        ends = f"{self.times[0]:.6g} to {self.times[-1]:.6g}{unit_suffix(self.time_unit)}" if len(self.times) else ""
        return format_line(self, join_first(self.state_names), f"modes {modes}", ends, f"{len(self.times)} nodes")

    @property
    def mode_spans(self) -> list[tuple[str, float, float]]:
        """Each mode of the sequence with the times at which it begins and ends.

        Of a simulation at given times the first and the last of them in the mode, without modes that have none.
        """
        return [
            (str(self.modes[a]), float(self.times[a]), float(self.times[b - 1]))
            for a, b in zip(self.segments[:-1], self.segments[1:], strict=True)
            if b > a
        ]

    @property
    def pieces(self) -> NDArray[np.intp]:
        """Where the continuous pieces begin, and K: as `segments`, divided at jumps too."""
        return np.union1d(self.segments, np.flatnonzero(np.diff(self.times) == 0) + 1)

    @property
    def jump_times(self) -> FloatArray:
        """Times of the jumps at known times, those at transitions apart."""
        return self.times[np.setdiff1d(self.pieces, self.segments)]


def select_visible(simulation: Simulation, before: FloatArray, after: FloatArray) -> FloatArray:
    """Select the entries of a trajectory from the values at the starts and ends of all rows.

    These are the start of every segment, and the ends of all its rows that are not empty.
    """
    parts = []
    for rows in simulation.segments:
        parts += [before[rows][:1], after[rows][simulation.end[rows] > simulation.start[rows]]]
    return np.concatenate(parts)


def build_trajectory(problem: Problem, e: int, simulation: Simulation) -> Trajectory:
    """Return the trajectory of experiment e from its rows, as its user sees it: without the jumps' own segments."""
    structure, system = problem.structures[e], problem.system
    moving = simulation.end > simulation.start
    counts = [1 + int(moving[rows].sum()) for rows in simulation.segments]
    if structure.jumps:  # a mode goes on after a jump
        starts = np.array(drop_jumps(problem.experiments[e], range(1, len(counts))), dtype=np.intp)
        counts = np.add.reduceat(counts, np.insert(starts, 0, 0)).tolist()
    modes = np.repeat(problem.experiments[e].mode_sequence, counts)
    names = tuple(system.state_names or (f"x{k + 1}" for k in range(structure.n)))
    units = tuple(system.state_units or ("",) * structure.n)
    return Trajectory(
        select_visible(simulation, simulation.start, simulation.end),
        select_visible(simulation, simulation.before, simulation.after),
        modes,
        np.cumsum([0, *counts]),
        names,
        units,
        problem.experiments[e].time_unit,
        problem.experiments[e].origin,
    )
