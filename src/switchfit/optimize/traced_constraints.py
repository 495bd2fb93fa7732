"""Linear constraints and breakpoints for the SQP that JAX traces, and feasible moves among them.

The traced counterparts of `linear_constraints`, `breakpoints` and `feasibility`, with arrays of fixed shapes and all
constraints in place of those that matter.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax

from switchfit.arrays import IntArray, Traced
from switchfit.optimize import algebra


class TracedConstraints(NamedTuple):
    """``A theta >= b`` and bounds, infinite where there is none: (m, d), (m,), (d,), (d,).

    `size` (d,) is the typical size of each unknown, of which rounding is a part, as of `minimize`.
    """

    A: Traced
    b: Traced
    lower: Traced
    upper: Traced
    size: Traced | float = 0.0

    @property
    def normals(self) -> Traced:
        """Inward normals of rows, lower and upper bounds: (m + 2 d, d)."""
        identity = jnp.eye(self.lower.shape[0])
        return jnp.concatenate([self.A, identity, -identity])


class TracedBreakpoints(NamedTuple):
    """Values of coordinates where the derivatives of J may jump.

    Attributes
    ----------
    coordinates : (k,) int
        Places in theta.
    points : (k, n)
        Ascending; infinite, or the last one again, where a coordinate has fewer than others.
    """

    coordinates: IntArray
    points: Traced

    def _rank(self, theta: Traced) -> tuple[Traced, Traced]:
        """Return how many breakpoints lie below each of the coordinates, and how many below or on it: (k,), (k,)."""
        x = theta[self.coordinates, None]
        return jnp.sum(self.points < x, axis=1), jnp.sum(self.points <= x, axis=1)

    def on_one(self, theta: Traced) -> Traced:
        """Return which coordinates sit exactly on a breakpoint: (d,) of bool."""
        below, up_to = self._rank(theta)
        return jnp.zeros(theta.shape, bool).at[self.coordinates].set(up_to > below)

    def count_crossed(self, theta: Traced, to: Traced) -> Traced:
        """Return the largest number of breakpoints strictly between two points in one coordinate."""
        below, up_to = self._rank(theta)
        below_to, up_to_to = self._rank(to)
        # Points below the end less those below or on the start: strictly inside a step to the right; or to the left.
        return jnp.max(jnp.maximum(below_to - up_to, below - up_to_to), initial=0)

    def piece(self, theta: Traced, constraints: TracedConstraints) -> tuple[Traced, Traced]:
        """Return the bounds (d,), (d,) narrowed to the next breakpoint on either side of theta."""
        where, x = self.coordinates, theta[self.coordinates, None]
        below = jnp.max(jnp.where(self.points < x, self.points, -jnp.inf), axis=1, initial=-jnp.inf)
        above = jnp.min(jnp.where(self.points > x, self.points, jnp.inf), axis=1, initial=jnp.inf)
        return constraints.lower.at[where].max(below), constraints.upper.at[where].min(above)

    def snap(self, moved: Traced, theta: Traced, step: Traced, size: Traced) -> Traced:
        """Return ``moved = theta + step``, exactly on the breakpoints that it reaches up to rounding: (d,)."""
        where, x = self.coordinates, moved[self.coordinates]
        # A sum of floats that should be a breakpoint misses it by an ulp or two, and would count as beside it for ever:
        # within 8 EPS of the largest number that was rounded on the way, it is put on it.
        nearest = jnp.argmin(jnp.abs(self.points - x[:, None]), axis=1)
        mark = self.points[jnp.arange(len(where)), nearest]
        reach = jnp.maximum(jnp.maximum(jnp.abs(theta), jnp.abs(step)), jnp.abs(moved))
        rounding = 8 * algebra.EPS * jnp.maximum(jnp.where(step != 0.0, reach, 0.0), size)
        return moved.at[where].set(jnp.where(jnp.abs(mark - x) <= rounding[where], mark, x))


def find_active(constraints: TracedConstraints, theta: Traced, scale: Traced) -> Traced:
    """Return which constraints hold with equality up to rounding: (m + 2 d,) bool."""
    size = jnp.maximum(jnp.maximum(scale, constraints.size), jnp.abs(theta))
    slack = algebra.slack(constraints, theta, jnp)
    return algebra.is_active(slack, size, jnp.abs(constraints.A), jnp.abs(constraints.b), jnp)


def move_traced(constraints: TracedConstraints, breakpoints: TracedBreakpoints, theta: Traced, step: Traced) -> Traced:
    """Return theta + step, on the breakpoints that it reaches, with violations of the size of rounding removed."""

    def project(i: int, moved: Traced) -> Traced:
        normal, bound = constraints.A[i], constraints.b[i]
        # A step of the programme ends on a row up to rounding: what is outside by that much is moved onto it, row by
        # row.
        violation, projected = algebra.project_on_row(moved, normal, bound, normal, jnp)
        return jnp.where(violation > 0.0, projected, moved)

    moved = breakpoints.snap(theta + step, theta, step, jnp.broadcast_to(constraints.size, theta.shape))
    moved = jnp.clip(moved, constraints.lower, constraints.upper)
    # All rows in turn, once; `feasibility` goes round a few times, and only where rows are near.
    rows = constraints.b.shape[0]
    if not rows:
        return moved
    violated = jnp.any(constraints.A @ moved < constraints.b)
    moved = lax.cond(violated, lambda: lax.fori_loop(0, rows, project, moved), lambda: moved)
    return jnp.clip(moved, constraints.lower, constraints.upper)
