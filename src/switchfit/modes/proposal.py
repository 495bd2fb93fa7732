"""What a generator of mode sequences returns."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from switchfit.problem.data import FloatArray


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
    """

    sequences: tuple[tuple[str, ...], ...]
    transition_times: tuple[FloatArray, ...]
    parameters: FloatArray
    cost: float = np.nan
