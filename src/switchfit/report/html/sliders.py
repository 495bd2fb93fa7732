"""Sliders of a page: how far an unknown may be moved, and the exact J on the way.

The curves move by their derivatives, ``x(t; theta + d) ~ x + S d``. J along one unknown, the others held, is
evaluated, and shows beside its quadratic approximation how far derivatives hold; where several are moved, J is that
approximation, ``J + g d + d' H d / 2``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray
from switchfit.report.html.curves import Curves
from switchfit.report.numbers import format_unit
from switchfit.report.times import describe_clock, list_dated
from switchfit.uncertainty.judged_fit import JudgedFit

SIDE_POINTS = 20
"""Values of J to each side of the estimate."""

VISIBLE = 0.15
"""Part of a channel's range by which the end of a slider moves the curve, if the bounds allow it."""


def build_sliders(estimate: JudgedFit, runs: dict[int, list[Curves]], places: Sequence[int]) -> list[dict[str, Any]]:
    """Return what the page knows of a slider, for each unknown that has room to move.

    Its place in theta, its name, unit and value, how it is shown as a date, the `values` and J along it, the others
    held, None where it cannot be evaluated.

    Parameters
    ----------
    estimate : JudgedFit
        With its problem.
    runs : mapping of run to its curves
        Those that are shown.
    places : sequence of int
        The unknowns.
    """
    found = []
    for place in places:
        (low, high), theta = find_range(estimate, runs, place), float(estimate.theta[place])
        if not low < high:
            continue
        # The estimate is a point of both sides, so that the rise is exactly 0 there.
        sides = np.linspace(low, theta, SIDE_POINTS + 1), np.linspace(theta, high, SIDE_POINTS + 1)
        values = np.unique(np.concatenate(sides))
        costs = np.array([evaluate_moved(estimate, place, value) for value in values])
        run = list_dated(estimate)[place]
        slider = {"place": place, "name": estimate.theta_names[place], "theta": theta}
        slider |= {"clock": run and describe_clock(run), "unit": format_unit(estimate.theta_units[place])}
        found.append({**slider, "values": drop_nan(values), "costs": drop_nan(costs)})
    return found


def drop_nan(values: ArrayLike) -> object:
    """Return a number or an array for JSON, with None for what is not finite."""
    return np.where(np.isfinite(values), values, np.array(None)).tolist()


def find_range(estimate: JudgedFit, runs: dict[int, list[Curves]], place: int) -> tuple[float, float]:
    """Return how far an unknown can be moved: until a curve has moved visibly, inside its bounds, in its order.

    Parameters
    ----------
    estimate : JudgedFit
    runs : mapping of run to its curves
    place : int
    """
    theta = float(estimate.theta[place])
    wanted = []
    for own in (own for run in runs.values() for own in run if f"d{place}_0" in own.curve):
        for k in range(len(own.names)):
            known = own.curve[f"y{k}"][np.isfinite(own.curve[f"y{k}"])]
            slope = float(np.nanmax(np.abs(own.curve[f"d{place}_{k}"]), initial=0.0))
            if len(known) and np.ptp(known) > 0 and slope > 0:
                wanted.append(VISIBLE * float(np.ptp(known)) / slope)
    # The first curve that moves visibly decides; an unknown that moves none gets a tenth of its value.
    half = min(wanted, default=0.0) or 0.1 * abs(theta) or 1.0
    constraints = estimate.evaluator_at_solution().problem.constraints
    slopes, slack = constraints.A[:, place], constraints.A @ estimate.theta - constraints.b
    # Constraints A theta >= b, such as the order of transition times: how far this unknown can go with the others held.
    # Not to the very end, where a mode has no duration, and J a kink.
    room = 0.98 * np.divide(slack, np.abs(slopes), out=np.full_like(slack, np.inf), where=slopes != 0)
    low = max(theta - np.min(room[slopes > 0], initial=half), float(estimate.lower[place]))
    high = min(theta + np.min(room[slopes < 0], initial=half), float(estimate.upper[place]))
    return low, high


def evaluate_moved(estimate: JudgedFit, place: int, value: float) -> float:
    """Return J with one unknown moved, by evaluating the runs that depend on it.

    Parameters
    ----------
    estimate : JudgedFit
    place : int
    value : float
    """
    evaluator = estimate.evaluator_at_solution()
    problem = evaluator.problem
    moved = estimate.theta.copy()
    moved[place] = value
    runs = [e for e, places in enumerate(problem.places) if place in places]

    def add_up(theta: FloatArray) -> float:
        costs = [evaluator.engines[e].cost(*problem.vectors(theta, e)) for e in runs]
        return sum(costs) + float(problem.unknowns.priors.evaluate(theta)[0])

    # The difference of the runs that depend on it, added to J of all: the others are not evaluated.
    total = estimate.cost + add_up(moved) - add_up(estimate.theta)
    return float(total) if np.isfinite(total) else np.nan
