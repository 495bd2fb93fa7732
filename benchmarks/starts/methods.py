"""What fits a problem from a start: switchfit's ways and its peers, each ``(case, start) -> End``."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np

import switchfit as sf
from benchmarks.starts import peers
from benchmarks.starts.case import Case
from benchmarks.starts.end import End

Method = Callable[[Case, np.ndarray], End]


def fit_with(**settings: Any) -> Method:
    """Return the method that calls `sf.estimate` with these settings."""

    def fit(case: Case, start: np.ndarray) -> End:
        return read_estimate(sf.estimate(case.problem, start=start, **settings))

    return fit


def read_estimate(estimate: Any) -> End:
    """Return what counts of an `sf.Estimate`."""
    verdict = getattr(estimate, "verdict", None)
    level = "" if verdict is None else str(getattr(verdict, "level", verdict))
    return End(
        theta=np.asarray(estimate.theta).tolist(),
        said=float(estimate.cost),
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
        methods |= {name: fit_with(strategy=name) for name in STRATEGIES}
    return methods | PEERS


PEERS: dict[str, Method] = {
    "scipy-least-squares": peers.fit_with_least_squares,
    "scipy-slsqp": peers.fit_with_slsqp,
    "ipopt": peers.fit_with_ipopt,
}
STRATEGIES = ("auto", "thorough")


def why_not(name: str, case: Case) -> str:
    """Return why a method does not apply to a problem; empty where it does."""
    reasons = {"scipy-least-squares": peers.why_no_least_squares, "ipopt": peers.why_no_ipopt}
    return reasons[name](case) if name in reasons else ""
