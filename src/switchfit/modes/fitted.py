"""A fitted schedule of each experiment: its times, its parameters, which of them act, and its cost."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray
from switchfit.modes.schedule import Schedule


@dataclass(frozen=True, eq=False)
class Fitted:
    """A schedule that was fitted.

    Attributes
    ----------
    schedules : tuple of Schedule, one for each experiment
    parameters : (M,)
        Free parameters and initial states, in the order of theta.
    acting : (M,) bool
        Those that act in the modes of the sequences; the others were held.
    cost : float
        J; infinite if the fit failed.
    guarded : int
        Transitions that have a guard.
    """

    schedules: tuple[Schedule, ...]
    parameters: FloatArray
    acting: NDArray[np.bool_]
    cost: float
    guarded: int = 0

    @property
    def sequences(self) -> tuple[tuple[str, ...], ...]:
        """The mode sequence of each experiment."""
        return tuple(schedule.sequence for schedule in self.schedules)

    @property
    def switches(self) -> int:
        """Number of transitions of all experiments."""
        return sum(schedule.switches for schedule in self.schedules)

    @property
    def free_switches(self) -> int:
        """Number of transitions whose times are unknowns: the time of one with a guard follows."""
        return self.switches - self.guarded

    @property
    def failed(self) -> bool:
        """Whether the model could not be evaluated, or a guard or terminal constraint is not met."""
        return not np.isfinite(self.cost)

    @property
    def has_unknowns(self) -> bool:
        """Whether there is anything to estimate."""
        return self.switches > 0 or bool(self.acting.any())

    @property
    def theta(self) -> FloatArray:
        """All times, then the parameters: (d,)."""
        return np.concatenate([*(schedule.times for schedule in self.schedules), self.parameters])
