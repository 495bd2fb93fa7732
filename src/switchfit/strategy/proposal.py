"""Proposal: a schedule that a generator of mode sequences returns, and what its data say about parameters."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from switchfit.arrays import FloatArray


class Quadratic(NamedTuple):
    """A quadratic cost of parameters and initial states, ``g'd + d'Q d / 2`` with ``d = p - center``."""

    center: FloatArray
    g: FloatArray
    Q: FloatArray

    def restrict(self, places: NDArray[np.intp]) -> Quadratic:
        """Return the cost of some of the parameters, the others being where it is lowest.

        Parameters
        ----------
        places : (K,) int array
        """
        others = np.setdiff1d(np.arange(len(self.center)), places)
        g, Q = self.g[places], self.Q[np.ix_(places, places)]
        if len(others):
            cross = self.Q[np.ix_(places, others)]
            solved = np.linalg.pinv(self.Q[np.ix_(others, others)], rcond=1e-10, hermitian=True)
            # Schur complement. The pseudo-inverse leaves directions alone of which the data say nothing.
            g, Q = g - cross @ solved @ self.g[others], Q - cross @ solved @ cross.T
        return Quadratic(self.center[places], g, Q)

    def evaluate(self, parameters: FloatArray) -> tuple[Any, FloatArray]:
        """Return the cost of parameters and initial states (..., M), and its gradient."""
        step = parameters - self.center
        rise = step @ self.Q
        return ((self.g + 0.5 * rise) * step).sum(-1), self.g + rise


class Proposal(NamedTuple):
    """A schedule that a generator proposes as the start of a fit.

    Attributes
    ----------
    sequences : tuple of tuple of str, one for each experiment
    transition_times : tuple of (N,) arrays, one for each experiment
    parameters : (P,) array
        The problem's free parameters and initial states, in the order of theta after the times.
    cost : float
        The generator's estimate of J, plus its penalties: proposals of one call are compared by it.
    evidence : Quadratic or None
        Of the best of a beam: what the data of its experiment alone say about the parameters of that.
    """

    sequences: tuple[tuple[str, ...], ...]
    transition_times: tuple[FloatArray, ...]
    parameters: FloatArray
    cost: float = np.nan
    evidence: Quadratic | None = None
