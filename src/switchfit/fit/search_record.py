"""What a search for a better minimum leaves in a fit: the strategies that were tried, and rival minima."""

from __future__ import annotations

from dataclasses import dataclass

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
