"""What fits a problem from a start: two ways of switchfit, and SciPy."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

import switchfit as sf
from benchmarks.sharp.case import Case

LIMIT = 60.0
"""Seconds after which a fit is stopped, and ends at its best point."""


class End(NamedTuple):
    """Where a fit ended: theta, the J that it reports, whether it calls itself good, and what it says of its end."""

    theta: np.ndarray
    cost: float
    good: bool
    said: str


@cache
def build_problem(case: Case) -> sf.Problem:
    """Return the problem of a case, traced once."""
    return case.build_problem()


def fit_with(strategy: Any) -> Callable[[Case, np.ndarray], End]:
    """Return the method that calls `sf.estimate` with a strategy."""

    def fit(case: Case, start: np.ndarray) -> End:
        until = time.monotonic() + LIMIT
        found = sf.estimate(
            build_problem(case),
            strategy=strategy,
            start=start,
            callback=lambda record: time.monotonic() > until,
            time_budget=LIMIT,
        )
        verdict = found.verdict
        said = f"{found.status.name}, {verdict.level}: {verdict.reasons[0]}"
        return End(found.theta, found.cost, verdict.level == "good", said)

    return fit


def fit_with_scipy(case: Case, start: np.ndarray) -> End:
    """Fit with `least_squares` and finite differences of LSODA.

    Tried on 8 starts of each problem: tolerances of 1e-6 to 1e-10 with differences of 1e-3 to 1e-6 of each unknown, on
    one side or two, units by the Jacobian or by the start, trf and dogbox, stops at all corners. All found the same
    ends nearly everywhere; this is the fastest that is never worse.
    """
    until = time.monotonic() + LIMIT
    best, lowest = start, np.inf

    def compute_residuals(theta: np.ndarray) -> np.ndarray:
        nonlocal best, lowest
        r = case.weigh(case.simulate_plainly(theta, until, rtol=1e-6, atol=1e-8))
        if 0.5 * r @ r < lowest:
            best, lowest = theta.copy(), float(0.5 * r @ r)
        return r

    upper = np.full(len(start), np.inf)
    upper[: len(case.tau)] = case.times[-1]
    try:
        found = least_squares(
            compute_residuals, start, bounds=(0.0, upper), x_scale="jac", diff_step=1e-3, max_nfev=300
        )
    except TimeoutError:
        return End(best, lowest, False, f"stopped after {LIMIT:.0f} s")
    return End(found.x, float(found.cost), bool(found.success), found.message)


METHODS: dict[str, Callable[[Case, np.ndarray], End]] = {
    "local": fit_with("local"),
    "auto": fit_with("auto"),
    "scipy": fit_with_scipy,
}
