"""How a fit was found: its iterations, the strategies that were tried, and rival minima."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.optimize import IterationRecord

Rival = tuple[str, float, float]


@dataclass(frozen=True)
class Step:
    """One strategy of a fit: the cost it reached and the work it took.

    Attributes
    ----------
    strategy : str
        "local", the fit from the first guess, or the name of another; "interrupted".
    cost : float
        The lowest J after it; infinite as long as the model could not be integrated, constraints are not met, or a fit
        without convergence has a large integration error.
    evaluations : int
    seconds : float
    ended : str
        Why the many starts ended: "settled", no further minimum was likely; "most", as many as are tried at most;
        "good", the lowest leaves nothing but noise; "time" or "interrupted". For another strategy "time" if the limit
        of time ended it, or the message of an error. Otherwise empty.

    See Also
    --------
    estimate, Estimate.steps

    Examples
    --------
    >>> [step.strategy for step in sf.estimate(heater_problem(), strategy="thorough").steps][0]
    'local'
    """

    strategy: str
    cost: float
    evaluations: int
    seconds: float
    ended: str = ""


@dataclass(frozen=True, eq=False, kw_only=True)
class SearchRecord:
    """How a fit was found: from where, with what work, and what else was tried.

    Attributes
    ----------
    initial_theta : (d,)
        Where the first fit began.
    initial_cost : float
        J at `initial_theta`; NaN if it is unknown or cannot be evaluated there.
    history : tuple of IterationRecord
        Of the fit that found theta. Where strategies were tried, it begins where one of them ended.
    evaluations : int
        Of everything that was tried.
    seconds : float
        Wall time of the estimation, always in seconds.
    steps : tuple of Step
        The strategies that were tried, in order; empty if the first fit was enough.
    starts : (tried, better, agreeing) or None
        Numbers of other starts that were fitted, that ended lower than this fit, and that ended at its J; None without
        other starts.
    rivals : tuple of (unknown, value, rise)
        Transition times of other minima that the data do not tell from this one, and by how much J is higher there.
    """

    initial_theta: FloatArray
    history: tuple[IterationRecord, ...]
    evaluations: int
    seconds: float
    initial_cost: float = np.nan
    steps: tuple[Step, ...] = ()
    starts: tuple[int, int, int] | None = None
    rivals: tuple[Rival, ...] = ()
