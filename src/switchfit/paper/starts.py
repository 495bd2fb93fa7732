"""Estimates from starts anywhere within the bounds, which according to the paper would generally agree."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from switchfit.estimation.estimator import Estimate
from switchfit.paper.vehicle import HORIZON, Figure, Found, Row, Say, build_simulated_problem
from switchfit.problem.data import FloatArray
from switchfit.runtime.errors import NotIntegrableError
from switchfit.strategy.choice import estimate, was_interrupted

TITLE = "Starts"
COUNT, QUICK_COUNT = 1000, 30
LOWER_MU, UPPER_MU = 0.05, 2.0
#: Estimates that agree to this part of the horizon, or to this difference of mu, count as one.
SAME = 1e-3
#: Number of estimates in the table, the most frequent ones.
SHOWN = 4
METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "exact": ("one fit, exact Hessian", {"strategy": "local", "hessian": "exact"}),
    "local": ("one fit, trust region", {"strategy": "local"}),
    "auto": ('strategy "auto"', {"strategy": "auto"}),
}


def compute(quick: bool, folder: Path, say: Say) -> Found:
    """Fit from starts all over the bounds, with three methods."""
    problem = build_simulated_problem()
    starts = draw_starts(QUICK_COUNT if quick else COUNT)
    found: Found = {"starts": len(starts), "ways": {}}
    for method, (label, settings) in METHODS.items():
        ends: list[Found] = []
        for k, start in enumerate(starts):
            if k % 100 == 0:
                say(f"{label}: start {k} of {len(starts)}")
            fit = None
            with suppress(NotIntegrableError):
                fit = estimate(problem, start=start, **settings)
            if fit is not None and was_interrupted(fit):
                raise KeyboardInterrupt
            _count(ends, fit)
        found["ways"][method] = sorted(ends, key=lambda end: -end["count"])
    return found


def draw_starts(count: int) -> FloatArray:
    """Return ordered transition times anywhere in the horizon, and mu anywhere within its bounds: (count, 3)."""
    rng = np.random.default_rng(0)
    times = np.sort(rng.uniform(0.0, HORIZON, (count, 2)), axis=1)
    return np.column_stack([times, rng.uniform(LOWER_MU, UPPER_MU, count)])


def _count(ends: list[Found], fit: Estimate | None) -> None:
    """Add an estimate to the count of those with which it agrees."""
    found: Found = {"theta": None, "cost": None}
    if fit is not None and fit.status.successful:
        found = {"theta": fit.theta.tolist(), "cost": fit.cost}
    for end in ends:
        if _agree(end["theta"], found["theta"]):
            end["count"] += 1
            return
    ends.append(found | {"count": 1})


def _agree(one: list[float] | None, other: list[float] | None) -> bool:
    if one is None or other is None:
        return one is other
    return bool(np.all(np.abs(np.subtract(one, other)) < SAME * np.array([HORIZON, HORIZON, 1.0])))


def draw(found: Found) -> dict[str, Figure]:
    """Return no figures: the table has the results."""
    return {}


def rows(found: Found) -> list[Row]:
    """Return a line for each method."""
    return [
        Row(
            f"V-B: {found['starts']} starts all over the bounds, {METHODS[method][0]}",
            "would generally lead to the same estimate",
            "; ".join(_name(end) for end in ends[:SHOWN]),
            _rest(ends[SHOWN:]),
        )
        for method, ends in found["ways"].items()
    ]


def _name(end: Found) -> str:
    if end["theta"] is None:
        return f"{end['count']} not converged"
    tau_1, tau_2, mu = end["theta"]
    return f"{end['count']} at ({tau_1:.2f}, {tau_2:.2f}, {mu:.3f}), J = {end['cost']:.3g}"


def _rest(ends: list[Found]) -> str:
    text = "tau uniform in 0 to 15 s, mu in its bounds; (tau_1, tau_2, mu)"
    return text + (f"; {sum(end['count'] for end in ends)} elsewhere" if ends else "")
