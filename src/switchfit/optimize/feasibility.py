"""Feasible trial points, which lie exactly on each bound, breakpoint and row that a step reaches up to rounding.

A coordinate that misses a breakpoint by an ulp would count as beside it for ever, and a mode that lasts an ulp as one
that has not collapsed. So steps are moved onto what they reach, and violations of the size of rounding are removed.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from switchfit.arrays import BoolArray, FloatArray
from switchfit.optimize.algebra import EPS, largest, project_on_row
from switchfit.optimize.linear_constraints import LinearConstraints
from switchfit.optimize.minimization_problem import MinimizationProblem


def feasible_start(problem: MinimizationProblem, theta: FloatArray) -> Trial:
    """Return the start theta (d,) with violations of the size of rounding removed; ValueError for larger ones."""
    constraints = problem.constraints
    start = move(problem, theta, np.zeros(theta.size), np.abs(theta))
    if start.far:
        return start
    slack = constraints.slack(theta)
    if (slack < 0.0).any():
        (A, b), size = constraints.sizes, np.maximum(np.abs(theta), problem.size)
        size = np.concatenate([b + A @ size, size, size])
        violated = np.flatnonzero(slack < -1e-12 * (size + np.finfo(float).tiny))
        if violated.size:
            worst = [f"{constraints.names[i]} (by {-slack[i]:.3g})" for i in violated[:5]]
            raise ValueError(f"The start violates {', '.join(worst)}; start at a feasible point.")
    return start


class Trial(NamedTuple):
    """A feasible theta (d,) with its slack (m + 2 d,), and whether it is known to be far from all constraints.

    `on_breakpoint` lists the coordinates that sit exactly on one of their breakpoints.
    """

    theta: FloatArray
    slack: FloatArray
    far: bool
    on_breakpoint: list[int]

    def is_at(self, theta: FloatArray) -> bool:
        """Return whether the trial is another point (d,), number by number."""
        return bool(self.theta.tolist() == theta.tolist())

    @classmethod
    def at(cls, problem: MinimizationProblem, theta: FloatArray) -> Trial:
        """Return the trial at a theta (d,) that is feasible."""
        return cls(theta, problem.constraints.slack(theta), False, problem.breakpoints.find_met(theta))


def move(problem: MinimizationProblem, theta: FloatArray, step: FloatArray, scale: FloatArray) -> Trial:
    """Return theta + step (d,), feasible, and bit for bit on a bound, breakpoint or row that it reaches up to rounding.

    Rounding is measured by the typical size of an unknown too: a time that is 1e-30 after the start of the horizon is
    at its start, and no step along it could ever be told from none. `scale` (d,) is the size of the unknowns so far,
    that of theta included.
    """
    constraints = problem.constraints
    moved = theta + step
    on_breakpoint = problem.breakpoints.snap(moved, theta, step, problem.size)
    slack = constraints.slack(moved)
    # The usual case: no constraint within reach of the step, and nothing to be done bit by bit.
    if constraints.are_far(slack, largest(scale + np.abs(step)) + largest(problem.size)):
        return Trial(moved, slack, True, on_breakpoint)
    lower, upper = constraints.lower, constraints.upper
    reach = np.maximum(np.maximum(np.abs(theta), np.abs(step)), np.abs(moved))
    # Rounding of theta + step, of the largest of the three numbers; a coordinate that does not move has none of its
    # own, and is on its bound only within that of its size.
    near = 8 * EPS * np.maximum((step != 0.0) * reach, problem.size)
    moved = np.where(moved - near <= lower, lower, np.where(moved + near >= upper, upper, moved))
    if (constraints.A @ moved - constraints.b > 16 * EPS * (constraints.sizes[0] @ problem.size)).all():
        return Trial.at(problem, moved)
    pinned = (moved == lower) | (moved == upper)
    # What is on a bound or a breakpoint stays there: rows that miss by rounding are repaired by the other unknowns. Two
    # transitions that meet at a sample time both end on its bits.
    pinned[on_breakpoint] = True
    return Trial.at(problem, snap_to_rows(problem, _repair(constraints, moved, pinned), pinned))


def snap_to_rows(
    problem: MinimizationProblem, theta: FloatArray, pinned: BoolArray, reach: float = 16 * EPS
) -> FloatArray:
    """Return theta (d,) with the slack of rows removed that is at most `reach` of the size of what they join.

    Only of rows that can hold exactly: that bound one coordinate, ``+-theta_i >= b``, or keep two in order,
    ``theta_i - theta_j >= 0``. Coordinates that are pinned (d,) stay where they are.
    """
    constraints = problem.constraints
    slack = constraints.A @ theta - constraints.b
    close = np.abs(slack) <= reach * (constraints.sizes[0] @ problem.size)
    # All of them hold exactly already, or none is close.
    if not slack[close].any():
        return theta
    snapped, fixed = theta.copy(), pinned.copy()
    # Rows that bound one coordinate come first: then chains of times in order follow from what is fixed.
    rows = sorted(constraints.exact_rows(np.flatnonzero(close)), key=lambda row: row[1] >= 0)
    for _ in rows:  # a coordinate that moves may leave a row that held
        before = snapped.copy()
        for i, j, bound in rows:
            if j < 0:
                snapped[i], fixed[i] = bound, True
            elif fixed[i] and not fixed[j]:
                snapped[j], fixed[j] = snapped[i], True
            elif not fixed[i]:
                snapped[i], fixed[i] = snapped[j], fixed[j]
        if np.array_equal(snapped, before):
            break
    snapped = np.clip(snapped, constraints.lower, constraints.upper)
    # A chain of times between two bounds that differ by rounding leaves no better point.
    return snapped if constraints.violation(snapped) <= constraints.violation(theta) else theta


def _repair(constraints: LinearConstraints, theta: FloatArray, pinned: BoolArray) -> FloatArray:
    """Remove violations of the rows that are due to rounding, leaving pinned coordinates where they are.

    Projections onto one violated row after the other, an ulp to its inside. What they cannot remove where many rows
    meet at a vertex is left: it is of the size of rounding too.
    """
    repaired = theta.copy()
    # A projection onto one row may leave another by an ulp: a few rounds, of which the best point counts.
    for _ in range(6):
        for normal, bound in zip(constraints.A, constraints.b, strict=True):
            inside = np.where(pinned, 0.0, normal)
            violation, projected = project_on_row(repaired, normal, bound, inside)
            if violation > 0.0:
                repaired = projected
        repaired = np.clip(repaired, constraints.lower, constraints.upper)
        if constraints.violation(repaired) <= 0.0:
            break
    return min(repaired, theta, key=constraints.violation)
