"""Detect stiff modes, for which ``Problem(solver="auto")`` takes implicit steps.

The step of an explicit method is limited by accuracy, or by stability: ``|lambda| h`` has to stay inside the region of
stability, which reaches to about 3.3 for the pair of Dormand and Prince, for every eigenvalue lambda of the Jacobian of
the vector field, even if its component has decayed. A mode in which stability limits the step is stiff (Hairer and
Wanner II, section IV.2). Explicit steps are then many, and at the limit: at a theta with a larger eigenvalue the same
mesh is unstable.

A `Watch` counts the steps of the explicit solve. For a mode with many steps, the eigenvalues are computed at every
`STEPS_BETWEEN` of them. If stability limits more than a quarter of the steps, the implicit method solves the experiment
too, and is used if it needs far fewer steps.

A fit may reach a theta where a mode is stiff and the explicit steps of its mesh are unstable: it then cannot go on.
After such a failure, the eigenvalues at that theta are compared with the mesh.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from switchfit.discretization.mesh import Mesh, Stiffness
from switchfit.problem.data import FloatArray
from switchfit.runtime.errors import NotIntegrableError

log = logging.getLogger("switchfit")

STEPS_BETWEEN = 250
"""Accepted steps in a mode between two states at which its eigenvalues are computed."""

STEPS_BETWEEN_AFTER_FAILURE = 64
"""The same after a fit has failed, to find out whether its mesh is unstable."""

FEW_STEPS = 1000
"""A mode with fewer steps is not called stiff, and its eigenvalues are not computed."""

LIMITED = 2.0
"""``|lambda| h`` from which stability limits the step: the region of stability reaches to 3.3 for eigenvalues whose
damping ratio is above 0.3, to 2.1 for one of 0.02. Accuracy limits it to less: at rtol = 1e-8 to 0.1 in an
oscillation."""

FEWER = 5
"""Factor by which implicit steps must be fewer. An implicit step takes some hundred times as long as an explicit one
in machine code, but explicit steps that stability limits fail as soon as theta moves (Van der Pol's oscillator with
mu = 100 has seven times fewer; explicit steps make J NaN at the guess)."""

FEWER_AFTER_FAILURE = 2
"""The same after explicit steps have failed."""


class _Look(NamedTuple):
    """A state of an explicit solve at which the eigenvalues can be computed: the arguments of `Watch.look`."""

    step: float
    slope: Callable[[float, FloatArray], FloatArray]
    t: float
    y: FloatArray
    smallest: float

    def measure_rate(self) -> float:
        """Return the largest ``|lambda|`` of a component that decays; 0 if none does, or the model is undefined."""
        try:
            with np.errstate(all="ignore"):
                jacobian = _differentiate(self.slope, self.t, self.y, self.smallest)
        except NotIntegrableError:  # beside the trajectory the model need not be defined
            return 0.0
        return _largest_decay(jacobian) if np.isfinite(jacobian).all() else 0.0


@dataclass
class _ModeSteps:
    """Accepted steps in one mode, so far and at the last look, and the projected total of a solve that was given up."""

    count: int = 0
    looked: int = 0
    projected: float = 0.0
    looks: list[_Look] = field(default_factory=list)

    @cached_property
    def rates(self) -> list[float]:
        """``|lambda|`` at each look."""
        return [look.measure_rate() for look in self.looks]

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


class Watch:
    """Counts the accepted steps of one solve, mode by mode, and keeps the states at which to compute eigenvalues.

    Parameters
    ----------
    most : float
        Steps after which `add` raises `TooManyStepsError`.
    between : int
        Steps in a mode between two looks.
    """

    def __init__(self, most: float = np.inf, between: int = STEPS_BETWEEN) -> None:
        self.modes: dict[str, _ModeSteps] = {}
        self.most, self.between = most, between

    @property
    def total(self) -> int:
        """Steps in all modes."""
        return sum(mode.total for mode in self.modes.values())

    @property
    def stiffest(self) -> tuple[str, float] | None:
        """The stiff mode with the most steps, and ``|lambda| h`` where stability limits them."""
        found = {name: mode for name, mode in self.modes.items() if mode.is_stiff}
        name = max(found, key=lambda name: found[name].total, default=None)
        return None if name is None else (name, float(np.median(found[name].limited)))

    def find_unstable(self, mesh: Mesh) -> tuple[str, float] | None:
        """Return the mode in which the explicit steps of a mesh are the furthest beyond `LIMITED`, and ``|lambda| h``
        there; None if they are in none.
        """
        last = len(mesh.times) - 2
        found = []
        for name, mode in self.modes.items():
            for rate, look in zip(mode.rates, mode.looks, strict=True):
                cell = min(int(np.searchsorted(mesh.times, look.t)) - 1, last)
                found.append((float(rate * (mesh.times[cell + 1] - mesh.times[cell])), name))
        ratio, name = max(found, default=(0.0, ""))
        return (name, ratio) if ratio > LIMITED else None

    def add(self, name: str, accepted: int) -> bool:
        """Count steps in a mode, and return whether it is time to `look`.

        Raises
        ------
        TooManyStepsError
            If there are more than `most`.
        """
        mode = self.modes.setdefault(name, _ModeSteps())
        mode.count += accepted
        if self.total > self.most:
            raise TooManyStepsError
        return mode.count - mode.looked >= self.between

    def look(
        self,
        name: str,
        step: float,
        slope: Callable[[float, FloatArray], FloatArray],
        t: float,
        y: FloatArray,
        smallest: float,
    ) -> None:
        """Keep a state of a mode, for its eigenvalues; they are computed only if the mode takes many steps.

        Parameters
        ----------
        name : str
        step : float
            Length of the last step.
        slope : callable
            ``slope(t, y) -> (n + 1,)``: the vector field, and the running cost, which is left out.
        t, y : float, (n + 1,)
            The end of that step.
        smallest : float
            Smallest size of a state for the steps of the differences.
        """
        mode = self.modes[name]
        mode.looked = mode.count
        mode.looks.append(_Look(step, slope, t, y.copy(), smallest))

    def give_up(self, name: str, steps: float) -> None:
        """Record that the solve of a mode was given up, and the steps that it would have taken at its pace."""
        self.modes[name].projected = steps


class TooManyStepsError(Exception):
    """More steps than a `Watch` allows."""


def _differentiate(
    slope: Callable[[float, FloatArray], FloatArray], t: float, y: FloatArray, smallest: float
) -> FloatArray:
    """Return the Jacobian of the vector field by differences, (n, n), good enough for the size of its eigenvalues."""
    n = len(y) - 1
    before = slope(t, y)[:n]
    steps = np.sqrt(np.finfo(float).eps) * (np.abs(y[:n]) + smallest)
    columns = []
    for k, step in enumerate(steps):
        moved = y.copy()
        moved[k] += step
        columns.append((slope(t, moved)[:n] - before) / (moved[k] - y[k]))
    return np.stack(columns, axis=1)


def _largest_decay(jacobian: FloatArray) -> float:
    """Return the largest size of an eigenvalue whose component decays; 0 if none does."""
    eigenvalues = np.linalg.eigvals(jacobian)
    return float(np.max(np.abs(eigenvalues[eigenvalues.real < 0]), initial=0.0))


def report_stiffness(found: tuple[str, float], explicit: Watch, implicit: Watch) -> Stiffness:
    """Return why implicit steps are the better choice, and log it; `found` is the stiff mode and ``|lambda| h``."""
    name, stability = found
    stiffness = Stiffness(name, explicit.modes[name].total, implicit.modes[name].total, stability)
    text = str(stiffness)
    log.info("%s.", text[0].upper() + text[1:])
    return stiffness
