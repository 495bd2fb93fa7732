"""Estimates from starts anywhere within the bounds, which according to the paper would generally agree."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np

from switchfit.arrays import FloatArray
from switchfit.estimation.estimating import estimate
from switchfit.paper import vehicle
from switchfit.paper.table_rows import Found, Say, TableRow
from switchfit.paper.vehicle import HORIZON
from switchfit.runtime.errors import NotIntegrableError
from switchfit.strategy.search import was_interrupted

START_COUNT, QUICK_START_COUNT = 1000, 30
LOWER_MU, UPPER_MU = 0.05, 2.0

#: Estimates that agree to this part of the horizon, or to this difference of mu, count as one.
LARGEST_DIFFERENCE_OF_ENDS = 1e-3

#: Number of estimates in the table, the most frequent ones.
MOST_LISTED_ENDS = 4

START_METHODS: dict[str, tuple[str, dict[str, Any]]] = {
    "exact": ("one fit, exact Hessian", {"strategy": "local", "hessian": "exact"}),
    "local": ("one fit, trust region", {"strategy": "local"}),
    "auto": ('strategy "auto"', {"strategy": "auto"}),
}


def compute_starts(quick: bool, say: Say) -> Found:
    """Fit from starts all over the bounds, with three methods."""
    problem = vehicle.build_simulated_problem()
    starts = draw_starts(QUICK_START_COUNT if quick else START_COUNT)
    found: Found = {"starts": len(starts), "ways": {}}
    for method, (label, settings) in START_METHODS.items():
        ends: list[Found] = []
        for k, start in enumerate(starts):
            if k % 100 == 0:
                say(f"{label}: start {k} of {len(starts)}")
            theta, cost = None, None
            with suppress(NotIntegrableError):
                fit = estimate(problem, start=start, **settings)
                # Ctrl-C ends the study, not one of a thousand fits.
                if was_interrupted(fit):
                    raise KeyboardInterrupt
                theta, cost = (fit.theta.tolist(), fit.cost) if fit.status.successful else (None, None)
            # Ends are grouped as they come: the first fit that ended somewhere stands for the group.
            same = (end for end in ends if _agree(end["theta"], theta))
            if (end := next(same, None)) is None:
                ends.append(end := {"theta": theta, "cost": cost, "count": 0})
            end["count"] += 1
        found["ways"][method] = sorted(ends, key=lambda end: -end["count"])
    return found


def draw_starts(count: int) -> FloatArray:
    """Return ordered transition times anywhere in the horizon, and mu anywhere within its bounds: (count, 3)."""
    rng = np.random.default_rng(0)
    times = np.sort(rng.uniform(0.0, HORIZON, (count, 2)), axis=1)
    return np.column_stack([times, rng.uniform(LOWER_MU, UPPER_MU, count)])


def _agree(one: list[float] | None, other: list[float] | None) -> bool:
    if one is None or other is None:
        return one is other
    return bool(
        np.all(np.abs(np.subtract(one, other)) < LARGEST_DIFFERENCE_OF_ENDS * np.array([HORIZON, HORIZON, 1.0]))
    )


def list_starts(found: Found) -> list[TableRow]:
    """Return a line for each method."""
    return [
        TableRow(
            f"V-B: {found['starts']} starts all over the bounds, {START_METHODS[method][0]}",
            "would generally lead to the same estimate",
            "; ".join(_name(end) for end in ends[:MOST_LISTED_ENDS]),
            _rest(ends[MOST_LISTED_ENDS:]),
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
