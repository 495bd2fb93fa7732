"""What fits a problem from a start: switchfit's ways and its peers, each ``(case, start) -> End``."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import numpy as np

import switchfit as sf
from benchmarks.starts import peers
from benchmarks.starts.case import Case
from benchmarks.starts.end import End
from switchfit import optimize
from switchfit.fit import minimization

Method = Callable[[Case, np.ndarray], End]


def fit_with(**settings: Any) -> Method:
    """Return the method that calls `sf.estimate` with these settings."""

    def fit(case: Case, start: np.ndarray) -> End:
        began = time.perf_counter()
        with time_optimizer() as seconds:
            estimate = sf.estimate(case.problem, start=start, **settings)
        return read_estimate(estimate, time.perf_counter() - began, sum(seconds))

    return fit


@contextmanager
def time_optimizer() -> Iterator[list[float]]:
    """Return a context with the seconds of each minimisation inside it, in this process."""
    seconds: list[float] = []

    def minimize(*given: Any, **settings: Any) -> Any:
        began = time.perf_counter()
        try:
            return optimize.minimize(*given, **settings)
        finally:
            seconds.append(time.perf_counter() - began)

    with patch.object(minimization, "minimize", minimize):
        yield seconds


def read_estimate(estimate: Any, fitting: float, optimizing: float) -> End:
    """Return what counts of an `sf.Estimate`."""
    level = estimate.verdict.level
    return End(
        theta=np.asarray(estimate.theta).tolist(),
        said=float(estimate.cost),
        claims=level == "good",
        verdict=level,
        status=estimate.status.name,
        evaluations=int(estimate.evaluations),
        iterations=int(estimate.iterations),
        fitting=fitting,
        optimizing=optimizing,
    )


def list_methods() -> dict[str, Method]:
    """Return all methods, by name: single fits with a line search and in a trust region, strategies, peers."""
    return {
        "exact": fit_with(strategy="local", hessian="exact"),
        "gauss-newton": fit_with(strategy="local", hessian="gauss-newton"),
        **{name: fit_with(strategy=name) for name in ("local", "auto", "thorough")},
        **PEERS,
    }


PEERS: dict[str, Method] = {
    "scipy-least-squares": peers.fit_with_least_squares,
    "scipy-slsqp": peers.fit_with_slsqp,
    "ipopt": peers.fit_with_ipopt,
}


def why_not(name: str, case: Case) -> str:
    """Return why a method does not apply to a problem; empty where it does."""
    reasons = {"scipy-least-squares": peers.why_no_least_squares, "ipopt": peers.why_no_ipopt}
    return reasons[name](case) if name in reasons else ""
