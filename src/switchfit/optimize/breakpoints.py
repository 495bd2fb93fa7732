"""Breakpoints: values of coordinates at which the derivatives of the cost may jump.

Of a transition time these are the nodes of the mesh: all samples and knots, at most of which J has no visible kink. So
they are no bounds of steps: a step that fails is cut at them (`line_search`), and a point that ends on one has two
one-sided derivatives (`oracle`).
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from switchfit.arrays import FloatArray
from switchfit.optimize.algebra import EPS
from switchfit.optimize.linear_constraints import LinearConstraints


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
            # The nearer of the two neighbours of x.
            above = bisect_left(points, x)
            if above == len(points) or (above > 0 and x - points[above - 1] <= points[above] - x):
                above -= 1
            mark = points[above]
            reach = max(abs(starts[i]), abs(by), abs(x)) if by != 0.0 else 0.0
            # theta + (mark - theta) is not always `mark` in floating point: it may miss it by an ulp of the largest
            # number on the way. Beside the breakpoint the coordinate would be in a piece of the length of an ulp, with
            # the derivatives of that one.
            if abs(mark - x) <= 8 * EPS * max(reach, sizes[i]):
                moved[i] = mark
                found.append(i)
        return found

    def count_crossed(self, theta: FloatArray, step: FloatArray) -> int:
        """Return the largest number of breakpoints that a coordinate passes strictly inside a step (d,)."""
        largest = 0
        starts, ends = theta.tolist(), (theta + step).tolist()
        for i, points in self.of_coordinates:
            # Strictly inside: a step from a breakpoint, or to one, does not pass it.
            low, high = (starts[i], ends[i]) if starts[i] <= ends[i] else (ends[i], starts[i])
            largest = max(largest, bisect_left(points, high) - bisect_right(points, low))
        return largest

    def piece(self, theta: FloatArray, constraints: LinearConstraints) -> tuple[FloatArray, FloatArray]:
        """Return the smooth piece around theta: bounds (d,) tightened to the next breakpoint on either side."""
        low, high = constraints.lower.copy(), constraints.upper.copy()
        for i, points in self.of_coordinates:
            # On a breakpoint both neighbours bound it: the side is what `search_direction` adds.
            below, above = bisect_left(points, theta[i]), bisect_right(points, theta[i])
            if below > 0:
                low[i] = max(low[i], points[below - 1])
            if above < len(points):
                high[i] = min(high[i], points[above])
        return low, high
