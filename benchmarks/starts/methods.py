"""What fits a problem from a start: switchfit's ways and its peers, each ``(problem, start) -> End``."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

import switchfit as sf


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


Method = Callable[[sf.Problem, np.ndarray], End]


def fit_with(**settings: Any) -> Method:
    """Return the method that calls `sf.estimate` with these settings."""

    def fit(problem: sf.Problem, start: np.ndarray) -> End:
        return read_estimate(sf.estimate(problem, start=start, **settings))

    return fit


def read_estimate(estimate: Any) -> End:
    """Return what counts of an `sf.Estimate`."""
    verdict = getattr(estimate, "verdict", None)
    level = "" if verdict is None else str(getattr(verdict, "level", verdict))
    return End(
        theta=np.asarray(estimate.theta).tolist(),
        cost=float(estimate.cost),
        violation=max((abs(value) for _, value, _ in estimate.constraints), default=0.0),
        claims=level == "good" if level else bool(estimate.success),
        verdict=level,
        status=estimate.status.name,
        evaluations=int(estimate.evaluations),
        iterations=int(estimate.iterations),
    )


def has_strategies() -> bool:
    """Return whether this version of `sf.estimate` has strategies."""
    return "strategy" in inspect.signature(sf.estimate).parameters


def list_methods() -> dict[str, Method]:
    """Return all methods that this version of switchfit has, by name."""
    one_fit = {"strategy": "local"} if has_strategies() else {}
    methods = {
        "exact": fit_with(hessian="exact", **one_fit),
        "gauss-newton": fit_with(hessian="gauss-newton", **one_fit),
        "default": fit_with(),
    }
    if has_strategies():
        methods |= {"auto": fit_with(strategy="auto"), "thorough": fit_with(strategy="thorough")}
    return methods


def why_not(name: str) -> str:
    """Return why a method is missing."""
    if name in ("auto", "thorough"):
        return "this version of sf.estimate has no strategies"
    return f"there is no method {name!r}; there are {', '.join(list_methods())}"
