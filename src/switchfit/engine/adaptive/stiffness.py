"""Detect in an adaptive solve which modes are stiff.

The step of an explicit method is limited by accuracy, or by stability: ``|lambda| h`` has to stay inside the region of
stability, which reaches to about 3.3 for the pair of Dormand and Prince, for every eigenvalue lambda of the Jacobian of
the vector field, even if its component has decayed. A mode in which stability limits the step is stiff (Hairer and
Wanner II, section IV.2). Explicit steps are then many, and at the limit: at a theta with a larger eigenvalue the same
mesh is unstable.

A `Watch` counts the steps of each mode in a solve. For a mode with many explicit steps, the eigenvalues are computed at
every `STEPS_BETWEEN` of them; the mode is stiff if stability limits more than a quarter of the steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import groupby
from typing import NamedTuple

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.discretization.mesh import MANY_STEPS, Mesh

STEPS_BETWEEN = 250
"""Accepted steps in a mode between two states at which its eigenvalues are computed."""

FEW_STEPS = 1000
"""A mode with fewer steps is not called stiff, and its eigenvalues are not computed: its rows take less than a
millisecond, and the program with implicit rows takes a second to compile."""

LOOKS_TO_STOP = 20
"""Looks in a row at which stability limits the step after which the explicit solve is given up: the steps that it would
take are known well enough from its pace. It took 25 ms to the end, where friction is regularised at 1e-6 m/s."""

LIMITED = 2.0
"""``|lambda| h`` from which stability limits the step: the region of stability reaches to 3.3 for eigenvalues whose
damping ratio is above 0.3, to 2.1 for one of 0.02. Accuracy limits it to less: at rtol = 1e-8 to 0.1 in an
oscillation."""

Slopes = Callable[[FloatArray, FloatArray], FloatArray]
"""The vector field and the running cost (L, n + 1) at times (L,) and y (L, n + 1); NaN where they are not defined."""


class Look(NamedTuple):
    """A state of an explicit solve at which the eigenvalues can be computed, if its mode takes many steps.

    Attributes
    ----------
    step : float
        Length of the last step.
    slopes : Slopes
        The running cost is left out.
    t, y : float, (n + 1,)
        The end of that step.
    smallest : float
        Smallest size of a state for the steps of the differences.
    """

    step: float
    slopes: Slopes
    t: float
    y: FloatArray
    smallest: float


@dataclass
class _ModeSteps:
    """Accepted steps in one mode, so far and at the last look, the projected total of a solve that was given up, the
    rows of a mesh with these steps, and the work of a row.
    """

    row_work: float = 1.0
    rows: int = 0
    count: int = 0
    looked: int = 0
    projected: float = 0.0
    looks: list[Look] = field(default_factory=list)

    @cached_property
    def rates(self) -> list[float]:
        """The largest ``|lambda|`` of a component that decays at each look."""
        return _measure_rates(self.looks)

    @property
    def limited(self) -> list[float]:
        """``|lambda| h`` at the looks where stability limits the step."""
        ratios = (rate * look.step for rate, look in zip(self.rates, self.looks, strict=True))
        return [ratio for ratio in ratios if ratio > LIMITED]

    @property
    def is_stiff(self) -> bool:
        """Whether there are many steps, and stability limits more than a quarter of them."""
        return self.total >= FEW_STEPS and 4 * len(self.limited) > len(self.looks)

    @property
    def total(self) -> int:
        """Steps that were or would have been taken."""
        return round(max(self.projected, self.count))

    @property
    def work(self) -> float:
        """Work of the rows of a mesh with these steps: there is at least one between two samples."""
        return self.row_work * max(self.rows, self.total)


class Watch:
    """Counts the accepted steps of one solve, mode by mode, and keeps the states at which to compute eigenvalues.

    Parameters
    ----------
    most : dict of str to float, optional
        Work in a mode after which `add` raises `TooManyStepsError`.
    between : int
        Steps in a mode between two looks.
    refused : set of str, optional
        Modes that take explicit steps although they are stiff; by default all do.

    Attributes
    ----------
    modes : dict of str to the steps of a mode
    current, mode : str, the steps of a mode
        The mode that is being solved; "" before the first.
    """

    def __init__(
        self, most: dict[str, float] | None = None, between: int = STEPS_BETWEEN, refused: set[str] | None = None
    ) -> None:
        self.modes: dict[str, _ModeSteps] = {}
        self.most, self.between, self.refused = most or {}, between, refused
        self.current, self.mode = "", _ModeSteps()

    def find_stiff(self) -> dict[str, float]:
        """Return the stiff modes, and ``|lambda| h`` where stability limits the steps of each."""
        return {name: float(np.median(mode.limited)) for name, mode in self.modes.items() if mode.is_stiff}

    def find_unstable(self, mesh: Mesh) -> dict[str, float]:
        """Return the modes in which explicit steps of a mesh are beyond `LIMITED`, and the largest ``|lambda| h`` of
        each.
        """
        last = len(mesh.times) - 2
        found: dict[str, float] = {}
        for name, mode in self.modes.items():
            for rate, look in zip(mode.rates, mode.looks, strict=True):
                # The steps of the fixed mesh, not those of the solve: |lambda| of the look times the length of the cell
                # it is in.
                cell = min(int(np.searchsorted(mesh.times, look.t)) - 1, last)
                ratio = float(rate * (mesh.times[cell + 1] - mesh.times[cell]))
                if ratio > max(LIMITED, found.get(name, 0.0)):
                    found[name] = ratio
        return found

    def enter(self, name: str, row_work: float = 1.0) -> None:
        """Begin the solve of a mode whose rows have this work, in additions, in an evaluation of (J, g, H)."""
        self.current, self.mode = name, self.modes.setdefault(name, _ModeSteps())
        self.mode.row_work = row_work

    def add(self, accepted: int, is_last: bool = False) -> bool:
        """Count steps in the current mode, and return whether it is time to `look`: `is_last` says that they end it.

        Raises
        ------
        TooManyStepsError
            If their work is more than the `most` of this mode.
        """
        mode = self.mode
        mode.count += accepted
        # The implicit solve of a mode is given up as soon as its rows are known to take longer than the explicit ones.
        if mode.row_work * mode.count > self.most.get(self.current, np.inf):
            raise TooManyStepsError
        return mode.count - mode.looked >= (MANY_STEPS if is_last else self.between)

    def look(self, there: Look) -> None:
        """Keep a state of the current mode, for its eigenvalues."""
        self.mode.looked = self.mode.count
        self.mode.looks.append(there)

    def is_clear(self) -> bool:
        """Return whether the current mode is stiff, however its solve goes on, and may take implicit steps."""
        looks = self.mode.looks
        # 20 of at most 60 looks are more than a quarter of them.
        may_stop = len(looks) in range(LOOKS_TO_STOP, 4 * LOOKS_TO_STOP, LOOKS_TO_STOP)
        if self.refused is None or self.current in self.refused or not may_stop:
            return False
        # In a row: where a mode is stiff in a part of its time alone, explicit steps may still be fewer.
        last = looks[-LOOKS_TO_STOP:]
        rates = _measure_rates(last)
        return all(rate * look.step > LIMITED for rate, look in zip(rates, last, strict=True))


class TooManyStepsError(Exception):
    """More work in a mode than a `Watch` allows."""


def _measure_rates(looks: Sequence[Look]) -> list[float]:
    """Return the largest ``|lambda|`` of a component that decays at each look; 0 if none does, or the model is
    undefined.
    """
    found: list[float] = []
    # The looks of one stretch together: their slopes are one call of machine code.
    for slopes, own in groupby(looks, lambda look: look.slopes):
        steps, _, times, y, smallest = (np.array(each) for each in zip(*own, strict=True))
        with np.errstate(all="ignore"):
            jacobians = _differentiate(slopes, times, y, smallest)
        rates = np.zeros(len(steps))
        defined = np.isfinite(jacobians).all(axis=(1, 2))  # beside the trajectory the model need not be
        eigenvalues = np.linalg.eigvals(jacobians[defined])
        # A component that grows limits nothing: its steps are short for accuracy.
        rates[defined] = np.where(eigenvalues.real < 0, np.abs(eigenvalues), 0.0).max(axis=1, initial=0.0)
        found += rates.tolist()
    return found


def _differentiate(slopes: Slopes, times: FloatArray, y: FloatArray, smallest: FloatArray) -> FloatArray:
    """Return the Jacobians of the vector field at times (L,) by differences, (L, n, n), good enough for the size of
    their eigenvalues.
    """
    n, each = y.shape[1] - 1, np.arange(y.shape[1] - 1)
    # Differences from t on one side: lambda is needed to a factor, and n + 1 slopes are all that it costs.
    moved = np.repeat(y[:, None], n + 1, axis=1)
    moved[:, 1 + each, each] += np.sqrt(np.finfo(float).eps) * (np.abs(y[:, :n]) + smallest[:, None])
    steps = moved[:, 1 + each, each] - y[:, :n]
    found = slopes(np.repeat(times, n + 1), moved.reshape(-1, n + 1)).reshape(moved.shape)[..., :n]
    return np.swapaxes((found[:, 1:] - found[:, :1]) / steps[..., None], 1, 2)
