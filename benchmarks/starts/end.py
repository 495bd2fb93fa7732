"""Where a fit ended, what it said of it, and what is so."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

import switchfit as sf
from switchfit.meshes.evaluator import Evaluator


@dataclass(frozen=True)
class End:
    """Where a fit ended and what it said of it.

    Attributes
    ----------
    theta : list of d floats
    said : float
        J as the fit has it, on a mesh of its own.
    claims : bool
        Whether the fit says that it succeeded: its verdict is "good", or it has no verdict and success is true.
    verdict : str
        "good", "doubtful" or "bad"; empty where a fit gives none.
    status : str
    evaluations, iterations : int
    fitting : float
        Seconds of the whole fit to an answer whose integration error is checked; without its verdict.
    optimizing : float
        Seconds of these in the optimiser alone, on meshes that are ready.
    """

    theta: list[float]
    said: float
    claims: bool
    verdict: str
    status: str
    evaluations: int
    iterations: int
    fitting: float
    optimizing: float


def judge(problem: sf.Problem, theta: list[float]) -> dict[str, float]:
    """Return J at theta, and the largest absolute value of a guard or terminal constraint, on a mesh chosen there.

    A fit's own mesh does not serve: it was chosen elsewhere, and an optimiser can descend into its integration error.
    """
    at = problem.check_theta(np.array(theta))
    evaluator = Evaluator(problem, at)
    held = evaluator.constrained(at).constraints if problem.constraint_names else []
    return {"cost": float(evaluator.cost(at)), "violation": max((abs(float(value)) for value in held), default=0.0)}
