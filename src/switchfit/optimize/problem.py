"""The optimization problem: the caller's function, constraints, breakpoints and settings; and feasible steps."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from switchfit.optimize.algebra import EPS, BoolArray, FloatArray, IntArray, largest, project_on_row
from switchfit.optimize.qp import LinearConstraints

HessianKind = Literal["auto", "exact", "descent-first", "block-diagonal", "gauss-newton", "none"]
"""Matrix of the quadratic program:

- "auto": the exact Hessian inside a trust region (`box`);
- "exact": the exact Hessian, made positive definite where needed, with a line search;
- "descent-first": the exact Hessian where it is positive definite, and steepest descent until then (Section II-A of the
  paper);
- "block-diagonal": "exact" without the entries between different blocks;
- "gauss-newton": "exact", for a caller whose evaluations return the Gauss-Newton matrix;
- "none": steepest descent in the metric of theta, as in the paper.
"""

Evaluate = Callable[..., Any]
"""``evaluate(theta, side)`` returns ``cost`` J, ``gradient`` (d,), and ``hessian``: (d, d), an `Arrow`, or None.

`side` is +1 or -1: the one-sided derivatives to return for coordinates that sit exactly on a breakpoint. If the
Hessian is an `Arrow`, the time of an iteration is linear in d. A cost or derivative that is not finite makes a point
unacceptable. With equality constraints c, ``evaluate(theta, side, multipliers)`` returns these too, ``constraints``
(k,), with their derivatives, ``jacobian`` (k, d); the Hessian is that of the Lagrangian ``J + multipliers . c``.
"""

Idle = Callable[[FloatArray, bool], BoolArray]
"""``idle(theta, everything)`` returns which coordinates, (d,), may be held at a theta with active rows.

J depends on none of them while these rows are active, whatever their derivatives are, which have the error of the
evaluation. Unless `everything`, only those that are found without an evaluation are needed.
"""


@dataclass(frozen=True, eq=False)
class Problem:
    """A problem with its settings, which the caller has checked.

    Attributes
    ----------
    evaluate : callable
        Cost, gradient and Hessian, and equality constraints if there are any.
    constraints : LinearConstraints
        ``A theta >= b`` and bounds.
    breakpoints : Breakpoints
    hessian : HessianKind
    labels : array, shape (d,), or None
        Labels of the blocks, where the Hessian is cut into blocks ("block-diagonal").
    tolerance : float
        Bound on the KKT residual. Unless `hessian` is "none", the next step has to be negligible too: at most 1e-10 of
        the size of each unknown, or a few iterations later.
    max_iterations : int
    size : array, shape (d,)
        Typical size of each unknown, to which rounding errors are relative; zero if only its values are known. For a
        time this is the length of the horizon, even if the time itself is small.
    idle : callable or None
        Finds the coordinates on which J does not depend.
    reach : array, shape (d,)
        Largest change of each unknown in the first step inside a trust region.
    equalities : tuple of str
        Names of the equality constraints c(theta) = 0; empty if there are none.
    accuracy : callable or None
        Returns the relative accuracy of J, which may be known only after some evaluations: the minimum is found where
        less is to be gained. None where it is that of rounding.
    """

    evaluate: Evaluate
    constraints: LinearConstraints
    breakpoints: Breakpoints
    hessian: HessianKind
    labels: FloatArray | None
    tolerance: float
    max_iterations: int
    size: FloatArray
    idle: Idle | None
    reach: FloatArray
    equalities: tuple[str, ...]
    accuracy: Callable[[], float] | None

    @property
    def has_region(self) -> bool:
        """Whether steps are searched for in a trust region, in which equality constraints always are."""
        return self.hessian == "auto" or bool(self.equalities)

    @property
    def uses_hessian(self) -> bool:
        """Whether the quadratic programme uses the Hessian."""
        return self.hessian != "none"

    def rows_hold(self, active: IntArray) -> bool:
        """Return whether rows are among the active constraints, and not bounds alone; these are in ascending order."""
        return bool(active.size and active[0] < self.constraints.b.size)


@dataclass(frozen=True, eq=False)
class Breakpoints:
    """Values of coordinates where the derivatives of J may jump: the coordinate, and its values in ascending order.

    Lists of numbers: bisecting a list takes a tenth of the time of a NumPy call, and it is done for one number at a
    time.
    """

    of_coordinates: tuple[tuple[int, list[float]], ...]

    @classmethod
    def of(cls, given: Sequence[ArrayLike]) -> Breakpoints:
        """Return those of one ascending array for each coordinate; coordinates may share one, which is read once."""
        each = {id(points): points for points in given}
        read = {key: np.asarray(points, dtype=float).tolist() for key, points in each.items()}
        return cls(tuple((i, read[id(points)]) for i, points in enumerate(given) if read[id(points)]))

    def find_met(self, theta: FloatArray) -> list[int]:
        """Return the coordinates of theta (d,) that sit exactly on one of their breakpoints."""
        values = theta.tolist()
        return [
            i
            for i, points in self.of_coordinates
            if (k := bisect_left(points, values[i])) < len(points) and points[k] == values[i]
        ]

    def snap(self, moved: FloatArray, theta: FloatArray, step: FloatArray, size: FloatArray) -> list[int]:
        """Put coordinates of ``moved = theta + step`` (d,) onto the breakpoints that they reach up to rounding.

        Rounding is a part of what is added, and of the typical `size` (d,). Returns the coordinates that were near one.
        """
        found = []
        values, starts, steps, sizes = moved.tolist(), theta.tolist(), step.tolist(), size.tolist()
        for i, points in self.of_coordinates:
            x, by = values[i], steps[i]
            above = bisect_left(points, x)
            if above == len(points) or (above > 0 and x - points[above - 1] <= points[above] - x):
                above -= 1
            mark = points[above]
            reach = max(abs(starts[i]), abs(by), abs(x)) if by != 0.0 else 0.0
            if abs(mark - x) <= 8 * EPS * max(reach, sizes[i]):
                moved[i] = mark
                found.append(i)
        return found

    def count_crossed(self, theta: FloatArray, step: FloatArray) -> int:
        """Return the largest number of breakpoints that a coordinate passes strictly inside a step (d,)."""
        largest = 0
        starts, ends = theta.tolist(), (theta + step).tolist()
        for i, points in self.of_coordinates:
            low, high = (starts[i], ends[i]) if starts[i] <= ends[i] else (ends[i], starts[i])
            largest = max(largest, bisect_left(points, high) - bisect_right(points, low))
        return largest

    def piece(self, theta: FloatArray, constraints: LinearConstraints) -> tuple[FloatArray, FloatArray]:
        """Return the smooth piece around theta: bounds (d,) tightened to the next breakpoint on either side."""
        low, high = constraints.lower.copy(), constraints.upper.copy()
        for i, points in self.of_coordinates:
            below, above = bisect_left(points, theta[i]), bisect_right(points, theta[i])
            if below > 0:
                low[i] = max(low[i], points[below - 1])
            if above < len(points):
                high[i] = min(high[i], points[above])
        return low, high


def feasible_start(problem: Problem, theta: FloatArray) -> Trial:
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
    def at(cls, problem: Problem, theta: FloatArray) -> Trial:
        """Return the trial at a theta (d,) that is feasible."""
        return cls(theta, problem.constraints.slack(theta), False, problem.breakpoints.find_met(theta))


def move(problem: Problem, theta: FloatArray, step: FloatArray, scale: FloatArray) -> Trial:
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
    near = 8 * EPS * np.maximum((step != 0.0) * reach, problem.size)
    moved = np.where(moved - near <= lower, lower, np.where(moved + near >= upper, upper, moved))
    if (constraints.A @ moved - constraints.b > 16 * EPS * (constraints.sizes[0] @ problem.size)).all():
        return Trial.at(problem, moved)
    pinned = (moved == lower) | (moved == upper)
    pinned[on_breakpoint] = True
    return Trial.at(problem, snap_to_rows(problem, _repair(constraints, moved, pinned), pinned))


def snap_to_rows(problem: Problem, theta: FloatArray, pinned: BoolArray, reach: float = 16 * EPS) -> FloatArray:
    """Return theta (d,) with the slack of rows removed that is at most `reach` of the size of what they join.

    Only of rows that can hold exactly: that bound one coordinate, ``+-theta_i >= b``, or keep two in order,
    ``theta_i - theta_j >= 0``. Coordinates that are pinned (d,) stay where they are.
    """
    constraints = problem.constraints
    slack = constraints.A @ theta - constraints.b
    close = np.abs(slack) <= reach * (constraints.sizes[0] @ problem.size)
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
    return snapped if constraints.violation(snapped) <= constraints.violation(theta) else theta


def _repair(constraints: LinearConstraints, theta: FloatArray, pinned: BoolArray) -> FloatArray:
    """Remove violations of the rows that are due to rounding, leaving pinned coordinates where they are.

    Projections onto one violated row after the other, an ulp to its inside. What they cannot remove where many rows
    meet at a vertex is left: it is of the size of rounding too.
    """
    repaired = theta.copy()
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
