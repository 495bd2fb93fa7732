"""Adaptive steps through a part of the horizon, in machine code or by SciPy.

A hundred steps take less than a tenth of a millisecond in machine code, and ten milliseconds in Python. SciPy solves
models without machine code, and repeats a solve that failed, for its error message: by RK45, whose step size control is
that of `switchfit.discretization.step_size`, and in modes that take implicit steps by Radau.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.discretization.step_size import EXPONENT, STIFF_EXPONENT, Tolerances, first_step
from switchfit.engine.native.loops.adaptive_steps import AT
from switchfit.engine.native.native_experiment import NativeExperiment
from switchfit.problem.functions import use_float64
from switchfit.runtime.cache import use_compilation_cache
from switchfit.runtime.errors import NotIntegrableError
from switchfit.runtime.work import count_work

Slope = Callable[[float, FloatArray], FloatArray]
"""The derivative (n + 1,) of the state and of the running cost so far at a time."""

STEP_ADDITIONS = 1e6
"""Additions in the time that a step takes in Python: a millisecond, of six calls of a slope by JAX."""


class NativeStepsError(Exception):
    """Machine code cannot go on: SciPy finds out why."""


class Stretch(NamedTuple):
    """A part of the horizon without a transition or a knot of the inputs: mode, start and end, state at the start
    (n,), and whether it is solved by explicit steps.
    """

    mode: int
    start: float
    end: float
    x: FloatArray
    is_explicit: bool = True

    @property
    def middle(self) -> float:
        """A time inside it."""
        return 0.5 * (self.start + self.end)


class NativeSteps:
    """Adaptive steps in machine code through a stretch, in a mode of its own structure: up to `t` and `y` so far."""

    message = None  # of a failure: SciPy has it

    def __init__(self, native: NativeExperiment, mode: int, stretch: Stretch, p: FloatArray, given: Tolerances):
        self._native, self._mode, self._p, self._end = native, mode, p, stretch.end
        self.y, (start, end) = np.append(stretch.x, 0.0), stretch[1:3]
        exponent = EXPONENT if stretch.is_explicit else STIFF_EXPONENT
        step = first_step(self.slope, start, self.y, end, given, exponent)
        # The layout of memory is that of `loops.adaptive_steps`, which goes on from here in each call.
        self._state = np.zeros(len(AT))
        self._state[[AT.t, AT.step, AT.end, AT.rtol, AT.atol]] = start, step, end, *given
        # Times at which signals are read are kept strictly inside the stretch: at its ends an input may jump.
        self._state[[AT.low, AT.high]] = np.nextafter(start, end), np.nextafter(end, start)
        self.t, self.is_running = start, True

    def slope(self, t: float, y: FloatArray) -> FloatArray:
        """Return the slope at a time."""
        return self.slopes(np.array([t]), y[None])[0]

    def slopes(self, times: FloatArray, y: FloatArray) -> FloatArray:
        """Return the slopes at times (L,) and y (L, n + 1); NaN where the model is not defined."""
        return self._native.slopes_in(self._mode, times, y, self._p)

    def advance(self, most: int) -> tuple[FloatArray, FloatArray]:
        """Take up to `most` steps; return the accepted times (L,) and the states there (L, n)."""
        found = self._native.adaptive_steps(self._mode, self._state, self.y, self._p, most)
        self.t = float(self._state[AT.t])
        self.is_running = self.t < self._end and not self._state[AT.stuck]
        return found


class PythonSteps:
    """Adaptive steps of SciPy through a stretch, with slopes from Python: up to `t` and `y` so far."""

    def __init__(self, slope: Slope, stretch: Stretch, given: Tolerances) -> None:
        from scipy.integrate import RK45, Radau  # here, since importing it takes longer than most fits

        method, self._slope = RK45 if stretch.is_explicit else Radau, slope
        self.message: str | None = None
        self.t, self.y, self.is_running = stretch.start, np.append(stretch.x, 0.0), True
        with np.errstate(all="ignore"):  # a slope of 1e300 is refused with a message
            self._solver = method(slope, self.t, self.y, stretch.end, rtol=given.rtol, atol=given.atol)

    def slopes(self, times: FloatArray, y: FloatArray) -> FloatArray:
        """Return the slopes at times (L,) and y (L, n + 1), outside of the solve too; NaN where the model is not
        defined.
        """
        found = np.full(y.shape, np.nan)
        with use_float64(), use_compilation_cache():
            for k, t in enumerate(times.tolist()):
                with suppress(NotIntegrableError):
                    found[k] = self._slope(t, y[k])
        return found

    def advance(self, most: int) -> tuple[FloatArray, FloatArray]:
        """Take a step; return the accepted time (1,) and the state there (1, n), none if it has failed."""
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # a state that overflows is refused
            self.message = self._solver.step()
        count_work(STEP_ADDITIONS)
        self.t, self.y, self.is_running = float(self._solver.t), self._solver.y, self._solver.status == "running"
        # After a step that failed SciPy's t and y are those before it: there is nothing new.
        taken = slice(int(self.message is None))
        return np.array([self.t])[taken], self.y[None, :-1][taken]
