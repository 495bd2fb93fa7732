"""Where a fit ended and what it said of it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class End:
    """Where a fit ended and what it said of it.

    Attributes
    ----------
    theta : list of d floats
    cost : float
    violation : float
        Largest absolute value of a guard or terminal constraint; 0 without any.
    claims : bool
        Whether the fit says that it succeeded: its verdict is "good", or it has no verdict and success is true.
    verdict : str
        "good", "doubtful" or "bad"; empty where a fit gives none.
    status : str
    evaluations, iterations : int
    """

    theta: list[float]
    cost: float
    violation: float
    claims: bool
    verdict: str
    status: str
    evaluations: int
    iterations: int
