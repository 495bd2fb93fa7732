"""An adaptive solver with slopes from Python. Import this only where it is needed: `scipy.integrate` takes long."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy.integrate

from switchfit.discretization.rows import end_of_row, stage_state
from switchfit.discretization.step_size import Progress, Tolerances, first_step, judge_step
from switchfit.discretization.tableaus import ADAPTIVE
from switchfit.problem.data import FloatArray


class ExplicitSolver(scipy.integrate.OdeSolver):
    """Steps of `switchfit.discretization.step_size` with slopes from Python, as one of SciPy's solvers."""

    y: FloatArray

    def __init__(
        self,
        slope: Callable[[float, FloatArray], FloatArray],
        t0: float,
        y0: FloatArray,
        end: float,
        *,
        rtol: float,
        atol: float,
    ) -> None:
        super().__init__(slope, t0, y0, end, vectorized=False)
        self._tolerances, self._end = Tolerances(rtol, atol), end
        self._slopes = np.zeros((len(ADAPTIVE.error), len(y0)))
        self._slopes[0] = self.fun(t0, y0)
        step = first_step(self.fun, t0, y0, self._slopes[0], end, self._tolerances)
        self._at = Progress(t0, step, False, False)

    def _step_impl(self) -> tuple[bool, str | None]:
        """Try steps until one is accepted; return whether one was, and the reason if not."""
        tableau, K, t, y = ADAPTIVE.tableau, self._slopes, self._at.t, self.y
        while not self._at.stuck:
            step = self._at.step
            for j, c in enumerate(tableau.c[1:].tolist(), start=1):
                K[j] = self.fun(t + c * step, stage_state(tableau.a[j], step, y, K[:j]))
            after = end_of_row(tableau, step, y, K[:-1])
            K[-1] = self.fun(t + step, after)
            self._at, self.y = judge_step(self._at, self._end, self._tolerances, y, after, K)
            if not self._at.refused:
                self.t, K[0] = float(self._at.t), K[-1]
                return True, None
        return False, self.TOO_SMALL_STEP
